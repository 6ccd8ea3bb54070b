"""Camera poses for a folder of photos or a video, by COLMAP's structure from motion on the CPU."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dyngs.capture.sfm.colmap import (
    LENS,
    LONGEST_SIDE,
    MAX_FEATURES,
    SEED,
    SfmOptions,
    SfmTask,
    feature_options,
    incremental_options,
    match_listed,
    quiet_colmap,
)
from dyngs.capture.sfm.frame_choice import MIN_CAMERA_MOTION, choose_frames, measure_frames
from dyngs.capture.sfm.photos import Photo, copy_file, gather_photos, prepare_colmap_images
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count
from dyngs.data.images.images import read_header
from dyngs.data.images.video import (
    colour_messages,
    frame_seconds,
    probe_video,
    read_frames,
    read_numbered_frames,
)
from dyngs.data.readers.transforms import find_mask, find_masks
from dyngs.data.times import write_seconds
from dyngs.io.containment import check_inside, restrict_paths_to
from dyngs.io.fields import first_few
from dyngs.io.outputs import atomic_folder
from dyngs.io.write import write_image

if TYPE_CHECKING:
    import pycolmap


_FITS_PX = 4.0
"""Median distance from the epipolar lines up to which a pair fits its poses, in pixels of images up
to 1,000 px."""
_WELL = 30  # matches of a pair that is looked at
_MOST_FITTED_PAIRS = 2000


def pose_agreement(model: pycolmap.Reconstruction, database: Path, longest_side: int) -> float:
    """Return the fraction of well matched pairs of registered images whose matches fit the
    poses."""
    import pycolmap

    posed = {key: image for key, image in model.images.items() if image.has_pose}
    rays: dict[int, np.ndarray] = {}
    fits = []
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        found = [
            (pycolmap.pair_id_to_image_pair(i), g.inlier_matches)
            for i, g in zip(ids, geometries, strict=True)
        ]
        found = [
            (pair, matches)
            for pair, matches in found
            if len(matches) >= _WELL and set(pair) <= posed.keys()
        ]
        for (a, b), matches in found[:: max(len(found) // _MOST_FITTED_PAIRS, 1)]:
            for key in (a, b):
                if key not in rays:
                    places = np.asarray(opened.read_keypoints(key))[:, :2].astype(np.float64)
                    camera = model.cameras[posed[key].camera_id]
                    rays[key] = np.asarray(camera.cam_from_img(places), np.float64)
            b_from_a = posed[b].cam_from_world() * posed[a].cam_from_world().inverse()
            x, y, z = b_from_a.translation / max(float(np.linalg.norm(b_from_a.translation)), 1e-12)
            essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a.rotation.matrix()
            distances = _sampson(essential, rays[a][matches[:, 0]], rays[b][matches[:, 1]])
            focal = model.cameras[posed[a].camera_id].mean_focal_length()
            fits.append(
                np.nanmedian(distances) * focal <= _FITS_PX * max(longest_side, 1000) / 1000
            )
    return float(np.mean(fits)) if fits else 1.0


def triangulation_angles_deg(model: pycolmap.Reconstruction) -> np.ndarray:
    """Return the largest angle under which each of some 2,000 points is seen from two images, in
    degrees."""
    centres = {i: image.projection_center() for i, image in model.images.items() if image.has_pose}
    angles = []
    ids = sorted(model.points3D)
    for key in ids[:: max(len(ids) // 2000, 1)]:
        point = model.points3D[key]
        rays = np.array([centres[element.image_id] for element in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return np.array(angles)


def homography_fraction(database: Path) -> float:
    """Return the fraction of well matched pairs explained by a homography: all, if the camera only
    rotated."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        _, geometries = opened.read_two_view_geometries()
    kinds = [x.config for x in geometries if len(x.inlier_matches) >= _WELL]
    kind = pycolmap.TwoViewGeometryConfiguration
    flat = [x.value for x in (kind.PLANAR, kind.PANORAMIC, kind.PLANAR_OR_PANORAMIC)]
    return float(np.isin(kinds, flat).mean()) if kinds else 0.0


