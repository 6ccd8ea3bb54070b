"""The runs of a study: one after another here, or by Ray on as many machines as a cluster has; none
is made twice."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.io.child import home_of_dyngs
from dyngs.io.containment import following_links_of_runs, follows_links_of_runs
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.training.events import Listener

T = TypeVar("T")
R = TypeVar("R")


def finished(config: Config, out: Path, listeners: Sequence[Listener] = ()) -> Path:
    """Train the run in folder ``out`` to its end, from its last checkpoint if there is one; return
    ``out``.

    A run that goes on keeps its own length, which a time limit may have changed.
    """
    if not checkpoint_paths(out):
        return train(config, listeners=listeners)
    begun = load_resolved(out)
    run = config.run.model_copy(update={"seed": begun.run.seed, "dir": out})
    return train(begun.model_copy(update={"run": run}), resume_from=out, listeners=listeners)


def done_in_turn(
    do: Callable[[T], R], tasks: Sequence[T], ray_cores: int | None = None
) -> Iterator[tuple[T, R | DyngsError]]:
    """Yield each task and what ``do`` makes of it, or why it cannot, as they end.

    ``ray_cores``: Ray does them at the same time, with so many cores set aside for each, on this
    machine or on the cluster that ``RAY_ADDRESS`` names, whose machines share the file system;
    None: here, one after another.
    """
    if ray_cores is None:
        for task in tasks:
            yield task, _attempted(do, task)
        return
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DyngsError("--ray needs the package ray; run pip install 'dyngs[ray]'") from None
    here = os.getcwd()
    os.chdir(home_of_dyngs())  # Ray's processes import modules from the current folder of ray.init
    try:
        ray.init()
    finally:
        os.chdir(here)
    try:
        remote: Any = ray.remote(num_cpus=ray_cores)(_attempted_in)
        links = follows_links_of_runs()
        waiting = {remote.remote(here, links, do, task): task for task in tasks}
        while waiting:
            (ready,), _ = ray.wait(list(waiting))
            yield waiting.pop(ready), ray.get(ready)
    finally:
        ray.shutdown()


def _attempted_in(folder: str, links: bool, do: Callable[[T], R], task: T) -> R | DyngsError:
    """Attempt a task in a process of Ray, with the current folder and permissions of ours."""
    os.chdir(folder)
    with following_links_of_runs(links):
        return _attempted(do, task)


def _attempted(do: Callable[[T], R], task: T) -> R | DyngsError:
    try:
        return do(task)
    except DyngsError as error:
        return error
