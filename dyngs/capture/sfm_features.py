"""Features and matches of images in COLMAP's database, and which images are compared; a stopped run
goes on."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from itertools import combinations
from pathlib import Path

import numpy as np

from dyngs.capture.sfm_work import (
    LENS,
    LONGEST_SIDE,
    MAX_FEATURES,
    SfmTask,
    feature_options,
    match_listed,
)

_AT_ONCE, _MATCHING_CALLS = 8, 16
# images up to this long are doubled in size for finding features: they have few otherwise
_SMALL_PX = 1000
_PEAK = 0.02 / 3
_STRONGER = (1.0, 1.5, 2.0, 3.0, 4.0)
_TRIED = 3
# features of a frame of a video, on average over three of them, above which weak ones are left out
ENOUGH = 4000


def find_features(task: SfmTask) -> float:
    """Find SIFT features of all images that have none in the database yet.

    Returns how many times the usual contrast a feature must have: more than 1 where frames of a
    video have more than ``ENOUGH``. The largest features would be the coarse ones, whose positions
    are not exact.

    COLMAP is called for some images at a time: it has no callbacks, and its database must not be
    opened by another copy of SQLite in the same process, whose end would take away COLMAP's locks.

    Images and cameras are entered first, in order: with several threads COLMAP would number them as
    they are done, and what follows depends on the numbers. Focal lengths of the EXIF tags are taken
    as first values.
    """
    import pycolmap

    reader = pycolmap.ImageReaderOptions(camera_model=LENS)
    mode = pycolmap.CameraMode.PER_IMAGE
    if task.masks is not None:
        reader.mask_path = task.masks
    if task.has_one_lens:
        mode = pycolmap.CameraMode.SINGLE
    side = min(task.side, LONGEST_SIDE)

    def extract(database: Path, names: Sequence[str], stronger: float) -> None:
        extraction = feature_options(task.options.num_threads, LONGEST_SIDE, MAX_FEATURES)
        extraction.sift.peak_threshold = stronger * _PEAK
        extraction.sift.first_octave = -1 if side <= _SMALL_PX else 0
        pycolmap.extract_features(
            database, task.images, names, camera_mode=mode, reader_options=reader,
            extraction_options=extraction, device=pycolmap.Device.cpu,
        )  # fmt: skip

    def least_contrast() -> float:
        places = np.linspace(0, len(task.names) - 1, _TRIED + 2).round()[1:-1]
        names = [task.names[place] for place in sorted({int(place) for place in places})]
        trial = task.database.with_name("trial.db")
        for stronger in _STRONGER:
            trial.unlink(missing_ok=True)
            pycolmap.Database.open(trial).close()
            extract(trial, names, stronger)
            with pycolmap.Database.open(trial) as opened:
                if opened.num_keypoints() <= ENOUGH * len(names):
                    return stronger
        return _STRONGER[-1]

    if _num_images(task.database) < len(task.names):
        task.database.unlink(missing_ok=True)
        pycolmap.Database.open(task.database).close()
        pycolmap.import_images(task.database, task.images, mode, task.names, reader)
        _enter_focal_lengths(task)
    stronger = least_contrast() if task.is_video else 1.0
    count = len(task.names)
    for first in range(0, count, _AT_ONCE):
        extract(task.database, task.names[first : first + _AT_ONCE], stronger)
        task.report("features, images", min(first + _AT_ONCE, count), count)
    return stronger


def match_pairs(task: SfmTask, pairs: Sequence[tuple[int, int]]) -> None:
    """Match pairs of images, given by their places in the order, and verify them; those of before
    are left."""
    # of few images at a time: COLMAP prepares each one anew in every call
    ordered = sorted(set(pairs))
    step = max(len(ordered) // _MATCHING_CALLS, _AT_ONCE)
    for first in range(0, len(ordered), step):
        part = ordered[first : first + step]
        match_listed(task.database, task.names, part, task.options.num_threads)
        task.report("matching, pairs", first + len(part), len(ordered))


def matched_images(database: Path) -> dict[str, int]:
    """Return how many other images each one was matched with, by name."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        ids, geometries = opened.read_two_view_geometries()
    counts = dict.fromkeys(names, 0)
    for key, geometry in zip(ids, geometries, strict=True):
        if len(geometry.inlier_matches):
            for image in pycolmap.pair_id_to_image_pair(key):
                counts[image] += 1
    return {names[image]: count for image, count in counts.items()}


