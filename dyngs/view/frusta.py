"""The cameras of a capture in the page, as frusta with their images."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from dyngs.data.times import evenly_spaced
from dyngs.io.write import to_uint8
from dyngs.runs.opened import Opened
from dyngs.view.cameras import centers_of, fov_of, pose_of
from dyngs.view.captured_views import viewpoint_of, views_of

if TYPE_CHECKING:
    from dyngs.view.server import Browsing

_COVERS = 1.5
"""Distance, in depths of a frustum, within which its image would cover what is behind."""
MOST = 120
"""Frusta that are shown at most, spread evenly over the cameras."""
_SIZE, _OF_SPREAD = 0.05, 0.15
"""Depth of a frustum at most, relative to the distance of the cameras from what they see, and from
their middle: those of a video stand close together."""


class Frusta:
    """Frusta of one browser."""

    def __init__(self, browsing: Browsing) -> None:
        self._browsing = browsing
        self._handles: list[tuple[Any, np.ndarray, float]] = []
        self._generation = 0
        browsing.on_move = self.hide_what_covers

    def show(self, opened: Opened) -> None:
        """Add the frusta, image by image, as the thread that draws finds time."""
        self.remove()
        generation = self._generation
        views = distinct(views_of(opened).poses)
        for index in (views[i] for i in evenly_spaced(len(views), MOST)):
            self._browsing.session.ask(lambda index=index: self._add(opened, index, generation))

    def remove(self) -> None:
        self._generation += 1
        handles = self._handles
        self._handles = []
        for handle, _, _ in handles:
            handle.remove()

    def hide_what_covers(self) -> None:
        """Hide the frusta that the browser's camera stands in, and all where the image is of
        another camera."""
        session = self._browsing.session
        eye = session.eye
        is_elsewhere = session.shown_view is not None
        if eye is None:
            return
        for handle, position, size in list(self._handles):
            covers = is_elsewhere or float(np.linalg.norm(position - eye.position)) < _COVERS * size
            if handle.visible == covers:
                handle.visible = not covers

    def _add(self, opened: Opened, index: int, generation: int) -> None:
        if generation != self._generation:
            return
        shown = views_of(opened)
        camera = shown.cameras[index]
        size = frustum_size(shown.poses, viewpoint_of(opened).extent)
        wxyz, position = pose_of(camera)
        handle = self._browsing.client.scene.add_camera_frustum(
            f"/cameras/{index}",
            fov=fov_of(camera),
            aspect=camera.width / camera.height,
            scale=size,
            thickness=0.03 * size,
            color=(230, 160, 30),
            image=_thumbnail(opened, index),
            format="jpeg",
            wxyz=wxyz,
            position=position,
            cast_shadow=False,
            receive_shadow=False,
        )
        handle.on_click(lambda _: self._go(index))
        self._handles.append((handle, position, size))
        self.hide_what_covers()

    def _go(self, index: int) -> None:
        time = views_of(self._browsing.session.opened).times[index]
        self._browsing.go_to(index)
        if time is not None and not self._browsing.session.opened.renderable.is_static:
            self._browsing.session.set_time(time)
            if self._browsing.time_slider is not None:
                self._browsing.time_slider.value = round(time, 3)


def distinct(poses: np.ndarray) -> list[int]:
    """Return the indices of the first view from each pose of (V, 4, 4), ascending: a fixed camera
    is shown once."""
    relative = poses.copy()
    relative[:, :3, 3] /= np.abs(poses[:, :3, 3]).max(initial=0.0) or 1.0
    _, first = np.unique(relative.round(6).reshape(len(poses), -1), axis=0, return_index=True)
    return sorted(first.tolist())


def frustum_size(poses: np.ndarray, extent: float) -> float:
    """Return the depth of the frusta of poses (V, 4, 4), world units; ``extent`` is the distance of
    what they see."""
    centers = centers_of(poses)
    spread_out = float(np.median(np.linalg.norm(centers - centers.mean(0), axis=1)))
    return (
        min(_SIZE * extent, _OF_SPREAD * spread_out)
        if spread_out > 1e-4 * extent
        else _SIZE * extent
    )


def _thumbnail(opened: Opened, index: int) -> np.ndarray | None:
    """Return the small image (h, w, 3) uint8 of a view, None where there is none."""
    loader = views_of(opened).thumbnails
    return (
        None
        if loader is None
        else to_uint8(loader[index].composite(opened.background).clamp(0, 1).numpy())
    )
