"""What can be chosen to look at: one scene, or the runs in a folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.errors import DyngsError
from dyngs.files.wrong_place import command_for
from dyngs.ops.device import CPU
from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths
from dyngs.view.network import PeopleNetwork, open_network
from dyngs.view.viewed import Viewed, load_viewed

_DEEPEST = 3
"""Folders below that which was given in which runs are looked for."""
_MOST_RUNS = 500


@dataclass(frozen=True)
class Source:
    """Scenes by name, loaded when they are chosen.

    Attributes:
        names: at least one.
        load: returns the scene of a name. Raises DyngsError.
        network: that predicts the people; None: scenes are loaded.
    """

    names: tuple[str, ...]
    load: Callable[[str], Viewed]
    network: PeopleNetwork | None = None


def open_source(path: Path, up: str | None = None, capture: Path | None = None, device: torch.device = CPU) -> Source:
    """Return what is to be seen of a run, a file, a folder of runs or a network; the first scene is not loaded yet.

    Args:
        path: of it.
        up: up axis; None: that of the capture, or of the file.
        capture: for a network: a person, or a folder of people.
        device: draws the scenes.

    Raises:
        DyngsError: nothing is there, a folder without runs, or a ``capture`` without a network.
    """
    if not path.exists():
        raise DyngsError(f"{path}: no such run, file or folder; give what `dyngs train` or `dyngs export` wrote")
    if is_network(path):
        network = open_network(path, capture)
        return Source(tuple(network.people), lambda name: network.predict(name, up=up).on(device), network)
    if capture is not None:
        raise DyngsError(f"--capture goes with the run of a network of people, {path} is none; leave it out")
    if not path.is_dir() or _is_run(path):
        name = path.name or str(path)
        return Source((name,), lambda _: load_viewed(path, up).on(device))
    runs = {run.relative_to(path).as_posix(): run for run in runs_in(path)}
    if not runs:
        known = command_for(path)
        instead = f"{known}; then " if known else ""
        raise DyngsError(f"{path}: no runs there; {instead}give a run, a file, or a folder of runs")
    return Source(tuple(runs), lambda name: replace(load_viewed(runs[name], up).on(device), name=name))


def first_of(source: Source) -> Viewed:
    """Return the first scene that can be loaded; a note says which could not.

    Raises:
        DyngsError: none can; the error of the first.
    """
    failed: list[DyngsError] = []
    for name in source.names:
        try:
            viewed = source.load(name)
        except DyngsError as error:
            failed.append(error)
            continue
        for error in failed:
            viewed = viewed.noted(f"left out: {error}")
        return viewed
    raise failed[0]


def is_network(path: Path) -> bool:
    """Return whether ``path`` is the run of a network that predicts people."""
    return path.is_dir() and _is_run(path) and load_resolved(path).model.is_network


def runs_in(folder: Path) -> list[Path]:
    """Return the runs with a scene in a folder and the folders below it, by name; networks are left out."""
    found: list[Path] = []
    level = [folder]
    for _ in range(_DEEPEST):
        below = sorted(child for parent in level for child in _folders(parent))
        found += [child for child in below if _is_run(child) and _has_scene(child)]
        level = [child for child in below if not _is_run(child)]
    return sorted(found)[:_MOST_RUNS]


def _is_run(folder: Path) -> bool:
    return (folder / RESOLVED_NAME).is_file()


def _has_scene(run: Path) -> bool:
    try:
        has_any = (run / SCENE_FILE).is_file() or bool(checkpoint_paths(run))
        return has_any and not load_resolved(run).model.is_network
    except (DyngsError, OSError):
        return False


def _folders(parent: Path) -> list[Path]:
    try:
        return [child for child in parent.iterdir() if child.is_dir() and not child.name.startswith(".")]
    except OSError:
        return []
