"""Contents of a run folder.

They are the configuration with a copy of the fitted body, the checks before a new run, the clean-up
after killed processes, the list of input files, and the coordinate frame set by ``dyngs edit``.
"""

from __future__ import annotations

import filecmp
import json
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import BaseModel

from dyngs.config import Config, DataConfig, RunConfig, TrainConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.config.keys.train import LOGGING_KEYS
from dyngs.core.errors import DyngsError, quote_path
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.io.fields import read_limited
from dyngs.io.formats.similarity import AXES, IDENTITY, Similarity, similarity_from_numbers
from dyngs.io.outputs import LOCK_NAME, Inputs, atomic_folder, lock_folder
from dyngs.io.write import remove_leftovers, write_text
from dyngs.models.kind import PredictsScenes, capability
from dyngs.runs.capture_record import RECORD_NAME, require_same_capture
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    TIMING_NAME,
    LoadedRun,
    checkpoint_paths,
    checkpoint_step,
    has_only_scene_file,
)

BODY_FOLDER = "body"
"""Copy of the fit ``data.body`` in a run folder."""
_PARAMETERS = ("body_train.npz", "body_pose.npz")
_KEPT = (*_PARAMETERS, "fit_report.json")
"""Files of a fit that are copied; images are not."""


def write_config(config: Config, folder: Path) -> None:
    """Write the configuration of the run in ``folder``, with a copy of the fit ``data.body``.

    An existing copy is kept. If the fit no longer exists, its path is stored unchanged.
    """
    body = config.data.body
    own = folder.absolute() / BODY_FOLDER
    if body is not None and (own.is_dir() or (body / _PARAMETERS[0]).is_file()):
        if not own.is_dir():
            with atomic_folder(own, require_empty) as started:
                for name in _KEPT:
                    if (body / name).is_file():
                        shutil.copyfile(body / name, started / name)
        config = _with_data(config, body=own)
    save_config(config, folder / RESOLVED_NAME)


def share_body_path(config: Config, stored: Config) -> Config:
    """Return ``config`` with ``data.body`` of ``stored`` if both fits are equal."""
    return (
        _with_data(config, body=stored.data.body)
        if is_same_body(config.data.body, stored.data.body)
        else config
    )


def is_same_body(one: Path | None, other: Path | None) -> bool:
    """Return whether two values of ``data.body`` have the same body parameters."""
    if one == other or one is None or other is None:
        return one == other
    stored = [name for name in _PARAMETERS if (one / name).exists() or (other / name).exists()]
    same, _, _ = filecmp.cmpfiles(one, other, stored, shallow=False)
    return bool(stored) and same == stored


def _with_data(config: Config, **values: Path | None) -> Config:
    """Return ``config`` with other ``values`` of its section ``data``."""
    return config.model_copy(update={"data": config.data.model_copy(update=values)})


LOG_NAME = "log.jsonl"
EXPORT_FOLDER = "export"
"""Folder of the exported .dyngs file of at most ``budget.max_mb`` in a run folder."""
CHOICES_NAME = "choices.json"
"""Results of the pilot runs in a run folder."""
REQUESTED_NAME = "asked.yaml"
"""Requested configuration in a run folder, if it differs from the resolved one (config.yaml)."""
_BEGUN = (
    RESOLVED_NAME,
    REQUESTED_NAME,
    LOG_NAME,
    TIMING_NAME,
    CHOICES_NAME,
    RECORD_NAME,
    BODY_FOLDER,
)
"""Files of a run that was stopped before its first checkpoint."""


def default_run_dir(config: Config) -> Path:
    """Return the default run folder: ``runs/CAPTURE-NAME``, or ``runs/NAME`` if ``run.name`` was
    set by the user."""
    name = config.run.name
    root = Path(os.path.abspath(config.data.root))
    if "name" not in config.run.model_fields_set:
        name = f"{root.stem if root.is_file() else root.name}-{name}".lstrip("-")
    parts = Path(name).parts
    if not parts or ".." in parts or Path(name).is_absolute():
        raise DyngsError(
            f"run.name={name!r}: must name a folder below runs; for another place use run.dir=FOLDER"
        )
    return Path("runs", name)


def require_empty(folder: Path) -> None:
    """Raise DyngsError unless ``folder`` does not exist or is empty; removes a stale lock file."""
    if (
        folder.is_dir()
        and not folder.is_symlink()
        and [path.name for path in folder.iterdir()] == [LOCK_NAME]
    ):
        with lock_folder(folder):  # removes the stale lock file at its end
            pass
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise DyngsError(f"{folder}: exists already; use another --out")
    if folder.exists() and not os.access(folder, os.W_OK):
        raise DyngsError(f"{folder}: not writable; use another --out or change its permissions")


