"""Checkpoints: the state of a training run, and the scene restored from it."""

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

CONFIG_ADVICE = "was its config changed? Otherwise train again"
"""Advice for a checkpoint that does not match the config of its run."""

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
"""Configuration keys that determine the contents of a checkpoint."""


def checkpoint_settings(config: Config) -> dict[str, Any]:
    """Return the settings that determine the contents of a checkpoint, by dotted key; None if a
    section lacks the key."""
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
    rasterize_mode: str  # "classic" or "antialiased"
    world_scale: float = 1.0  # as ``Capture.world_scale``


def parse_info(header: Mapping[str, Any]) -> CheckpointInfo:
    """Parse the metadata in a file header.

    Raises KeyError, ValueError, TypeError or OverflowError for an invalid header.
    """
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


def read_run_capture(
    data: DataConfig, info: CheckpointInfo, capture: Capture | None = None
) -> Capture:
    """Read the capture of a run in the scene coordinates that the run was trained in.

    ``read_capture`` may give other coordinates if the capture or the version of dyngs has changed.
    A given ``capture`` is not read again.
    """
    found = capture or read_capture(data)
    return change_coordinates(found, info.world_scale, info.world_offset)


@dataclass(frozen=True)
class Checkpoint:
    """State of a run from which training resumes: named tensors and metadata."""

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
        """Raise DyngsError if ``config`` differs in a setting of ``checkpoint_settings``."""
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
    """Restore the scene of a checkpoint of ``model``.

    Raises DyngsError: a missing or invalid tensor.
    """
    with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
        try:
            return find_kind(model).restore(model, checkpoint)
        except KeyError as missing:
            raise DyngsError(f"{checkpoint.name} lacks {missing}; {CONFIG_ADVICE}") from None
