"""Loggers: programs that show the scalars and progress images of a training."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dyngs.config import Config
from dyngs.core.errors import DyngsError

Values = Mapping[str, float | np.ndarray]


class Logger(Protocol):
    """A program that shows scalars, and images (H, W, 3) uint8, by names such as ``train/psnr``."""

    def log(self, step: int, values: Values) -> None: ...

    def close(self) -> None: ...


class _TensorBoard:
    def __init__(self, config: Config, folder: Path, after_step: int) -> None:
        board: Any = import_module("torch.utils.tensorboard")
        self._writer = board.SummaryWriter(str(folder / "tensorboard"), purge_step=after_step + 1)
        self.close = self._writer.close

    def log(self, step: int, values: Values) -> None:
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                self._writer.add_image(name, value, step, dataformats="HWC")
            else:
                self._writer.add_scalar(name, value, step)


class _Wandb:
    def __init__(self, config: Config, folder: Path, after_step: int) -> None:
        self._wandb: Any = import_module("wandb")
        values = config.model_dump(mode="json")
        self._run = self._wandb.init(
            project="dyngs", name=folder.name, dir=str(folder), config=values
        )
        self.close = self._run.finish

    def log(self, step: int, values: Values) -> None:
        image = self._wandb.Image
        shown = {k: image(x) if isinstance(x, np.ndarray) else x for k, x in values.items()}
        self._run.log(shown, step=step)


class _Rerun:
    def __init__(self, config: Config, folder: Path, after_step: int) -> None:
        self._rerun: Any = import_module("rerun")
        self._stream = self._rerun.RecordingStream("dyngs")
        self._stream.save(folder / f"after_step_{after_step}.rrd")
        self.close = self._stream.flush

    def log(self, step: int, values: Values) -> None:
        self._stream.set_time("step", sequence=step)
        for name, value in values.items():
            kind = self._rerun.Image if isinstance(value, np.ndarray) else self._rerun.Scalars
            self._stream.log(name, kind(value))


_LOGGERS = {"tensorboard": _TensorBoard, "wandb": _Wandb, "rerun": _Rerun}


def require_loggers(config: Config) -> None:
    """Raise DyngsError if the package of a logger is not installed."""
    for name in config.train.loggers:
        if find_spec(name) is None:
            raise DyngsError(
                f"train.loggers={name} needs a package; run pip install 'dyngs[{name}]'"
            )


def open_loggers(config: Config, folder: Path, after_step: int) -> list[Logger]:
    """Open the loggers of ``train.loggers``. Raises DyngsError: one cannot be started."""
    found: list[Logger] = []
    for name in config.train.loggers:
        try:
            found.append(_LOGGERS[name](config, folder, after_step))
        except Exception as error:
            raise DyngsError(f"train.loggers={name} cannot be started: {error}") from error
    return found
