"""Detects one person in a capture; writes silhouettes and key points for the body fit.

Local letters: F images of one camera in order of time, H height, W width.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from dyngs.capture.fixed_camera import is_image_sequence, read_fixed_camera
from dyngs.capture.masks import refine_outlines, resize_mask
from dyngs.capture.sfm.photos import digest_files
from dyngs.config import DataConfig
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info
from dyngs.data.capture import Capture, View, group_by_camera
from dyngs.data.images.images import area_downscale_uint8, read_image, target_size
from dyngs.data.read import is_capture, read_capture
from dyngs.human.detect.detector import MIN_CONFIDENCE, Detection, Detector, MediaPipe
from dyngs.human.fit.capture_fit import viterbi_path
from dyngs.human.fit.fitted_capture import FitInputs, FittedCapture, write_fitted_capture
from dyngs.io.outputs import make_once, record_source, require_new_folder
from dyngs.io.write import cache_folder, temporary_folder_beside, write_image, write_text

SWAP_COST = 0.04
"""Cost per image of exchanging left and right, as mean motion of a key point per frame in heights
of the person. Confused limbs move further than this in a few images; a person who has turned around
stays so for many images and is not changed."""
_PAIRS = {
    "all": ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16)),
    "arms": ((7, 8), (9, 10)),
    "legs": ((13, 14), (15, 16)),
}
"""Pairs of left and right COCO key points, by the groups that are exchanged together."""


def fix_left_right_swaps(person: Sequence[Detection | None]) -> tuple[list[Detection | None], int]:
    """Make left and right consistent over time in the F detections of a person.

    Detectors confuse crossing arms, and front with back. All pairs of key points, then arms, then
    legs are exchanged in the images where this reduces motion by more than ``SWAP_COST``. Dynamic
    programming finds the sequence of least cost.

    Returns:
        the corrected detections, and the number of changed images.
    """
    numbers = [number for number, x in enumerate(person) if x is not None]
    detections = [x for x in person if x is not None]
    points = np.array([x.keypoints for x in detections], np.float64).reshape(-1, 17, 3)
    heights = np.array([x.height for x in detections])
    changed = np.zeros(len(points), bool)
    for pairs in _PAIRS.values():
        swapped = _find_swaps(points, np.array(pairs), heights)
        for left, right in pairs:
            points[swapped, left], points[swapped, right] = (
                points[swapped, right],
                points[swapped, left],
            )
        changed ^= swapped
    result = list(person)
    for number, detection, own in zip(numbers, detections, points.astype(np.float32), strict=True):
        result[number] = replace(detection, keypoints=own)
    return result, int(changed.sum())


def _find_swaps(points: np.ndarray, pairs: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Return the images (F,) bool in which to exchange left and right.

    ``points``: (F, 17, 3) key points. ``pairs``: (P, 2) left and right rows.
    """
    if len(points) < 2:
        return np.zeros(len(points), bool)
    # (2, F, P, 2, 3): original and exchanged key points
    both = np.stack([points[:, pairs], points[:, pairs[:, ::-1]]])
    sure: np.ndarray = np.all(points[:, pairs, 2] > MIN_CONFIDENCE, axis=-1)  # (F, P)
    weights = (sure[1:] & sure[:-1])[..., None]
    # (2, 2, F - 1, P, 2): motion from each state of an image to each state of the next one
    moved = np.linalg.norm(both[None, :, 1:, ..., :2] - both[:, None, :-1, ..., :2], axis=-1)
    units = heights[1:].clip(1e-6) * (2 * weights.sum((1, 2))).clip(1)
    changes = (moved * weights).sum((3, 4)) / units
    costs = np.tile([0.0, SWAP_COST], (len(points), 1))
    return np.array(viterbi_path(costs, changes.transpose(2, 0, 1)), bool)


