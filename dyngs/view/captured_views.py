"""What the viewer shows next to a scene: the views of its capture, and from where it is looked at
first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.data.aim import look_at_point
from dyngs.data.capture import View
from dyngs.data.loader import ImageLoader
from dyngs.export.choose_path import orbit_around, points_at
from dyngs.human.avatar.scene import avatar_of
from dyngs.models.views import training_cameras
from dyngs.runs.opened import Opened, scene_of_split

THUMBNAIL = 96
"""Longest side of the small images, px."""


@dataclass(frozen=True)
class CapturedViews:
    """V views of a capture, each with a camera of the size of training, and their images, also
    small ones.

    There are no images where those of the capture do not show what the scene plays.
    """

    views: tuple[View, ...] = ()
    cameras: tuple[Cameras, ...] = ()
    images: ImageLoader | None = None
    thumbnails: ImageLoader | None = None

    def __len__(self) -> int:
        return len(self.views)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(view.name for view in self.views)

    @property
    def times(self) -> tuple[float | None, ...]:
        return tuple(view.time for view in self.views)

    @property
    def poses(self) -> np.ndarray:
        """(V, 4, 4) world to camera."""
        return np.stack([view.cam_from_world for view in self.views])


@dataclass(frozen=True)
class Viewpoint:
    """The camera from which a scene is looked at first, the point (3,) to orbit around, its rough
    size, and up (3,)."""

    start: Cameras
    center: np.ndarray
    extent: float
    up: np.ndarray


def views_of(opened: Opened) -> CapturedViews:
    """Return the views of a scene's capture, if there is one; without images where a person is in
    other poses."""
    if opened.captured is None:
        return CapturedViews()
    found = opened.captured.once("views", lambda: _views_of_capture(opened))
    return found if opened.as_captured else replace(found, images=None)


def captured_views(
    views: Sequence[View], data: DataConfig, images: ImageLoader | None = None
) -> CapturedViews:
    """Return views with their cameras, and what loads their images."""
    small = data.model_copy(update={"downscale": 1.0, "longest_side": THUMBNAIL, "cache_mb": 256.0})
    cameras = tuple(training_cameras(views, data))
    return CapturedViews(
        tuple(views), cameras, images or ImageLoader(views, data), ImageLoader(views, small)
    )


def viewpoint_of(opened: Opened) -> Viewpoint:
    """Return where to begin: at the first camera of the capture, else where all of the scene is in
    view."""
    return (opened.captured or opened).once("viewpoint", lambda: _viewpoint(opened))


def has_timeline(opened: Opened) -> bool:
    """Return whether there are times to choose from, now or later."""
    may_move = opened.in_training and len(opened.renderable.times) > 1
    return may_move or not opened.renderable.is_static or opened.person is not None


def _views_of_capture(opened: Opened) -> CapturedViews:
    """Return the views of all splits that show what the scene plays: a person may be filmed in
    other clips, too."""
    if opened.missing is not None:
        return CapturedViews()
    capture = opened.capture
    by_name = {}
    for split in ("train", "val", "test"):
        found = capture.splits.get(split, ())
        if found and scene_of_split(opened, capture, split) is opened.renderable:
            by_name |= {view.name: view for view in found}
    return captured_views(tuple(by_name.values()), opened.config.data)


def _viewpoint(opened: Opened) -> Viewpoint:
    shown = views_of(opened)
    up = opened.up
    if len(shown):
        poses = torch.from_numpy(shown.poses).float()
        start = shown.cameras[0]
        together = Cameras(
            poses, start.intrinsics.expand(len(poses), 3, 3), start.width, start.height
        )
        center = look_at_point(together)
        eyes = together.centers.double().cpu().numpy()
        person = avatar_of(opened.renderable)
        if person is not None:
            center = person.at(None).means.double().cpu().numpy().mean(0)
    else:
        means = points_at(opened.renderable).double().cpu().numpy()
        start = orbit_around(opened, 1)
        center = np.median(means[np.isfinite(means).all(1)], axis=0)
        eyes = start.centers.double().cpu().numpy()
    extent = float(np.median(np.linalg.norm(eyes - center, axis=1)))
    return Viewpoint(start, center, extent, np.array([0.0, 0.0, 1.0]) if up is None else up[0])
