"""The configuration in a run folder and the fitted body that it names next to it: the folder may
move as a whole."""

from __future__ import annotations

import shutil
from pathlib import Path

from dyngs.config import Config
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.core.errors import DyngsError
from dyngs.io.write import remove_quietly, temporary_folder_beside

BODY_FOLDER = "body"
"""In a run folder: the fit that ``data.body`` named when the run began."""
_PARAMETERS = ("body_train.npz", "body_pose.npz")
_KEPT = (*_PARAMETERS, "fit_report.json")
"""Files of a fit that are kept; images are not."""


def write_config(config: Config, folder: Path) -> None:
    """Write the configuration of the run in ``folder``, with a copy of the fit that ``data.body``
    names.

    The fit is copied once: where the folder has one it is the run's. Where the fit is gone, as that
    of a run of former versions may be, its path stays as it is.
    """
    body = config.data.body
    own = folder.absolute() / BODY_FOLDER
    if body is not None and (own.is_dir() or (body / _PARAMETERS[0]).is_file()):
        if not own.is_dir():
            _copy_fit(body, own)
        config = _with_body(config, own)
    save_config(config, folder / RESOLVED_NAME)


def with_body_of(config: Config, stored: Config) -> Config:
    """Return ``config`` with the path of the fit of ``stored``, where both have the same."""
    return (
        _with_body(config, stored.data.body)
        if is_same_body(config.data.body, stored.data.body)
        else config
    )


def is_same_body(one: Path | None, other: Path | None) -> bool:
    """Return whether two values of ``data.body`` give the same body parameters, wherever they
    lie."""
    if one == other or one is None or other is None:
        return one == other
    return (one / _PARAMETERS[0]).is_file() and all(
        _content(one / x) == _content(other / x) for x in _PARAMETERS
    )


def _with_body(config: Config, body: Path | None) -> Config:
    return config.model_copy(update={"data": config.data.model_copy(update={"body": body})})


def _copy_fit(body: Path, own: Path) -> None:
    """Copy a fit to the new folder ``own``, which appears complete or not at all."""
    started = temporary_folder_beside(own)
    try:
        for name in _KEPT:
            if (body / name).is_file():
                shutil.copyfile(body / name, started / name)
        started.rename(own)
    except OSError as error:
        raise DyngsError(f"cannot write {own}: {error.strerror or error}") from error
    finally:
        remove_quietly(started)


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None
