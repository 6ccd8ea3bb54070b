"""What can be chosen to look at: one scene, the runs in a folder, or the people that a network may
predict."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from dyngs.api.predict import network_config, predict, require_network
from dyngs.config import DataConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.read import captures_in, read_capture
from dyngs.io.outputs import command_for
from dyngs.models.kind import Predicts, capability
from dyngs.ops.device import CPU
from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths
from dyngs.runs.opened import Opened, open_scene
from dyngs.view.layers import coarser

_DEEPEST = 3
"""Folders below that which was given in which runs are looked for."""
_MOST_RUNS = 500
MOST_IMAGES = 5
"""Images that can be picked."""


@dataclass(frozen=True)
class PeopleNetwork:
    """A trained network, captures of people by name, and the number of images that it was trained
    to predict from."""

    run: Path
    people: dict[str, DataConfig]
    num_images: int
    _images: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def images_of(self, person: str) -> tuple[str, ...]:
        """Return the names of the images of a person that can be predicted from. Raises
        DyngsError."""
        if person not in self._images:
            views = read_capture(self.people[person]).splits["train"]
            self._images[person] = tuple(view.name for view in views)
        return self._images[person]

    def predict(self, person: str, images: tuple[str, ...] = (), up: str | None = None) -> Opened:
        """Return a person as the network predicts it.

        Args:
            images: to predict from; without any, as many as in training, chosen to see much of the
                person.
            up: up axis; None: that of the capture.

        Raises:
            DyngsError: not a capture of a person, or unknown images.
        """
        with tempfile.TemporaryDirectory(prefix="dyngs_view_") as folder:
            out = Path(folder) / "run"
            made = predict(self.run, self.people[person].root, out, images or self.num_images)
            opened = open_to_view(out, person, up)
        return opened.noted(f"predicted from {', '.join(made.views)} in {made.seconds:.1f} s")


def open_network(run: Path, capture: Path | None = None) -> PeopleNetwork:
    """Return a network with the people it was trained on, or those of ``capture``: one, or a folder
    of them.

    Raises DyngsError: not the run of a network, or no captures there.
    """
    config = network_config(run)
    num_views = require_network(config, run).num_views(config.model)
    data = config.data
    captures = []
    if capture is not None:
        data = data.model_copy(update={"root": capture.absolute()})
        with suppress(DyngsError):
            read_capture(data)
            captures = [data]
    people = {one.root.name: one for one in captures or captures_in(data)}
    return PeopleNetwork(run, people, num_views)


@dataclass(frozen=True)
class Source:
    """Names of scenes, at least one, what loads the scene of a name, and the network if that is
    what makes them."""

    names: tuple[str, ...]
    load: Callable[[str], Opened]
    network: PeopleNetwork | None = None


def open_source(
    path: Path,
    up: str | None = None,
    capture: Path | None = None,
    device: torch.device = CPU,
    data_root: Path | None = None,
    most: int | None = None,
) -> Source:
    """Return what is to be seen of a run, a file, a folder of runs or a network; the first scene is
    not loaded yet.

    Args:
        up, data_root: as in ``open_to_view``.
        capture: for a network: a person, or a folder of people.
        device: draws the scenes.
        most: Gaussians of a still scene that are drawn at most while anything moves; None: all.

    Raises:
        DyngsError: nothing is there, a folder without runs, or a ``capture`` without a network.
    """
    if not path.exists():
        raise DyngsError(
            f"{path}: no such run, file or folder; give what `dyngs train` or `dyngs export` wrote"
        )
    if _is_run(path) and _predicts(path):
        if most is not None:
            raise DyngsError(
                f"{path} is a network of people; levels of detail are for still scenes"
            )
        network = open_network(path, capture)
        people = tuple(network.people)
        return Source(people, lambda name: network.predict(name, up=up).to(device), network)
    if capture is not None:
        raise DyngsError(
            f"--capture goes with the run of a network of people, {path} is none; leave it out"
        )
    if not path.is_dir() or _is_run(path):
        runs = {path.name or str(path): path}
    elif data_root is not None:
        raise DyngsError(f"data.root= goes with one run, {path} is none; leave it out")
    else:
        runs = {run.relative_to(path).as_posix(): run for run in runs_in(path)}
    if not runs:
        known = command_for(path)
        instead = f"{known}; then " if known else ""
        raise DyngsError(f"{path}: no runs there; {instead}give a run, a file, or a folder of runs")

    def load(name: str) -> Opened:
        opened = open_to_view(runs[name], name, up, data_root).to(device)
        return opened if most is None else coarser(opened, most)

    return Source(tuple(runs), load)


def open_to_view(
    path: Path, name: str, up: str | None = None, data_root: Path | None = None
) -> Opened:
    """Open a run or a file; where its capture is gone, a note says what lacks.

    Args:
        name: that it is shown by.
        up: up axis such as "z" or "-y"; None: that of the capture, or as the file or its format has
            it.
        data_root: where the capture of a run lies by now, if it was moved.

    Raises:
        DyngsError: nothing is there, it is damaged, or it is something else.
    """
    opened = replace(open_scene(path, nonfinite="skip", data_root=data_root), name=name)
    opened = replace(opened, stated_up=up or opened.stated_up)
    if opened.captured is not None and opened.missing is not None:
        opened = opened.noted(
            f"without the capture, so no cameras and no truth: {opened.missing}; if it was moved, add data.root=FOLDER"
        )
    return opened


def first_of(source: Source) -> Opened:
    """Return the first scene that can be loaded; a note says which could not. Raises DyngsError."""
    failed: list[DyngsError] = []
    for name in source.names:
        try:
            return source.load(name).noted(*(f"left out: {error}" for error in failed))
        except DyngsError as error:
            failed.append(error)
    raise failed[0]


def _predicts(run: Path) -> bool:
    """Return whether a run holds a network that predicts people."""
    return capability(load_resolved(run).model, Predicts) is not None


def runs_in(folder: Path) -> list[Path]:
    """Return the runs with a scene in a folder and the folders below it, by name; networks are left
    out."""
    found: list[Path] = []
    level = [folder]
    for _ in range(_DEEPEST):
        below = [child for parent in level for child in _folders(parent)]
        found += [child for child in below if _is_run(child) and _has_scene(child)]
        level = [child for child in below if not _is_run(child)]
    return sorted(found)[:_MOST_RUNS]


def _is_run(folder: Path) -> bool:
    return (folder / RESOLVED_NAME).is_file()


def _has_scene(run: Path) -> bool:
    try:
        has_any = (run / SCENE_FILE).is_file() or bool(checkpoint_paths(run))
        return has_any and not _predicts(run)
    except (DyngsError, OSError):
        return False


def _folders(parent: Path) -> list[Path]:
    try:
        return [x for x in parent.iterdir() if x.is_dir() and not x.name.startswith(".")]
    except OSError:
        return []
