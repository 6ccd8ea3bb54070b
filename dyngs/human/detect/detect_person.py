"""Masks and key points of one person in a clip, written as input files of the body fit.

Symbols: F images of one camera in order of time, H height, W width, P pairs of key points.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from dyngs.capture.fixed_camera import is_image_sequence, read_fixed_camera
from dyngs.capture.masks import estimate_alpha, resize_mask, soften_outline
from dyngs.capture.sfm.photos import digest_files
from dyngs.config import DataConfig
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info
from dyngs.data.capture import Capture, View, group_by_camera
from dyngs.data.images.images import area_downscale_uint8, read_image, target_size
from dyngs.data.read import is_capture, read_capture
from dyngs.human.detect.detector import Detection, Detector, MediaPipe
from dyngs.human.detect.pictures import detection_sheet, people_sheet
from dyngs.human.detect.tracking import (
    PARAMS,
    PersonTrack,
    covered_images,
    expand_box,
    find_people,
    key_point_distance,
)
from dyngs.human.fit.fitted_capture import FitInputs, FittedCapture, write_fitted_capture
from dyngs.human.fit.keypoints import KEY_POINTS, MIN_CONFIDENCE, WHOLE_BODY_ROWS
from dyngs.human.fit.viterbi import viterbi_path
from dyngs.io.outputs import make_once, record_source, require_new_folder
from dyngs.io.write import cache_folder, temporary_folder_beside, write_image, write_text

SWAP_COST = 0.04
"""Cost of starting or ending a left-right swap, as key point motion in heights of the person. A
limb mistaken for the other one in a few images moves more than this."""
_PAIRS = {
    "all": tuple((left, left + 1) for left in range(1, len(KEY_POINTS), 2)),
    "arms": ((7, 8), (9, 10), (21, 22), (23, 24)),
    "legs": ((13, 14), (15, 16), (17, 18), (19, 20)),
}
"""Pairs of left and right key points, by their rows in ``KEY_POINTS``."""


def fix_left_right_swaps(person: Sequence[Detection | None]) -> tuple[list[Detection | None], int]:
    """Make left and right consistent over time; return the F detections and the number of changed
    images.

    Detectors confuse arms where they cross, and front with back. All pairs of key points, then
    arms, then legs are swapped in those images where the cheapest sequence (dynamic programming
    over key point motion, with ``SWAP_COST``) has them swapped.
    """
    numbers = [number for number, x in enumerate(person) if x is not None]
    detections = [x for x in person if x is not None]
    points = np.array([x.keypoints for x in detections], np.float64).reshape(-1, len(KEY_POINTS), 3)
    heights = np.array([x.height for x in detections])
    positions = [x.positions for x in detections]
    was_swapped = np.zeros(len(points), bool)
    for pairs in _PAIRS.values():
        # Hands and feet follow; they would outvote shoulders and hips.
        deciding = [(left, right) for left, right in pairs if left < 17]
        swapped = _find_swaps(points, np.array(deciding), heights)
        for left, right in pairs:
            points[swapped, left], points[swapped, right] = (
                points[swapped, right],
                points[swapped, left],
            )
        swap = np.arange(len(KEY_POINTS))
        swap[np.array(pairs)] = np.array(pairs)[:, ::-1]
        positions = [
            x[swap] if is_swapped and x is not None else x
            for x, is_swapped in zip(positions, swapped, strict=True)
        ]
        was_swapped ^= swapped
    result = list(person)
    for number, detection, keypoints, own in zip(
        numbers, detections, points.astype(np.float32), positions, strict=True
    ):
        result[number] = replace(detection, keypoints=keypoints, positions=own)
    return result, int(was_swapped.sum())


def _find_swaps(points: np.ndarray, pairs: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Return the images (F,) bool in which ``pairs`` (P, 2) of ``points`` (F, K, 3) should be
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


DETECTOR_SIDE_PX = 960
"""Longest side of the images in which people are searched, and of masks while they are refined."""
CROP_SIDE_PX = 512
"""Longest side of the crops around the person in which outlines and key points are detected."""
MAX_REPROJECTION_ERROR = 0.15
"""Mean distance, in heights, between epipolar lines and key points of one person in two cameras."""


@dataclass(frozen=True)
class CameraPeople:
    """People in the images of one camera, the most visible first, in px of the full images."""

    views: tuple[View, ...]
    tracks: tuple[PersonTrack, ...]


def detect_person(
    capture: Capture,
    detector: Detector,
    folder: Path,
    on_progress: ProgressCallback,
    log: Callable[[str], None] = log_info,
    *,
    person: int | None = None,
) -> FitInputs:
    """Detect one person in all views; write masks and key points to ``folder`` and return their
    paths.

    Everybody in the images is followed over time. ``person`` numbers them by their size and time in
    the images, from 1; None: the first. Views in which somebody else is in front of that person
    are left out. Left and right are made consistent over time. With a fixed camera, masks follow
    the difference from its background. Views without the person get empty masks. Results and
    warnings are logged. ``detection.png`` shows outlines and key points; with several people,
    ``people.png`` shows them with their numbers. Raises DyngsError: nobody is detected, or no
    person has that number.
    """
    groups = [*group_by_camera(capture.splits).values()]
    search = CropDetector(detector, folder / "crops")
    cameras: list[CameraPeople] = []
    for index, views in enumerate(groups, 1):
        cameras.append(_find_people(views, search))
        on_progress("searching people, cameras", index, len(groups))
    subjects = choose_subjects(cameras, (person or 1) - 1)
    if not any(camera.tracks for camera in cameras):
        raise DyngsError(
            f"{capture.root}: {detector.name} detects nobody in "
            f"{format_count(sum(map(len, groups)), 'image')}; check the images, or pass masks of "
            "another program to `dyngs data fit` (`dyngs docs people`)"
        )
    if not any(subjects):
        most = max(len(camera.tracks) for camera in cameras)
        raise DyngsError(
            f"{capture.root}: there is no person {person}; {detector.name} found {most}, so give a "
            f"number from 1 to {most}"
        )
    if any(len(camera.tracks) > 1 for camera in cameras):
        _describe_people(cameras, subjects, folder / "people.png", log)
    found: dict[str, Detection] = {}
    all_masks: list[np.ndarray] = []
    for index, (camera, subject) in enumerate(zip(cameras, subjects, strict=True), 1):
        prefix = "" if len(cameras) == 1 else f"camera {camera.views[0].camera_id}: "
        if subject is None:
            log(f"warning: {prefix}{detector.name} detects nobody; skipping its images")
            masks = _empty_masks(camera.views)
        else:
            masks, own = _outline_person(camera, subject, search, prefix, log)
            found.update(own)
        for view, mask in zip(camera.views, masks, strict=True):
            write_image(folder / "masks" / f"{view.name}.png", mask)
        all_masks += masks
        on_progress("detecting the person, cameras", index, len(cameras))
    if not found:
        raise DyngsError(
            f"{capture.root}: the person is hidden or not recognised in all images; choose another "
            "one (data.person) or other frames (data.frames)"
        )
    views = [view for camera in cameras for view in camera.views]
    keypoints = [found[view.name].keypoints if view.name in found else None for view in views]
    write_image(folder / "detection.png", detection_sheet(views, all_masks, keypoints))
    _write_keypoints(folder / "keypoints.json", found)
    return FitInputs(keypoints=folder / "keypoints.json", masks=folder / "masks")


@dataclass(frozen=True)
class CropDetector:
    """A detector that searches windows of images, which it gets as files in ``folder``."""

    detector: Detector
    folder: Path

    def __call__(
        self, windows: Sequence[tuple[np.ndarray, np.ndarray]], side: int
    ) -> list[Detection | None]:
        """Return the person in each window, in px of the image, with the mask of the window.

        Args:
            windows: pixels (h, w, 3) uint8, and their box (4,) in the image.
            side: longest side at which a window is searched, px.
        """
        files = [self.folder / f"{row:06d}.png" for row in range(len(windows))]
        scales = []
        for file, (pixels, _) in zip(files, windows, strict=True):
            crop = np.ascontiguousarray(pixels)
            size = target_size(crop.shape[1], crop.shape[0], 1.0, side)
            write_image(file, area_downscale_uint8(torch.from_numpy(crop), *size).numpy())
            scales.append(crop.shape[1] / size[0])
        detections = self.detector.detect(files)
        for file in files:
            file.unlink()
        result: list[Detection | None] = []
        for detection, (_, box), scale in zip(detections, windows, scales, strict=True):
            if detection is not None:
                keypoints = detection.keypoints * np.array([scale, scale, 1.0])
                keypoints[:, :2] += box[:2]
                detection = replace(detection, keypoints=keypoints.astype(np.float32))
            result.append(detection)
        return result


def _find_people(views: Sequence[View], search: CropDetector) -> CameraPeople:
    size = target_size(views[0].width, views[0].height, 1.0, DETECTOR_SIDE_PX)
    images = np.stack([_shrunk_image(view, size) for view in views])
    tracks = find_people(
        images,
        lambda windows: search([(_cut(images[i], box), box) for i, box in windows], CROP_SIDE_PX),
    )
    scale = views[0].width / size[0]
    return CameraPeople(tuple(views), tuple(track.scaled(scale) for track in tracks))


def choose_subjects(cameras: Sequence[CameraPeople], rank: int) -> list[PersonTrack | None]:
    """Return the same person in each camera, None where they are not found.

    The camera that sees most people numbers them; ``rank`` counts from 0. In each other camera the
    track is chosen whose key points agree best with the epipolar geometry.
    """
    main = _main_camera(cameras)
    if rank >= len(main.tracks):
        return [None for _ in cameras]
    subject = main.tracks[rank]
    subjects: list[PersonTrack | None] = []
    for camera in cameras:
        if camera is main:
            subjects.append(subject)
            continue
        errors = [_epipolar_error(main, subject, camera, track) for track in camera.tracks]
        is_other = not errors or min(errors) > MAX_REPROJECTION_ERROR
        subjects.append(None if is_other else camera.tracks[int(np.argmin(errors))])
    return subjects


def _main_camera(cameras: Sequence[CameraPeople]) -> CameraPeople:
    return max(cameras, key=lambda x: (len(x.tracks), sum(track.size for track in x.tracks)))


def _epipolar_error(
    first: CameraPeople, person: PersonTrack, second: CameraPeople, other: PersonTrack
) -> float:
    """Return the mean distance of key points from epipolar lines, in heights; infinity: the tracks
    share no time."""
    times = {view.time: number for number, view in enumerate(second.views)}
    errors = []
    for number, detection in person.detections.items():
        partner = other.detections.get(times.get(first.views[number].time, -1))
        if partner is None:
            continue
        lines = _epipolar_lines(first.views[number], second.views[0], detection.keypoints[:, :2])
        points = np.insert(partner.keypoints[:, :2], 2, 1.0, axis=1)
        distances = np.abs((lines * points).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
        weights = detection.keypoints[:, 2] * partner.keypoints[:, 2]
        if weights.sum() > 0:
            errors.append(float((weights * distances).sum() / weights.sum() / partner.height))
    return float(np.median(errors)) if errors else float("inf")


def _epipolar_lines(first: View, second: View, points: np.ndarray) -> np.ndarray:
    """Return the lines (K, 3) in the second view on which points (K, 2) of the first one lie."""
    relative = second.cam_from_world @ np.linalg.inv(first.cam_from_world)
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ relative[:3, :3]
    inverse = np.linalg.inv(second.intrinsics).T
    fundamental = inverse @ essential @ np.linalg.inv(first.intrinsics)
    return np.concatenate([points, np.ones((len(points), 1))], axis=1) @ fundamental.T


def _describe_people(
    cameras: Sequence[CameraPeople],
    subjects: Sequence[PersonTrack | None],
    sheet: Path,
    log: Callable[[str], None],
) -> None:
    """Log everybody in the camera that sees most people, and write a picture of them."""
    main = _main_camera(cameras)
    for number, track in enumerate(main.tracks, 1):
        images = track.numbers
        chosen = " (chosen)" if any(track is subject for subject in subjects) else ""
        picture = ", never moves: a picture?" if track.is_picture else ""
        log(
            f"person {number}{chosen}: images {images[0]} to {images[-1]} of {len(main.views)}, "
            f"{track.height:.0f} px high{picture}"
        )
    log("people.png shows them; choose another one with data.person=NUMBER")
    write_image(sheet, people_sheet(main.views, main.tracks))


def _outline_person(
    camera: CameraPeople,
    subject: PersonTrack,
    search: CropDetector,
    prefix: str,
    log: Callable[[str], None],
) -> tuple[list[np.ndarray], dict[str, Detection]]:
    """Return masks (H, W, 1) uint8 of all views of a camera, and the detections by view name."""
    views = camera.views
    shape = (1, views[0].height, views[0].width)
    others = [track for track in camera.tracks if track is not subject]
    covered = covered_images(subject, others)
    numbers = [number for number in subject.numbers if number not in covered]
    if not numbers:
        log(f"warning: {prefix}somebody else is in front in all images; skipping them")
        return _empty_masks(views), {}
    windows = {n: expand_box(subject.detections[n].box, shape) for n in numbers}
    edges = np.stack(list(windows.values()))
    union = np.concatenate([edges[:, :2].min(0), edges[:, 2:].max(0)])
    left, top, right, bottom = union.astype(int)
    size = target_size(right - left, bottom - top, 1.0, DETECTOR_SIDE_PX)
    scale = (right - left) / size[0]
    images = np.zeros((len(views), size[1], size[0], 3), np.uint8)
    crops = []
    for number, view in enumerate(views):
        pixels = read_image(view.image_path, (view.width, view.height))[..., :3]
        around = pixels[top:bottom, left:right].contiguous()
        images[number] = area_downscale_uint8(around, *size).numpy()
        if number in windows:
            # a copy, so that whole images are not kept
            crops.append((_cut(pixels.numpy(), windows[number]).copy(), windows[number]))
    person: list[Detection | None] = [None for _ in views]
    masks = np.zeros(images.shape[:3], bool)
    for number, detection in zip(numbers, search(crops, CROP_SIDE_PX), strict=True):
        tracked = subject.detections[number]
        if (
            detection is None
            or key_point_distance(detection.keypoints, tracked.keypoints)
            > 2 * PARAMS.same_person * tracked.height
        ):
            continue
        masks[number] = _place_mask(detection.mask, windows[number], union, size)
        keypoints = (detection.keypoints - [left, top, 0]) / [scale, scale, 1]
        person[number] = Detection(
            keypoints.astype(np.float32),
            (255 * masks[number]).astype(np.uint8),
            detection.positions,
        )
    person, num_swapped = fix_left_right_swaps(person)
    heights = [scale * x.height for x in person if x is not None]
    if not heights:
        return _empty_masks(views), {}
    log(
        f"{prefix}{search.detector.name} detected the person in {len(heights)} of "
        f"{format_count(len(person), 'image')}, {np.median(heights):.0f} px high; swapped "
        f"left and right in {format_count(num_swapped, 'image')}"
    )
    if covered:
        log(
            f"{prefix}left out {format_count(len(covered), 'image')} in which somebody else is in "
            f"front, first image {min(covered)}"
        )
    for warning in capture_warnings(images, person, is_single_camera=not prefix):
        log(f"warning: {prefix}{warning}")
    their_boxes = np.zeros(masks.shape, bool)
    for track in others:
        for number, detection in track.detections.items():
            box = (detection.box - [left, top, left, top]) / scale
            x0, y0, x1, y1 = box.clip(0).astype(int)
            their_boxes[number, y0:y1, x0:x1] = True
    alpha = estimate_alpha(images, masks, their_boxes)
    if alpha is None:
        alpha = np.stack([soften_outline(mask) for mask in masks])
    else:
        is_person = alpha > 0.5
        iou = (is_person & masks).sum() / max(int((is_person | masks).sum()), 1)
        log(
            f"{prefix}fixed camera: masks refined by background subtraction (IoU with the "
            f"detector's {iou:.3f})"
        )
    written = []
    found = {}
    for number, (view, detection) in enumerate(zip(views, person, strict=True)):
        written.append(_full_mask(alpha[number], union, view))
        if detection is not None:
            keypoints = detection.keypoints * np.array([scale, scale, 1.0], np.float32)
            keypoints[:, :2] += [left, top]
            found[view.name] = replace(detection, keypoints=keypoints)
    return written, found


def _empty_masks(views: Sequence[View]) -> list[np.ndarray]:
    return [np.zeros((view.height, view.width, 1), np.uint8) for view in views]


def _cut(image: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the pixels of an image (H, W, 3) in a box of whole px."""
    left, top, right, bottom = box.astype(int)
    return image[top:bottom, left:right]


