"""What a command reads: the files of runs, and what configurations and captures name, for the check
of its outputs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from dyngs.config import RunConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.io.outputs import Inputs
from dyngs.runs.capture_record import RECORD_NAME
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    TIMING_NAME,
    LoadedRun,
    checkpoint_paths,
    has_only_scene_file,
)
from dyngs.runs.config_file import BODY_FOLDER
from dyngs.runs.folder import ASKED_NAME, LOG_NAME

Read = Path | BaseModel | LoadedRun | Capture | None


def inputs_of(*read: Read) -> Inputs:
    """Return what is read of files, folders, runs, configurations and captures, with all that these
    name.

    Of a run, its folder or its ``scene.dyngs``, these are its own files and what its configuration
    names: other files in its folder are outputs.
    """
    return Inputs(path for one in read for path in _named_by(one))


def _named_by(one: Read) -> Iterator[Path]:
    match one:
        case Path() if (one / RESOLVED_NAME).is_file():
            yield from _files_of_run(one)
            with suppress(DyngsError):  # the command that reads it refuses it
                yield from _named_by(load_resolved(one))
        case Path():
            yield one
            if one.name == SCENE_FILE and (one.parent / RESOLVED_NAME).is_file():
                yield from _named_by(one.parent)
        case LoadedRun():
            if one.config.run.dir is not None and (one.config.run.dir / RESOLVED_NAME).is_file():
                yield from _files_of_run(one.config.run.dir)
            yield from _named_by(one.config)
        case Capture():
            yield one.root
        case RunConfig():
            return  # an output
        case BaseModel():
            for name in type(one).model_fields:
                value = getattr(one, name)
                yield from _named_by(value) if isinstance(value, Path | BaseModel) else ()


def _files_of_run(run_dir: Path) -> Iterator[Path]:
    yield from (
        run_dir / name for name in (RESOLVED_NAME, ASKED_NAME, LOG_NAME, TIMING_NAME, RECORD_NAME)
    )
    yield from checkpoint_paths(run_dir)
    yield from (run_dir / BODY_FOLDER).glob("*")
    if has_only_scene_file(run_dir):
        yield run_dir / SCENE_FILE
