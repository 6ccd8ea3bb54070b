"""A video, or a folder of its frames, of a person filmed by one fixed camera with estimated
intrinsics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.capture import Capture, Silhouette, VideoFrame, View
from dyngs.data.geometry import OPENGL_FROM_OPENCV, pinhole_matrix
from dyngs.data.images.images import SUFFIXES, list_files, read_header
from dyngs.data.images.video import colour_messages, decode_frames, locate_cached_frames
from dyngs.data.readers.transforms import find_mask, find_masks
from dyngs.data.times import evenly_spaced, natural_order, parse_frames
from dyngs.io.containment import check_inside, check_size, restrict_paths_to
from dyngs.io.outputs import VIDEO_SUFFIXES

FORMAT = "fixed_camera"
"""``Capture.format`` of these captures."""
MOST_FRAMES = 60  # frames that are taken where ``data.frames`` names none
FOCAL = 1.2
"""Default focal length in longest sides of the image: between that of a phone and a film
camera."""


def is_image_sequence(source: Path) -> bool:
    """Whether a path is a video, or a folder with images directly or in ``images``."""
    with wrap_read_errors(source):
        if source.is_file():
            return source.suffix.lower() in VIDEO_SUFFIXES
        return source.is_dir() and bool(_images_of(source))


def read_fixed_camera(options: DataConfig, masks: Path | None = None) -> Capture:
    """Read a clip of one fixed camera; ``options.root`` is a video or a folder of images in order
    of names.

    The camera is a pinhole with the principal point in the centre and the focal length from EXIF,
    else ``FOCAL`` times the longest side. It is at the world origin; the world is y up if the
    camera is level. Without ``data.frames``, ``MOST_FRAMES`` are used, evenly spaced. Raises
    DyngsError for a missing clip, images of different sizes, or an image without a mask.

    Args:
        masks: folder of masks (white = the person) named after the images, or ``frame_000012.png``
            for frame 12 of a video; None: alpha of the images, if any.
    """
    source = options.root
    with (
        restrict_paths_to(source if source.is_dir() else source.parent, options.follow_links),
        wrap_read_errors(source),
    ):
        paths, fps, notes = _frames_of(source)
    numbers = _chosen(options, len(paths))
    videos = {paths[i]: VideoFrame(source, i) for i in numbers} if source.is_file() else {}
    with wrap_read_errors(source):
        decode_frames(source, videos)
        headers = [read_header(paths[i]) for i in numbers]
    silhouettes = None if masks is None else silhouettes_of(masks, [paths[i].name for i in numbers])
    first = headers[0]
    check_size(source, first.width, first.height, first.channels)
    width, height = first.upright_size
    other = next(
        (i for i, x in zip(numbers, headers, strict=True) if x.upright_size != (width, height)),
        None,
    )
    if other is not None:
        raise DyngsError(
            f"{paths[other]}: its size differs from {paths[numbers[0]].name}; give frames of one "
            "camera"
        )
    focal = first.focal_px or FOCAL * max(width, height)
    intrinsics = pinhole_matrix(focal, focal, width / 2, height / 2)
    last = max(len(numbers) - 1, 1)
    views = tuple(
        View(
            name=paths[i].stem,
            image_path=paths[i],
            cam_from_world=OPENGL_FROM_OPENCV.copy(),
            intrinsics=intrinsics,
            width=width,
            height=height,
            time=row / last,
            frame=row,
            video=videos.get(paths[i]),
            silhouette=None if silhouettes is None else silhouettes[row],
        )
        for row, i in enumerate(numbers)
    )
    has_alpha = masks is not None or first.alpha is not None
    note = f"{len(numbers)} of {len(paths)} frames, focal length {focal:.0f} px "
    note += "from EXIF" if first.focal_px else "guessed"
    return Capture(
        source, FORMAT, {"train": views}, has_alpha=has_alpha, fps=fps, warnings=(note, *notes)
    )


def _frames_of(source: Path) -> tuple[Sequence[Path], float | None, list[str]]:
    """Return the image files of a clip in order, the frame rate of a video, and messages on
    colours."""
    if source.is_file():
        planned = locate_cached_frames(source)
        if not planned.paths:
            raise DyngsError(f"{source}: the video contains no frame; copy it again")
        return planned.paths, planned.info.fps or None, colour_messages([planned.info])
    images = _images_of(source)
    if not images:
        raise DyngsError(f"{source}: no images found; give a video or a folder of its frames")
    return [check_inside(path) for path in images], None, []


def _images_of(folder: Path) -> list[Path]:
    found = list_files(folder, SUFFIXES) or list_files(folder / "images", SUFFIXES)
    return sorted(found, key=lambda path: natural_order(path.name))


def _chosen(options: DataConfig, count: int) -> list[int]:
    if options.frames is None:
        return evenly_spaced(count, MOST_FRAMES)
    numbers = list(range(count))[parse_frames(options.frames)]
    if not numbers:
        raise DyngsError(
            f"{options.root}: data.frames={options.frames} selects none of {count} frames"
        )
    return sorted(numbers)


def silhouettes_of(masks: Path, names: Sequence[str]) -> list[Silhouette]:
    """Return the masks (white = the person) of the named images.

    Raises DyngsError if the folder or a mask is missing.
    """
    if not masks.is_dir():
        raise DyngsError(f"no such folder of masks: {masks}")
    with restrict_paths_to(masks), wrap_read_errors(masks):
        found = find_masks(masks)
        own = [find_mask(name, found) for name in names]
        for path in own:
            if path is not None:
                check_inside(path)
    missing = [name for name, path in zip(names, own, strict=True) if path is None]
    if missing:
        raise DyngsError(
            f"{masks}: no mask for {len(missing)} of {len(names)} images, first {missing[0]}; "
            "name a mask after its image (a.jpg.png, a.jpg or a.png for a.jpg), white where the "
            "person is"
        )
    return [Silhouette(path, "white") for path in own if path is not None]
