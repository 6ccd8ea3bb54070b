"""Execution of the runs of a study, one by one or with Ray, and storage of its results."""

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
# Validation of stored dataclasses: no unknown fields, finite numbers
STORED_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
STUDY_FILE = "study.json"  # File in the folder of a study that describes it


def train_to_end(config: Config, out: Path, listeners: Sequence[Listener] = ()) -> Path:
    """Train the run in folder ``out`` to its end, from its last checkpoint if there is one. Return
    ``out``.

    A resumed run keeps its number of steps, which a time limit may have changed.
    """
    if not checkpoint_paths(out):
        return train(config, listeners=listeners)
    begun = load_resolved(out)
    run = config.run.model_copy(update={"seed": begun.run.seed, "dir": out})
    return train(begun.model_copy(update={"run": run}), resume_from=out, listeners=listeners)


def run_tasks(
    do: Callable[[T], R], tasks: Sequence[T], ray_cores: int | None = None
) -> Iterator[tuple[T, R | DyngsError]]:
    """Yield each task with the result of ``do``, or with its DyngsError, in the order of
    completion.

    Args:
        ray_cores: cores that Ray reserves per task, on this machine or on the cluster at
            ``RAY_ADDRESS``, whose machines share the file system. None runs the tasks here, one by
            one.
    """

    def attempt(task: T) -> R | DyngsError:
        try:
            return do(task)
        except DyngsError as error:
            return error

    if ray_cores is None:
        for task in tasks:
            yield task, attempt(task)
        return
    here = os.getcwd()
    links = run_links_allowed()

    def attempt_on_worker(task: T) -> R | DyngsError:
        os.chdir(here)
        with allow_run_links(links):
            return attempt(task)

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
        remote: Any = ray.remote(num_cpus=ray_cores)(attempt_on_worker)
        waiting = {remote.remote(task): task for task in tasks}
        while waiting:
            (ready,), _ = ray.wait(list(waiting))
            yield waiting.pop(ready), ray.get(ready)
    finally:
        ray.shutdown()


def read_stored(path: Path, kind: TypeAdapter[T]) -> T:
    """Return a stored result. Raises DyngsError if the file is damaged."""
    with wrap_read_errors(path, "not a result of a study; remove it to measure again"):
        return kind.validate_json(read_limited(path))


def write_stored(path: Path, values: Mapping[str, Any] | Sequence[Any]) -> None:
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def require_same_study(
    out: Path, facts: Mapping[str, object], compared_keys: Sequence[str]
) -> None:
    """Store the description of a study in its folder, or compare it with the stored one.

    Args:
        facts: description of the study.
        compared_keys: keys of ``facts`` that must be equal.

    Raises:
        DyngsError: the folder holds another study. The message lists the differences.
    """
    path = out / STUDY_FILE
    if not path.is_file():
        write_stored(path, facts)
        return
    here = json.loads(json.dumps(facts))
    with wrap_read_errors(path, "damaged description of a study; use another --out"):
        known = json.loads(read_limited(path))
        differing = [
            f"{key}: {_describe_value(known.get(key))} there, {_describe_value(here[key])} here"
            for key in compared_keys
            if known.get(key) != here[key]
        ]
    if differing:
        raise DyngsError(
            f"{out}: contains another study ({'; '.join(differing)}); use another --out"
        )


def _describe_value(value: object) -> str:
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return format_one_line(text, 80) or "none"
