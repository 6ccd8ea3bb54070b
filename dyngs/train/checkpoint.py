"""Checkpoints and run folders.

A run folder holds ``config.yaml`` (resolved), ``checkpoints/step_0007000.safetensors``, ``timing.json`` and
``log.jsonl``. Equal runs write equal checkpoint bytes: wall time is kept in ``timing.json``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.colour.network import network_of
from dyngs.config import Config, HumanModel, HumanNetModel, SceneModel
from dyngs.config_io import load_resolved
from dyngs.data.write import write_text
from dyngs.deform.trained import trained_scene
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.human.trained import trained_avatar
from dyngs.storage.file import read_scene
from dyngs.train.scene import Scene
from dyngs.train.tensor_file import FileKind, read_tensors, write_tensors

KEEP_CHECKPOINTS = 2
COMPACT_NAME = "scene.dyngs"
"""Of the file that holds a run that is done in little space, see ``dyngs.storage``."""
_KIND = FileKind("dyngs", "a checkpoint", 1)
_FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


@dataclass(frozen=True)
class CheckpointInfo:
    """What a checkpoint says of itself.

    Attributes:
        step: steps done.
        extent: of the scene, world units.
        world_offset: add it to the means to get the capture's own coordinates.
        background: resolved choice: "white", "black" or "random".
        rasterize_mode: how the Gaussians want to be drawn.
    """

    step: int
    extent: float
    world_offset: tuple[float, float, float]
    background: str
    rasterize_mode: str


@dataclass(frozen=True)
class Checkpoint:
    """Everything that a run needs to go on: named tensors and a few values."""

    info: CheckpointInfo
    tensors: dict[str, Tensor]

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The tensors whose names start with ``prefix.``, without it."""
        return {name[len(prefix) + 1 :]: x for name, x in self.tensors.items() if name.startswith(f"{prefix}.")}


@dataclass(frozen=True)
class LoadedRun:
    """A trained model, ready to be drawn.

    Attributes:
        config: the resolved configuration.
        scene: what is drawn at any time.
        step, seconds_train: how far and how long it was trained (0 s where ``timing.json`` is lost).
        info: of the checkpoint.
    """

    config: Config
    scene: Scene
    step: int
    seconds_train: float
    info: CheckpointInfo


def checkpoint_paths(run_dir: Path) -> list[Path]:
    """The run's checkpoints, oldest first."""
    folder = run_dir / "checkpoints"
    return sorted(f for f in folder.glob("step_*.safetensors") if re.fullmatch(r"step_\d+", f.stem))


def save_checkpoint(run_dir: Path, checkpoint: Checkpoint, seconds_train: float) -> Path:
    """The new checkpoint's path; written atomically, the oldest but ``KEEP_CHECKPOINTS`` are then removed.

    Raises:
        DyngsError: a model with values that are not finite (earlier checkpoints stay), a full disk, and the like.
    """
    tensors = {name: x.detach().contiguous() for name, x in checkpoint.tensors.items()}
    for name, x in tensors.items():
        if name.startswith(("gaussians.", "model.")) and not bool(torch.isfinite(x).all()):
            field, step = name.removeprefix("gaussians.").removeprefix("model."), checkpoint.info.step
            raise DyngsError(f"{run_dir}: {field} is not finite after step {step}; not saved. {last_good(run_dir)}")
    path = run_dir / "checkpoints" / f"step_{checkpoint.info.step:07d}.safetensors"
    write_tensors(path, _KIND, tensors, asdict(checkpoint.info), ", then `dyngs train --resume`")
    _write_seconds(run_dir, checkpoint.info.step, seconds_train)
    for old in checkpoint_paths(run_dir)[:-KEEP_CHECKPOINTS]:
        old.unlink(missing_ok=True)
    return path


