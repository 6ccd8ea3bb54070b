"""Checks of a capture that was read; each returns one line per suspicious thing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.capture.inspection.facts import counted
from dyngs.capture.inspection.mask_problems import mask_problems
from dyngs.capture.inspection.scene_problems import listed, scene_problems, time_problems
from dyngs.data.capture import Capture, all_views
from dyngs.data.geometry.poses import matrix_fault, pose_fault
from dyngs.data.images.images import SUFFIXES, read_header, read_image
from dyngs.errors import DyngsError, reading, reason
from dyngs.files.containment import staying_within
from dyngs.files.fields import read_json_object


def problems_of(capture: Capture, deep: bool) -> list[str]:
    """Return one line for everything suspicious about a capture, beside its own warnings.

    Args:
        deep: decode every image instead of reading its header only.
    """
    problems = []
    for check in (_split_problems, _name_problems, _pose_problems, _intrinsics_problems):
        problems += check(capture)
    problems += [*_image_problems(capture, deep), *mask_problems(capture)]
    return [*problems, *time_problems(capture), *scene_problems(capture)]


def _split_problems(capture: Capture) -> list[str]:
    problems = []
    if not capture.splits.get("test"):
        problems.append("the split 'test' is empty, so nothing can be measured (see data.test_every)")
    if len(capture.splits.get("train", ())) < 3:
        problems.append(f"only {len(capture.splits.get('train', ()))} training views; a scene needs some 20 or more")
    return problems


def _name_problems(capture: Capture) -> list[str]:
    """Names and images that occur more than once."""
    views = all_views(capture.splits)
    names = Counter(view.name for view in views)
    images = Counter(view.image_path for view in views)
    doubled = listed(
        (n for n, count in names.items() if count > 1), lambda n: f"the name '{n}' occurs {names[n]} times"
    )
    shared = listed((p for p, count in images.items() if count > 1), lambda p: f"{p} is the image of {images[p]} views")
    return doubled + shared


def _pose_problems(capture: Capture) -> list[str]:
    views = all_views(capture.splits)
    problems = listed((fault for fault in map(pose_fault, views) if fault is not None), str)
    poses = Counter(view.cam_from_world.round(9).tobytes() for view in views if view.time is None)
    same = sum(count for count in poses.values() if count > 1)
    if same:
        problems.append(f"{same} views of a static scene share their pose with another one")
    return problems


def _intrinsics_problems(capture: Capture) -> list[str]:
    def faults() -> Iterator[str]:
        for view in all_views(capture.splits):
            k, width, height = view.intrinsics, view.width, view.height
            fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
            if not np.isfinite(k).all() or fx <= 0 or fy <= 0:
                yield f"'{view.name}': the focal length ({fx:g}, {fy:g}) px is not a positive number"
            elif not (0 <= cx <= width and 0 <= cy <= height):
                yield f"'{view.name}': the principal point ({cx:g}, {cy:g}) lies outside the {width}x{height} image"
            elif max(abs(cx / width - 0.5), abs(cy / height - 0.5)) > 0.2:
                yield f"'{view.name}': the principal point ({cx:g}, {cy:g}) is far from the middle of {width}x{height}"
            elif not 0.9 < fx / fy < 1.1:
                yield f"'{view.name}': the focal lengths ({fx:g}, {fy:g}) px differ by more than 10%"
            elif not 0.05 < fx / max(width, height) < 50:
                yield f"'{view.name}': a focal length of {fx:g} px does not suit a {width}x{height} image"

    return listed(faults(), str)


def _image_problems(capture: Capture, deep: bool) -> list[str]:
    """Images and masks that are missing, unreadable, or of another size than their camera's."""
    unreadable, sizes, channels = [], [], Counter[int]()
    for view in all_views(capture.splits):
        for path in (view.image_path, view.mask_path):
            if path is None or (view.video is not None and not path.is_file()):
                continue
            try:
                header = read_header(path)
                if deep:
                    read_image(path)
            except DyngsError as error:
                unreadable.append(str(error))
                continue
            if header.size_for((view.width, view.height)) != (view.width, view.height):
                camera = f"its camera says {view.width}x{view.height}"
                sizes.append(f"{path} has {header.width}x{header.height} pixels, {camera}")
            if path == view.image_path:
                channels[header.channels] += 1
    problems = listed(unreadable, str) + listed(sizes, str)
    if len(channels) > 1:
        problems.append("images have different numbers of channels: " + counted(channels))
    return problems


def transforms_file_problems(root: Path, known: str) -> list[str]:
    """Return the problems of ``transforms*.json`` files in a folder that no reader accepts.

    Args:
        known: the reader's error; lines that it holds already are left out.
    """
    problems = []
    for file in sorted(root.glob("transforms*.json")) if root.is_dir() else []:
        try:
            with staying_within(root):
                frames: Any = read_json_object(file).get("frames", [])
            with reading(file):
                entries = [(str(frame["file_path"]), np.array(frame["transform_matrix"], float)) for frame in frames]
                names = Counter(name for name, _ in entries)
                missing = [n for n in names if not any((root / (n + suffix)).is_file() for suffix in ("", *SUFFIXES))]
        except DyngsError as error:
            if str(file) not in known:
                why = reason(error.__cause__ or error)
                problems.append(f"{file}: holds no frames with 'file_path' and 'transform_matrix' ({why})")
            continue
        faults = (matrix_fault(pose, f"{file}: '{name}'") for name, pose in entries)
        doubled = ((n, count) for n, count in names.items() if count > 1)
        if not entries:
            problems.append(f"{file} lists no frames")
        problems += listed(missing, lambda n: f"{root / n}: no such image")
        problems += listed((fault for fault in faults if fault is not None), str)
        problems += listed(doubled, lambda item: f"the name '{item[0]}' occurs {item[1]} times")
    return [line for line in problems if line not in known]