@contextmanager
def open_export_folder(out: Path, run_dir: Path, config: Config) -> Iterator[Path]:
    """Yield the folder to export a run to: ``out``, or a temporary folder that replaces it."""
    if not out.exists():
        with atomic_folder(out, require_empty) as started:
            yield started
        return
    with lock_folder(out):
        if out.resolve() != run_dir.resolve():
            _require_export_of(config, out)
        yield out


def _require_export_of(config: Config, folder: Path) -> None:
    """Raise DyngsError if ``folder`` has another run; an earlier export of the same run is fine."""
    found = _found(folder)
    if not found and not checkpoint_paths(folder):
        return
    try:
        same = _is_same_run(load_resolved(folder), config)
    except DyngsError:
        same = False
    if not same or checkpoint_paths(folder):
        raise DyngsError(f"{folder}: contains another run; use another --out")


def require_startable(folder: Path, config: Config) -> None:
    """Raise DyngsError if ``folder`` has files of another run, or checkpoints of this run."""
    begun = load_begun_config(folder)
    paths = checkpoint_paths(folder)
    found = _found(folder)
    go_on = f"`dyngs train --resume {quote_path(folder)}`, or give another run.dir"
    if paths:
        raise DyngsError(
            f"{folder} already contains a run, stopped after step {checkpoint_step(paths[-1]):,}; "
            f"continue with {go_on}"
        )
    if begun is not None:
        if not (_is_same_run(begun, config) or _matches_request(folder, config)):
            raise DyngsError(
                f"{folder} already contains another run, stopped before its first checkpoint; "
                f"restart it with {go_on}"
            )
    elif found:
        raise DyngsError(
            f"{folder} already contains {found[0]}, which a new run would replace; use another run.dir"
        )


def is_finished(folder: Path, config: Config) -> bool:
    """Return whether ``folder`` has the finished run of this requested configuration."""
    paths = checkpoint_paths(folder)
    if not paths or not _matches_request(folder, config):
        return False
    return checkpoint_step(paths[-1]) >= load_resolved(folder).total_steps


def write_requested_config(folder: Path, requested: Config) -> None:
    """Write the requested configuration if it differs from the resolved one."""
    path = folder / REQUESTED_NAME
    stored = load_resolved(folder)
    if _is_same_run(stored, requested):
        path.unlink(missing_ok=True)
    else:
        save_config(share_body_path(requested, stored), path)


def update_data_root(folder: Path, data: DataConfig) -> None:
    """Store the new folder of a moved capture in the configuration of a run, after checking it."""
    for path in (folder / RESOLVED_NAME, folder / REQUESTED_NAME):
        stored = load_resolved(path) if path.is_file() else None
        if stored is not None and stored.data.root != data.root:
            is_network = capability(stored.model, PredictsScenes) is not None
            capture = None if is_network else read_capture(data)
            require_same_capture(folder, data, capture)
            save_config(_with_data(stored, root=data.root), path)


def load_requested_config(folder: Path) -> Config:
    """Load the requested configuration of a run."""
    path = folder / REQUESTED_NAME
    return load_resolved(path if path.is_file() else folder)


def _matches_request(folder: Path, config: Config) -> bool:
    try:
        return _is_same_run(load_requested_config(folder), config)
    except DyngsError:  # a file of that name that is not of a run
        return False


def remove_partial_files(folder: Path, *, sole_writer: bool) -> None:
    """Remove partially written files of killed processes from a run folder.

    With ``sole_writer`` no other process writes to the folder, so all temporary files are stale.
    """
    remove_leftovers(folder, _BEGUN.__contains__ if sole_writer else None)
    for inner in (folder / "checkpoints", folder / EXPORT_FOLDER):
        if not inner.is_symlink():
            remove_leftovers(inner, (lambda _: True) if sole_writer else None)


def _found(folder: Path) -> list[str]:
    """Return the names of existing files of a run in ``folder``, those of ``_BEGUN`` last."""
    metrics = sorted(path.name for path in folder.glob("metrics*.json"))
    names = [SCENE_FILE, EXPORT_FOLDER, *metrics, *_BEGUN]
    found = [name for name in names if os.path.lexists(folder / name)]
    checkpoints = folder / "checkpoints"
    is_taken = os.path.lexists(checkpoints) and not checkpoints.is_dir()
    return ["checkpoints", *found] if is_taken else found


