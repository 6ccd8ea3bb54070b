"""What a command reads: the files of runs, and what configurations and captures name, for the check
of its outputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from pydantic import BaseModel

from dyngs.config import Config, DataConfig, RunConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, all_views
from dyngs.data.read import read_capture
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
_FILES_OF_VIEWS = ("image_path", "mask_path", "depth_path", "motion_mask_path", "flow_path")


def inputs_of(*read: Read) -> Inputs:
    """Return what is read of files, folders, runs, configurations and captures, with all that these
    name.

    Of a run, its folder or its ``scene.dyngs``, these are its own files and what its configuration
    names: other files in its folder are outputs.
    """
    found = list(chain.from_iterable(_named_by(one) for one in read))
    return Inputs((one for one in found if isinstance(one, Path)), lambda: _outside_captures(found))


def _named_by(one: Read) -> Iterator[Path | DataConfig | Capture]:
    match one:
        case Path() if (one / RESOLVED_NAME).is_file():
            yield from _files_of_run(one)
            yield from _named_by(_config_of(one))
        case Path() if one.name == SCENE_FILE and (one.parent / RESOLVED_NAME).is_file():
            yield one
            yield from _named_by(one.parent)
        case Path():
            yield one
        case LoadedRun():
            if one.config.run.dir is not None and (one.config.run.dir / RESOLVED_NAME).is_file():
                yield from _files_of_run(one.config.run.dir)
            yield from _named_by(one.config)
        case Capture():
            yield from (one.root, one)
        case RunConfig():
            return  # an output
        case BaseModel():
            if isinstance(one, DataConfig) and one.follow_links:
                yield one
            for name in type(one).model_fields:
                value = getattr(one, name)
                yield from _named_by(value) if isinstance(value, Path | BaseModel) else ()


def _config_of(run_dir: Path) -> Config | None:
    try:
        return load_resolved(run_dir)
    except DyngsError:  # then the command that reads it says so
        return None


def _files_of_run(run_dir: Path) -> Iterator[Path]:
    yield from (
        run_dir / name for name in (RESOLVED_NAME, ASKED_NAME, LOG_NAME, TIMING_NAME, RECORD_NAME)
    )
    yield from checkpoint_paths(run_dir)
    yield from (run_dir / BODY_FOLDER).glob("*")
    if has_only_scene_file(run_dir):
        yield run_dir / SCENE_FILE


def _outside_captures(found: Sequence[Path | DataConfig | Capture]) -> Iterator[Path]:
    """Yield the files of captures that lie elsewhere than in their folders, as
    ``data.follow_links`` allows."""
    captures = [one for one in found if isinstance(one, Capture)]
    for data in (one for one in found if isinstance(one, DataConfig)):
        try:
            captures.append(read_capture(data))
        except DyngsError:  # then the command that reads it says so
            continue
    for view in chain.from_iterable(all_views(capture.splits) for capture in captures):
        yield from (path for name in _FILES_OF_VIEWS if (path := getattr(view, name)) is not None)
        yield from (one.path for one in (view.silhouette,) if one is not None)
        yield from (one.video for one in (view.video,) if one is not None)
