"""Masks and key points of one person in a clip, written as input files of the body fit.

Symbols: F images of one camera in order of time, H height, W width, P pairs of key points.
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
"""Cost of starting or ending a left-right swap, as key point motion in heights of the person. A
limb mistaken for the other one in a few images moves more than this."""
_PAIRS = {
    "all": ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16)),
    "arms": ((7, 8), (9, 10)),
    "legs": ((13, 14), (15, 16)),
}
"""Pairs of left and right COCO key points."""


def fix_left_right_swaps(person: Sequence[Detection | None]) -> tuple[list[Detection | None], int]:
    """Make left and right consistent over time; return the F detections and the number of changed
    images.

    Detectors confuse arms where they cross, and front with back. All pairs of key points, then
    arms, then legs are swapped in those images where the cheapest sequence (dynamic programming
    over key point motion, with ``SWAP_COST``) has them swapped.
    """
    numbers = [number for number, x in enumerate(person) if x is not None]
    detections = [x for x in person if x is not None]
    points = np.array([x.keypoints for x in detections], np.float64).reshape(-1, 17, 3)
    heights = np.array([x.height for x in detections])
    was_swapped = np.zeros(len(points), bool)
    for pairs in _PAIRS.values():
        swapped = _find_swaps(points, np.array(pairs), heights)
        for left, right in pairs:
            points[swapped, left], points[swapped, right] = (
                points[swapped, right],
                points[swapped, left],
            )
        was_swapped ^= swapped
    result = list(person)
    for number, detection, keypoints in zip(
        numbers, detections, points.astype(np.float32), strict=True
    ):
        result[number] = replace(detection, keypoints=keypoints)
    return result, int(was_swapped.sum())


def _find_swaps(points: np.ndarray, pairs: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Return the images (F,) bool in which ``pairs`` (P, 2) of ``points`` (F, 17, 3) should be
    swapped."""
    if len(points) < 2:
        return np.zeros(len(points), bool)
    # (2, F, P, 2, 3): original and swapped
    both = np.stack([points[:, pairs], points[:, pairs[:, ::-1]]])
    confident: np.ndarray = np.all(points[:, pairs, 2] > MIN_CONFIDENCE, axis=-1)  # (F, P)
    weights = (confident[1:] & confident[:-1])[..., None]
    # (2, 2, F - 1, P, 2): motion from the first state to the second
    distances = np.linalg.norm(both[None, :, 1:, ..., :2] - both[:, None, :-1, ..., :2], axis=-1)
    units = heights[1:].clip(1e-6) * (2 * weights.sum((1, 2))).clip(1)
    changes = (distances * weights).sum((3, 4)) / units
    costs = np.tile([0.0, SWAP_COST], (len(points), 1))
    return np.array(viterbi_path(costs, changes.transpose(2, 0, 1)), bool)


def capture_warnings(
    images: np.ndarray, person: Sequence[Detection | None], *, is_single_camera: bool = True
) -> list[str]:
    """Return warnings about images that the body fit cannot use well.

    Args:
        images: (F, H, W, 3) uint8.
        person: detection in each image.
        is_single_camera: whether the capture has one camera only.
    """
    detected = [(image, x) for image, x in zip(images, person, strict=True) if x is not None]
    detections = [x for _, x in detected]
    count = len(detected)
    height = float(np.median([x.height for x in detections]))
    num_cut_off = sum(_is_cut_off(x, images.shape[1]) for x in detections)
    sharpness = np.array([_sharpness(image, x) for image, x in detected])
    num_blurred = int((sharpness < 0.3 * np.median(sharpness)).sum())
    messages = []
    if count < len(images):
        num_missing = len(images) - count
        messages.append(
            f"no person detected in {num_missing} of {format_count(len(images), 'image')}; "
            "skipping them"
        )
    if num_cut_off > 0.1 * count:
        messages.append(
            f"feet are cut off or hidden in {num_cut_off} of {format_count(count, 'image')}; legs "
            "are not reliable there"
        )
    if height < 120:
        messages.append(
            f"the person is only {height:.0f} px high; move closer or record larger images"
        )
    if num_blurred > 0.1 * count:
        messages.append(
            f"{format_count(num_blurred, 'image')} blurred; use more light or slower motion"
        )
    if is_single_camera and not _turns(detections):
        messages.append(
            "the person never turns around; sides that the camera does not see are guessed"
        )
    return messages


def _is_cut_off(person: Detection, height: int) -> bool:
    ankles = person.keypoints[[15, 16]]
    return bool(
        (ankles[:, 2] < MIN_CONFIDENCE).all()
        or (ankles[:, 1] > height - 2).any()
        or person.box[3] > height - 1.5
    )


def _sharpness(image: np.ndarray, person: Detection) -> float:
    """Return the standard deviation of the Laplacian over that of grey levels, in the person's
    box."""
    left, top, right, bottom = (max(round(float(edge)), 0) for edge in person.box)
    grey = image[top:bottom, left:right].astype(np.float32).mean(-1)
    return float(ndimage.laplace(grey).std() / max(float(grey.std()), 1.0)) if grey.size else 0.0


def _turns(people: Sequence[Detection]) -> bool:
    """True if the person is seen from the front and from behind.

    The left shoulder is then once right and once left of the right one, by a tenth of the height.
    """
    left, right = (np.array([x.keypoints[row] for x in people]) for row in (5, 6))
    confident = (left[:, 2] > MIN_CONFIDENCE) & (right[:, 2] > MIN_CONFIDENCE)
    across = (left[confident, 0] - right[confident, 0]) / np.array(
        [max(x.height, 1.0) for x in people]
    )[confident]
    return bool((across > 0.1).any() and (across < -0.1).any())


