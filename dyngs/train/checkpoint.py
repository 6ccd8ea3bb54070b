"""Checkpoints and run folders.

A run folder holds ``config.yaml`` (resolved), ``checkpoints/step_0007000.safetensors``, ``timing.json`` and
``log.jsonl``. Equal runs write equal checkpoint bytes: wall time is kept in ``timing.json``.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dyngs.config import Config, HumanModel, SceneModel
from dyngs.config_io import load_resolved
from dyngs.data.write import whole_file, write_text
from dyngs.deform.trained import trained_scene
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.human.trained import trained_avatar
from dyngs.train.scene import Scene

FORMAT_VERSION = 1
KEEP_CHECKPOINTS = 2
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
    header = {"format": FORMAT_VERSION, **asdict(checkpoint.info)}
    header["digest"] = _digest(tensors, header)
    path = run_dir / "checkpoints" / f"step_{checkpoint.info.step:07d}.safetensors"
    with whole_file(path) as temporary:
        try:
            # One key only: the library writes several in random order.
            save_file(tensors, temporary, metadata={"dyngs": json.dumps(header, sort_keys=True)})
        except SafetensorError as error:
            raise DyngsError(f"cannot write {path}: {error}; free some space, then `dyngs train --resume`") from None
    _write_seconds(run_dir, checkpoint.info.step, seconds_train)
    for old in checkpoint_paths(run_dir)[:-KEEP_CHECKPOINTS]:
        old.unlink(missing_ok=True)
    return path


def load_checkpoint(path: Path) -> Checkpoint:
    """The checkpoint in ``path``.

    Raises:
        DyngsError: a file that is missing, truncated, altered, or of another version; names an older one if there is.
    """
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("dyngs", "null"))
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError, ValueError) as error:
        raise DyngsError(f"{path}: cannot be read as a checkpoint ({error}){_instead_of(path)}") from None
    if not isinstance(header, dict) or "format" not in header:
        raise DyngsError(f"{path}: not a checkpoint of dyngs{_instead_of(path)}")
    if header["format"] != FORMAT_VERSION:
        raise DyngsError(f"{path}: written by another version of dyngs; use that version or train anew")
    if header.pop("digest", None) != _digest(tensors, header):
        raise DyngsError(f"{path}: damaged or altered, its checksum differs{_instead_of(path)}")
    x, y, z = header["world_offset"]
    info = CheckpointInfo(header["step"], header["extent"], (x, y, z), header["background"], header["rasterize_mode"])
    return Checkpoint(info, tensors)


def latest_checkpoint(run_dir: Path) -> Checkpoint:
    """The newest checkpoint of a run. Raises DyngsError if there is none or it is damaged."""
    paths = checkpoint_paths(run_dir)
    if not paths:
        raise DyngsError(f"{run_dir}: no checkpoints there; give the folder of a run that has trained")
    return load_checkpoint(paths[-1])


def load_run(run_dir: Path) -> LoadedRun:
    """The model of a run folder at its newest checkpoint.

    Raises:
        DyngsError: no run folder, no checkpoint, or a damaged one.
    """
    config = load_resolved(run_dir)
    checkpoint = latest_checkpoint(run_dir)
    scene = stored_scene(checkpoint, config.model)
    step = checkpoint.info.step
    return LoadedRun(config, scene, step, seconds_at(run_dir, step), checkpoint.info)


def stored_scene(checkpoint: Checkpoint, model: SceneModel) -> Scene:
    """The scene of a checkpoint of ``model``."""
    part = checkpoint.part("gaussians")
    try:
        gaussians = Gaussians(**{name: part[name] for name in _FIELDS})
        state = checkpoint.part("model")
        return (
            trained_avatar(gaussians, state)
            if isinstance(model, HumanModel)
            else trained_scene(gaussians, state, model)
        )
    except KeyError as missing:
        raise DyngsError(f"the checkpoint of step {checkpoint.info.step} lacks {missing}") from None


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


def _digest(tensors: dict[str, Tensor], header: dict[str, object]) -> str:
    """Checksum over the header and the names, types, shapes and bytes of all tensors."""
    total = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        x = tensors[name].contiguous()
        total.update(f"{name} {x.dtype} {tuple(x.shape)}\n".encode())
        total.update(x.reshape(-1).numpy().data)
    return total.hexdigest()


def _instead_of(path: Path) -> str:
    """What to do about a damaged checkpoint."""
    older = [p for p in checkpoint_paths(path.parent.parent) if p.name < path.name]
    if older:
        return f"; delete it to go on from the previous one, {older[-1].name}"
    return "; there is no older one, train anew"