def _place_mask(
    mask: np.ndarray, window: np.ndarray, union: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Return the mask (h, w) of a window as bool in the region ``union`` of ``size`` px."""
    scale = (union[2] - union[0]) / size[0]
    columns = (np.arange(size[0]) + 0.5) * scale + union[0] - window[0]
    rows = (np.arange(size[1]) + 0.5) * scale + union[1] - window[1]
    height = window[3] - window[1]
    width = window[2] - window[0]
    grid = np.meshgrid(
        rows * mask.shape[0] / height - 0.5, columns * mask.shape[1] / width - 0.5, indexing="ij"
    )
    placed = ndimage.map_coordinates(mask.astype(np.float32), grid, order=1, mode="nearest")
    inside = ((rows >= 0) & (rows < height))[:, None] & (columns >= 0) & (columns < width)
    return (placed > 127) & inside


def _full_mask(alpha: np.ndarray, union: np.ndarray, view: View) -> np.ndarray:
    """Return alpha of the region ``union`` as grey levels (H, W, 1) uint8 of a whole image."""
    left, top, right, bottom = union.astype(int)
    whole = np.zeros((view.height, view.width, 1), np.uint8)
    whole[top:bottom, left:right] = resize_mask(alpha, bottom - top, right - left)
    return whole


def _shrunk_image(view: View, size: tuple[int, int]) -> np.ndarray:
    pixels = read_image(view.image_path, (view.width, view.height))[..., :3]
    return area_downscale_uint8(pixels, *size).numpy()


def _write_keypoints(path: Path, people: Mapping[str, Detection]) -> None:
    """Write the key points of each view, by name, as a COCO-WholeBody file, with the relative
    positions of the first 17 beside them."""
    images = [{"id": row, "file_name": f"{name}.png"} for row, name in enumerate(people)]
    annotations = []
    for row, person in enumerate(people.values()):
        whole_body = np.zeros((133, 3))
        whole_body[list(WHOLE_BODY_ROWS)] = person.keypoints
        annotation: dict[str, object] = {
            "image_id": row,
            "category_id": 1,
            "keypoints": whole_body.ravel().round(4).tolist(),
        }
        if person.positions is not None:
            annotation["positions"] = person.positions[:17].ravel().round(4).tolist()
        annotations.append(annotation)
    write_text(path, json.dumps({"images": images, "annotations": annotations}) + "\n")


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
        inputs = detect_person(capture, detector, folder, on_progress, log, person=options.person)
        if capture.has_alpha:
            log("using the silhouettes of the images; only key points are detected")
            inputs = replace(inputs, masks=None)
        result = write_fitted_capture(options, out, on_progress, inputs)
        for picture in folder.glob("*.png"):
            shutil.copy(picture, out / picture.name)
            log(f"see {out / picture.name}")
        return result
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
    chosen = (data.frames, data.person, data.stature)
    frames_hash = hashlib.sha256(repr(chosen).encode()).hexdigest()[:8]
    folder = cache_folder("people") / f"{name}.{digest_files(data.root)}{frames_hash}"

    def detect() -> None:
        detector = MediaPipe()
        log(f"person:  detecting (see `dyngs data people`), result in {folder}")
        log(write_detected_person(data, folder, detector, on_progress, log).summary)

    make_once(folder, detect, log, f"person:  using the cached result in {folder}")
    record_source(folder, data.root)
    return data.model_copy(update={"root": folder, "frames": None, "person": None, "stature": None})
