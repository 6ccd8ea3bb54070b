"""Contents of a run folder: checks before a new run begins, and removal of unfinished files of
killed processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dyngs.config import Config, DataConfig, RunConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.core.errors import DyngsError, as_word
from dyngs.data.read import read_capture
from dyngs.io.lock import LOCK_NAME, writing
from dyngs.io.outputs import new_folder
from dyngs.io.write import remove_leftovers
from dyngs.models.kind import Predicts, capability
from dyngs.runs.capture_record import RECORD_NAME, require_same_capture
from dyngs.runs.checkpoint import SCENE_FILE, TIMING_NAME, checkpoint_paths, step_of
from dyngs.runs.config_file import BODY_FOLDER, with_body_of, write_config

LOG_NAME = "log.jsonl"
EXPORT_FOLDER = "export"
"""In a run folder: the run as one .dyngs file of at most ``budget.max_mb``."""
CHOICES_NAME = "choices.json"
"""In a run folder: what small runs before it said."""
ASKED_NAME = "asked.yaml"
"""In a run folder: the configuration as it was asked for, where training has chosen something else
(config.yaml)."""
_BEGUN = (RESOLVED_NAME, ASKED_NAME, LOG_NAME, TIMING_NAME, CHOICES_NAME, RECORD_NAME, BODY_FOLDER)
"""Files that a run stopped before its first checkpoint may have written."""


def default_folder(name: str) -> Path:
    """Return the run folder of a run that has only a name."""
    parts = Path(name).parts
    if not parts or ".." in parts or Path(name).is_absolute():
        raise DyngsError(
            f"run.name={name!r}: must name a folder below runs; for another place give run.dir=FOLDER"
        )
    return Path("runs", name)


def require_empty(folder: Path) -> None:
    """Raise unless ``folder`` does not exist or is empty; a lock file whose owner was killed is
    removed."""
    if (
        folder.is_dir()
        and not folder.is_symlink()
        and [path.name for path in folder.iterdir()] == [LOCK_NAME]
    ):
        with writing(folder):  # it removes the file at its end
            pass
    if folder.is_symlink() or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise DyngsError(f"{folder}: exists already; give another --out")
    if folder.exists() and not os.access(folder, os.W_OK):
        raise DyngsError(
            f"{folder}: cannot be written; give another --out or change its permissions"
        )


@contextmanager
def folder_of_export(out: Path, run_dir: Path, config: Config) -> Iterator[Path]:
    """Yield the folder to write the stored scene and configuration of a run to: ``out``, or one
    that becomes it."""
    if not out.exists():
        with new_folder(out, require_empty) as started:
            yield started
        return
    with writing(out):
        if out.resolve() != run_dir.resolve():
            _require_export_of(config, out)
        yield out


def _require_export_of(config: Config, folder: Path) -> None:
    """Raise unless a run can be exported to ``folder``: no run is there, or a former export of the
    same one."""
    found = _found(folder)
    if not found and not checkpoint_paths(folder):
        return
    try:
        same = _is_same_run(load_resolved(folder), config)
    except DyngsError:
        same = False
    if not same or checkpoint_paths(folder):
        raise DyngsError(
            f"{folder}: holds another run, which an export would replace; give another --out"
        )


def require_startable(folder: Path, config: Config) -> None:
    """Raise unless the run of ``config`` would replace nothing in ``folder`` but what the same run
    has only begun."""
    begun = _config_of_begun(folder)
    paths = checkpoint_paths(folder)
    found = _found(folder)
    go_on = f"`dyngs train --resume {as_word(folder)}`, or give another run.dir"
    if paths:
        raise DyngsError(
            f"{folder} already holds a run, stopped after step {step_of(paths[-1]):,}; go on with {go_on}"
        )
    if begun is not None:
        if not (_is_same_run(begun, config) or _is_as_asked(folder, config)):
            raise DyngsError(
                f"{folder} already holds another run, stopped before its first checkpoint; "
                f"begin that again with {go_on}"
            )
    elif found:
        raise DyngsError(
            f"{folder} already holds {found[0]}, which a new run would replace; give another run.dir"
        )


def is_done(folder: Path, config: Config) -> bool:
    """Return whether ``folder`` holds the finished run of just this configuration, as it was asked
    for."""
    paths = checkpoint_paths(folder)
    if not paths or not _is_as_asked(folder, config):
        return False
    return step_of(paths[-1]) >= load_resolved(folder).total_steps


def note_asked(folder: Path, asked: Config) -> None:
    """Write the configuration that was requested next to that of the run, if the two differ."""
    path = folder / ASKED_NAME
    stored = load_resolved(folder)
    if _is_same_run(stored, asked):
        path.unlink(missing_ok=True)
    else:
        save_config(with_body_of(asked, stored), path)


def note_root(folder: Path, data: DataConfig) -> None:
    """Write into the configuration of a run where its capture lies by now; it must be the same
    capture."""
    for path in (folder / RESOLVED_NAME, folder / ASKED_NAME):
        stored = load_resolved(path) if path.is_file() else None
        if stored is not None and stored.data.root != data.root:
            is_network = capability(stored.model, Predicts) is not None
            capture = None if is_network else read_capture(data)
            require_same_capture(folder, data, capture)
            save_config(
                stored.model_copy(
                    update={"data": stored.data.model_copy(update={"root": data.root})}
                ),
                path,
            )


def asked_for(folder: Path) -> Config:
    """Return the configuration of a run as it was asked for."""
    path = folder / ASKED_NAME
    return load_resolved(path if path.is_file() else folder)


def _is_as_asked(folder: Path, config: Config) -> bool:
    try:
        return _is_same_run(asked_for(folder), config)
    except DyngsError:  # a file of that name, but not of a run
        return False


def was_only_begun(folder: Path) -> bool:
    """Return whether a run began in ``folder`` and was stopped before its first checkpoint."""
    return _config_of_begun(folder) is not None


def begin(folder: Path, config: Config) -> None:
    """Write the configuration of a run, unless the same one is there already."""
    begun = _config_of_begun(folder)
    if begun is None or not _is_same_run(begun, config):
        write_config(config, folder)


def tidy(folder: Path, *, sole_writer: bool) -> None:
    """Remove what killed processes left half written in a run folder; its owner calls this before
    it writes.

    ``sole_writer``: no other process writes into it, so that checkpoints that nobody goes on
    writing can be told.
    """
    remove_leftovers(folder, _BEGUN.__contains__ if sole_writer else None)
    for inner in (folder / "checkpoints", folder / EXPORT_FOLDER):
        if not inner.is_symlink():
            remove_leftovers(inner, (lambda _: True) if sole_writer else None)


def _found(folder: Path) -> list[str]:
    """Return the names in ``folder`` that a run writes, whatever lies there under them; those of a
    begun run last."""
    metrics = sorted(path.name for path in folder.glob("metrics*.json"))
    names = [SCENE_FILE, EXPORT_FOLDER, *metrics, *_BEGUN]
    found = [name for name in names if (folder / name).exists() or (folder / name).is_symlink()]
    checkpoints = folder / "checkpoints"
    is_taken = not checkpoints.is_dir() and (checkpoints.exists() or checkpoints.is_symlink())
    return ["checkpoints", *found] if is_taken else found


def _config_of_begun(folder: Path) -> Config | None:
    """Return the configuration of a run stopped before its first checkpoint; None where there is no
    such run."""
    found = _found(folder)
    if (
        RESOLVED_NAME not in found
        or checkpoint_paths(folder)
        or any(name not in _BEGUN for name in found)
    ):
        return None
    try:
        return load_resolved(folder)
    except DyngsError:  # a file of that name, but not of a run
        return None


def _is_same_run(one: Config, other: Config) -> bool:
    """Return whether two runs have the same bytes, whatever they are called, wherever they are, by
    how many threads."""
    return _what_counts(one) == _what_counts(with_body_of(other, one))


def _what_counts(config: Config) -> Config:
    data = config.data.model_copy(update={"follow_links": False})
    return config.model_copy(update={"run": RunConfig(seed=config.run.seed), "data": data})
