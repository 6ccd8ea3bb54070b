"""Data classes of a capture: views with cameras, sparse points and body parameters. Images stay on
disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from dyngs.core.camera import Cameras

Split = Literal["train", "val", "test", "pose"]
"""Splits of a capture; "pose" is a separate clip of a person, with its own times and frame
numbers."""

BodyKind = Literal["smpl", "smplh", "smplx"]
ShapeSpace = Literal["smpl", "anny"]

BODY_KINDS: dict[int, BodyKind] = {24: "smpl", 52: "smplh", 55: "smplx"}
"""Body model by number of joints."""


@dataclass(frozen=True)
class Lens:
    """Lens distortion of a view; images are undistorted to a pinhole image on load.

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
    """Mask file of a person.

    Attributes:
        path: an image of the same size, or an HDF5 file with a data set ``masks`` (F, H, W).
        person: how pixels of the person are marked: "white" (grey levels are partial coverage),
            "black" (the inverse of "white"), or "nonzero" (labels: everything but 0).
        row: row of the data set, None for an image.
    """

    path: Path
    person: Literal["white", "black", "nonzero"]
    row: int | None = None


@dataclass(frozen=True)
class View:
    """One image and its camera; fields that a capture does not have are None.

    Attributes:
        name: unique within the capture (usually the path below the root, without extension).
        image_path: image file; for a frame of a ``video`` the cached file, see ``images.video``.
        cam_from_world: (4, 4) float64, OpenCV axes, in scene coordinates (see
            ``Capture.world_scale``).
        intrinsics: (3, 3) float64 in pixels of the *stored* image size.
        width, height: stored image size in pixels.
        camera_id: index of the physical camera.
        mask_path: white = used, black = ignored.
        time: in [0, 1], or None for a static scene.
        frame: frame number of a sequence.
        video: the video frame that ``image_path`` is decoded from.
        silhouette: mask of the person, which becomes the image's alpha.
        depth_path: depth map, see ``images.maps``.
        depth_scale: factor from depth values to scene units, if they are in the unit of the files.
        motion_mask_path: white = moving; with ``motion_mask_labels``, every label but 0.
        flow_path: optical flow to the view ``flow_to``, the next view of the same camera.
        exposure: relative exposure from EXIF, see ``ImageHeader``; comparable within a capture.
        copy_factor: how many times smaller the file is than the original image of which it is a
            copy.
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
    copy_factor: int = 1


Splits = dict[Split, tuple[View, ...]]
"""Views by split name."""


def all_views(splits: Mapping[Split, tuple[View, ...]]) -> list[View]:
    """Return the views of all splits, one split after the other."""
    return [view for views in splits.values() for view in views]


def group_by_camera(splits: Mapping[Split, tuple[View, ...]]) -> dict[int, list[View]]:
    """Return the views of each camera in order of time, by camera id."""
    found: dict[int, list[View]] = {}
    for view in sorted(
        all_views(splits), key=lambda view: (view.camera_id, view.time or 0.0, view.name)
    ):
        found.setdefault(view.camera_id, []).append(view)
    return found


def map_views(splits: Splits, change: Callable[[View], View]) -> Splits:
    """Return the splits with ``change`` applied to each view."""
    return {name: tuple(map(change, views)) for name, views in splits.items()}


@dataclass(frozen=True)
class PointCloud:
    """Sparse points: ``xyz`` (P, 3) float64 in scene coordinates, ``rgb`` (P, 3) uint8."""

    xyz: np.ndarray
    rgb: np.ndarray


@dataclass(frozen=True)
class BodyFrames:
    """Body parameters of the frames of one clip, float64, in the world and unit of its cameras.

    A point x of the shaped template in rest pose is mapped to ``scale * R LBS(x; poses) + trans``.
    LBS rotates the body by ``poses[:, 0]`` about the pelvis (joint 0), R (``origin_rotations``)
    about the template's origin; ``merge_root_rotation`` merges the two.

    Attributes:
        frames: (F,) ascending frame numbers, as in ``View.frame``.
        poses: (F, J, 3) axis-angle, radians, J = 24, 52 or 55.
        trans: (F, 3) translations.
        betas: (B,) shape coefficients in ``shape_space``.
        scale: (F,) world units per metre of the template, positive.
        origin_rotations: (F, 3) axis-angle, radians; None for the identity.
        pelvis: (3,) rest position of the pelvis of the fitted body, None if the files do not store
            it.
        shape_space: space of ``betas``: that of the SMPL family, or of the free template.
        fitted_to: ``fingerprint`` of the template that dyngs fitted; empty for the free template
            and for parameters from elsewhere.
    """

    frames: tuple[int, ...]
    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray
    scale: np.ndarray
    origin_rotations: np.ndarray | None = None
    pelvis: np.ndarray | None = None
    shape_space: ShapeSpace = "smpl"
    fitted_to: str = ""

    @property
    def kind(self) -> BodyKind:
        """Body model with this number of joints."""
        return BODY_KINDS[self.poses.shape[1]]


@dataclass(frozen=True)
class Capture:
    """A capture on disk: its views, points, body parameters and coordinate frame.

    Example:

        import dyngs

        capture = dyngs.read_capture("lego")
        capture.splits["train"][0].name, len(capture.splits["test"])

    Attributes:
        root: the folder.
        format: name of its format, as in ``data.format``.
        splits: views by split, each tuple sorted by name; train is never empty.
        points: sparse points or None.
        points_file: .ply of the points if they may be in other coordinates than the cameras, else
            None.
        world_scale: power of two, length of a scene unit in the unit of the files. A point x in
            scene coordinates is ``world_scale * x + world_offset`` in the files, see
            ``scene_space.normalise_capture``.
        world_offset: (3,) float64 in the unit of the files; zero unless the scene lies far from
            the origin.
        has_alpha: images have straight alpha, with 0 = transparent.
        body: body parameters of each split, for captures of people.
        fps: frames per second of the recording.
        file_time_span: first and last time in the files, which become 0 and 1 in the views.
        times_in_seconds: times in the files are seconds.
        seconds: duration from time 0 to time 1.
        tracks_path: 2D tracks, see ``data.tracks``.
        warnings: messages of the reader.
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
    file_time_span: tuple[float, float] | None = None
    times_in_seconds: bool = False
    seconds: float | None = None
    tracks_path: Path | None = None
    warnings: tuple[str, ...] = ()

    @staticmethod
    def from_images(
        images: Sequence[Any],
        cameras: Cameras | Sequence[Cameras],
        times: Sequence[float] | None = None,
        masks: Sequence[Any] | None = None,
    ) -> Capture:
        """Return a capture of images in memory, for ``dyngs.train`` and ``dyngs.evaluate``.

        The images are stored once, as PNG in the user's cache (``DYNGS_CACHE_DIR``). Runs that are
        trained on them can therefore be resumed, evaluated and viewed from there. Every eighth
        image is held out, as of files.

        Example:

            import numpy as np

            import dyngs

            images = [np.zeros((48, 64, 3), np.uint8)] * 4
            poses = np.stack([np.eye(4)] * 4)
            poses[:, 0, 3] = np.arange(4)
            intrinsics = [[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]
            cameras = dyngs.Cameras.from_matrices(poses, intrinsics, width=64, height=48)
            capture = dyngs.Capture.from_images(images, cameras)

        Args:
            images: (H, W), (H, W, 3) or (H, W, 4) arrays or tensors with straight alpha; uint8, or
                floats in [0, 1], which are rounded to 8 bits.
            cameras: one per image; a list of ``Cameras`` where sizes differ.
            times: one per image in any unit, for a moving scene.
            masks: (H, W) bool, uint8 or float; True, 255 or 1: used, 0: ignored.

        Raises:
            DyngsError: other lengths, shapes, types or values, or an invalid pose.
        """
        from dyngs.data.arrays import capture_from_images

        return capture_from_images(images, cameras, times, masks)

    def __repr__(self) -> str:
        views = ", ".join(f"{len(x)} {name}" for name, x in self.splits.items() if x)
        points = 0 if self.points is None else len(self.points.xyz)
        return f"Capture({self.root}: {self.format}, views: {views}; {points:,} points)"

    def replace(self, **changes: object) -> Capture:
        """Return a copy with some attributes replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class CaptureFormat:
    """A capture format: how a folder is recognised and read.

    Attributes:
        files: names of its files, for messages.
        recognise: whether a folder contains these files; opens none of them.
        read: reads the folder; ``dyngs.data.read`` then completes splits and times.
        extends: name of a more general format whose files this one contains as well.
    """

    name: str
    files: str
    recognise: Callable[[Path], bool]
    read: Callable[[Path], Capture]
    extends: str | None = None