def _num_images(database: Path) -> int:
    import pycolmap

    if not database.is_file():
        return 0
    with closing(pycolmap.Database.open(database)) as opened:
        return int(opened.num_images())


def _enter_focal_lengths(task: SfmTask) -> None:
    import pycolmap

    tags = dict(zip(task.names, (photo.header.tags for photo in task.photos), strict=True))
    with pycolmap.Database.open(task.database) as opened:
        first: dict[int, str] = {}
        for image in sorted(opened.read_all_images(), key=lambda image: image.name):
            first.setdefault(image.camera_id, image.name)
        for camera in opened.read_all_cameras():
            focal = tags[first[camera.camera_id]].focal_px
            camera.has_prior_focal_length = focal is not None
            if focal is not None:
                params = camera.params.copy()
                params[list(camera.focal_length_idxs())] = focal
                camera.params = params
            opened.update_camera(camera)


_EXHAUSTIVE_PHOTOS, _EXHAUSTIVE_FRAMES = 60, 24
_STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Distances in the order of names at which images are compared: dense near, sparse far (loops of a
few seconds)."""
# images that look most alike, compared with each one next to its neighbours
_ALIKE_FRAMES, _ALIKE_PHOTOS = 6, 24
_WORDS, _SAMPLE, _ROUNDS = 64, 20_000, 8


def pairs_to_match(task: SfmTask) -> list[tuple[int, int]]:
    """Return the pairs to match, by places in the order of names, the smaller one first."""
    matching = task.options.matching
    count = len(task.names)
    limit = _EXHAUSTIVE_FRAMES if task.is_video else _EXHAUSTIVE_PHOTOS
    if matching == "exhaustive" or (matching == "auto" and count <= limit):
        return list(combinations(range(count), 2))
    near = [(i, i + step) for step in _STEPS for i in range(count - step)]
    return near if matching == "sequential" else near + _alike_pairs(task)


def _alike_pairs(task: SfmTask) -> list[tuple[int, int]]:
    """Return pairs of each image with the others that look most alike by their features.

    An image is described by its SIFT descriptors, counted by which of 64 typical ones is nearest
    (found by k-means among these images), as sums of differences from it (VLAD: Jegou et al. 2010,
    "Aggregating local descriptors into a compact image representation"). Nothing random is left to
    chance: the same features give the same pairs.
    """
    import pycolmap

    with pycolmap.Database.open(task.database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        found = [
            np.asarray(opened.read_descriptors(ids[name]).data).astype(np.float32)
            for name in task.names
        ]
    described = _described(found)
    alike = described @ described.T
    np.fill_diagonal(alike, -np.inf)
    pairs = set()
    for i, row in enumerate(alike):
        for j in np.argsort(-row, kind="stable")[
            : _ALIKE_FRAMES if task.is_video else _ALIKE_PHOTOS
        ].tolist():
            if np.isfinite(row[j]):
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def _described(descriptors: list[np.ndarray]) -> np.ndarray:
    """Return (N, D) unit vectors, zero for images without features."""
    full = np.concatenate([*descriptors, np.zeros((0, 128), np.float32)])
    if len(full) == 0:
        return np.zeros((len(descriptors), 1), np.float32)
    words = _typical(full[:: max(len(full) // _SAMPLE, 1)])
    vectors = np.zeros((len(descriptors), *words.shape), np.float32)
    for place, own in enumerate(descriptors):
        if len(own):
            nearest = _nearest(own, words)
            np.add.at(vectors[place], nearest, own - words[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True) + 1e-6
    flat = vectors.reshape(len(vectors), -1)
    return flat / (np.linalg.norm(flat, axis=1, keepdims=True) + 1e-6)


def _typical(sample: np.ndarray) -> np.ndarray:
    """Return centres of clusters by k-means from evenly spaced ones."""
    words = sample[np.linspace(0, len(sample) - 1, min(_WORDS, len(sample))).astype(int)]
    for _ in range(_ROUNDS):
        nearest = _nearest(sample, words)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, sample)
        counts = np.bincount(nearest, minlength=len(words))[:, None]
        words = np.where(counts > 0, sums / np.maximum(counts, 1), words).astype(np.float32)
    return words


def _nearest(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    return ((words**2).sum(1) - 2 * rows @ words.T).argmin(1)
