"""Body parameters that were fitted to a capture, kept beside it: read in place of the capture's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.data.body_frames import body_frames
from dyngs.data.capture import BodyFrames, Capture, Split, Splits, all_views
from dyngs.errors import DyngsError, reading
from dyngs.files.containment import staying_within
from dyngs.files.numpy_files import read_npz


def read_body_file(path: Path) -> BodyFrames:
    """Read body parameters: poses (F, 72, 156 or 165), trans (F, 3), betas and, if there, scale and ``frames`` (F,).

    Without ``frames``, row n is for frame n. ``surface_model_type`` "anny" says that betas are of the free template's
    shape space.

    Raises:
        DyngsError: names the file and what is wrong.
    """
    found = read_npz(path, ("poses", "trans", "betas"), ("scale", "surface_model_type", "frames"))
    count = len(found["poses"]) if found["poses"].ndim else 0
    numbers = found.get("frames", np.arange(count))
    if numbers.ndim != 1 or numbers.dtype.kind not in "iu" or len(numbers) != count:
        raise DyngsError(f"{path}: 'frames' must hold one whole number for each row of 'poses'; export it again")
    frames = [int(number) for number in numbers]
    body = body_frames(path, frames, found["poses"], found["trans"], found["betas"], found.get("scale", 1.0))
    return replace(body, shape_space="anny") if str(found.get("surface_model_type")) == "anny" else body


def with_fitted_body(capture: Capture, folder: Path) -> Capture:
    """Return the capture with the body parameters of ``folder``: ``body_train.npz``, and ``body_pose.npz`` if there.

    Raises:
        DyngsError: a file is missing or broken.
    """
    if not (folder / "body_train.npz").is_file():
        raise DyngsError(
            f"{folder / 'body_train.npz'}: no such file (data.body); a fit that `dyngs train human` made comes back by "
            f"training with data.root={capture.root} into another run.dir"
        )
    with staying_within(folder, False), reading(folder, "give a folder that `dyngs data fit` wrote"):
        train = read_body_file(folder / "body_train.npz")
        body: dict[Split, BodyFrames] = {"train": train, "val": train, "test": train}
        if (folder / "body_pose.npz").is_file():
            body["pose"] = read_body_file(folder / "body_pose.npz")
    splits = numbered(capture.splits)
    if "pose" in splits and "pose" not in body:
        splits = {name: views for name, views in splits.items() if name != "pose"}
    return capture.replace(splits=splits, body=body)


def numbered(splits: Splits) -> Splits:
    """Return the views with frame numbers; if any has none, all get them by the order of their times."""
    views = all_views(splits)
    if all(view.frame is not None for view in views):
        return splits
    order = {time: i for i, time in enumerate(sorted({view.time or 0.0 for view in views}))}
    return {name: tuple(replace(view, frame=order[view.time or 0.0]) for view in own) for name, own in splits.items()}
