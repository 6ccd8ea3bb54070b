"""The runs of a study, one after another or by Ray, and the files in which a study keeps what it
has, so that nothing is trained or measured twice."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, format_one_line, wrap_read_errors
from dyngs.io.child import package_parent
from dyngs.io.containment import allow_run_links, run_links_allowed
from dyngs.io.fields import read_limited
from dyngs.io.write import write_text
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.training.events import Listener

T = TypeVar("T")
R = TypeVar("R")
STORED_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
"""How the dataclasses of results are read: nothing else, and only numbers."""
STUDY_FILE = "study.json"
"""What a study is about, in its folder."""


def train_to_end(config: Config, out: Path, listeners: Sequence[Listener] = ()) -> Path:
    """Train the run in folder ``out`` to its end, from its last checkpoint if there is one; return
    ``out``.

    A run that goes on keeps its own length, which a time limit may have changed.
    """
    if not checkpoint_paths(out):
        return train(config, listeners=listeners)
    begun = load_resolved(out)
    run = config.run.model_copy(update={"seed": begun.run.seed, "dir": out})
    return train(begun.model_copy(update={"run": run}), resume_from=out, listeners=listeners)


def run_tasks(
    do: Callable[[T], R], tasks: Sequence[T], ray_cores: int | None = None
) -> Iterator[tuple[T, R | DyngsError]]:
    """Yield each task and what ``do`` makes of it, or why it cannot, as they end.

    ``ray_cores``: Ray does them at the same time, with so many cores set aside for each, on this
    machine or on the cluster that ``RAY_ADDRESS`` names, whose machines share the file system;
    None: here, one after another.
    """

    def attempted(task: T) -> R | DyngsError:
        try:
            return do(task)
        except DyngsError as error:
            return error

    if ray_cores is None:
        for task in tasks:
            yield task, attempted(task)
        return
    here = os.getcwd()
    links = run_links_allowed()

    def attempted_elsewhere(task: T) -> R | DyngsError:
        os.chdir(here)
        with allow_run_links(links):
            return attempted(task)

    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise DyngsError("--ray needs the package ray; run pip install 'dyngs[ray]'") from None
    os.chdir(package_parent())  # Ray's processes import modules from the current folder of ray.init
    try:
        ray.init()
    finally:
        os.chdir(here)
    try:
        remote: Any = ray.remote(num_cpus=ray_cores)(attempted_elsewhere)
        waiting = {remote.remote(task): task for task in tasks}
        while waiting:
            (ready,), _ = ray.wait(list(waiting))
            yield waiting.pop(ready), ray.get(ready)
    finally:
        ray.shutdown()


def read_stored(path: Path, kind: TypeAdapter[T]) -> T:
    """Return a result. Raises DyngsError: the file is damaged."""
    with wrap_read_errors(path, "it is no result of a study: remove it to have it measured again"):
        return kind.validate_json(read_limited(path))


def write_stored(path: Path, values: Mapping[str, Any] | Sequence[Any]) -> None:
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def require_same_study(
    out: Path, facts: Mapping[str, object], compared_keys: Sequence[str]
) -> None:
    """Store the facts of a study in its folder ``out``, or compare them with those stored there.

    Raises:
        DyngsError: one of the ``compared`` facts differs; names those that do.
    """
    path = out / STUDY_FILE
    if not path.is_file():
        write_stored(path, facts)
        return
    here = json.loads(json.dumps(facts))
    with wrap_read_errors(path, "what its folder holds is not known; give another --out"):
        known = json.loads(read_limited(path))
        differing = [
            f"{key} is {_shown(known.get(key))} there and {_shown(here[key])} here"
            for key in compared_keys
            if known.get(key) != here[key]
        ]
    if differing:
        raise DyngsError(f"{out}: holds another study ({'; '.join(differing)}); give another --out")


def _shown(value: object) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return format_one_line(text, 80) or "none"
