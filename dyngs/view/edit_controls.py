"""The folder Edit of the page: pick points, measure, delete by a box, undo, save. Each browser
edits for itself."""

from __future__ import annotations

import math
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np

from dyngs.core.errors import DyngsError, counted
from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.opened import Opened
from dyngs.view.captured_views import viewpoint_of
from dyngs.view.editing import Editing, picked, world_of

if TYPE_CHECKING:
    from dyngs.view.server import Browsing

_SHARE = 0.5  # size of the box at first over that of the scene
_DOT = 0.008  # radius of a picked point over its distance to the camera at first
_COLOURS = (255, 200, 0), (80, 200, 255)
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
# (12, 2, 3) of a cube
_EDGES = np.array([(a, b) for a, b in combinations(_CORNERS, 2) if np.abs(a - b).sum() == 1])


def can_be_edited(opened: Opened) -> bool:
    """Return whether a scene has Gaussians of which a part can be saved: not those of people, or in
    training."""
    is_whole = (
        isinstance(opened.renderable, GaussianScene)
        and opened.person is None
        and not opened.in_training
    )
    return is_whole and opened.path is not None and opened.path.exists()


class EditControls:
    """Controls and marks of one browser for one scene; ``remove`` takes the marks away."""

    def __init__(self, browsing: Browsing, opened: Opened) -> None:
        begin = viewpoint_of(opened)
        world = world_of(opened)
        size = np.full(3, float(f"{_SHARE * begin.extent * world.scale:.2g}"))
        self.editing = Editing(opened, world.points(begin.center), size)
        self._browsing, self._extent, self._marks = browsing, begin.extent, dict[str, Any]()
        gui = browsing.client.gui
        pick = gui.add_checkbox(
            "Pick points", False, hint="click on the scene: two points and their distance"
        )
        box = gui.add_checkbox("Box", False, hint="drag its arrows; along the axes of the scene")
        longest = 2 * begin.extent * world.scale
        step = 10.0 ** (math.floor(math.log10(longest)) - 2)
        longest = step * math.ceil(longest / step)
        self._sizes = [
            gui.add_slider(f"Size {axis}", step, longest, step, size[0]) for axis in "xyz"
        ]
        self._text = gui.add_markdown(self.editing.said)
        pick.on_update(lambda _: self._listen(bool(pick.value)))
        box.on_update(lambda _: self._show_box() if box.value else self._drop("box", "gizmo"))
        for slider in self._sizes:
            slider.on_update(lambda _: self._resize())
        gui.add_button("Delete inside").on_click(
            lambda _: self._ask(lambda: self._delete(inside=True))
        )
        gui.add_button("Delete outside").on_click(
            lambda _: self._ask(lambda: self._delete(inside=False))
        )
        gui.add_button("Undo").on_click(lambda _: self._ask(self._undo))
        save = gui.add_button("Save as .ply", hint="a new file; what is opened stays as it is")
        save.on_click(lambda _: self._ask(self._save))

    def remove(self) -> None:
        self._listen(False)
        self._drop(*list(self._marks))

    def _ask(self, job: Any) -> None:
        """Have a job done by the thread that draws; what cannot be done is told."""

        def work() -> None:
            try:
                job()
            except DyngsError as error:
                self._tell("Not done", str(error))
            self._text.content = self.editing.said

        self._browsing.session.ask(work)

    def _listen(self, listens: bool) -> None:
        scene = self._browsing.client.scene
        scene.remove_click_callback()
        if listens:
            scene.on_click()(lambda event: self._ask(lambda: self._pick(event)))
        else:
            self.editing.points = []
            self._drop("A", "B", "line")
            self._text.content = self.editing.said

    def _pick(self, event: Any) -> None:
        session = self._browsing.session
        if session.eye is None:
            return
        pixel = session.eye.fov / session.eye.size[1]
        origin = np.array(event.ray_origin)
        point = picked(session.opened, origin, np.array(event.ray_direction), pixel, session.shot())
        if point is None:
            self._tell("Nothing there", "The scene is not solid at this place.")
            return
        self.editing.pick(point)
        self._drop("A", "B", "line")
        scene = self._browsing.client.scene
        points = self.editing.points
        for name, place, colour in zip("AB", points, _COLOURS, strict=False):
            radius = _DOT * float(np.linalg.norm(place - origin))
            self._marks[name] = scene.add_icosphere(
                f"/edit/{name}", radius=radius, color=colour, position=place
            )
        if len(points) == 2:
            line = np.stack(points)[None].astype(np.float32)
            self._marks["line"] = scene.add_line_segments(
                "/edit/line", line, _COLOURS[0], thickness=3, thickness_units="screen"
            )

    def _show_box(self) -> None:
        """Show the box and its gizmo, along the axes of the frame."""
        scene = self._browsing.client.scene
        back = world_of(self.editing.whole).inverse()
        place = back.points(self.editing.centre)
        self._drop("gizmo")
        gizmo = scene.add_transform_controls(
            "/edit/gizmo",
            scale=0.3 * self._extent,
            disable_rotations=True,
            wxyz=back.turn,
            position=place,
        )
        gizmo.on_update(lambda _: self._move(np.array(gizmo.position)))
        self._marks["gizmo"] = gizmo
        self._show_edges()

    def _show_edges(self) -> None:
        self._drop("box")
        back = world_of(self.editing.whole).inverse()
        edges = (_EDGES * back.scale * self.editing.size).astype(np.float32)
        self._marks["box"] = self._browsing.client.scene.add_line_segments(
            "/edit/box",
            edges,
            _COLOURS[0],
            thickness=2,
            thickness_units="screen",
            wxyz=back.turn,
            position=back.points(self.editing.centre),
        )

    def _move(self, place: np.ndarray) -> None:
        if not np.isfinite(place).all():
            return
        self.editing.centre = world_of(self.editing.whole).points(place)
        self._marks["box"].position = place
        self._text.content = self.editing.said

    def _resize(self) -> None:
        self.editing.size = np.array([float(slider.value) for slider in self._sizes])
        if "box" in self._marks:
            self._show_edges()
        self._text.content = self.editing.said

    def _delete(self, *, inside: bool) -> None:
        gone = self.editing.delete(inside=inside)
        self._show()
        self._tell("Deleted", f"{counted(gone, 'Gaussian')}; Undo brings them back")

    def _undo(self) -> None:
        if self.editing.undo():
            self._show()

    def _show(self) -> None:
        self._browsing.loaded = self.editing.left
        self._browsing.session.show(self.editing.left)

    def _save(self) -> None:
        data = self.editing.file(self._browsing.session.time)
        name = f"{self.editing.whole.name.removesuffix('.ply')}_edited.ply"
        self._browsing.client.send_file_download(name, data, save_immediately=True)

    def _tell(self, title: str, body: str) -> None:
        self._browsing.client.add_notification(title, body, auto_close_seconds=8.0)

    def _drop(self, *names: str) -> None:
        for name in names:
            handle = self._marks.pop(name, None)
            if handle is not None:
                handle.remove()