def capture_warnings(
    images: np.ndarray, person: Sequence[Detection | None], *, alone: bool = True
) -> list[str]:
    """Return warnings about problems of a recording that reduce the quality of an avatar.

    Args:
        images: (F, H, W, 3) uint8.
        person: detection of the person in each image, None if there is none.
        alone: whether the capture has no other camera.
    """
    shown = [(image, x) for image, x in zip(images, person, strict=True) if x is not None]
    detections = [x for _, x in shown]
    count = len(shown)
    height = float(np.median([x.height for x in detections]))
    cut = sum(_is_cut_off(x, images.shape[1]) for x in detections)
    sharp = np.array([_sharpness(image, x) for image, x in shown])
    blurred = int((sharp < 0.3 * np.median(sharp)).sum())
    lines = []
    if count < len(images):
        gone = len(images) - count
        lines.append(
            f"no person found in {gone} of {format_count(len(images), 'image')}; these are left out"
        )
    if cut > 0.1 * count:
        lines.append(
            f"the feet are cut off or hidden in {cut} of {format_count(count, 'image')}; the legs are unknown there"
        )
    if height < 120:
        lines.append(f"the person is {height:.0f} px high; move closer or record larger images")
    if blurred > 0.1 * count:
        lines.append(
            f"blurred: {format_count(blurred, 'image')}; use more light, or move more slowly"
        )
    if alone and not _turns(detections):
        lines.append("the person never turns around; sides that the camera never sees are unknown")
    return lines


def _is_cut_off(person: Detection, height: int) -> bool:
    ankles = person.keypoints[[15, 16]]
    return bool(
        (ankles[:, 2] < MIN_CONFIDENCE).all()
        or (ankles[:, 1] > height - 2).any()
        or person.box[3] > height - 1.5
    )


def _sharpness(image: np.ndarray, person: Detection) -> float:
    """Return the ratio of two standard deviations in the person's box: Laplacian, grey levels."""
    left, top, right, bottom = (max(round(float(edge)), 0) for edge in person.box)
    grey = image[top:bottom, left:right].astype(np.float32).mean(-1)
    return float(ndimage.laplace(grey).std() / max(float(grey.std()), 1.0)) if grey.size else 0.0


def _turns(people: Sequence[Detection]) -> bool:
    """Return whether the person is seen from the front and from behind.

    The left shoulder must be to the right of the right one in an image, and to its left in another,
    each by a tenth of the person's height.
    """
    left, right = (np.array([x.keypoints[row] for x in people]) for row in (5, 6))
    sure = (left[:, 2] > MIN_CONFIDENCE) & (right[:, 2] > MIN_CONFIDENCE)
    across = (left[sure, 0] - right[sure, 0]) / np.array([max(x.height, 1.0) for x in people])[sure]
    return bool((across > 0.1).any() and (across < -0.1).any())


DETECTOR_SIDE_PX = 960  # longest side to which images are resized for the detector, px


