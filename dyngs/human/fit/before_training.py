"""The fit of a body before an avatar is trained, kept in the user's cache."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable

from dyngs.capture.photos import digest_of
from dyngs.config import DataConfig
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError, reading
from dyngs.files.temporary import cache_folder
from dyngs.human.fit.fitted_capture import write_fit
from dyngs.human.fit.inputs import FitInputs

KEYPOINTS = "keypoints"
"""Folder of a capture with key points of its images, as OpenPose writes them."""
_LARGEST = 100_000_000
"""Files of a capture larger than this many bytes, such as videos, are not what it says about bodies and cameras."""


def with_fitted_body(
    data: DataConfig,
    *,
    only_if_needed: bool = False,
    say: Callable[[str], None] = print,
    report: ReportProgress = report_nothing,
) -> DataConfig:
    """Return the options with a fit of the free template to the capture; the same capture is fitted once.

    Nothing is fitted where ``data.body`` names a fit, where the capture itself holds one, or without silhouettes.

    Args:
        data: its ``root`` is a capture of a person.
        only_if_needed: fit nothing where the capture has body parameters.
        say: is told in a line what is done, and what came out.
        report: is told how far the fit has come.

    Raises:
        DyngsError: neither body parameters nor silhouettes.
    """
    if data.body is not None:
        return data
    capture = read_capture(data)
    if capture.body is not None and (only_if_needed or capture.body["train"].shape_space == "anny"):
        return data
    if not capture.has_alpha:
        if capture.body is None:
            raise DyngsError(
                f"{data.root}: has neither silhouettes nor body parameters, so no person can be found; add masks of "
                "the person (docs/person.md)"
            )
        say(f"{data.root}: no silhouettes, so the body parameters are taken as given")
        return data
    folder = cache_folder("bodies") / f"{re.sub(r'[^A-Za-z0-9-]', '_', data.root.name)[:40]}.{_digest(data)}"
    if folder.is_dir():
        say(f"body:    the fit of before, in {folder}")
    else:
        say(f"body:    fitted to the silhouettes first, as by `dyngs data fit`, into {folder}")
        points = data.root / KEYPOINTS
        say(write_fit(data, folder, report, FitInputs(points if points.is_dir() else None)).summary())
    return data.model_copy(update={"body": folder})


def _digest(data: DataConfig) -> str:
    """Return a digest of the capture's files (names, sizes, times of change) and of the options of reading it."""
    root = data.root.resolve()
    with reading(root):
        files = sorted(path for path in root.rglob("*") if path.is_file() and path.stat().st_size < _LARGEST)
    options = data.model_dump(mode="json", include={"format", "frames", "times", "frames_per_second", "test_every"})
    chosen = hashlib.sha256(repr(sorted(options.items())).encode()).hexdigest()[:8]
    return f"{digest_of(root, files)}{chosen}"
