"""Checkpoints and run folders.

A run folder holds ``config.yaml`` (resolved), ``checkpoints/step_0007000.safetensors``,
``timing.json`` and ``log.jsonl``. Equal runs write equal checkpoint bytes: wall time is kept in
``timing.json``.
"""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, quote_path, wrap_read_errors
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.io.fields import read_limited
from dyngs.io.tensor_file import FileKind, read_tensors, write_tensors
from dyngs.io.write import write_text
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo, parse_info, restore_model
from dyngs.models.kind import PredictsScenes, capability
from dyngs.models.renderable import Renderable
from dyngs.runs.stored_file import read_scene

KEEP_CHECKPOINTS = 2
TIMING_NAME = "timing.json"
_MOST_TIMING_BYTES = 1 << 20
SCENE_FILE = "scene.dyngs"
"""Name of the .dyngs file that holds a finished run, see ``dyngs.runs.stored_file``."""
_KIND = FileKind("dyngs", "a checkpoint", 1)


@dataclass(frozen=True)
class LoadedRun:
    """A trained model ready for rendering; ``seconds_train`` is 0 without ``timing.json``."""

    config: Config
    renderable: Renderable
    step: int
    seconds_train: float
    info: CheckpointInfo

    @property
    def scene(self) -> GaussianScene:
        """The scene of Gaussians. Raises DyngsError for other kinds of model."""
        return require_gaussians(self.renderable, f"a run of model.kind={self.config.model.kind}")


def checkpoint_paths(run_dir: Path) -> list[Path]:
    """Return the run's checkpoints, oldest first."""
    found = (run_dir / "checkpoints").glob("step_*.safetensors")
    return sorted((f for f in found if re.fullmatch(r"step_[0-9]+", f.stem)), key=checkpoint_step)


def checkpoint_step(path: Path) -> int:
    """Return the step of a checkpoint, from its file name."""
    return int(path.stem.removeprefix("step_"))


def save_checkpoint(run_dir: Path, checkpoint: Checkpoint, seconds_train: float) -> Path:
    """Write a checkpoint atomically, remove all but the newest ``KEEP_CHECKPOINTS``, return its
    path.

    Raises DyngsError: non-finite values in the model (earlier checkpoints are kept), a full disk.
    """
    tensors = {name: x.detach().contiguous() for name, x in checkpoint.tensors.items()}
    for name, x in tensors.items():
        if not bool(torch.isfinite(x).all()):
            field = name.removeprefix("gaussians.").removeprefix("model.")
            step = checkpoint.info.step
            raise DyngsError(
                f"{run_dir}: {field} is not finite after step {step}; not saved. {describe_last_checkpoint(run_dir)}"
            )
    path = run_dir / "checkpoints" / f"step_{checkpoint.info.step:07d}.safetensors"
    # The time is written first: if the process is killed in between, no checkpoint lacks its time.
    _write_seconds(run_dir, checkpoint.info.step, seconds_train)
    header = asdict(checkpoint.info) | {"settings": checkpoint.settings}
    write_tensors(path, _KIND, tensors, header, ", then `dyngs train --resume`")
    for old in checkpoint_paths(run_dir)[:-KEEP_CHECKPOINTS]:
        old.unlink(missing_ok=True)
    return path


def load_checkpoint(path: Path) -> Checkpoint:
    """Load the checkpoint ``path``. Raises DyngsError, which names an older checkpoint if any."""
    header, tensors = read_tensors(path, _KIND, _instead_of(path))
    with wrap_read_errors(path, _instead_of(path).removeprefix("; ")):
        return Checkpoint(parse_info(header), tensors, path, dict(header.get("settings", {})))


def latest_checkpoint(run_dir: Path) -> Checkpoint:
    """Load the newest checkpoint of a run, even during training.

    Raises DyngsError: no checkpoint, or a damaged one.
    """
    while True:
        paths = checkpoint_paths(run_dir)
        if not paths:
            raise DyngsError(f"{run_dir}: no checkpoints found; give the folder of a trained run")
        try:
            return load_checkpoint(paths[-1])
        except DyngsError:
            if os.path.lexists(paths[-1]):  # including broken links
                raise  # otherwise the run has replaced it by a newer checkpoint


def load_run(run_dir: Path, data_root: Path | None = None) -> LoadedRun:
    """Load the model of a run from its newest checkpoint, or from its .dyngs file without
    checkpoints."""
    config = load_resolved(run_dir, data_root=data_root)
    if capability(config.model, PredictsScenes) is not None:
        raise DyngsError(
            f"{run_dir}: a network, not a scene; "
            f"predict a scene with `dyngs predict {quote_path(run_dir)} CAPTURE --out RUN`"
        )
    checkpoint = (
        replace(read_scene(run_dir / SCENE_FILE), path=run_dir / SCENE_FILE)
        if has_only_scene_file(run_dir)
        else latest_checkpoint(run_dir)
    )
    checkpoint.require_settings(config)
    scene = restore_model(checkpoint, config.model)
    step = checkpoint.info.step
    return LoadedRun(config, scene, step, seconds_at(run_dir, step), checkpoint.info)


def has_only_scene_file(run_dir: Path) -> bool:
    """Return whether the folder has a ``scene.dyngs`` but no checkpoints."""
    return (run_dir / SCENE_FILE).is_file() and not checkpoint_paths(run_dir)


def describe_last_checkpoint(run_dir: Path) -> str:
    """Return a sentence that names the newest checkpoint, if any."""
    paths = checkpoint_paths(run_dir)
    return f"The last good checkpoint is {paths[-1]}" if paths else "There is no checkpoint yet"


def seconds_at(run_dir: Path, step: int) -> float:
    """Return the total training time up to the checkpoint of ``step``, seconds; 0 if unknown."""
    return _read_seconds(run_dir).get(str(step), 0.0)


def _read_seconds(run_dir: Path) -> dict[str, float]:
    try:
        stored = json.loads(read_limited(run_dir / TIMING_NAME, _MOST_TIMING_BYTES))
        known = {str(int(step)): float(x) for step, x in stored["seconds_train"].items()}
        return {step: seconds for step, seconds in known.items() if math.isfinite(seconds)}
    except Exception:  # a missing or damaged file only loses the times
        return {}


def _write_seconds(run_dir: Path, step: int, seconds: float) -> None:
    known = {s: value for s, value in _read_seconds(run_dir).items() if int(s) < step}
    known[str(step)] = round(seconds, 3)
    write_text(run_dir / TIMING_NAME, json.dumps({"seconds_train": known}) + "\n")


def _instead_of(path: Path) -> str:
    """Return the advice about a damaged checkpoint, as the end of a message."""
    older = [
        p
        for p in checkpoint_paths(path.parent.parent)
        if checkpoint_step(p) < checkpoint_step(path)
    ]
    if older:
        return f"; delete it to continue from the previous one, {older[-1].name}"
    return "; there is no older checkpoint, train again"
