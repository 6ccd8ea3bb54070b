"""Export of runs as .ply files: all Gaussians, only the moving or only the static ones; at one time or at many."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

import torch

from dyngs.colour.bake import with_harmonics
from dyngs.errors import DyngsError
from dyngs.files.temporary import temporary_folder_beside
from dyngs.runs.checkpoint import LoadedRun, load_run
from dyngs.scene import Scene
from dyngs.splats.ply import write_ply

Part = Literal["all", "moving", "still"]


def export_ply(run_dir: Path, path: Path) -> Path:
    """Write the newest checkpoint of a run as .ply, at time 0; see ``write_run_ply``. Return the path.

    Raises:
        DyngsError: no such run, no checkpoint, or the file cannot be written.
    """
    return write_run_ply(load_run(run_dir), path)


def write_run_ply(run: LoadedRun, path: Path, time: float = 0.0, part: Part = "all") -> Path:
    """Write a run as .ply and return the path.

    A 3D filter is fused; the header states the render mode, and the time if something moves.

    Args:
        run: a trained model.
        path: output file; an old one is replaced when the new one is complete.
        time: scene time in [0, 1].
        part: all Gaussians, or only the moving or static ones.

    Raises:
        DyngsError: the part is empty, or the file cannot be written.
    """
    return _write(run, scene_part(run.scene, part), path, time)


def write_run_ply_sequence(run: LoadedRun, folder: Path, times: Sequence[float], part: Part = "all") -> list[Path]:
    """Write a sequence ``frame_0000.ply`` and so on, one file per time, for players; return the paths.

    All files are written into a hidden folder first and appear together, so that a failed export leaves no incomplete
    sequence behind.

    Args:
        run: a trained model.
        folder: output folder, created if missing. Files of an earlier sequence of the same length are replaced.
        times: T >= 1 times in [0, 1].
        part: as in ``write_run_ply``.

    Raises:
        DyngsError: the part is empty, the folder holds other .ply files, or the files cannot be written.
    """
    scene = scene_part(run.scene, part)
    names = frame_names(len(times))
    _require_no_others(folder, names)
    is_new = not folder.exists()
    staging = temporary_folder_beside(folder / "frames")
    try:
        for name, time in zip(names, times, strict=True):
            _write(run, scene, staging / name, time)
        for name in names:
            os.replace(staging / name, folder / name)
        staging.rmdir()
    except OSError as error:
        raise DyngsError(f"cannot write the sequence {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
        if is_new:
            with suppress(OSError):
                folder.rmdir()  # only succeeds while it is empty
    return [folder / name for name in names]


def frame_names(count: int) -> list[str]:
    """Return ``frame_0000.ply`` and so on, with at least four digits and names in the order of the frames."""
    digits = max(4, len(str(count - 1)))
    return [f"frame_{i:0{digits}d}.ply" for i in range(count)]


def scene_part(scene: Scene, part: Part) -> Scene:
    """Return a part of a scene. Raises DyngsError if it is empty."""
    if part == "all":
        return scene
    found = scene.part(part)
    if not len(found):
        empty = "every Gaussian of this run moves: it has no still part"
        raise DyngsError("nothing moves in this run: it has no dynamic part" if part == "moving" else empty)
    return found


def _write(run: LoadedRun, scene: Scene, path: Path, time: float) -> Path:
    model = run.config.model
    with torch.no_grad():
        moment = scene.moment(time)
    gaussians, shader = moment.gaussians, scene.shader(moment)
    comments = [f"step: {run.step}"] if scene.is_still else [f"step: {run.step}", f"dyngs time {time!r}"]
    if shader is not None:
        baked = with_harmonics(gaussians, shader)
        gaussians = baked.gaussians
        comments.append(f"colours: harmonics fitted to a network, rms error {baked.error:.4f}")
    return write_ply(
        path, gaussians, model.rasterize_mode, comments, eps2d=model.eps2d, world_offset=run.info.world_offset
    )


def _require_no_others(folder: Path, names: Sequence[str]) -> None:
    """Check that the folder holds no .ply files that players would take for frames.

    Raises:
        DyngsError: there is a file that is not among ``names``, or the folder is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise DyngsError(f"{folder}: is a file, but a sequence needs a folder")
    others = sorted(f.name for f in folder.glob("[!.]*.ply") if f.name not in names)
    if others:
        raise DyngsError(
            f"{folder}: holds other .ply files ({others[0]}), which players would take for frames; give an empty folder"
        )
