"""Poses and points from matches: COLMAP's global and incremental mapping, and which result is taken."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dyngs.capture.sfm_matches import agreement
from dyngs.conventions import ReportProgress

if TYPE_CHECKING:
    import pycolmap

Mapper = Literal["global", "incremental"]
GOOD_ERROR_PX = 1.5
"""Mean reprojection error, in pixels of images up to 1,000 px long, above which the other mapping is tried, too."""
GOOD_AGREEMENT = 0.9
"""Fraction of matched pairs that fit the poses, below which the other mapping is tried, too."""
_TRACKS_PER_IMAGE = 400
"""Points of an image that global mapping places at first, those seen in most images; the others are added to the
poses found. All of them take two to three times as long, for the same points in the end."""
_THREADS = 1  # with more, sums are added in another order on each run, and the model differs
_SAME_ERROR, _SAME_AGREEMENT = 0.05, 0.02
_FOCALS = (0.2, 10.0)


@dataclass(frozen=True)
class Model:
    """A model found by mapping.

    Attributes:
        reconstruction: poses, cameras, points.
        mapper: what found it.
        agreeing: fraction of the matched pairs whose matches fit the poses.
    """

    reconstruction: pycolmap.Reconstruction
    mapper: Mapper
    agreeing: float

    @property
    def registered(self) -> int:
        """Images that have a pose."""
        return self.reconstruction.num_reg_images()

    @property
    def has_real_lens(self) -> bool:
        """Whether focal lengths, as fractions of the longest side, are those of cameras: 0.2 to 10, or said by EXIF."""
        return all(
            camera.has_prior_focal_length
            or _FOCALS[0] <= camera.mean_focal_length() / max(camera.width, camera.height) <= _FOCALS[1]
            for camera in self.reconstruction.cameras.values()
        )

    @property
    def error_px(self) -> float:
        """Mean reprojection error."""
        return float(self.reconstruction.compute_mean_reprojection_error())


@dataclass(frozen=True)
class MappingTask:
    """Input of mapping.

    Attributes:
        database: COLMAP's, with verified matches.
        images: folder of the images, for the colours of points.
        scratch: folder for files in between.
        count: images.
        longest_side: of the images, in pixels.
        seed: of everything random.
        report: is told of images that got a pose.
        first: mapping that is tried first. Incremental mapping of photos is as fast, and its poses are nearer to given
            ones; it breaks videos into pieces.
    """

    database: Path
    images: Path
    scratch: Path
    count: int
    longest_side: int
    seed: int
    report: ReportProgress
    first: Mapper = "global"


def mapped(task: MappingTask, wanted: Literal["auto", "global", "incremental"]) -> Model | None:
    """Return the model with most images; None where none could be found.

    "auto" is ``task.first``, and the other mapping next to it only where the first leaves images out, its poses do
    not fit the matches of all pairs, or its mean reprojection error is large: see ``better``.
    """
    if wanted != "auto":
        return _found(task, wanted)
    first = _found(task, task.first)
    if first is not None and not needs_more(first, task):
        return first
    return better(first, _found(task, "incremental" if task.first == "global" else "global"))


def needs_more(model: Model, task: MappingTask) -> bool:
    """Whether images are left out, poses do not fit the matches, a lens is none, or the error is large."""
    bad = model.registered < task.count or model.agreeing < GOOD_AGREEMENT or not model.has_real_lens
    return bad or model.error_px > GOOD_ERROR_PX * max(task.longest_side, 1000) / 1000


def better(first: Model | None, second: Model | None) -> Model | None:
    """Return the model with more images whose pairs agree, then the clearly smaller error, else the first.

    Global mapping may give every image a pose and put a part of them elsewhere: such images must not count.
    """
    if first is None or second is None:
        return first or second
    if first.has_real_lens != second.has_real_lens:
        return first if first.has_real_lens else second
    good, other = first.registered * first.agreeing, second.registered * second.agreeing
    if abs(good - other) > _SAME_AGREEMENT * max(first.registered, second.registered):
        return first if good > other else second
    if first.registered != second.registered:
        return max(first, second, key=lambda model: model.registered)
    return second if second.error_px < first.error_px * (1 - _SAME_ERROR) else first


def _found(task: MappingTask, mapper: Mapper) -> Model | None:
    """Return the model of one mapper with most images; a failure of its solver counts as no model."""
    import pycolmap

    folder = task.scratch / mapper
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    pycolmap.set_random_seed(task.seed)
    try:
        models = (_global if mapper == "global" else _incremental)(task, folder)
    except (RuntimeError, ValueError):
        models = {}
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is None or best.num_reg_images() < 2:
        return None
    task.report("poses, images", best.num_reg_images(), task.count)
    return Model(best, mapper, agreement(best, task.database, task.longest_side))


def _global(task: MappingTask, folder: Path) -> dict[int, pycolmap.Reconstruction]:
    """Map all images at once, then let incremental mapping refine: it filters points by pixels, not by angles."""
    import pycolmap

    task.report("poses, images", 0, task.count)
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = _THREADS
    mapper = options.mapper
    seeded = (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation)
    for part in seeded:
        part.random_seed = task.seed
    mapper.track_required_tracks_per_view = _TRACKS_PER_IMAGE
    mapper.bundle_adjustment.ceres.use_gpu = mapper.global_positioning.use_gpu = False
    found = pycolmap.global_mapping(task.database, task.images, folder, options)
    best = max(found.values(), key=lambda model: model.num_reg_images(), default=None)
    if best is None or best.num_reg_images() < task.count:
        return found
    start = folder / "start"
    start.mkdir()
    best.write(start)
    refined = pycolmap.incremental_mapping(
        task.database, task.images, folder, _incremental_options(task), input_path=start
    )
    kept = max(refined.values(), key=lambda model: model.num_reg_images(), default=None)
    return found if kept is None or kept.num_reg_images() < best.num_reg_images() else {0: kept}


def _incremental(task: MappingTask, folder: Path) -> dict[int, pycolmap.Reconstruction]:
    import pycolmap

    told = _counter(task)
    told()  # the second one of the first pair is told by COLMAP
    return pycolmap.incremental_mapping(
        task.database, task.images, folder, _incremental_options(task),
        initial_image_pair_callback=told, next_image_callback=told,
    )  # fmt: skip


def _counter(task: MappingTask) -> Callable[[], None]:
    """Return a callback of incremental mapping: an image has got its pose."""
    done = 0

    def count() -> None:
        nonlocal done
        done = min(done + 1, task.count)
        task.report("poses, images", done, task.count)

    return count


def _incremental_options(task: MappingTask) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = _THREADS
    mapping.random_seed = mapping.mapper.random_seed = mapping.triangulation.random_seed = task.seed
    mapping.min_model_size = 3
    mapping.mapper.init_min_num_inliers = 50
    mapping.ba_use_gpu = False
    return mapping