def load_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in ``path``.

    Raises:
        DyngsError: a file that is missing, truncated, altered, or of another version; names an older one if there is.
    """
    header, tensors = read_tensors(path, _KIND, _instead_of(path))
    return Checkpoint(info_of(header), tensors)


def info_of(header: Mapping[str, Any]) -> CheckpointInfo:
    """What the header of a file says.

    Raises:
        KeyError: something lacks.
    """
    x, y, z = header["world_offset"]
    return CheckpointInfo(header["step"], header["extent"], (x, y, z), header["background"], header["rasterize_mode"])


def latest_checkpoint(run_dir: Path) -> Checkpoint:
    """The newest checkpoint of a run. Raises DyngsError if there is none or it is damaged."""
    paths = checkpoint_paths(run_dir)
    if not paths:
        raise DyngsError(f"{run_dir}: no checkpoints there; give the folder of a run that has trained")
    return load_checkpoint(paths[-1])


def load_run(run_dir: Path) -> LoadedRun:
    """The model of a run folder at its newest checkpoint, or of its compact file where it has no checkpoints.

    Raises:
        DyngsError: no run folder, no checkpoint, or a damaged one.
    """
    config = load_resolved(run_dir)
    if isinstance(config.model, HumanNetModel):
        raise DyngsError(f"{run_dir}: a network, not a scene; `dyngs predict {run_dir} CAPTURE --out RUN` makes one")
    checkpoint = _compact_checkpoint(run_dir) if is_compact(run_dir) else latest_checkpoint(run_dir)
    scene = stored_scene(checkpoint, config.model)
    step = checkpoint.info.step
    return LoadedRun(config, scene, step, seconds_at(run_dir, step), checkpoint.info)


def is_compact(run_dir: Path) -> bool:
    """Whether the run is only there as the file that ``dyngs export --format compact`` writes."""
    return (run_dir / COMPACT_NAME).is_file() and not checkpoint_paths(run_dir)


def _compact_checkpoint(run_dir: Path) -> Checkpoint:
    """What drawing needs; it cannot be trained on."""
    stored = read_scene(run_dir / COMPACT_NAME)
    return Checkpoint(CheckpointInfo(**stored.info.model_dump()), stored.tensors)


def stored_scene(checkpoint: Checkpoint, model: SceneModel) -> Scene:
    """The scene of a checkpoint of ``model``."""
    part = checkpoint.part("gaussians")
    try:
        gaussians = Gaussians(**{name: part[name] for name in _FIELDS})
        state = checkpoint.part("model")
        colour = network_of(checkpoint.part("model.colour"))
        if isinstance(model, HumanModel):
            return replace(trained_avatar(gaussians, state), colour=colour)
        return replace(trained_scene(gaussians, state, model), colour=colour)
    except KeyError as missing:
        raise DyngsError(
            f"the checkpoint of step {checkpoint.info.step} lacks {missing}; an earlier version wrote it: train anew"
        ) from None


def last_good(run_dir: Path) -> str:
    """A sentence that names the newest checkpoint, or says that there is none."""
    paths = checkpoint_paths(run_dir)
    return f"The last good checkpoint is {paths[-1]}" if paths else "There is no checkpoint yet"


def seconds_at(run_dir: Path, step: int) -> float:
    """Training time up to the checkpoint of ``step``, over all resumes; 0 where it is not known."""
    return _read_seconds(run_dir).get(str(step), 0.0)


def _read_seconds(run_dir: Path) -> dict[str, float]:
    try:
        stored = json.loads((run_dir / "timing.json").read_text(encoding="utf-8"))
        return {str(step): float(seconds) for step, seconds in stored["seconds_train"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _write_seconds(run_dir: Path, step: int, seconds: float) -> None:
    known = {s: value for s, value in _read_seconds(run_dir).items() if int(s) < step}
    known[str(step)] = round(seconds, 3)
    write_text(run_dir / "timing.json", json.dumps({"seconds_train": known}) + "\n")


def _instead_of(path: Path) -> str:
    """What to do about a damaged checkpoint."""
    older = [p for p in checkpoint_paths(path.parent.parent) if p.name < path.name]
    if older:
        return f"; delete it to go on from the previous one, {older[-1].name}"
    return "; there is no older one, train anew"