DETECTOR_SIDE_PX = 960  # longest side of the images given to a detector


def detect_person(
    capture: Capture,
    detector: Detector,
    folder: Path,
    on_progress: ProgressCallback,
    log: Callable[[str], None] = log_info,
) -> FitInputs:
    """Detect the person in all views; write masks and key points to ``folder`` and return their
    paths.

    Left and right are made consistent over time. With a fixed camera, masks follow the difference
    from its background. Views without the person get empty masks. Results and warnings are logged.
    Raises DyngsError: nobody is detected.
    """
    points: dict[str, np.ndarray] = {}
    cameras = [*group_by_camera(capture.splits).values()]
    for index, views in enumerate(cameras, 1):
        # Detectors read image files, which are deleted afterwards.
        size = target_size(views[0].width, views[0].height, 1.0, DETECTOR_SIDE_PX)
        files = [folder / "frames" / f"{row:06d}.png" for row in range(len(views))]
        images = np.stack([_shrunk_image(view, size) for view in views])
        for file, image in zip(files, images, strict=True):
            write_image(file, image)
        person, num_swapped = fix_left_right_swaps(detector.detect(files))
        for file in files:
            file.unlink()
        on_progress("detecting the person, cameras", index, len(cameras))
        prefix = "" if len(cameras) == 1 else f"camera {views[0].camera_id}: "
        heights = [x.height for x in person if x is not None]
        if not heights:
            log(f"warning: {prefix}{detector.name} detects nobody; skipping its images")
        else:
            log(
                f"{prefix}{detector.name} detected the person in {len(heights)} of "
                f"{format_count(len(person), 'image')}, {np.median(heights):.0f} px high; swapped "
                f"left and right in {format_count(num_swapped, 'image')}"
            )
            for warning in capture_warnings(images, person, is_single_camera=len(cameras) == 1):
                log(f"warning: {prefix}{warning}")
        masks = np.zeros(images.shape[:3], bool)
        for row, detection in enumerate(person):
            if detection is not None:
                masks[row] = detection.mask > 127
                scale = views[row].width / size[0]
                points[views[row].name] = detection.keypoints * np.array([scale, scale, 1.0])
        outlines = refine_outlines(images, masks) if heights else None
        if outlines is not None:
            iou = (outlines & masks).sum() / max(int((outlines | masks).sum()), 1)
            log(
                f"fixed camera: masks refined by background subtraction (IoU with the detector's "
                f"{iou:.3f})"
            )
            masks = outlines
        for view, mask in zip(views, masks, strict=True):
            write_image(folder / "masks" / f"{view.name}.png", resize_mask(mask, view))
    if not points:
        raise DyngsError(
            f"{capture.root}: {detector.name} detects nobody in "
            f"{format_count(sum(map(len, cameras)), 'image')}; check the images, or pass masks of "
            "another program to `dyngs data fit` (`dyngs docs people`)"
        )
    _write_keypoints(folder / "keypoints.json", points)
    return FitInputs(keypoints=folder / "keypoints.json", masks=folder / "masks")


def _shrunk_image(view: View, size: tuple[int, int]) -> np.ndarray:
    pixels = read_image(view.image_path, (view.width, view.height))[..., :3]
    return area_downscale_uint8(pixels, *size).numpy()


def _write_keypoints(path: Path, points: dict[str, np.ndarray]) -> None:
    """Write the key points (17, 3) of each view, by name, as a COCO file."""
    images = [{"id": row, "file_name": f"{name}.png"} for row, name in enumerate(points)]
    people = [
        {
            "image_id": row,
            "category_id": 1,
            "keypoints": [round(float(x), 4) for x in keypoints.ravel()],
        }
        for row, keypoints in enumerate(points.values())
    ]
    write_text(path, json.dumps({"images": images, "annotations": people}) + "\n")


def write_detected_person(
    options: DataConfig,
    out: Path,
    detector: Detector,
    on_progress: ProgressCallback = ignore_progress,
    log: Callable[[str], None] = log_info,
) -> FittedCapture:
    """Detect a person, fit the body, and write the fitted capture to the new folder ``out``.

    ``options.root`` is a video, a folder with frames of one fixed camera, or a capture with
    cameras. Raises DyngsError: see ``detect_person`` and ``write_fitted_capture``.
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
        inputs = detect_person(capture, detector, folder, on_progress, log)
        return write_fitted_capture(options, out, on_progress, inputs)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def ensure_detected_person(
    data: DataConfig,
    *,
    log: Callable[[str], None] = log_info,
    on_progress: ProgressCallback = ignore_progress,
) -> DataConfig:
    """Return options for the fitted capture of the person in a clip; the result is cached per
    clip.

    Raises DyngsError: there is no detector, or see ``write_detected_person``.
    """
    name = re.sub(r"[^A-Za-z0-9-]", "_", data.root.stem)[:40]
    frames_hash = hashlib.sha256(repr(data.frames).encode()).hexdigest()[:8]
    folder = cache_folder("people") / f"{name}.{digest_files(data.root)}{frames_hash}"

    def detect() -> None:
        detector = MediaPipe()
        log(f"person:  detecting (see `dyngs data people`), result in {folder}")
        log(write_detected_person(data, folder, detector, on_progress, log).summary)

    make_once(folder, detect, log, f"person:  using the cached result in {folder}")
    record_source(folder, data.root)
    return data.model_copy(update={"root": folder, "frames": None})
