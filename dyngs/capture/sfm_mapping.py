"""Poses and points from matches: COLMAP's global and incremental mapping, and which result is
taken."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dyngs.capture.sfm_matches import agreement
from dyngs.capture.sfm_work import SEED, SfmTask, incremental_options

if TYPE_CHECKING:
    import pycolmap

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
    """A model that ``mapper`` found; ``agreeing`` is the fraction of the matched pairs whose
    matches fit the poses."""

    reconstruction: pycolmap.Reconstruction
    mapper: Mapper
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


def mapped(task: SfmTask) -> SfmModel | None:
    """Return the model with most images; None where none could be found.

    "auto" is global mapping for a video and incremental mapping for photos, where it is as fast and
    its poses are nearer to given ones (it breaks videos into pieces). The other one is tried only
    where the first leaves images out, its poses do not fit the matches of all pairs, or its mean
    reprojection error is large: see ``better``.
    """
    if task.options.mapper != "auto":
        return _found(task, task.options.mapper)
    order: tuple[Mapper, Mapper] = (
        ("global", "incremental") if task.is_video else ("incremental", "global")
    )
    first = _found(task, order[0])
    return (
        first
        if first is not None and not needs_more(first, task)
        else better(first, _found(task, order[1]))
    )


def needs_more(model: SfmModel, task: SfmTask) -> bool:
    """Whether images are left out, poses do not fit the matches, a lens is none, or the error is
    large."""
    bad = (
        model.registered < len(task.names)
        or model.agreeing < GOOD_AGREEMENT
        or not model.has_real_lens
    )
    return bad or model.error_px > GOOD_ERROR_PX * max(task.side, 1000) / 1000


def better(first: SfmModel | None, second: SfmModel | None) -> SfmModel | None:
    """Return the model with more images whose pairs agree, then the clearly smaller error, else the
    first.

    Global mapping may give every image a pose and put a part of them elsewhere: such images must
    not count.
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
    return SfmModel(best, mapper, agreement(best, task.database, task.side))


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
    seeded = (
        options,
        mapper,
        mapper.rotation_averaging,
        mapper.global_positioning,
        mapper.retriangulation,
    )
    for part in seeded:
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
