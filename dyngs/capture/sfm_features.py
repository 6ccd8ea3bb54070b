"""Features and matches of images in COLMAP's database, and which images are compared; a stopped run goes on."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dyngs.capture.photos import Photo
from dyngs.capture.sfm_work import SfmOptions
from dyngs.conventions import ReportProgress
from dyngs.files.write import write_text

if TYPE_CHECKING:
    import pycolmap


_AT_ONCE, _MATCHING_CALLS = 8, 16
_SMALL_PX = 1000
"""Images up to this long are doubled in size for finding features: they have few otherwise."""
_PEAK = 0.02 / 3
_STRONGER = (1.0, 1.5, 2.0, 3.0, 4.0)
_TRIED = 3


@dataclass(frozen=True)
class FeatureTask:
    """Input of finding and matching features.

    Attributes:
        database: COLMAP's; made where it is missing.
        images: folder of upright images.
        names: of the images in it, in order.
        photos: the same ones, with their tags.
        options: effort, seed, threads.
        masks: folder of masks ``NAME.png``, white = keep; None without.
        single_camera: all images share a lens.
        enough: features of an image, on average over three of them, above which weak ones are left out; 0 = never.
    """

    database: Path
    images: Path
    names: Sequence[str]
    photos: Sequence[Photo]
    options: SfmOptions
    masks: Path | None = None
    single_camera: bool = True
    enough: int = 0

    @property
    def side(self) -> int:
        """Longest side of an image, in pixels."""
        return max((max(photo.header.size) for photo in self.photos), default=0)


def find_features(task: FeatureTask, report: ReportProgress) -> float:
    """Find SIFT features of all images that have none in the database yet.

    Returns how many times the usual contrast a feature must have: more than 1 where images have more than
    ``task.enough``. The largest features (``max_features``) would be the coarse ones, whose places are not exact.

    COLMAP is called for some images at a time: it has no callbacks, and its database must not be opened by another
    copy of SQLite in the same process, whose end would take away COLMAP's locks.

    Images and cameras are entered first, in order: with several threads COLMAP would number them as they are done,
    and what follows depends on the numbers. Focal lengths of the EXIF tags are taken as first values.
    """
    import pycolmap

    reader, mode = _reader(task)
    if _num_images(task.database) < len(task.names):
        task.database.unlink(missing_ok=True)
        pycolmap.Database.open(task.database).close()
        pycolmap.import_images(task.database, task.images, mode, task.names, reader)
        _enter_focal_lengths(task)
    stronger = _stronger(task) if task.enough else 1.0
    count = len(task.names)
    for first in range(0, count, _AT_ONCE):
        _extract(task, task.database, task.names[first : first + _AT_ONCE], stronger)
        report("features, images", min(first + _AT_ONCE, count), count)
    return stronger


def _reader(task: FeatureTask) -> tuple[pycolmap.ImageReaderOptions, pycolmap.CameraMode]:
    import pycolmap

    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = task.options.camera_model
    if task.masks is not None:
        reader.mask_path = task.masks
    return reader, pycolmap.CameraMode.SINGLE if task.single_camera else pycolmap.CameraMode.PER_IMAGE


def _extract(task: FeatureTask, database: Path, names: Sequence[str], stronger: float) -> None:
    """Find features of some images, with ``stronger`` times the usual contrast."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    extraction.num_threads = task.options.num_threads or -1
    extraction.max_image_size = task.options.longest_side
    extraction.sift.max_num_features = task.options.max_features
    extraction.sift.peak_threshold = stronger * _PEAK
    extraction.sift.first_octave = -1 if min(task.side, task.options.longest_side) <= _SMALL_PX else 0
    reader, mode = _reader(task)
    pycolmap.extract_features(
        database, task.images, names, camera_mode=mode, reader_options=reader,
        extraction_options=extraction, device=pycolmap.Device.cpu,
    )  # fmt: skip


def _stronger(task: FeatureTask) -> float:
    """Return the least contrast, in multiples of the usual one, at which images have at most ``task.enough``."""
    import pycolmap

    places = np.linspace(0, len(task.names) - 1, _TRIED + 2).round()[1:-1]
    names = [task.names[place] for place in sorted({int(place) for place in places})]
    trial = task.database.with_name("trial.db")
    for stronger in _STRONGER:
        trial.unlink(missing_ok=True)
        pycolmap.Database.open(trial).close()
        _extract(task, trial, names, stronger)
        with pycolmap.Database.open(trial) as opened:
            if opened.num_keypoints() <= task.enough * len(names):
                return stronger
    return _STRONGER[-1]


def match_pairs(task: FeatureTask, pairs: Sequence[tuple[int, int]], report: ReportProgress) -> None:
    """Match pairs of images, given by their places in the order, and verify them; those of before are left."""
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.num_threads = task.options.num_threads or -1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = task.options.seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = task.database.with_name("pairs.txt")
    ordered = sorted(set(pairs))  # of few images at a time: COLMAP prepares each one anew in every call
    step = max(len(ordered) // _MATCHING_CALLS, _AT_ONCE)
    for first in range(0, len(ordered), step):
        part = ordered[first : first + step]
        write_text(pairing.match_list_path, "".join(f"{task.names[i]} {task.names[j]}\n" for i, j in part))
        pycolmap.match_image_pairs(task.database, matching, pairing, verification, device=pycolmap.Device.cpu)
        report("matching, pairs", first + len(part), len(ordered))


def matched_images(database: Path) -> dict[str, int]:
    """Return how many other images each one was matched with, by name."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        counts = {image.image_id: 0 for image in opened.read_all_images()}
        names = {image.image_id: image.name for image in opened.read_all_images()}
        ids, geometries = opened.read_two_view_geometries()
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


def _enter_focal_lengths(task: FeatureTask) -> None:
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


STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Distances in the order of names at which images are compared: dense near, sparse far (loops of a few seconds)."""
ALIKE = 6
"""Images that look most alike, compared with each one beside its neighbours; of photos ``ALIKE_PHOTOS``."""
ALIKE_PHOTOS = 24
_WORDS, _SAMPLE, _ROUNDS = 64, 20_000, 8


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Return all pairs of ``count`` images, the first one smaller."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def neighbour_pairs(count: int, overlap: int | None = None) -> list[tuple[int, int]]:
    """Return pairs at the distances ``STEPS``, or at all distances up to ``overlap``."""
    steps = STEPS if overlap is None else range(1, overlap + 1)
    return [(i, i + step) for step in steps for i in range(count - step)]


def alike_pairs(database: Path, names: Sequence[str], each: int) -> list[tuple[int, int]]:
    """Return pairs of each image with the ``each`` others that look most alike by their features.

    An image is described by its SIFT descriptors, counted by which of 64 typical ones is nearest (found by k-means
    among these images), as sums of differences from it (VLAD: Jegou et al. 2010, "Aggregating local descriptors into
    a compact image representation"). Nothing random is left to chance: the same features give the same pairs.

    Args:
        database: COLMAP's, with features of all images.
        names: of the images, as in the database.
        each: pairs for every image.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        found = [np.asarray(opened.read_descriptors(ids[name]).data) for name in names]
    described = _described([descriptors.astype(np.float32) for descriptors in found])
    alike = described @ described.T
    np.fill_diagonal(alike, -np.inf)
    pairs = set()
    for i, row in enumerate(alike):
        for j in np.argsort(-row, kind="stable")[:each].tolist():
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
