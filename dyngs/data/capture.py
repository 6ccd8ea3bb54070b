"""Captures in memory: views with cameras, sparse points and body parameters; images stay on
disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

Split = Literal["train", "val", "test", "pose"]
"""The split "pose" shows a person in another clip, with times and frame numbers of its own."""

BodyKind = Literal["smpl", "smplh", "smplx"]
ShapeSpace = Literal["smpl", "anny"]

BODY_KINDS: dict[int, BodyKind] = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Number of joints to body model."""


@dataclass(frozen=True)
class Lens:
    """Lens distortion of one view; images are undistorted to a pinhole on load.

    Attributes:
        model: "none", "opencv" (k1 k2 p1 p2 [k3 k4 k5 k6]) or "fisheye" (OpenCV equidistant
            k1..k4).
        params: the coefficients, in OpenCV's order.
    """

    model: Literal["none", "opencv", "fisheye"] = "none"
    params: tuple[float, ...] = ()


@dataclass(frozen=True)
class VideoFrame:
    """One frame of a video file; ``number`` counts from 0."""

    video: Path
    number: int


@dataclass(frozen=True)
class Silhouette:
    """Mask of a person in an image, in a file.

    Attributes:
        path: an image of the same size, or an HDF5 file whose data set ``masks`` (F, H, W) has a
            row per frame.
        person: how the person's pixels are marked: "white" (grey levels are partial coverage),
            "black" (the inverse of "white"), or "nonzero" (labels: everything but 0).
        row: row of the data set, None for an image.
    """

    path: Path
    person: Literal["white", "black", "nonzero"]
    row: int | None = None


@dataclass(frozen=True)
class View:
    """One image and its camera; what a capture does not have is None.

    Attributes:
        name: unique within the capture (usually the path below the root, without extension).
        image_path: image file; for a frame of a ``video`` the file it is decoded to, see
            ``images.video``.
        cam_from_world: (4, 4) float64, OpenCV axes, in scene coordinates (see
            ``Capture.world_scale``).
        intrinsics: (3, 3) float64 in pixels of the *stored* image size.
        width, height: stored image size in pixels.
        camera_id: index of the physical camera.
        mask_path: white = keep, black = ignore.
        time: in [0, 1], or None for a static scene.
        frame: frame number of a sequence.
        video: the video frame that ``image_path`` is decoded from.
        silhouette: mask of the person, which becomes the image's alpha.
        depth_path: depth map, in any unit, see ``images.maps``.
        depth_scale: scene units in the unit of the files, which that of the depth map may be.
        motion_mask_path: white = moves; if ``motion_mask_labels``, all but 0 does.
        flow_path: optical flow to the view ``flow_to``, the next one of this camera in its file.
        exposure: light let in by the EXIF tags, by ``ImageHeader``: comparable among views of one
            capture.
        shrunk: how many times smaller the file is than the image that it is a copy of.
    """

    name: str
    image_path: Path
    cam_from_world: np.ndarray
    intrinsics: np.ndarray
    width: int
    height: int
    lens: Lens = field(default_factory=Lens)
    camera_id: int = 0
    mask_path: Path | None = None
    time: float | None = None
    frame: int | None = None
    video: VideoFrame | None = None
    silhouette: Silhouette | None = None
    depth_path: Path | None = None
    depth_scale: float = 1.0
    motion_mask_path: Path | None = None
    motion_mask_labels: bool = False
    flow_path: Path | None = None
    flow_to: str | None = None
    exposure: float | None = None
    shrunk: int = 1


Splits = dict[Split, tuple[View, ...]]
"""Split name to its views."""


def all_views(splits: Mapping[Split, tuple[View, ...]]) -> list[View]:
    """The views of all splits, one split after the other."""
    return [view for views in splits.values() for view in views]


def group_by_camera(splits: Mapping[Split, tuple[View, ...]]) -> dict[int, list[View]]:
    """Return the views of each camera in order of time, cameras by their numbers."""
    found: dict[int, list[View]] = {}
    for view in sorted(
        all_views(splits), key=lambda view: (view.camera_id, view.time or 0.0, view.name)
    ):
        found.setdefault(view.camera_id, []).append(view)
    return found


