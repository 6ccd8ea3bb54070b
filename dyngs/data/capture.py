"""What a reader returns: an immutable description of a captured scene, images not yet decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

Split = Literal["train", "val", "test", "pose"]
"""A "pose" split shows a person in another clip than the others: with times and frame numbers of its own."""

BodyKind = Literal["smpl", "smplh", "smplx"]

BODY_KINDS: dict[int, BodyKind] = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Number of joints to the body model that has so many."""


@dataclass(frozen=True)
class Lens:
    """Lens distortion of one view; images are undistorted to a pinhole on load.

    Attributes:
        model: "none", "opencv" (k1 k2 p1 p2 [k3 k4 k5 k6]) or "fisheye" (OpenCV equidistant k1..k4).
        params: the coefficients, in OpenCV's order.
    """

    model: Literal["none", "opencv", "fisheye"] = "none"
    params: tuple[float, ...] = ()


@dataclass(frozen=True)
class VideoFrame:
    """A picture that comes out of a video: of this file the frame of this number, 0 being the first one."""

    video: Path
    number: int


@dataclass(frozen=True)
class Silhouette:
    """Where a person is in a picture.

    Attributes:
        path: a picture of the same size, or an HDF5 file whose data set ``masks`` has a row (H, W) per frame.
        person: how the person's pixels are marked: "white" (grey levels count as shares), "black" (as "white",
            inverted), or "nonzero" (labels: everything but 0).
        row: of the data set, None for a picture.
    """

    path: Path
    person: Literal["white", "black", "nonzero"]
    row: int | None = None


@dataclass(frozen=True)
class View:
    """One picture and its camera.

    Attributes:
        name: unique within the capture (usually the path below the root, without extension).
        image_path: picture file; of a ``video``'s frame where it lies or will lie, see ``pictures.frame_cache``.
        cam_from_world: (4, 4) float64, OpenCV axes, in the capture's rebased world (see ``Capture.world_offset``).
        intrinsics: (3, 3) float64 in pixels of the *stored* picture size.
        width, height: stored picture size in pixels.
        camera_id: which physical camera took it.
        mask_path: white = keep, black = ignore; None without a mask.
        time: in [0, 1], or None for a still scene.
        frame: frame number of a sequence, or None.
        video: the video frame that ``image_path`` is decoded from, None where it is a file of the capture.
        silhouette: the person in the picture, becomes its alpha; None: no person is cut out.
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


Splits = dict[Split, tuple[View, ...]]
"""Split name to its views."""


def all_views(splits: Mapping[Split, tuple[View, ...]]) -> list[View]:
    """The views of all splits, one split after the other."""
    return [view for views in splits.values() for view in views]


@dataclass(frozen=True)
class PointCloud:
    """Sparse points: ``xyz`` (P, 3) float64 in the rebased world, ``rgb`` (P, 3) uint8."""

    xyz: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True)
class BodyFrames:
    """Body parameters of the frames of one clip, float64, in the world and the unit of the cameras of that clip.

    A point x of the shaped template at rest comes to ``scale * turn(LBS(x; poses)) + trans``. LBS turns everything by
    ``poses[:, 0]`` about the pelvis (joint 0), ``turn`` about the template's origin; ``about_pelvis`` does without.

    Attributes:
        frames: (F,) numbers, ascending, as in ``View.frame`` of the views of the same clip.
        poses: (F, J, 3) axis-angle, radians, J = 24, 52 or 55.
        trans: (F, 3).
        betas: (B,) shape coefficients.
        scale: (F,) world units per metre of the template, positive.
        turns: (F, 3) axis-angle, radians; None where there is nothing to turn.
        pelvis: (3,) where the pelvis of the body that was fitted is at rest, None where the files do not say.
    """

    frames: tuple[int, ...]
    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray
    scale: np.ndarray
    turns: np.ndarray | None = None
    pelvis: np.ndarray | None = None

    @property
    def kind(self) -> BodyKind:
        """The model whose joints these are."""
        return BODY_KINDS[self.poses.shape[1]]


@dataclass(frozen=True)
class Capture:
    """A scene on disk.

    Attributes:
        root: the folder.
        format: name of the reader, as ``data.format`` has it.
        splits: split name to views, each tuple sorted by name; train is never empty.
        points: sparse points or None.
        world_offset: (3,) float64 added to rebased coordinates to get the file's coordinates (zero unless the scene
            lies far from its origin).
        has_alpha: pictures carry straight alpha that means "transparent here".
        body: body parameters of each split, by frame number, for captures of people, else None.
        fps: frames per second of the recording, None where the capture does not say.
        warnings: suspicious things met while reading, one line each.
    """

    root: Path
    format: str
    splits: Splits
    points: PointCloud | None = None
    world_offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    has_alpha: bool = False
    body: dict[Split, BodyFrames] | None = None
    fps: float | None = None
    warnings: tuple[str, ...] = ()

    def replace(self, **changes: object) -> Capture:
        return replace(self, **changes)  # type: ignore[arg-type]