def _sampson(matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Sampson distances (M,) of places (M, 2) to a (3, 3) fundamental or essential
    matrix."""
    a = np.c_[first, np.ones(len(first))]
    b = np.c_[second, np.ones(len(second))]
    lines_b = a @ matrix.T
    lines_a = b @ matrix
    slope = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    return np.abs((b * lines_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))


_NUM_FRAMES = 100
# Points that determine a pose. The captures of the benchmarks have at least 15 in each image.
_FEWEST_OBSERVED = 6
# Points per photo below which the scene becomes poor: 19 in street, whose held-out views reach
# 13.5 dB; 65 to 120 in photos of good scenes.
_FEW_POINTS = 30
_SMALL_ANGLE_DEG = 1.0
# fraction of the pairs that a homography explains, above which the camera only rotated: 1 for
# images of a rotating camera, 0.72 for the fox, up to 0.2 for other captures
_FLAT = 0.95


@dataclass(frozen=True)
class SfmResult:
    """Result of pose estimation: a capture in COLMAP's layout in the folder ``root``.

    Attributes:
        unregistered: names of the images without a pose.
        mean_error_px: mean reprojection error.
        notes: lines about choices, and about what to film or photograph better.
    """

    root: Path
    num_images: int
    num_registered: int
    unregistered: tuple[str, ...]
    num_points: int
    mean_error_px: float
    notes: tuple[str, ...]

    def summary(self) -> str:
        """Return the result as lines of text."""
        lines = [
            f"{self.num_registered} of {self.num_images} images registered, {self.num_points} "
            f"points, mean error {self.mean_error_px:.2f} px: {self.root}"
        ]
        if self.unregistered:
            lines.append("not registered: " + first_few(self.unregistered))
        return "\n".join((*lines, *self.notes))


def estimate_poses(
    source: Path,
    out: Path,
    options: SfmOptions = SfmOptions(),
    report: ProgressCallback = ignore_progress,
) -> SfmResult:
    """Estimate poses of the images in ``source`` and write a COLMAP capture (``out/images``,
    ``out/sparse/0``).

    Work is done in a hidden folder next to ``out``, which is renamed at the end, so ``out`` is
    complete or absent. The model with most images is kept. Raises DyngsError with advice for too
    few images, an ``out`` in use, a camera that does not move or only rotates, or failed
    registration.

    Args:
        source: a folder of photos (subfolders included) or a video file.
        out: a folder that does not exist, or is empty.
    """
    if not source.exists():
        raise DyngsError(f"no such folder of photos or video: {source}")
    if options.masks is not None and not options.masks.is_dir():
        raise DyngsError(f"no such folder of masks: {options.masks}")
    with (
        atomic_folder(out) as capture,
        restrict_paths_to(source, options.follow_links or source.is_file()),
    ):
        return _posed_in(capture, source, out, options, report)


def _posed_in(
    capture: Path, source: Path, out: Path, options: SfmOptions, report: ProgressCallback
) -> SfmResult:
    blurred: list[str] = []
    if source.is_file():
        photos, notes, blurred = _frames_of(source, capture, options, report)
    else:
        photos, notes = gather_photos(source, capture / "images", out)
    if len(photos) < 3:
        found = "; ".join((f"{source} has {format_count(len(photos), 'image')}", *notes))
        raise DyngsError(f"{found}; structure from motion needs at least 3, ideally 30")
    with quiet_colmap():
        masks = options.masks
        with nullcontext() if masks is None else restrict_paths_to(masks, options.follow_links):
            task = _laid_out(capture, photos, source.is_file(), options, report)
        find_features(task)
        match_pairs(task, pairs_to_match(task))
        if homography_fraction(task.database) > _FLAT:
            raise DyngsError(
                "the camera only rotated, or all images show one flat surface, which gives no "
                "depth; walk sideways around the scene by about a quarter of its distance, and "
                "keep it in view"
            )
        model = run_mapping(task)
    if model is None:
        raise DyngsError(
            f"could not estimate poses for {len(task.names)} images: take sharper images that "
            "overlap by two thirds, move the camera sideways, avoid textureless or moving "
            "surfaces, or try matching=exhaustive"
        )
    _require_depth(model, task)
    count = len(photos)
    dropped = drop_unobserving_images(model.reconstruction)
    own = dict(zip(task.names, (photo.name for photo in photos), strict=True))
    missing = _write_model(model, capture, own)
    if dropped:
        names = first_few([own[name] for name in dropped])
        notes.append(f"{len(dropped)} images dropped, which see almost no points: {names}")
    found = [name for name in missing if name not in {own[x] for x in dropped}]
    points = model.reconstruction.num_points3D()
    if not task.is_video and points < _FEW_POINTS * count:
        notes.append(
            f"{points} points are few for {count} images, so expect a poor scene: take photos with "
            "more overlap, from more positions"
        )
    notes += _advice(found, blurred, task.is_video)
    shutil.rmtree(task.images.parent)
    return SfmResult(
        out, count, count - len(missing), missing, points, model.error_px, tuple(notes)
    )


def _laid_out(
    capture: Path,
    photos: list[Photo],
    is_video: bool,
    options: SfmOptions,
    report: ProgressCallback,
) -> SfmTask:
    folder = capture / "images"
    work = capture / "colmap"
    work.mkdir()
    found = {} if options.masks is None else find_masks(options.masks)
    masks = {
        photo.name: mask for photo in photos if (mask := find_mask(photo.source, found)) is not None
    }
    if options.masks is not None and not masks:
        raise DyngsError(
            f"{options.masks}: no mask is named after an image (a.jpg.png, a.jpg or a.png for "
            "a.jpg)"
        )
    names = prepare_colmap_images(photos, folder, work / "images", masks)
    for name, mask in masks.items():
        copy_file(check_inside(mask).resolve(), folder.with_name("masks") / (name + mask.suffix))
    used = work / "masks" if masks else None
    return SfmTask(
        work / "database.db", work / "images", names, photos, options, report, is_video, used
    )


def drop_unobserving_images(model: pycolmap.Reconstruction) -> list[str]:
    """Remove the poses of images that observe fewer than ``_FEWEST_OBSERVED`` points.

    Nothing determines these poses. Returns the names of the images.
    """
    dropped = []
    for image in model.images.values():
        if image.has_pose and image.num_points3D < _FEWEST_OBSERVED:
            dropped.append(image)
    for image in dropped:
        model.deregister_frame(image.frame_id)
    return sorted(image.name for image in dropped)


def _film(task: SfmTask) -> str:
    return "film" if task.is_video else "take photos"


def _require_depth(model: SfmModel, task: SfmTask) -> None:
    """Check that triangulation angles are large enough and the lens is plausible."""
    if not model.has_real_lens:
        raise DyngsError(
            "no plausible lens fits the matches: most of them are probably on a moving object, "
            "such as a person who fills the image; give masks of it (--masks), or film a static "
            "scene"
        )
    angles = triangulation_angles_deg(model.reconstruction)
    angle = float(np.median(angles)) if len(angles) else 0.0
    if angle >= _SMALL_ANGLE_DEG:
        return
    raise DyngsError(
        f"the camera hardly moved: the median triangulation angle is {max(angle, 0.1):.1f} "
        f"degrees, which gives no depth; {_film(task)} while walking sideways by about a quarter "
        "of the distance to the scene"
    )


def _write_model(model: SfmModel, capture: Path, names: dict[str, str]) -> tuple[str, ...]:
    """Write the model with the images' own names; return the names of images without a pose."""
    registered = set()
    for image in model.reconstruction.images.values():
        image.name = names[image.name]
        if image.has_pose:
            registered.add(image.name)
    sparse = capture / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.reconstruction.write(sparse)
    return tuple(name for name in names.values() if name not in registered)


def _advice(unregistered: Sequence[str], blurred: Sequence[str], is_video: bool) -> Iterator[str]:
    """Yield advice on images without a pose and on blurred images."""
    if unregistered:
        more = "move slower there" if is_video else "take more photos around them"
        yield (
            f"{len(unregistered)} images could not be registered: {more}, unless they show "
            "mostly moving objects or the camera only rotated there"
        )
    if blurred:
        more = "use more light or move slower" if is_video else "take them again"
        yield f"{len(blurred)} images are blurred ({first_few(blurred)}): {more}"


def _frames_of(
    video: Path, capture: Path, options: SfmOptions, report: ProgressCallback
) -> tuple[list[Photo], list[str], list[str]]:
    """Frames of a video, chosen by ``frame_choice``; their seconds are written, too.

    Two passes, so that only one image is held in memory: the first one measures.
    """
    measures = measure_frames(read_frames(video))
    numbers, blurred = choose_frames(measures, options.num_frames or _NUM_FRAMES)
    reach = measures.away.max(initial=0.0)
    if len(measures) >= 3 and reach < MIN_CAMERA_MOTION:
        raise DyngsError(
            f"{video}: the camera does not move (the image shifts by {reach:.2%} of its width), "
            "which gives no depth; film while walking sideways around the scene"
        )
    names = {index: f"frame_{index:05d}.png" for index in numbers}
    photos = []
    for index, rgb in read_numbered_frames(video, numbers):
        path = capture / "images" / names[index]
        # a third of the time of the usual level, a tenth more bytes
        write_image(path, rgb, png_level=1)
        photos.append(Photo(path.name, read_header(path), path.name))
        report("frames of the video", len(photos), len(names))
    seconds = frame_seconds(video, len(measures))
    write_seconds(capture, {name: seconds[index] for index, name in names.items()})
    notes = [
        *colour_messages([probe_video(video)]),
        f"{len(numbers)} of {len(measures)} frames selected by motion and sharpness",
    ]
    return photos, notes, [names[index] for index in blurred]


# Features, and which images are compared

_AT_ONCE, _MATCHING_CALLS = 8, 16
# images up to this long are doubled in size for finding features: they have few otherwise
_SMALL_PX = 1000
# Longest side in px of video frames: their neighbours overlap, so that fewer features suffice.
_VIDEO_SIDE = 1080
_PEAK = 0.02 / 3


def find_features(task: SfmTask) -> None:
    """Find SIFT features of all images.

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
    side = min(task.side, _VIDEO_SIDE if task.is_video else LONGEST_SIDE)

    extraction = feature_options(task.options.num_threads, side, MAX_FEATURES)
    extraction.sift.peak_threshold = _PEAK
    extraction.sift.first_octave = -1 if side <= _SMALL_PX else 0
    pycolmap.Database.open(task.database).close()
    pycolmap.import_images(task.database, task.images, mode, task.names, reader)
    _enter_focal_lengths(task)
    count = len(task.names)
    for first in range(0, count, _AT_ONCE):
        names = task.names[first : first + _AT_ONCE]
        pycolmap.extract_features(
            task.database, task.images, names, camera_mode=mode, reader_options=reader,
            extraction_options=extraction, device=pycolmap.Device.cpu,
        )  # fmt: skip
        task.report("features, images", first + len(names), count)


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


def _enter_focal_lengths(task: SfmTask) -> None:
    import pycolmap

    focals = {
        name: photo.header.focal_px for name, photo in zip(task.names, task.photos, strict=True)
    }
    with pycolmap.Database.open(task.database) as opened:
        first: dict[int, str] = {}
        for image in sorted(opened.read_all_images(), key=lambda image: image.name):
            first.setdefault(image.camera_id, image.name)
        for camera in opened.read_all_cameras():
            focal = focals[first[camera.camera_id]]
            camera.has_prior_focal_length = focal is not None
            if focal is not None:
                params = camera.params.copy()
                params[list(camera.focal_length_idxs())] = focal
                camera.params = params
            opened.update_camera(camera)


_EXHAUSTIVE_PHOTOS, _EXHAUSTIVE_FRAMES = 60, 24
_STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
_VIDEO_STEPS = (1, 2, 4, 8, 16, 32)
"""Distances in the order of names at which images are compared: dense near, sparse far (loops of a
few seconds)."""
# images that look most alike, compared with each one next to its neighbours
_ALIKE_FRAMES, _ALIKE_PHOTOS = 4, 24
_WORDS, _SAMPLE, _ROUNDS = 64, 20_000, 8


def pairs_to_match(task: SfmTask) -> list[tuple[int, int]]:
    """Return the pairs to match, by places in the order of names, the smaller one first."""
    matching = task.options.matching
    count = len(task.names)
    limit = _EXHAUSTIVE_FRAMES if task.is_video else _EXHAUSTIVE_PHOTOS
    if matching == "exhaustive" or (matching == "auto" and count <= limit):
        return list(combinations(range(count), 2))
    steps = _VIDEO_STEPS if task.is_video else _STEPS
    near = [(i, i + step) for step in steps for i in range(count - step)]
    return near if matching == "sequential" else near + _alike_pairs(task)


def _alike_pairs(task: SfmTask) -> list[tuple[int, int]]:
    """Return the pairs of each image with its most similar images, by their features.

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
    from scipy.cluster.vq import kmeans2, vq

    full = np.concatenate([*descriptors, np.zeros((0, 128), np.float32)])
    if len(full) == 0:
        return np.zeros((len(descriptors), 1), np.float32)
    sample = full[:: max(len(full) // _SAMPLE, 1)]
    first = sample[np.linspace(0, len(sample) - 1, min(_WORDS, len(sample))).astype(int)]
    words, _ = kmeans2(sample, first, _ROUNDS, minit="matrix", missing="warn")
    vectors = np.zeros((len(descriptors), *words.shape), np.float32)
    for place, own in enumerate(descriptors):
        if len(own):
            nearest, _ = vq(own, words)
            np.add.at(vectors[place], nearest, own - words[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True) + 1e-6
    flat = vectors.reshape(len(vectors), -1)
    return flat / (np.linalg.norm(flat, axis=1, keepdims=True) + 1e-6)


# Poses and points from matches

Mapper = Literal["global", "incremental"]
GOOD_ERROR_PX = 1.5
"""Mean reprojection error, in pixels of images up to 1,000 px long, above which the other mapping
is tried, too."""
# fraction of matched pairs that fit the poses, below which the other mapping is tried, too
GOOD_AGREEMENT = 0.9
_TRACKS_PER_IMAGE = 400
"""Points of an image that global mapping places at first, those seen in most images; the others are
added to the poses found. All of them take two to three times as long, for the same points in the
end."""
_THREADS = 1  # with more, sums are added in another order on each run, and the model differs
_SAME_ERROR, _SAME_AGREEMENT = 0.05, 0.02
_FOCALS = (0.2, 10.0)


@dataclass(frozen=True)
class SfmModel:
    """A model, and the fraction of the matched pairs whose matches fit its poses."""

    reconstruction: pycolmap.Reconstruction
    agreeing: float

    @property
    def registered(self) -> int:
        """Images that have a pose."""
        return self.reconstruction.num_reg_images()

    @property
    def has_real_lens(self) -> bool:
        """Whether focal lengths, as fractions of the longest side, are those of cameras: 0.2 to 10,
        or said by EXIF."""
        return all(
            camera.has_prior_focal_length
            or _FOCALS[0]
            <= camera.mean_focal_length() / max(camera.width, camera.height)
            <= _FOCALS[1]
            for camera in self.reconstruction.cameras.values()
        )

    @property
    def error_px(self) -> float:
        """Mean reprojection error."""
        return float(self.reconstruction.compute_mean_reprojection_error())


def run_mapping(task: SfmTask) -> SfmModel | None:
    """Return the model with most images, None if mapping fails.

    Videos use global mapping, photos incremental mapping, which is as fast for them and more
    accurate. The other mapper is tried only if the first leaves images out, its poses do not fit
    the matches, or its mean reprojection error is large: see ``choose_better_model``.
    """
    order: tuple[Mapper, Mapper] = (
        ("global", "incremental") if task.is_video else ("incremental", "global")
    )
    first = _found(task, order[0])
    return (
        first
        if first is not None and not _needs_more(first, task)
        else choose_better_model(first, _found(task, order[1]))
    )


def _needs_more(model: SfmModel, task: SfmTask) -> bool:
    """Whether images are missing, poses do not fit the matches, a lens is implausible, or the
    error is large."""
    bad = (
        model.registered < len(task.names)
        or model.agreeing < GOOD_AGREEMENT
        or not model.has_real_lens
    )
    return bad or model.error_px > GOOD_ERROR_PX * max(task.side, 1000) / 1000


def choose_better_model(first: SfmModel | None, second: SfmModel | None) -> SfmModel | None:
    """Return the model with more consistent images, then the clearly smaller error, else the
    first.

    Global mapping may place some images wrongly, so that only consistent ones count.
    """
    if first is None or second is None:
        return first or second
    if first.has_real_lens != second.has_real_lens:
        return first if first.has_real_lens else second
    good = first.registered * first.agreeing
    other = second.registered * second.agreeing
    if abs(good - other) > _SAME_AGREEMENT * max(first.registered, second.registered):
        return first if good > other else second
    if first.registered != second.registered:
        return max(first, second, key=lambda model: model.registered)
    return second if second.error_px < first.error_px * (1 - _SAME_ERROR) else first


def _found(task: SfmTask, mapper: Mapper) -> SfmModel | None:
    """Return the model of one mapper with most images; a failure of its solver counts as no
    model."""
    import pycolmap

    folder = task.database.with_name("models") / mapper
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pycolmap.set_random_seed(SEED)
    try:
        best = (_global if mapper == "global" else _incremental)(task, folder)
    except (RuntimeError, ValueError):
        best = None
    if best is None or best.num_reg_images() < 2:
        return None
    task.report("poses, images", best.num_reg_images(), len(task.names))
    return SfmModel(best, pose_agreement(best, task.database, task.side))


def _most_images(models: Iterable[pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    return max(models, key=lambda model: model.num_reg_images(), default=None)


def _global(task: SfmTask, folder: Path) -> pycolmap.Reconstruction | None:
    """Map all images at once, then let incremental mapping refine: it filters points by pixels, not
    by angles."""
    import pycolmap

    task.report("poses, images", 0, len(task.names))
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = _THREADS
    mapper = options.mapper
    for part in (
        options,
        mapper,
        mapper.rotation_averaging,
        mapper.global_positioning,
        mapper.retriangulation,
    ):
        part.random_seed = SEED
    mapper.track_required_tracks_per_view = _TRACKS_PER_IMAGE
    mapper.bundle_adjustment.ceres.use_gpu = mapper.global_positioning.use_gpu = False
    best = _most_images(
        pycolmap.global_mapping(task.database, task.images, folder, options).values()
    )
    if best is None or best.num_reg_images() < len(task.names):
        return best
    start = folder / "start"
    start.mkdir()
    best.write(start)
    refined = pycolmap.incremental_mapping(
        task.database, task.images, folder, _options(), input_path=start
    )
    kept = _most_images(refined.values())
    return best if kept is None or kept.num_reg_images() < best.num_reg_images() else kept


def _incremental(task: SfmTask, folder: Path) -> pycolmap.Reconstruction | None:
    import pycolmap

    done = 0

    def told() -> None:
        nonlocal done
        done = min(done + 1, len(task.names))
        task.report("poses, images", done, len(task.names))

    told()  # the second one of the first pair is told by COLMAP
    found = pycolmap.incremental_mapping(
        task.database,
        task.images,
        folder,
        _options(),
        initial_image_pair_callback=told,
        next_image_callback=told,
    )
    return _most_images(found.values())


def _options() -> pycolmap.IncrementalPipelineOptions:
    mapping = incremental_options(_THREADS)
    mapping.min_model_size = 3
    mapping.mapper.init_min_num_inliers = 50
    return mapping
