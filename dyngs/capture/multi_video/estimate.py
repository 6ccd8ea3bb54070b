"""A capture of several videos that ran at once: offsets between them, poses of their cameras, frames with seconds."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dyngs.capture.multi_video.camera_poses import (
    StandingModel,
    StandingOptions,
    camera_name,
    standing_image,
    standing_model,
)
from dyngs.capture.multi_video.capture import write_facts, write_images, write_model
from dyngs.capture.multi_video.films import Film, SmallImages, open_films, small_images
from dyngs.capture.multi_video.given import checked_starts, read_given
from dyngs.capture.multi_video.moments import taken_frames
from dyngs.capture.multi_video.planes import Watcher, motion_of
from dyngs.capture.multi_video.starts import found_starts, given_starts
from dyngs.capture.multi_video.steadiness import STANDS, steadiness
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.readers.shared.camera_sequences import MIN_CAMERAS_TO_HOLD_OUT
from dyngs.errors import DyngsError
from dyngs.files.containment import MAX_MEGAPIXELS, images_up_to, staying_within
from dyngs.files.fields import first_few
from dyngs.files.outputs import require_new_folder
from dyngs.files.temporary import temporary_folder_beside

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class VideosOptions:
    """Options for several videos.

    Attributes:
        num_moments: moments to take at most, evenly spaced; None: as many as fit ``moments.MOST_MOMENTS``.
        starts: camera to the second at which its video begins; None: as in ``videos.json``, else found.
        seed: of everything random.
        num_threads: 0 = all cores.
        follow_links: videos may be links that lead out of their folder.
        max_megapixels: larger videos are refused.
    """

    num_moments: int | None = None
    starts: dict[str, float] | None = None
    seed: int = 0
    num_threads: int = 0
    follow_links: bool = False
    max_megapixels: float = MAX_MEGAPIXELS


@dataclass(frozen=True)
class VideosResult:
    """Result for several videos.

    Attributes:
        root: the capture folder in COLMAP's layout with ``times.json``, to be trained on.
        lines: what was found, a line each.
    """

    root: Path
    lines: tuple[str, ...]

    def summary(self) -> str:
        """The result as lines of text."""
        return "\n".join(self.lines)


def poses_of_videos(
    source: Path, out: Path, options: VideosOptions = VideosOptions(), report: ReportProgress = report_nothing
) -> VideosResult:
    """Make a capture of a folder of videos that ran at once, of cameras that stand.

    All work is done in a folder beside ``out`` which is renamed at the end, so ``out`` is whole or absent.

    Args:
        source: a folder with two videos or more, and ``videos.json`` if something is known.
        out: a folder that does not exist, or is empty.
        options: moments, offsets, effort.
        report: is told how far the work has come.

    Raises:
        DyngsError: a camera that moves, poses or offsets that cannot be found, with what to do; an ``out`` in use.
    """
    require_new_folder(out)
    work = temporary_folder_beside(out)
    try:
        with staying_within(source, options.follow_links), images_up_to(options.max_megapixels):
            lines = _made_in(work, source, options, report)
        work.chmod(0o755)
        if out.exists():
            out.rmdir()
        os.replace(work, out)
    except OSError as error:
        raise DyngsError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return VideosResult(out, (*lines, f"written: {out}"))


def _made_in(work: Path, source: Path, options: VideosOptions, report: ReportProgress) -> list[str]:
    """Write the capture in the folder ``work`` and return what was found."""
    films = open_films(source)
    if len(films) < 2:
        raise DyngsError(
            f"{source}: holds {len(films)} videos, two or more are needed; give one video as the file itself"
        )
    given = read_given(source, [film.name for film in films])
    starts = given.starts
    if options.starts is not None:
        starts = checked_starts(options.starts, [film.name for film in films], "--start")
    small = small_images(films, report)
    lines = [_require_standing(source, films, small)]
    films, small, found, line = _posed(work, films, small, options, report)
    lines.append(line)
    watchers = [_watcher(film, images, found.model) for film, images in zip(films, small, strict=True)]
    begun = found_starts(films, watchers) if starts is None else given_starts(films, starts)
    lines.append(begun.line)
    taken, line = taken_frames(films, begun.seconds, options.num_moments)
    lines.append(line)
    names = write_images(work, films, taken, report)
    write_model(work, films, names, found.model)
    test = _held_out(films, given.test)
    seconds = {
        name: float(second)
        for own, frames in zip(names, taken, strict=True)
        for name, second in zip(own, frames.seconds, strict=True)
    }
    write_facts(work, seconds, {film.name: float(x) for film, x in zip(films, begun.seconds, strict=True)}, test)
    if test:
        lines.append(f"held out for testing: {first_few(test)}")
    return lines


def _require_standing(source: Path, films: Sequence[Film], small: Sequence[SmallImages]) -> str:
    """Return a line that says that all cameras stand.

    Raises:
        DyngsError: one of them moves, or is too short to tell.
    """
    found = [steadiness(images.grey) for images in small]
    moving = [
        f"{film.name} ({'far' if np.isinf(steady.displaced) else f'up to {steady.displaced:.1%} of its width'})"
        for film, steady in zip(films, found, strict=True)
        if not steady.stands
    ]
    if moving:
        raise DyngsError(
            f"{source}: of several videos, cameras must stand still, but {first_few(moving)} "
            f"{'moves' if len(moving) == 1 else 'move'}; remove {'it' if len(moving) == 1 else 'them'}, stabilise what "
            "only shakes, or train on one moving camera's video alone"
        )
    most = max(steady.displaced for steady in found)
    allowed = f"{STANDS:.1%} allowed"
    return f"{len(films)} cameras stand still (images displaced by {most:.2%} of their width at most, {allowed})"


def _posed(
    work: Path, films: list[Film], small: list[SmallImages], options: VideosOptions, report: ReportProgress
) -> tuple[list[Film], list[SmallImages], StandingModel, str]:
    """Return the cameras that have a pose, with their small images, the poses, and a line on them.

    Raises:
        DyngsError: fewer than two poses.
    """
    images = []
    for film, shown in zip(films, small, strict=True):
        images.append(standing_image(film, len(shown.grey)))
        report("what stands, cameras", len(images), len(films))
    folder = work / "colmap"
    found = standing_model(
        films, images, folder, StandingOptions(seed=options.seed, num_threads=options.num_threads), report
    )
    shutil.rmtree(folder)
    names = set() if found is None else {camera_name(image) for image in found.model.images.values() if image.has_pose}
    if found is None or len(names) < 2:
        raise DyngsError(
            f"no poses could be found for {len(films)} cameras: neighbours must show much of the same, from directions "
            "that differ by 30 degrees or less, with texture in what stands; add cameras between them, or give the "
            "poses in cameras.json (docs/formats.md)"
        )
    left = [film.name for film in films if film.name not in names]
    kept = [(film, shown) for film, shown in zip(films, small, strict=True) if film.name in names]
    model = found.model
    lens = "one lens for all of a size" if found.shared else "a lens each"
    line = (
        f"{len(kept)} of {len(films)} cameras have a pose, {model.num_points3D():,} points, mean error "
        f"{model.compute_mean_reprojection_error():.2f} px ({lens}, {found.tries})"
    )
    if left:
        line += f"; left out, they do not match the others: {first_few(left)}"
    return [film for film, _ in kept], [shown for _, shown in kept], found, line


def _watcher(film: Film, images: SmallImages, model: pycolmap.Reconstruction) -> Watcher:
    """Return a camera with the rays of its small images, and the motion in them."""
    image = next(image for image in model.images.values() if camera_name(image) == film.name)
    camera = model.cameras[image.camera_id]
    height, width = images.grey.shape[1:]
    rows, columns = np.mgrid[0:height, 0:width]
    step = camera.width // width
    places = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1) * step
    directions = np.concatenate([np.asarray(camera.cam_from_img(places)), np.ones((len(places), 1))], axis=1)
    rotation = np.asarray(image.cam_from_world().rotation.matrix())
    rays = np.nan_to_num(directions) @ rotation
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    return Watcher(np.asarray(image.projection_center()), rays, motion_of(images), images.seconds)


def _held_out(films: Sequence[Film], given: tuple[str, ...] | None) -> list[str]:
    """Return the cameras for testing: those given, else the first one where there are enough."""
    names = [film.name for film in films]
    if given is not None:
        return [name for name in names if name in given]
    return names[:1] if len(names) >= MIN_CAMERAS_TO_HOLD_OUT else []
