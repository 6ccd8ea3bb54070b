"""Scenes to choose from in the viewer: a single scene, or the runs in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from dyngs.config.io import RESOLVED_NAME
from dyngs.core.errors import DyngsError
from dyngs.io.formats.formats import format_to_read
from dyngs.io.outputs import suggest_command
from dyngs.ops.device import CPU
from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths
from dyngs.runs.opened import OpenedScene, open_scene
from dyngs.view.layers import with_levels


@dataclass(frozen=True)
class SceneSource:
    """Names of scenes, at least one, and the function that loads a scene by name."""

    names: tuple[str, ...]
    load: Callable[[str], OpenedScene]


def open_source(
    path: Path,
    up: str | None = None,
    device: torch.device = CPU,
    data_root: Path | None = None,
    most: int | None = None,
) -> SceneSource:
    """Return the scenes of a run, a file or a folder of runs, without loading them.

    Args:
        up, data_root: as in ``open_to_view``.
        device: render device.
        most: largest number of Gaussians rendered while the view of a static scene moves. None
            renders all.

    Raises:
        DyngsError: no scene found.
    """
    runs = {path.name or str(path): path}
    if path.is_dir() and not (path / RESOLVED_NAME).is_file() and format_to_read(path) is None:
        if data_root is not None:
            raise DyngsError(f"data.root=: {path} is not a single run; remove it")
        runs = {run.relative_to(path).as_posix(): run for run in runs_in(path)}
    if not runs:
        known = suggest_command(path)
        instead = f"{known}; then " if known else ""
        raise DyngsError(f"{path}: no runs found; {instead}give a run, a file, or a folder of runs")

    def load(name: str) -> OpenedScene:
        opened = open_to_view(runs[name], name, up, data_root).to(device)
        return opened if most is None else with_levels(opened, most)

    return SceneSource(tuple(runs), load)


def open_to_view(
    path: Path, name: str, up: str | None = None, data_root: Path | None = None
) -> OpenedScene:
    """Open a run or a file for viewing. A missing capture is reported in a note.

    Args:
        name: displayed name.
        up: up axis such as "z" or "-y". None uses that of the capture or the file.
        data_root: current folder of the capture, if it was moved.

    Raises:
        DyngsError: missing, damaged or unsupported file.
    """
    opened = open_scene(path, nonfinite="skip", data_root=data_root)
    opened = replace(opened, name=name, stated_up=up or opened.stated_up)
    if opened.missing is not None:
        opened = opened.noted(
            f"capture not found, no cameras and true images: {opened.missing}; if it was moved, "
            "add "
            "data.root=FOLDER"
        )
    return opened


def load_first(source: SceneSource) -> OpenedScene:
    """Return the first scene that can be loaded, with notes about those that cannot. Raises
    DyngsError."""
    failed: list[DyngsError] = []
    for name in source.names:
        try:
            return source.load(name).noted(*(f"skipped: {error}" for error in failed))
        except DyngsError as error:
            failed.append(error)
    raise failed[0]


def runs_in(folder: Path) -> list[Path]:
    """Return at most 500 runs with a scene or network, up to three folders below ``folder``, by
    name."""
    runs = []
    for below in ("*", "*/*", "*/*/*"):
        for config in folder.glob(f"{below}/{RESOLVED_NAME}"):
            run = config.parent
            is_hidden = any(part.startswith(".") for part in run.relative_to(folder).parts)
            if not is_hidden and ((run / SCENE_FILE).is_file() or checkpoint_paths(run)):
                runs.append(run)
    return sorted(runs)[:500]
