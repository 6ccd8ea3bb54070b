"""Checkpoints as values: the state of a training run, and the scene that it describes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.core.section import ModelSection
from dyngs.core.state import select_prefix
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.data.scene_space import change_coordinates
from dyngs.models.kind import find_kind
from dyngs.models.renderable import Renderable

CONFIG_ADVICE = "was its config changed? Otherwise train anew"
"""Advice where a checkpoint and its run do not fit together."""

_MAX_STEP = 2**53
_BACKGROUNDS = ("white", "black", "random")

_SETTINGS = (
    "model.kind",
    "model.sh_degree",
    "model.deform.kind",
    "colour.kind",
    "strategy.kind",
    "camera.refine",
    "train.robust",
    "train.exposure",
)
"""Keys of the configuration that decide what a checkpoint holds."""


def checkpoint_settings(config: Config) -> dict[str, Any]:
    """Return the settings that decide what a checkpoint holds, by dotted key; None where a section
    has no such key."""
    found = {}
    for name in _SETTINGS:
        value: Any = config
        for key in name.split("."):
            value = getattr(value, key, None)
        found[name] = value
    return found


@dataclass(frozen=True)
class CheckpointInfo:
    """Metadata of a checkpoint."""

    step: int
    extent: float  # of the scene, scene units
    world_offset: tuple[float, float, float]  # as ``Capture.world_offset``
    background: str  # resolved choice: "white", "black" or "random"
    rasterize_mode: str  # how the Gaussians want to be drawn
    world_scale: float = 1.0  # as ``Capture.world_scale``


def parse_info(header: Mapping[str, Any]) -> CheckpointInfo:
    """Return the metadata in the header of a file. Raises KeyError, ValueError, TypeError or
    OverflowError."""
    step, (x, y, z) = header["step"], (float(value) for value in header["world_offset"])
    extent = float(header["extent"])
    background = header["background"]
    mode = header["rasterize_mode"]
    # earlier versions trained in the unit of the files
    scale = float(header.get("world_scale", 1.0))
    if isinstance(step, bool) or not isinstance(step, int) or not 0 <= step <= _MAX_STEP:
        raise ValueError(f"its step is {step!r:.60}")
    if (
        not all(math.isfinite(value) for value in (extent, x, y, z, scale))
        or extent < 0
        or scale <= 0
    ):
        raise ValueError("its extent, world_offset or world_scale is not valid")
    if background not in _BACKGROUNDS or mode not in {mode.value for mode in RasterizeMode}:
        raise ValueError(f"its background is {background!r:.60}, its rasterize_mode {mode!r:.60}")
    return CheckpointInfo(step, extent, (x, y, z), background, mode, scale)


def read_run_capture(data: DataConfig, info: CheckpointInfo) -> Capture:
    """Return the capture of a run in the scene coordinates that the run was trained in.

    Those of ``read_capture`` may differ: the capture has changed since, or another version of dyngs
    trained the run.
    """
    return change_coordinates(read_capture(data), info.world_scale, info.world_offset)


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a run needs to go on: named tensors and a few values."""

    info: CheckpointInfo
    tensors: dict[str, Tensor]
    # of the file that it was read from; None: of none
    path: Path | None = field(default=None, compare=False)
    # ``settings_of`` its trainer; empty: not known
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return f"the checkpoint of step {self.info.step}" if self.path is None else str(self.path)

    def require_settings(self, config: Config) -> None:
        """Raise where ``config`` has another value of a setting that decided what the checkpoint
        holds."""
        for name, now in checkpoint_settings(config).items():
            before = self.settings.get(name, now)
            if before != now:
                raise DyngsError(
                    f"{self.name}: was trained with {name}={before}, but config.yaml has {name}={now}; "
                    "change it back, or train anew"
                )

    def part(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names start with ``prefix.``, without it."""
        return select_prefix(self.tensors, prefix)


def restore_model(checkpoint: Checkpoint, model: ModelSection) -> Renderable:
    """Return the scene of a checkpoint of ``model``.

    Raises:
        DyngsError: a tensor is missing, or is not as the model or the other tensors have it; names
            the file.
    """
    with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
        try:
            return find_kind(model).restore(model, checkpoint)
        except KeyError as missing:
            raise DyngsError(f"{checkpoint.name} lacks {missing}; {CONFIG_ADVICE}") from None
