"""Edit controls of the viewer page: measure, select, delete, undo, save.

Each browser has its own edits. Files and runs on disk never change.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from dyngs.api.edit import write_part
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, format_count
from dyngs.data.geometry import cameras_at_poses, look_at, perpendicular
from dyngs.export.edit.crop import (
    Box,
    Region,
    ScreenPolygon,
    Sphere,
    gaussians_in_region,
    screen_positions,
)
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.similarity import IDENTITY, Similarity
from dyngs.runs.opened import OpenedScene
from dyngs.view.layers import ViewRequest, depth_of, mark_selection, with_camera_of_view
from dyngs.view.views import camera_at, initial_viewpoint

if TYPE_CHECKING:
    from dyngs.view.server import BrowserConnection

REMOVES = "cmd/ctrl"  # Modifier key that removes from the selection
TOOLS = {
    "none": "",
    "measure": "Click two points to measure their distance.",
    "rectangle": "Shift-drag to select, Ctrl-drag to deselect.",
    "polygon": "Shift-click corners, the first one again to select (Ctrl: deselect).",
    "sphere": "Shift-click a surface to select, Ctrl-click to deselect.",
}
_SIZE = 9  # Side in px of the image rendered to pick a point
_SOLID = 0.5  # Alpha below which a ray hits nothing
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
# (12, 2, 3) edges of a unit cube
_EDGES = np.array([(a, b) for a, b in combinations(_CORNERS, 2) if np.abs(a - b).sum() == 1])


def world_of(opened: OpenedScene) -> Similarity:
    """Return the transform from a scene to the coordinates of ``dyngs edit``; identity for a
    file."""
    return IDENTITY if opened.captured is None else opened.world


def pick_point(
    opened: OpenedScene,
    origin: np.ndarray,
    direction: np.ndarray,
    pixel: float,
    request: ViewRequest,
) -> np.ndarray | None:
    """Return the point (3,) where a ray hits the scene, or None.

    It lies at the expected depth, so it is accurate to about the size of the Gaussians.

    Args:
        origin, direction: (3,) of the ray.
        pixel: angle of a pixel in rad.
        request: time and part that are shown.
    """
    length = float(np.linalg.norm(direction))
    if not (np.isfinite([*origin, length]).all() and length > 0 and pixel > 0):
        return None  # invalid input from the browser
    forward = direction / length
    camera = camera_at((1, 0, 0, 0), origin, 2 * math.atan(0.5 * _SIZE * pixel), (_SIZE, _SIZE))
    camera = cameras_at_poses(
        camera, look_at(origin, origin + forward, perpendicular(forward))[None]
    )
    found = depth_of(opened, ViewRequest(camera, request.time, part=request.part))
    depth, alpha = (float(x[_SIZE // 2, _SIZE // 2]) for x in found)
    return origin + depth * forward if alpha >= _SOLID else None


@dataclass
class EditState:
    """Picked points, a box, and the selected and remaining Gaussians of the scene ``whole``.

    Attributes:
        points: at most two, (3,) each, in scene coordinates.
        centre, size: (3,) each, of the box, in the coordinates of ``world_of``.
        corners: (3,) each, of an unfinished polygon, in scene coordinates.
        steps: remaining and selected Gaussians, (N,) bool each, after each change.
        undone: steps that ``redo`` restores, the next one at the end.
    """

    whole: OpenedScene
    centre: np.ndarray
    size: np.ndarray
    points: list[np.ndarray] = field(default_factory=list)
    corners: list[np.ndarray] = field(default_factory=list)
    steps: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    undone: list[tuple[Tensor, Tensor]] = field(default_factory=list)

    @property
    def box(self) -> Box:
        return Box(self.centre - self.size / 2, self.centre + self.size / 2)

    @property
    def state(self) -> tuple[Tensor, Tensor]:
        """Remaining and selected Gaussians, (N,) bool each."""
        if self.steps:
            return self.steps[-1]
        whole = torch.ones(len(self.whole.scene), dtype=torch.bool, device="cpu")
        return whole, ~whole

    @property
    def rows(self) -> Tensor:
        """(K,) indices of the remaining Gaussians."""
        return self.state[0].nonzero()[:, 0]

    @property
    def left(self) -> OpenedScene:
        """The remaining scene, with a highlighted selection."""
        if not self.steps:
            return self.whole
        scene: GaussianScene = self.whole.scene
        left = self.whole.with_scene(scene.select(self.rows.to(scene.device)))
        kept, selected = self.state
        if bool(selected.any()):
            mark_selection(left, selected[kept])
        return left

    def pick(self, point: np.ndarray) -> None:
        """Add a picked point (3,). A third point starts a new pair."""
        self.points = [point] if len(self.points) == 2 else [*self.points, point]

    def change(self, kept: Tensor, selected: Tensor) -> None:
        """Add a step with new remaining and selected Gaussians, (N,) bool each."""
        self.steps.append((kept, selected & kept))
        self.undone.clear()

    def select(self, inside: Tensor, *, removes: bool = False) -> None:
        """Add Gaussians (N,) bool to the selection, or remove them from it."""
        kept, selected = self.state
        self.change(kept, selected & ~inside if removes else selected | inside)

    def select_box(self) -> None:
        self.select(gaussians_in_region(self.box, self.whole.scene, world_of(self.whole)))

    def select_region(self, region: Region, time: float | None, *, removes: bool) -> None:
        """Add the Gaussians with centres in a region of the scene at ``time``, or remove them."""
        inside = gaussians_in_region(region, self.whole.scene, times=[time])
        self.select(inside, removes=removes)

    def invert(self) -> None:
        kept, selected = self.state
        self.change(kept, ~selected)

    def delete(self, *, selected: bool) -> int:
        """Delete the selected Gaussians, or all others. Return their number.

        Raises:
            DyngsError: nothing is selected, or no Gaussian would remain.
        """
        kept, chosen = self.state
        if not bool(chosen.any()):
            raise DyngsError("nothing is selected; select with a tool or by the box")
        left = kept & (chosen ^ selected)
        if not bool(left.any()):
            raise DyngsError("cannot delete all Gaussians: the whole scene is selected")
        self.change(left, torch.zeros_like(left))
        return int(kept.sum() - left.sum())

    def undo(self) -> None:
        if self.steps:
            self.undone.append(self.steps.pop())

    def redo(self) -> None:
        if self.undone:
            self.steps.append(self.undone.pop())

    def file(self, time: float | None) -> bytes:
        """Return the remaining Gaussians as a .ply, at ``time`` if the scene moves."""
        moment = None if self.whole.scene.is_static else time
        with tempfile.TemporaryDirectory(prefix="dyngs_view_") as folder:
            path = Path(folder) / "edited.ply"
            return write_part(self.whole, self.rows, path, moment).path.read_bytes()

    @property
    def description(self) -> str:
        """Markdown about picked points, box and remaining Gaussians, with options of ``dyngs
        edit``."""
        world = world_of(self.whole)
        places = [world.points(point) for point in self.points]
        # Use more digits for scenes far from the origin.
        low, high, *texts = (
            self._digits(place) for place in (self.box.low, self.box.high, *places)
        )
        lines = [f"{name}: `{text}`" for name, text in zip("AB", texts, strict=False)]
        if len(places) == 2:
            length = float(np.linalg.norm(places[1] - places[0]))
            lines.append(f"distance: **{length:.4g} {'m' if self.whole.scaled else 'units'}**")
            lines.append(f'`--scale "{texts[0]} {texts[1]} LENGTHm"`')
        lines.append(f"box: `--crop {low} {high}`")
        total = format_count(len(self.whole.scene), "Gaussian")
        lines.append(f"{len(self.rows):,} of {total} remaining")
        lines.append(f"{int(self.state[1].sum()):,} selected")
        return "\n\n".join(lines)

    def _digits(self, point: np.ndarray) -> str:
        distance = float(np.abs(point).max() / self.size.max())
        digits = 4 + math.ceil(math.log10(max(distance, 1)))
        return ",".join(f"{x:.{digits}g}" for x in point)


def can_be_edited(opened: OpenedScene) -> bool:
    """Return whether a scene can be edited: Gaussians from a file or run, no person, not in
    training."""
    is_file = opened.path is not None and opened.path.exists()
    has_gaussians = isinstance(opened.renderable, GaussianScene) and opened.person is None
    return is_file and has_gaussians and not opened.in_training


class EditControls:
    """Edit controls and markers of one browser for one scene."""

    def __init__(self, connection: BrowserConnection, opened: OpenedScene) -> None:
        begin = initial_viewpoint(opened)
        world = world_of(opened)
        extent = begin.extent * world.scale
        size = np.full(3, float(f"{0.5 * extent:.2g}"))
        self.editing = EditState(opened, world.points(begin.center), size)
        self._connection, self._extent = connection, begin.extent
        self._back = world.inverse()
        self._marks = dict[str, Any]()
        gui = connection.client.gui
        self._tool = gui.add_dropdown("Tool", tuple(TOOLS))
        self._hint = gui.add_markdown("")
        hint = "of the sphere, as a fraction of the size of the scene"
        self._radius = gui.add_slider("Radius", 0.005, 0.5, 0.005, 0.05, hint=hint)
        hint = "drag the arrows to move the box along the axes of the scene"
        self._box = gui.add_checkbox("Box", False, hint=hint)
        step = 10.0 ** (math.floor(math.log10(2 * extent)) - 2)
        self._size = gui.add_vector3(
            "Size", tuple(size.tolist()), min=(step, step, step), step=step
        )
        self._text = gui.add_markdown(self.editing.description)
        self._tool.on_update(lambda _: self._listen())
        self._box.on_update(lambda _: self._show_box())
        self._size.on_update(lambda _: self._refresh())
        jobs: dict[str, Callable[[], None]] = {
            "Select box": self.editing.select_box,
            "Invert selection": self.editing.invert,
            "Delete selected": lambda: self._delete(selected=True),
            "Delete others": lambda: self._delete(selected=False),
            "Undo": self.editing.undo,
            "Redo": self.editing.redo,
            "Save as .ply": self._save,
        }
        for name, job in jobs.items():
            gui.add_button(name).on_click(lambda _, job=job: self._submit_job(job))

    def remove(self) -> None:
        self._connection.client.scene.remove_click_callback()
        self._connection.client.scene.remove_rect_select_callback()
        for mark in self._marks.values():
            mark.remove()
        self._marks.clear()

    def _submit_job(self, job: Callable[[], None]) -> None:
        """Run a job in the render thread, and show its error."""

        def work() -> None:
            before = len(self.editing.steps)
            try:
                job()
            except DyngsError as error:
                self._connection.notify("Failed", str(error))
            if len(self.editing.steps) != before:
                self._show()
            self._refresh()

        self._connection.session.submit_job(work)

    def _refresh(self) -> None:
        """Redraw picked points, their line and the box, and update the description."""
        editing = self.editing
        editing.size = np.array(self._size.value, np.float64)
        scene = self._connection.client.scene
        for name in ("A", "B", "corner", "line", "polygon", "box"):
            if name in self._marks:
                self._marks.pop(name).remove()
        colours = (255, 200, 0), (80, 200, 255)
        for name, place, colour in zip("AB", editing.points, colours, strict=False):
            radius = 0.008 * self._extent
            self._marks[name] = scene.add_icosphere(
                f"/edit/{name}", radius=radius, color=colour, position=place
            )
        lines = dict[str, np.ndarray]()
        if len(editing.points) == 2:
            lines["line"] = np.stack(editing.points)[None]
        corners = editing.corners
        if corners:
            self._marks["corner"] = scene.add_icosphere(
                "/edit/corner", radius=2e-4 * self._extent, color=colours[0], position=corners[0]
            )
        if len(corners) > 1:
            lines["polygon"] = np.stack([corners[:-1], corners[1:]], axis=1)
        if self._box.value:
            lines["box"] = self._back.points(editing.centre + _EDGES * editing.size)
        for name, ends in lines.items():
            self._marks[name] = scene.add_line_segments(
                f"/edit/{name}",
                ends.astype(np.float32),
                colours[0],
                thickness=2,
                thickness_units="screen",
            )
        self._text.content = editing.description

    def _listen(self) -> None:
        """Receive the pointer events of the chosen tool."""
        scene = self._connection.client.scene
        scene.remove_click_callback()
        scene.remove_rect_select_callback()
        tool = str(self._tool.value)
        self._hint.content = TOOLS[tool]
        self.editing.points = []
        self.editing.corners = []
        jobs = {
            "measure": lambda event: self.editing.pick(self._point_at(event)),
            "rectangle": self._select_rectangle,
            "polygon": self._add_corner,
            "sphere": self._select_sphere,
        }
        if tool in jobs:
            listen = scene.on_rect_select if tool == "rectangle" else scene.on_click
            for modifier in (None,) if tool == "measure" else ("shift", REMOVES):
                listen(modifier=modifier)(lambda event: self._submit_job(lambda: jobs[tool](event)))
        self._refresh()

    def _point_at(self, event: Any) -> np.ndarray:
        """Return the point (3,) of the scene under the pointer. Raises DyngsError."""
        session = self._connection.session
        request = session.view_request()
        pixel = 1 / float(request.camera.intrinsics[0, 1, 1])
        origin = np.array(event.ray_origin, np.float64)
        direction = np.array(event.ray_direction, np.float64)
        point = pick_point(session.opened, origin, direction, pixel, request)
        if point is None:
            raise DyngsError("no surface here")
        return point

    def _select_sphere(self, event: Any) -> None:
        x, y, z = self._point_at(event).tolist()
        self._select(Sphere((x, y, z), float(self._radius.value) * self._extent), event)

    def _select_rectangle(self, event: Any) -> None:
        left, top = event.screen_min
        right, bottom = event.screen_max
        corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
        self._select(ScreenPolygon(self._camera(), corners), event)

    def _add_corner(self, event: Any) -> None:
        """Add a corner in front of the camera. A click at the first one closes the polygon."""
        corners = self.editing.corners
        if len(corners) > 2:
            places = screen_positions(np.array(corners), self._camera())
            if np.abs(places[0] - event.screen_pos).max() < 0.02:
                self.editing.corners = []
                self._select(ScreenPolygon(self._camera(), places), event)
                return
        ray = np.array(event.ray_direction, np.float64)
        corners.append(np.array(event.ray_origin) + 0.05 * self._extent * ray)

    def _camera(self) -> Cameras:
        """Return the camera of the displayed image."""
        session = self._connection.session
        return with_camera_of_view(session.opened, session.view_request()).camera

    def _select(self, region: Region, event: Any) -> None:
        time = self._connection.session.time
        self.editing.select_region(region, time, removes=event.modifier == REMOVES)

    def _show_box(self) -> None:
        """Show or hide the box and its gizmo."""
        if self._box.value:
            gizmo = self._connection.client.scene.add_transform_controls(
                "/edit/gizmo",
                scale=0.3 * self._extent,
                disable_rotations=True,
                wxyz=self._back.turn,
                position=self._back.points(self.editing.centre),
            )
            gizmo.on_update(lambda _: self._move(np.array(gizmo.position)))
            self._marks["gizmo"] = gizmo
        else:
            self._marks.pop("gizmo").remove()
        self._refresh()

    def _move(self, place: np.ndarray) -> None:
        if np.isfinite(place).all():
            self.editing.centre = world_of(self.editing.whole).points(place)
            self._refresh()

    def _delete(self, *, selected: bool) -> None:
        gone = self.editing.delete(selected=selected)
        self._connection.notify(
            "Deleted", f"{format_count(gone, 'Gaussian')} (use Undo to restore)"
        )

    def _show(self) -> None:
        left = self.editing.left
        self._connection.loaded = left
        self._connection.session.show(left)

    def _save(self) -> None:
        data = self.editing.file(self._connection.session.time)
        name = f"{self.editing.whole.name.removesuffix('.ply')}_edited.ply"
        self._connection.client.send_file_download(name, data, save_immediately=True)
