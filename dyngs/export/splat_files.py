"""Runs as files of Gaussians: all Gaussians, only the moving or only the static ones; at one time or at many."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from dyngs.errors import DyngsError
from dyngs.files.temporary import temporary_folder_beside
from dyngs.gaussians.colour.bake import with_harmonics
from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened
from dyngs.splats.formats import Written, turned_file, write_splats
from dyngs.splats.rotation import AXES, axis_of, nearest_axis, turn_between
from dyngs.splats.splat_file import SplatFile

Part = Literal["all", "moving", "still"]


@dataclass(frozen=True)
class Writing:
    """How Gaussians are written.

    Attributes:
        turn: unit quaternion wxyz, from the axes of the capture to those of the file.
        up: axis that then points up, such as "-y"; None: not known.
        sh_degree: degree of the harmonics in the file; None: as they are, up to what the format holds.
    """

    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    up: str | None = None
    sh_degree: int | None = None


AS_THEY_ARE = Writing()


def writing_of(
    opened: Opened, target: str, up: str | None = None, from_up: str | None = None, sh_degree: int | None = None
) -> tuple[Writing, str]:
    """Return how a scene is written, and a line about which way is up in the file.

    Args:
        opened: the scene.
        target: axis that viewers of the format take for up.
        up: axis that is requested instead; "keep": nothing is turned.
        from_up: axis that is up in the scene; None: found as ``up_of`` does.
        sh_degree: degree of the harmonics in the file.

    Raises:
        DyngsError: no such axis.
    """
    if up == "keep":
        return Writing(sh_degree=sh_degree), "axes are those of the capture"
    found = (axis_of(from_up), "--from-up") if from_up is not None else up_of(opened)
    wanted = target if up is None else up
    if found is None:
        line = "nothing says which way is up in this run, so axes are those of the capture; --from-up=AXIS tells it"
        return Writing(sh_degree=sh_degree), line
    direction, who = found
    name = nearest_axis(direction)
    here = name if name is not None and AXES[name] == tuple(direction) else "a slanted direction"
    turned = "the axes of the capture are kept" if here == wanted else f"turned, it was {here} in the capture"
    how = Writing(turn_between(direction, axis_of(wanted)), wanted, sh_degree)
    return how, f"up is {wanted} in the file ({turned}, says {who})"


def up_of(opened: Opened) -> tuple[tuple[float, ...], str] | None:
    """Return the direction (3,) that is up and what says so: an axis where one is within 30 degrees; None: nothing."""
    if opened.up is None:
        return None
    found, who = opened.up
    name = nearest_axis(tuple(found.tolist()))
    return (tuple(found.tolist()) if name is None else AXES[name]), who


def write_run_splats(
    opened: Opened, path: Path, time: float = 0.0, part: Part = "all", how: Writing = AS_THEY_ARE
) -> Written:
    """Write a run as a file of Gaussians; its suffix names the format.

    A 3D filter is fused, and colours of a network become harmonics; the header, where the format has one, states the
    render mode, and the time if something moves.

    Args:
        opened: a trained model.
        path: output file; an old one is replaced when the new one is complete.
        time: scene time in [0, 1].
        part: all Gaussians, or only the moving or static ones.
        how: axes, degree of the harmonics.

    Raises:
        DyngsError: the part is empty, an unknown suffix, or the file cannot be written.
    """
    inputs_of(opened).require_output(path)
    return _write(opened, scene_part(opened.scene, part), path, time, how)


def write_run_sequence(
    opened: Opened,
    folder: Path,
    times: Sequence[float],
    part: Part = "all",
    how: Writing = AS_THEY_ARE,
    suffix: str = ".ply",
) -> list[Written]:
    """Write a sequence ``frame_0000.ply`` and so on, one file per time, for players.

    All files are written into a hidden folder first and appear together, so that a failed export leaves no incomplete
    sequence behind.

    Args:
        opened: a trained model.
        folder: output folder, created if missing. Files of an earlier sequence of the same length are replaced.
        times: T >= 1 times in [0, 1].
        part: as in ``write_run_splats``.
        how: axes, degree of the harmonics.
        suffix: of the files, names the format.

    Raises:
        DyngsError: the part is empty, the folder holds other such files, or the files cannot be written.
    """
    scene = scene_part(opened.scene, part)
    names = frame_names(len(times), suffix)
    inputs = inputs_of(opened)
    for path in (folder, *(folder / name for name in names)):
        inputs.require_output(path)
    _require_no_others(folder, names, suffix)
    is_new = not folder.exists()
    staging = temporary_folder_beside(folder / "frames")
    try:
        written = [_write(opened, scene, staging / name, time, how) for name, time in zip(names, times, strict=True)]
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
    return [replace(one, path=folder / name) for one, name in zip(written, names, strict=True)]


def frame_names(count: int, suffix: str = ".ply") -> list[str]:
    """Return ``frame_0000.ply`` and so on, with at least four digits and names in the order of the frames."""
    digits = max(4, len(str(count - 1)))
    return [f"frame_{i:0{digits}d}{suffix}" for i in range(count)]


def scene_part(scene: GaussianScene, part: Part) -> GaussianScene:
    """Return a part of a scene. Raises DyngsError if it is empty."""
    if part == "all":
        return scene
    found = scene.part(part)
    if not len(found):
        empty = "every Gaussian of this run moves: it has no still part"
        raise DyngsError("nothing moves in this run: it has no dynamic part" if part == "moving" else empty)
    return found


def splats_at(opened: Opened, scene: GaussianScene, time: float, how: Writing = AS_THEY_ARE) -> SplatFile:
    """Return what a file of Gaussians is to hold of a scene at one time, in the axes that are asked for."""
    model = opened.config.model
    with torch.no_grad():
        moment = scene.time_step(time)
    gaussians, shader = moment.gaussians, scene.shader(moment)
    comments = [f"step: {opened.step}"] if scene.is_static else [f"step: {opened.step}", f"dyngs time {time!r}"]
    if shader is not None:
        baked = with_harmonics(gaussians, shader)
        gaussians = baked.gaussians
        comments.append(f"colours: harmonics fitted to a network, rms error {baked.error:.4f}")
    x, y, z = opened.info.world_offset
    splat = SplatFile(gaussians.detach(), model.rasterize_mode, model.eps2d, (x, y, z), tuple(comments))
    return turned_file(splat, how.turn, how.up)


def _write(opened: Opened, scene: GaussianScene, path: Path, time: float, how: Writing) -> Written:
    return write_splats(path, splats_at(opened, scene, time, how), sh_degree=how.sh_degree)


def _require_no_others(folder: Path, names: Sequence[str], suffix: str) -> None:
    """Check that the folder holds no files that players would take for frames.

    Raises:
        DyngsError: there is a file that is not among ``names``, or the folder is a file.
    """
    if folder.exists() and not folder.is_dir():
        raise DyngsError(f"{folder}: is a file, but a sequence needs a folder")
    others = sorted(f.name for f in folder.glob(f"[!.]*{suffix}") if f.name not in names)
    if others:
        raise DyngsError(
            f"{folder}: holds other {suffix} files ({others[0]}), which players would take for frames; give an empty "
            "folder"
        )
