"""Silhouettes and key points of one person in a clip, as files that the fit of a body reads.

Local letters: F images of one camera in order of time, H height, W width.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyngs.capture.background import at_size, outlined
from dyngs.capture.fixed_camera import is_plain_clip, read_fixed_camera
from dyngs.capture.photos import digest_of
from dyngs.config import DataConfig
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError, counted, show
from dyngs.data.capture import Capture, View, by_camera
from dyngs.data.images.images import area_downscale_uint8, read_image, target_size
from dyngs.data.read import is_capture, read_capture
from dyngs.human.detect.detector import Detection, Detector
from dyngs.human.detect.following import followed, with_sides
from dyngs.human.detect.mediapipe import MediaPipe
from dyngs.human.detect.warnings import warnings_of
from dyngs.human.fit.fitted_capture import FitInputs, FittedCapture, write_fitted_capture
from dyngs.io.lock import make_once
from dyngs.io.outputs import note_sources, require_new_folder
from dyngs.io.temporary import cache_folder, temporary_folder_beside
from dyngs.io.write import write_image, write_text

SIDE = 960  # longest side of the images that a detector sees, px


@dataclass(frozen=True)
class _Camera:
    """The views of one camera in order of time and their images (F, H, W, 3) uint8."""

    views: tuple[View, ...]
    images: np.ndarray

    @property
    def scale(self) -> float:
        """Pixels of a view per pixel of these images."""
        return self.views[0].width / self.images.shape[2]


def find_person(
    capture: Capture,
    detector: Detector,
    folder: Path,
    report: ReportProgress,
    say: Callable[[str], None] = show,
    number: int = 1,
) -> FitInputs:
    """Find a person in all views, write masks and key points to ``folder``, and return where they
    are.

    Left and right are made the same over time. Where a camera stands, outlines of masks are those
    of what stands before its background. Views without the person, or a camera that never shows
    them, get empty masks. Says what was found, and what will be bad about it.
    Raises DyngsError: nobody is found, or not so many.

    Args:
        number: which person of several: 1 is who fills most of the clip.
    """
    points: dict[str, np.ndarray] = {}
    cameras = _cameras_of(capture)
    for index, camera in enumerate(cameras):
        people = followed(_detected(camera, detector, folder / "frames"))
        report("cameras in which the person is found", index + 1, len(cameras))
        where = "" if len(cameras) == 1 else f"camera {camera.views[0].camera_id}: "
        if not people:
            say(f"warning: {where}{detector.name} finds nobody, its images are left out")
            _write_empty_masks(camera, folder / "masks")
            continue
        if not 1 <= number <= len(people):
            raise DyngsError(
                f"{capture.root}: {where}--person {number}, but people found: {len(people)}"
            )
        person, swapped = with_sides(people[number - 1])
        say(
            f"{where}{_summary(person, detector)}; left and right swapped in {counted(swapped, 'image')}"
        )
        others = [x for x in people if x is not people[number - 1]]
        for warning in warnings_of(camera.images, person, others, alone=len(cameras) == 1):
            say(f"warning: {where}{warning}")
        _write_masks(camera, person, folder / "masks", say)
        for view, own in zip(camera.views, person, strict=True):
            if own is not None:
                points[view.name] = own.keypoints * np.array([camera.scale, camera.scale, 1.0])
    if not points:
        raise DyngsError(
            f"{capture.root}: {detector.name} finds nobody in {counted(sum(len(x.views) for x in cameras), 'image')}; "
            "look at them, or give masks of another program to `dyngs data fit` (docs/person.md)"
        )
    _write_keypoints(folder / "keypoints.json", points)
    return FitInputs(keypoints=folder / "keypoints.json", masks=folder / "masks")


def _cameras_of(capture: Capture) -> list[_Camera]:
    cameras = []
    for views in by_camera(capture.splits).values():
        size = target_size(views[0].width, views[0].height, 1.0, SIDE)
        images = [read_image(view.image_path, (view.width, view.height))[..., :3] for view in views]
        cameras.append(
            _Camera(
                tuple(views), np.stack([area_downscale_uint8(x, *size).numpy() for x in images])
            )
        )
    return cameras


def _detected(camera: _Camera, detector: Detector, folder: Path) -> list[list[Detection]]:
    """Return the people in the images, which a detector reads from files that only live here."""
    files = [folder / f"{row:06d}.png" for row in range(len(camera.images))]
    try:
        for file, image in zip(files, camera.images, strict=True):
            write_image(file, image)
        return detector.detect(files)
    finally:
        for file in files:
            file.unlink(missing_ok=True)


def _summary(person: Sequence[Detection | None], detector: Detector) -> str:
    seen = [x for x in person if x is not None]
    height = float(np.median([x.height for x in seen]))
    return f"{detector.name} finds the person, {height:.0f} px high, in {len(seen)} of {counted(len(person), 'image')}"


def _write_masks(
    camera: _Camera, person: Sequence[Detection | None], folder: Path, say: Callable[[str], None]
) -> None:
    """Write the masks of all views at their size; nothing where the detector makes no masks."""
    size = camera.images.shape[1:3]
    masks = np.stack([np.zeros(size, bool) if x is None else x.mask > 127 for x in person])
    better = outlined(camera.images, masks)
    if better is not None:
        common = (better & masks).sum() / max(int((better | masks).sum()), 1)
        say(
            f"the camera stands: outlines by its background, which agree with the detector's to {common:.3f} (IoU)"
        )
    for view, mask in zip(camera.views, masks if better is None else better, strict=True):
        write_image(folder / f"{view.name}.png", at_size(mask, view))


def _write_empty_masks(camera: _Camera, folder: Path) -> None:
    for view in camera.views:
        write_image(folder / f"{view.name}.png", np.zeros((view.height, view.width), np.uint8))


def _write_keypoints(path: Path, points: dict[str, np.ndarray]) -> None:
    """Write a COCO file of the key points (17, 3) of each view by name."""
    images = [{"id": row, "file_name": f"{name}.png"} for row, name in enumerate(points)]
    people = [
        {"image_id": row, "category_id": 1, "keypoints": [round(float(x), 4) for x in own.ravel()]}
        for row, own in enumerate(points.values())
    ]
    write_text(path, json.dumps({"images": images, "annotations": people}) + "\n")


def write_found_person(
    options: DataConfig,
    out: Path,
    detector: Detector,
    report: ReportProgress = report_nothing,
    say: Callable[[str], None] = show,
    number: int = 1,
) -> FittedCapture:
    """Find a person and fit the body to them: write the capture of ``write_fitted_capture`` to the
    new folder ``out``.

    ``options.root`` is a video or a folder of the frames of one standing camera, or a capture with
    cameras. Raises DyngsError: see ``find_person`` and ``write_fitted_capture``.
    """
    require_new_folder(out)
    clip = options.format == "auto" and not is_capture(options.root) and is_plain_clip(options.root)
    folder = temporary_folder_beside(out.with_name(f"{out.name}.found"))
    try:
        capture = read_fixed_camera(options) if clip else read_capture(options)
        found = find_person(capture, detector, folder, report, say, number)
        return write_fitted_capture(options, out, report, found)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def with_found_person(
    data: DataConfig, *, say: Callable[[str], None] = show, report: ReportProgress = report_nothing
) -> DataConfig:
    """Return the options with the capture of the person that is found in a clip; the same clip is
    looked at once.

    Raises DyngsError: no detector, or see ``write_found_person``.
    """
    name = re.sub(r"[^A-Za-z0-9-]", "_", data.root.stem)[:40]
    chosen = hashlib.sha256(repr(data.frames).encode()).hexdigest()[:8]
    folder = cache_folder("people") / f"{name}.{digest_of(data.root)}{chosen}"

    def find() -> None:
        detector = MediaPipe()
        say(f"person:  found first, as by `dyngs data people`, into {folder}")
        say(write_found_person(data, folder, detector, report, say).summary())

    make_once(folder, find, say, f"person:  found before, in {folder}")
    note_sources(folder, data.root)
    return data.model_copy(update={"root": folder, "frames": None})
