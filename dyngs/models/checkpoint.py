"""The state of a training run that a checkpoint stores."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.data.scene_space import expressed
from dyngs.state import part_of

OTHER_CONFIG = "was its config changed? Otherwise train anew"
"""Advice where a checkpoint and its run do not fit together."""


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

    Those of ``read_capture`` may differ: the capture has changed since, or another version of dyngs trained the run.
    """
    return expressed(read_capture(data), info.world_scale, info.world_offset)


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a run needs to go on: named tensors and a few values."""

    info: CheckpointInfo
    tensors: dict[str, Tensor]
    path: Path | None = field(default=None, compare=False)  # of the file that it was read from; None: of none

    @property
    def name(self) -> str:
        return f"the checkpoint of step {self.info.step}" if self.path is None else str(self.path)

    def part(self, prefix: str) -> dict[str, Tensor]:
        """Return the tensors whose names start with ``prefix.``, without it."""
        return part_of(self.tensors, prefix)
