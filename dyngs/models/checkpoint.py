"""The state of a training run that a checkpoint stores."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.core.errors import DyngsError
from dyngs.core.state import part_of
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.data.scene_space import change_coordinates

OTHER_CONFIG = "was its config changed? Otherwise train anew"
"""Advice where a checkpoint and its run do not fit together."""

_SETTINGS = ("model.kind", "model.sh_degree", "model.deform.kind", "colour.kind", "strategy.kind")
_SETTINGS += ("camera.refine", "train.robust", "train.exposure")
"""Keys of the configuration that decide what a checkpoint holds; the first that differs is told."""


def settings_of(config: Config) -> dict[str, Any]:
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


def read_capture_of(data: DataConfig, info: CheckpointInfo) -> Capture:
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
        for name, now in settings_of(config).items():
            before = self.settings.get(name, now)
            if before != now:
                raise DyngsError(
                    f"{self.name}: was trained with {name}={before}, but config.yaml has {name}={now}; "
                    "change it back, or train anew"
                )

    def part(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names start with ``prefix.``, without it."""
        return part_of(self.tensors, prefix)