def detect_person(
    capture: Capture,
    detector: Detector,
    folder: Path,
    report: ProgressCallback,
    log: Callable[[str], None] = log_info,
) -> FitInputs:
    """Detect a person in all views; write masks and key points to ``folder``; return their paths.

    Left and right are made consistent over time. Masks of fixed cameras are refined by background
    subtraction. Views without the person get empty masks. Logs the detections and warnings about
    the recording.
    Raises DyngsError: no view shows a person.
    """
    points: dict[str, np.ndarray] = {}
    cameras = [*group_by_camera(capture.splits).values()]
    for index, views in enumerate(cameras, 1):
        # The detector reads files; they are removed after it has run.
        size = target_size(views[0].width, views[0].height, 1.0, DETECTOR_SIDE_PX)
        files = [folder / "frames" / f"{row:06d}.png" for row in range(len(views))]
        images = np.stack([_shrunk_image(view, size) for view in views])
        for file, image in zip(files, images, strict=True):
            write_image(file, image)
        person, swapped = fix_left_right_swaps(detector.detect(files))
        for file in files:
            file.unlink()
        report("cameras in which the person is found", index, len(cameras))
        where = "" if len(cameras) == 1 else f"camera {views[0].camera_id}: "
        heights = [x.height for x in person if x is not None]
        if not heights:
            log(f"warning: {where}{detector.name} finds nobody, its images are left out")
        else:
            log(
                f"{where}{detector.name} finds the person, {np.median(heights):.0f} px high, in {len(heights)} of "
                f"{format_count(len(person), 'image')}; left and right swapped in {format_count(swapped, 'image')}"
            )
            for warning in capture_warnings(images, person, alone=len(cameras) == 1):
                log(f"warning: {where}{warning}")
        masks = np.zeros(images.shape[:3], bool)
        for row, own in enumerate(person):
            if own is not None:
                masks[row] = own.mask > 127
                scale = views[row].width / size[0]
                points[views[row].name] = own.keypoints * np.array([scale, scale, 1.0])
        refined = refine_outlines(images, masks) if heights else None
        if refined is not None:
            iou = (refined & masks).sum() / max(int((refined | masks).sum()), 1)
            log(
                f"fixed camera: outlines refined by its background (IoU {iou:.3f} "
                "with the detector's masks)"
            )
            masks = refined
        for view, mask in zip(views, masks, strict=True):
            write_image(folder / "masks" / f"{view.name}.png", resize_mask(mask, view))
    if not points:
        raise DyngsError(
            f"{capture.root}: {detector.name} finds nobody in {format_count(sum(map(len, cameras)), 'image')}; look at "
            "them, or give masks of another program to `dyngs data fit` (`dyngs docs people`)"
        )
    _write_keypoints(folder / "keypoints.json", points)
    return FitInputs(keypoints=folder / "keypoints.json", masks=folder / "masks")


def _shrunk_image(view: View, size: tuple[int, int]) -> np.ndarray:
    pixels = read_image(view.image_path, (view.width, view.height))[..., :3]
    return area_downscale_uint8(pixels, *size).numpy()


def _write_keypoints(path: Path, points: dict[str, np.ndarray]) -> None:
    """Write key points (17, 3), by name of the view, as a COCO file."""
    images = [{"id": row, "file_name": f"{name}.png"} for row, name in enumerate(points)]
    people = [
        {"image_id": row, "category_id": 1, "keypoints": [round(float(x), 4) for x in own.ravel()]}
        for row, own in enumerate(points.values())
    ]
    write_text(path, json.dumps({"images": images, "annotations": people}) + "\n")


def write_detected_person(
    options: DataConfig,
    out: Path,
    detector: Detector,
    report: ProgressCallback = ignore_progress,
    log: Callable[[str], None] = log_info,
) -> FittedCapture:
    """Detect a person, fit the body, and write the fitted capture to the new folder ``out``.

    ``options.root`` is a video or a folder of frames of one fixed camera, or a capture with camera
    poses. Raises DyngsError: see ``detect_person`` and ``write_fitted_capture``.
    """
    require_new_folder(out)
    clip = (
        options.format == "auto"
        and not is_capture(options.root)
        and is_image_sequence(options.root)
    )
    folder = temporary_folder_beside(out.with_name(f"{out.name}.found"))
    try:
        capture = read_fixed_camera(options) if clip else read_capture(options)
        found = detect_person(capture, detector, folder, report, log)
        return write_fitted_capture(options, out, report, found)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def ensure_detected_person(
    data: DataConfig,
    *,
    log: Callable[[str], None] = log_info,
    report: ProgressCallback = ignore_progress,
) -> DataConfig:
    """Return options that name the fitted capture of a clip, which is made if it is not cached.

    Raises DyngsError: no detector is installed, or see ``write_detected_person``.
    """
    name = re.sub(r"[^A-Za-z0-9-]", "_", data.root.stem)[:40]
    selection = hashlib.sha256(repr(data.frames).encode()).hexdigest()[:8]
    folder = cache_folder("people") / f"{name}.{digest_files(data.root)}{selection}"

    def detect() -> None:
        detector = MediaPipe()
        log(f"person:  detection and body fit (`dyngs data people`), cached in {folder}")
        log(write_detected_person(data, folder, detector, report, log).summary)

    make_once(folder, detect, log, f"person:  reuses the body fit in {folder}")
    record_source(folder, data.root)
    return data.model_copy(update={"root": folder, "frames": None})
