"""Sequences of several cameras: one folder of images or one video per camera, turned into views with times."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.data.capture import VideoFrame, View
from dyngs.data.geometry.intrinsics import match_size, rescale_warning
from dyngs.data.images.frame_cache import VideoFrames, planned_frames
from dyngs.data.images.images import SUFFIXES
from dyngs.data.images.video import VIDEO_SUFFIXES, VideoInfo
from dyngs.data.readers.shared.transforms import Frame, FrameFile, read_views
from dyngs.errors import DyngsError

MIN_CAMERAS_TO_HOLD_OUT = 3
"""From this number on, the first camera is for testing where the capture names none."""


@dataclass(frozen=True)
class CameraSource:
    """The images of one camera.

    Attributes:
        name: name of its folder, or of its video without the suffix.
        images: frame number to file; frames of a video may have to be decoded first.
        video: frames of the video, None for a folder.
    """

    name: str
    images: dict[int, Path]
    video: VideoFrames | None = None


def find_cameras(root: Path) -> dict[str, Path]:
    """Map camera names, sorted, to folders of images, or to video files where there is no such folder.

    Images lie in the folder itself or in ``images`` below it.

    Raises:
        DyngsError: two videos for one camera.
    """
    found: dict[str, Path] = {}
    for path in sorted(root.iterdir()):
        if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file() and not path.name.startswith("."):
            if path.stem in found:
                raise DyngsError(f"{root}: {found[path.stem].name} and {path.name} are one camera; remove one of them")
            found[path.stem] = path
    for path in sorted(root.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            folder = next((f for f in (path, path / "images") if _images(f)), None)
            if folder is not None:
                found[path.name] = folder
    return dict(sorted(found.items()))


def open_camera(name: str, path: Path) -> CameraSource:
    """List the images of the camera that ``find_cameras`` found at ``path``.

    Raises:
        DyngsError: an image without a number, two with the same one, or a video that cannot be opened.
    """
    if path.is_file():
        planned = planned_frames(path)
        return CameraSource(name, dict(enumerate(planned.paths)), planned)
    images: dict[int, Path] = {}
    for image in _images(path):
        digits = re.findall(r"\d+", image.stem)
        if not digits:
            raise DyngsError(f"{image}: no frame number in its name; call it frame_0000{image.suffix} or the like")
        other = images.setdefault(int(digits[-1]), image)
        if other != image:
            raise DyngsError(f"{path}: {other.name} and {image.name} have the same frame number; remove one of them")
    return CameraSource(name, images)


def sequence_views(
    path: Path, cameras: Sequence[CameraSource], calibrations: Mapping[str, dict[str, object]]
) -> tuple[dict[str, tuple[View, ...]], list[str]]:
    """Return the views of each camera, and warnings; times run from 0 at the lowest frame number to 1 at the highest.

    Args:
        path: the calibration file in the capture's folder.
        cameras: in the order of their ``camera_id``.
        calibrations: by camera name, the fields of a frame in a transforms file: ``fl_x``, ``transform_matrix``, ...

    Raises:
        DyngsError: see ``dyngs.data.readers.shared.transforms.read_views``.
    """
    numbers = sorted({number for camera in cameras for number in camera.images})
    span = max(numbers[-1] - numbers[0], 1)
    views: dict[str, tuple[View, ...]] = {}
    warnings = _rate_warning(cameras)
    for index, camera in enumerate(cameras):
        own = dict(calibrations[camera.name])
        where = f"{path}, camera {camera.name}"
        if camera.video is not None and ("w" not in own or "h" not in own):
            own |= {"w": camera.video.info.width, "h": camera.video.info.height}
        frames = []
        for number, image in sorted(camera.images.items()):
            times = {"frame": number, "time": (number - numbers[0]) / span}
            fields = {**own, **times, "file_path": str(image), "camera": index}
            video = None if camera.video is None else VideoFrame(camera.video.source, number)
            frames.append(Frame(where, fields, {}, image, video))
        read, notes = read_views(FrameFile(path, {}, tuple(frames)))
        views[camera.name], more = tuple(read.values()), []
        if camera.video is not None:
            views[camera.name], more = _at_video_size(camera.name, camera.video.info, views[camera.name], where)
        warnings += [*notes, *more]
    return views, warnings


def video_fps(cameras: Sequence[CameraSource]) -> float | None:
    """Return the frame rate of the first video that has one, None if none has."""
    rates = (camera.video.info.fps for camera in cameras if camera.video is not None)
    return next((fps for fps in rates if fps > 0), None)


def _at_video_size(
    name: str, video: VideoInfo, views: tuple[View, ...], where: str
) -> tuple[tuple[View, ...], list[str]]:
    """Return the views named after the video and with its size: its frames may not be decoded yet."""
    sized, rescaled = [], []
    for view in views:
        described = (view.width, view.height)
        intrinsics, size, changed = match_size(view.intrinsics, described, (video.width, video.height), where)
        rescaled += [where] if changed else []
        frame = f"{name}/{view.image_path.stem}"
        sized.append(replace(view, name=frame, intrinsics=intrinsics, width=size[0], height=size[1]))
    return tuple(sized), rescale_warning(rescaled)


def _rate_warning(cameras: Sequence[CameraSource]) -> list[str]:
    videos = [
        (camera.name, camera.video.info.fps)
        for camera in cameras
        if camera.video is not None and camera.video.info.fps > 0
    ]
    odd = [(name, fps) for name, fps in videos if not math.isclose(fps, videos[0][1], rel_tol=0.01)]
    if not odd:
        return []
    first, (name, fps) = videos[0], odd[0]
    return [
        f"{first[0]} has {first[1]:g} frames per second, {name} {fps:g}: frames of one number are taken for "
        "simultaneous; convert the videos to one rate"
    ]


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