def map_views(splits: Splits, change: Callable[[View], View]) -> Splits:
    """Return the splits with ``change`` of each view."""
    return {name: tuple(map(change, views)) for name, views in splits.items()}


@dataclass(frozen=True)
class PointCloud:
    """Sparse points: ``xyz`` (P, 3) float64 in scene coordinates, ``rgb`` (P, 3) uint8."""

    xyz: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True)
class BodyFrames:
    """Body parameters of the frames of one clip, float64, in the world and the unit of the clip's
    cameras.

    A point x of the shaped template at rest is mapped to ``scale * turn(LBS(x; poses)) + trans``.
    LBS rotates the whole body by ``poses[:, 0]`` about the pelvis (joint 0), ``turn`` about the
    template's origin; ``about_pelvis`` merges the two.

    Attributes:
        frames: (F,) ascending frame numbers, as in ``View.frame``.
        poses: (F, J, 3) axis-angle, radians, J = 24, 52 or 55.
        trans: (F, 3).
        betas: (B,) shape coefficients, in the shape space ``shape_space``.
        scale: (F,) world units per metre of the template, positive.
        turns: (F, 3) axis-angle, radians, rotation about the template's origin; None for none.
        pelvis: (3,) rest position of the pelvis of the fitted body, None where the files do not
            say.
        shape_space: that of ``betas``: of SMPL's family, or of the free template.
        fitted_to: ``fingerprint`` of the template that dyngs fitted; empty for the free one and
            parameters of others.
    """

    frames: tuple[int, ...]
    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray
    scale: np.ndarray
    turns: np.ndarray | None = None
    pelvis: np.ndarray | None = None
    shape_space: ShapeSpace = "smpl"
    fitted_to: str = ""

    @property
    def kind(self) -> BodyKind:
        """The body model with that number of joints."""
        return BODY_KINDS[self.poses.shape[1]]


@dataclass(frozen=True)
class Capture:
    """A scene on disk.

    Attributes:
        root: the folder.
        format: as ``data.format`` has it.
        splits: split name to views, each tuple sorted by name; train is never empty.
        points: sparse points or None.
        points_file: the .ply that the points are from, which is not known to fit the cameras; None
            for other points.
        world_scale: power of two, length of a scene unit in the unit of the files. A point x in
            scene coordinates is ``world_scale * x + world_offset`` in the files. See
            ``scene_space.normalise_capture``.
        world_offset: (3,) float64 in the unit of the files; zero unless the scene lies far from its
            origin.
        has_alpha: images carry straight alpha that means "transparent here".
        body: body parameters of each split, by frame number, for captures of people.
        fps: frames per second of the recording.
        span: first and last time as written in the files, which are 0 and 1 in the views.
        in_seconds: times in the files are seconds.
        seconds: from time 0 to time 1.
        tracks_path: 2D tracks, see ``data.tracks``.
        warnings: suspicious findings of the reader, one line each.
    """

    root: Path
    format: str
    splits: Splits
    points: PointCloud | None = None
    points_file: Path | None = None
    world_scale: float = 1.0
    world_offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    has_alpha: bool = False
    body: dict[Split, BodyFrames] | None = None
    fps: float | None = None
    span: tuple[float, float] | None = None
    in_seconds: bool = False
    seconds: float | None = None
    tracks_path: Path | None = None
    warnings: tuple[str, ...] = ()

    def replace(self, **changes: object) -> Capture:
        """Return the capture with other attributes."""
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class CaptureFormat:
    """A capture format: how a folder of this format is recognised and read.

    Attributes:
        files: the files by which it is recognised, for messages.
        recognise: whether a folder holds these files; opens none of them.
        read: reads the folder; ``dyngs.data.read`` then finishes splits and times.
        extends: name of the format of which this one is a special case: its folders are recognised
            as that one, too.
    """

    name: str
    files: str
    recognise: Callable[[Path], bool]
    read: Callable[[Path], Capture]
    extends: str | None = None
