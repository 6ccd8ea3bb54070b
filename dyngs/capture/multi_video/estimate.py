"""A capture of several videos that ran at once: offsets between them, poses of their cameras,
frames with seconds."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dyngs.capture.multi_video.camera_poses import (
    FixedModel,
    camera_name,
    fixed_model,
    image_without_movers,
)
from dyngs.capture.multi_video.films import (
    STANDS,
    VIDEOS_FILE,
    Film,
    checked_starts,
    displaced_by,
    open_film,
    read_given,
    small_images,
)
from dyngs.capture.multi_video.starts import describe_starts, found_starts
from dyngs.capture.sfm_work import SfmOptions
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.data.images.video import colour_notes, read_numbered_frames, videos_in
from dyngs.data.readers.camera_folders import MIN_CAMERAS_TO_HOLD_OUT
from dyngs.data.readers.colmap import TEST_LIST
from dyngs.data.times import Taken, taken_frames, write_seconds
from dyngs.io.containment import images_up_to, inside, staying_within
from dyngs.io.fields import first_few
from dyngs.io.outputs import require_new_folder
from dyngs.io.temporary import temporary_folder_beside
from dyngs.io.write import write_image, write_text

if TYPE_CHECKING:
    import pycolmap


def poses_of_videos(
    source: Path,
    out: Path,
    options: SfmOptions = SfmOptions(),
    report: ReportProgress = report_nothing,
) -> str:
    """Make a capture of a folder of videos that ran at once, of fixed cameras; return what was
    found, as lines.

    All work is done in a folder next to ``out`` which is renamed at the end, so ``out`` is complete
    or absent. It is in COLMAP's layout, with ``times.json``, and ready to be trained on. Raises
    DyngsError: a camera that moves, poses or offsets that cannot be found, with what to do; an
    ``out`` in use.

    Args:
        source: a folder with two videos or more, and ``videos.json`` if something is known.
        out: a folder that does not exist, or is empty.
    """
    require_new_folder(out)
    work = temporary_folder_beside(out)
    try:
        with staying_within(source, options.follow_links), images_up_to(options.max_megapixels):
            lines = _made_in(work, source, options, report)
        if out.exists():
            out.rmdir()
        os.replace(work, out)
    except OSError as error:
        raise DyngsError(f"cannot write {out}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return "\n".join((*lines, f"written: {out}"))


def _made_in(work: Path, source: Path, options: SfmOptions, report: ReportProgress) -> list[str]:
    films = [open_film(inside(path)) for path in videos_in(source)]
    if len(films) < 2:
        raise DyngsError(
            f"{source}: holds {len(films)} videos, two or more are needed; give one video as the file itself"
        )
    starts, held_out = read_given(source, [film.name for film in films])
    if options.starts is not None:
        starts = checked_starts(options.starts, [film.name for film in films], "--start")
    small = small_images(films, report)
    lines = colour_notes(film.info for film in films)
    lines.append(_require_fixed(source, films, small))
    if starts is None:
        starts, line = found_starts(films)
    else:
        line = f"offsets between the cameras as given: {describe_starts(starts)}"
    lines.append(line)
    films, found, line = _posed(work, films, small, options, report)
    lines.append(line)
    begun = np.array([starts[film.name] for film in films])
    begun = begun - begun.min()
    clocks = [film.seconds + start for film, start in zip(films, begun, strict=True)]
    taken, line = taken_frames(source, clocks, [film.rate for film in films], options.num_frames)
    lines.append(line)
    names = _write_images(work, films, taken, report)
    _write_model(work, films, names, found.model)
    if held_out is not None:
        test = [film.name for film in films if film.name in held_out]
    else:
        test = [films[0].name] if len(films) >= MIN_CAMERAS_TO_HOLD_OUT else []
    seconds = {
        name: round(float(second), 6)
        for own, frames in zip(names, taken, strict=True)
        for name, second in zip(own, frames.seconds, strict=True)
    }
    write_seconds(work, seconds)
    if test:
        listed = [f"{name}\n" for name in seconds if name.partition("/")[0] in test]
        write_text(work / "sparse" / "0" / TEST_LIST, "".join(listed))
        lines.append(f"held out for testing: {first_few(test)}")
    rounded = {film.name: round(float(start), 6) for film, start in zip(films, begun, strict=True)}
    write_text(work / VIDEOS_FILE, json.dumps({"starts": rounded, "test": test}, indent=1) + "\n")
    return lines


def _write_images(
    root: Path, films: Sequence[Film], taken: Sequence[Taken], report: ReportProgress
) -> list[list[str]]:
    """Write the frames as ``root/images/CAMERA/frame_NNNNN.png``; return their names below
    ``images`` by camera."""
    total = sum(len(frames.numbers) for frames in taken)
    done = 0
    names: list[list[str]] = []
    for film, frames in zip(films, taken, strict=True):
        own = []
        for number, rgb in read_numbered_frames(
            film.path, [int(number) for number in frames.numbers]
        ):
            own.append(f"{film.name}/frame_{number:05d}.png")
            write_image(root / "images" / own[-1], rgb)
            done += 1
            report("frames of the videos", done, total)
        names.append(own)
    return names


def _write_model(
    root: Path,
    films: Sequence[Film],
    names: Sequence[Sequence[str]],
    standing: pycolmap.Reconstruction,
) -> None:
    """Write ``root/sparse/0``: a lens for each camera, its one pose for all its images, and the
    points.

    The first image of each camera has the observations of the points.
    """
    import pycolmap

    full = pycolmap.Reconstruction()
    posed = {camera_name(image): image for image in standing.images.values() if image.has_pose}
    first_ids: dict[int, int] = {}
    image_id = 0
    for number, (film, own) in enumerate(zip(films, names, strict=True)):
        image = posed[film.name]
        lens = standing.cameras[image.camera_id]
        camera = pycolmap.Camera(
            camera_id=number + 1,
            model=lens.model,
            width=lens.width,
            height=lens.height,
            params=lens.params,
        )
        full.add_camera_with_trivial_rig(camera)
        places = np.array([point.xy for point in image.points2D], dtype=np.float64).reshape(-1, 2)
        for place, name in enumerate(own):
            image_id += 1
            seen = places if place == 0 else np.zeros((0, 2))
            new = pycolmap.Image(name=name, keypoints=seen, camera_id=number + 1, image_id=image_id)
            full.add_image_with_trivial_frame(new, image.cam_from_world())
        first_ids[image.image_id] = image_id - len(own) + 1
    for number in sorted(standing.points3D):
        point = standing.points3D[number]
        track = pycolmap.Track()
        for element in point.track.elements:
            if element.image_id in first_ids:
                track.add_element(first_ids[element.image_id], element.point2D_idx)
        full.add_point3D(point.xyz, track, point.color)
    full.update_point_3d_errors()
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    full.write(folder)


def _require_fixed(source: Path, films: Sequence[Film], small: Sequence[np.ndarray]) -> str:
    """Return a line that says that all cameras stand."""
    found = [displaced_by(grey) for grey in small]
    moving = [
        f"{film.name} ({'far' if np.isinf(displaced) else f'up to {displaced:.1%} of its width'})"
        for film, displaced in zip(films, found, strict=True)
        if displaced > STANDS
    ]
    if moving:
        raise DyngsError(
            f"{source}: of several videos, cameras must stand still, but {first_few(moving)} "
            f"{'moves' if len(moving) == 1 else 'move'}; remove {'it' if len(moving) == 1 else 'them'}, stabilise what "
            "only shakes, or train on one moving camera's video alone"
        )
    return (
        f"{len(films)} cameras stand still (images displaced by {max(found):.2%} of their width at most, {STANDS:.1%} "
        "allowed)"
    )


def _posed(
    work: Path,
    films: list[Film],
    small: list[np.ndarray],
    options: SfmOptions,
    report: ReportProgress,
) -> tuple[list[Film], FixedModel, str]:
    """Return the cameras that have a pose, the poses, and a line on them."""
    images = []
    for film, shown in zip(films, small, strict=True):
        images.append(image_without_movers(film, len(shown)))
        report("what stands, cameras", len(images), len(films))
    folder = work / "colmap"
    found = fixed_model(films, images, folder, options.num_threads, report)
    shutil.rmtree(folder)
    names = (
        set()
        if found is None
        else {camera_name(image) for image in found.model.images.values() if image.has_pose}
    )
    if found is None or len(names) < 2:
        raise DyngsError(
            f"no poses could be found for {len(films)} cameras: neighbours must show much of the same, from directions "
            "that differ by 30 degrees or less, with texture in what stands; add cameras between them, or give the "
            "poses in cameras.json (docs/formats.md)"
        )
    left = [film.name for film in films if film.name not in names]
    kept = [film for film in films if film.name in names]
    model = found.model
    lens = "one lens for all of a size" if found.shared else "a lens each"
    line = (
        f"{len(kept)} of {len(films)} cameras have a pose, {model.num_points3D():,} points, mean error "
        f"{model.compute_mean_reprojection_error():.2f} px ({lens}, {found.tries})"
    )
    if left:
        line += f"; left out, they do not match the others: {first_few(left)}"
    return kept, found, line
