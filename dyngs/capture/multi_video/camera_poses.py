"""Poses of fixed cameras, one each, from one image per camera: what stands in it, of many time
steps together."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dyngs.capture.multi_video.films import Film
from dyngs.capture.sfm_work import (
    LENS,
    LONGEST_SIDE,
    MAX_FEATURES,
    SEED,
    feature_options,
    incremental_options,
    matching_options,
    quiet_colmap,
)
from dyngs.core.conventions import ReportProgress
from dyngs.data.images.video import read_numbered_frames
from dyngs.data.times import evenly_spaced
from dyngs.io.write import write_image

if TYPE_CHECKING:
    import pycolmap

MOMENTS = 15
"""Frames of a video whose median shows what stands."""
MEDIAN_BYTES = 400_000_000  # memory that these frames take at most
# random seeds of mapping: repeated patterns lead some astray, and then fewer points are seen
STARTS = (0, 1, 2)
FEW_OBSERVATIONS = 400  # observations per camera below which other features are tried, too
LARGEST_ERROR = 2.0  # observations with a larger reprojection error, in px, are left out in the end
# points that only two cameras see are left out where each camera sees so many others
ENOUGH_TRACKS = 60
# mean reprojection error in px above which cameras of one size are also tried with a lens each
LONE_LENSES = 1.0
_LESS = 0.7  # lenses of their own are kept if they lower the error to this, or find more cameras


@dataclass(frozen=True)
class FixedModel:
    """A model with an image ``CAMERA.png`` for each camera; ``shared``: those of one size have one
    lens."""

    model: pycolmap.Reconstruction
    shared: bool
    tries: str

    @property
    def registered(self) -> int:
        """Cameras with a pose."""
        return self.model.num_reg_images()


def image_without_movers(film: Film, num_frames: int) -> np.ndarray:
    """Return the (H, W, 3) uint8 median of the first frames of a fixed camera: without what moves,
    with less noise."""
    most = max(MEDIAN_BYTES // max(film.info.width * film.info.height * 3, 1), 3)
    wanted = evenly_spaced(num_frames, min(MOMENTS, most))
    frames = np.stack([rgb for _, rgb in read_numbered_frames(film.path, wanted)])
    median = np.empty(frames.shape[1:], np.uint8)
    for row in range(0, len(median), 64):
        median[row : row + 64] = np.round(np.median(frames[:, row : row + 64], axis=0))
    return median


def fixed_model(
    films: Sequence[Film],
    images: Sequence[np.ndarray],
    work: Path,
    num_threads: int,
    report: ReportProgress,
) -> FixedModel | None:
    """Return the poses of fixed cameras by an image (H, W, 3) uint8 of each, None where no two
    cameras match.

    SIFT features, all pairs matched, incremental mapping from several random seeds; of the models,
    that with most cameras, then with most observations. Where a camera or observations are missing,
    features are also found with affine shapes and matched under guidance, which works over wider
    angles. Cameras of one size share a lens unless that fits badly. ``work`` is a folder for
    COLMAP's files.
    """
    folder = work / "fixed"
    for film, rgb in zip(films, images, strict=True):
        size = f"{rgb.shape[1]}x{rgb.shape[0]}"  # a folder has one lens where lenses are shared
        write_image(folder / size / f"{film.name}.png", rgb)
    attempts = [("usual", True), ("affine", True), ("affine", False), ("usual", False)]
    best: FixedModel | None = None
    with quiet_colmap():
        for number, (features, shared) in enumerate(attempts):
            if not _worth_trying(best, features, shared, len(films)):
                continue
            found = _attempt(
                work / f"{features}_{shared}", folder, features == "affine", shared, num_threads
            )
            report("poses of the cameras, attempts", number + 1, len(attempts))
            if found is not None:
                _refine(found, num_threads)
                tried = FixedModel(found, shared, f"{features} features")
                best = tried if best is None or _is_better(tried, best) else best
        report("poses of the cameras, attempts", len(attempts), len(attempts))
    return best


def camera_name(image: pycolmap.Image) -> str:
    """Return the camera that an image of the model is of."""
    return Path(image.name).stem


def _worth_trying(best: FixedModel | None, features: str, shared: bool, count: int) -> bool:
    if best is None or best.registered < count:
        return True
    if shared:
        return best.model.compute_num_observations() < FEW_OBSERVATIONS * count
    return (
        best.tries.startswith(features)
        and best.model.compute_mean_reprojection_error() > LONE_LENSES
    )


def _is_better(one: FixedModel, other: FixedModel) -> bool:
    if one.registered != other.registered:
        return one.registered > other.registered
    errors = [each.model.compute_mean_reprojection_error() for each in (one, other)]
    if one.shared != other.shared:
        return errors[0] < (1 / _LESS if one.shared else _LESS) * errors[1]
    return one.model.compute_num_observations() > other.model.compute_num_observations()


def _attempt(
    work: Path, images: Path, affine: bool, shared: bool, num_threads: int
) -> pycolmap.Reconstruction | None:
    import pycolmap

    work.mkdir(parents=True)
    database = work / "database.db"
    device = pycolmap.Device.cpu
    extraction = feature_options(num_threads, LONGEST_SIDE, MAX_FEATURES)
    extraction.sift.peak_threshold = 0.002
    extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = affine
    reader = pycolmap.ImageReaderOptions(camera_model=LENS)
    mode = pycolmap.CameraMode.PER_FOLDER if shared else pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database,
        images,
        camera_mode=mode,
        reader_options=reader,
        extraction_options=extraction,
        device=device,
    )
    matching, verification = matching_options(num_threads)
    matching.guided_matching = affine
    pycolmap.match_exhaustive(database, matching, verification_options=verification, device=device)
    best: pycolmap.Reconstruction | None = None
    for start in STARTS:
        folder = work / f"models_{start}"
        folder.mkdir()
        mapping = incremental_options(num_threads, SEED + start)
        mapping.min_model_size = 2
        mapping.mapper.init_min_num_inliers = 40
        mapping.mapper.abs_pose_min_num_inliers = 20
        mapping.triangulation.ignore_two_view_tracks = False
        for model in pycolmap.incremental_mapping(database, images, folder, mapping).values():
            if best is None or _extent(model) > _extent(best):
                best = model
        shutil.rmtree(folder)
    return best


def _refine(model: pycolmap.Reconstruction, num_threads: int) -> None:
    """Adjust poses, lenses and points once more, with a robust loss, and without what fits badly or
    two cameras see.

    Repeated patterns give matches that only two cameras agree on; those bend the model.
    """
    import pycolmap

    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = 0.5
    adjustment.ceres.solver_options.num_threads = num_threads or -1
    for _ in range(2):
        problem = pycolmap.BundleAdjustmentConfig()
        for image in model.images.values():
            if image.has_pose:
                problem.add_image(image.image_id)
        problem.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # Not pycolmap.bundle_adjustment, which turns COLMAP's log on.
        pycolmap.create_default_bundle_adjuster(adjustment, problem, model).solve()
        model.update_point_3d_errors()
        _drop_poor_points(model)
    model.update_point_3d_errors()


def _drop_poor_points(model: pycolmap.Reconstruction) -> None:
    """Remove observations with large errors, and points of two cameras where each camera has enough
    others."""
    import pycolmap

    manager = pycolmap.ObservationManager(model)
    manager.filter_all_points3D(LARGEST_ERROR, 1.5)
    counts = dict.fromkeys((image.image_id for image in model.images.values() if image.has_pose), 0)
    for point in model.points3D.values():
        if point.track.length() > 2:
            for element in point.track.elements:
                counts[element.image_id] += 1
    if min(counts.values(), default=0) >= ENOUGH_TRACKS:
        for number in [
            number for number, point in model.points3D.items() if point.track.length() == 2
        ]:
            model.delete_point3D(number)


def _extent(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.compute_num_observations()