def load_begun_config(folder: Path) -> Config | None:
    """Return the configuration of a run stopped before its first checkpoint; None if there is
    none."""
    found = _found(folder)
    if (
        RESOLVED_NAME not in found
        or checkpoint_paths(folder)
        or any(name not in _BEGUN for name in found)
    ):
        return None
    try:
        return load_resolved(folder)
    except DyngsError:  # a file of that name that is not of a run
        return None


def _is_same_run(one: Config, other: Config) -> bool:
    """Return whether two configurations give the same result; names, folders, threads and logging
    are ignored."""
    return not differing_keys(one, other)


def differing_keys(one: Config, other: Config) -> list[str]:
    """Return the keys by which the results of two configurations differ."""
    pairs = zip(_relevant_config(one), _relevant_config(share_body_path(other, one)), strict=True)
    return [
        f"{section}.{key}"
        for (section, mine), (_, theirs) in pairs
        for key in type(theirs).model_fields
        if getattr(mine, key, None) != getattr(theirs, key)
    ]


def _relevant_config(config: Config) -> Config:
    data = config.data.model_copy(update={"follow_links": False, "cache_mb": 0})
    usual = TrainConfig()
    train = config.train.model_copy(update={key: getattr(usual, key) for key in LOGGING_KEYS})
    run = RunConfig(seed=config.run.seed)
    return config.model_copy(update={"run": run, "data": data, "train": train})


Read = Path | BaseModel | LoadedRun | Capture | None


def collect_inputs(*read: Read) -> Inputs:
    """Collect the input files of a command, including those that runs and configurations refer to.

    For a run these are its own files and the paths in its configuration; other files in its folder
    are outputs.
    """
    return Inputs(path for one in read for path in _input_paths(one))


def _input_paths(one: Read) -> Iterator[Path]:
    match one:
        case Path() if (one / RESOLVED_NAME).is_file():
            yield from _files_of_run(one)
            with suppress(DyngsError):  # reported by the command that reads it
                yield from _input_paths(load_resolved(one))
        case Path():
            yield one
            if one.name == SCENE_FILE and (one.parent / RESOLVED_NAME).is_file():
                yield from _input_paths(one.parent)
        case LoadedRun():
            if one.config.run.dir is not None:
                yield from _input_paths(one.config.run.dir)
            yield from _input_paths(one.config)
        case Capture():
            yield one.root
        case RunConfig():
            return  # an output
        case BaseModel():
            for name in type(one).model_fields:
                value = getattr(one, name)
                yield from _input_paths(value) if isinstance(value, Path | BaseModel) else ()


def _files_of_run(run_dir: Path) -> Iterator[Path]:
    yield from (
        run_dir / name
        for name in (RESOLVED_NAME, REQUESTED_NAME, LOG_NAME, TIMING_NAME, RECORD_NAME)
    )
    yield from checkpoint_paths(run_dir)
    yield from (run_dir / BODY_FOLDER).glob("*")
    if has_only_scene_file(run_dir):
        yield run_dir / SCENE_FILE


FRAME_NAME = "frame.json"
_MOST_BYTES = 4096


@dataclass(frozen=True)
class RunFrame:
    """User-defined coordinate frame of a run, set by ``dyngs edit``.

    Attributes:
        similarity: transform from training coordinates to the frame, without ``offset``.
        offset: (3,) added in the frame, for coordinates that are too large for float32.
        up: up axis of the frame, such as "z"; None: unknown.
        fixed: whether exports keep the axes, as for control points.
    """

    similarity: Similarity = IDENTITY
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: str | None = None
    fixed: bool = False


def write_frame(folder: Path, frame: RunFrame) -> None:
    """Write the frame of the run in ``folder``, atomically."""
    write_text(
        folder / FRAME_NAME,
        json.dumps(asdict(frame) | {"similarity": frame.similarity.numbers}) + "\n",
    )


def read_frame(folder: Path) -> RunFrame | None:
    """Return the coordinate frame of the run in ``folder``; None if it was not edited.

    Raises DyngsError: a damaged file.
    """
    path = folder / FRAME_NAME
    if not path.exists():
        return None
    try:
        stored = json.loads(read_limited(path, _MOST_BYTES))
        similarity = similarity_from_numbers([float(a) for a in stored["similarity"]])
        x, y, z = map(float, stored["offset"])
        up = stored["up"]
        fixed = stored["fixed"]
        if not math.isfinite(x + y + z) or up not in (None, *AXES) or not isinstance(fixed, bool):
            raise ValueError("no offset or no axis")
    except (DyngsError, ValueError, KeyError, TypeError, RecursionError):
        raise DyngsError(f"{path}: damaged coordinate frame; edit the original run again") from None
    return RunFrame(similarity, (x, y, z), up, fixed)
