"""Sessions of the viewer without a browser."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from moving_scene import Sliding, camera, moving_scene

from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.opened import OpenedScene, wrap_scene
from dyngs.view.session import BrowserCamera, SentImage, Session
from dyngs.view.views import Viewpoint, pose_of


def opened_at(scene: GaussianScene, name: str = "balls") -> OpenedScene:
    """A scene on white, looked at from 4 away."""
    opened = replace(
        wrap_scene(replace(scene, background=torch.ones(3)), Path(name)), stated_up="-y"
    )
    opened.once("viewpoint", lambda: Viewpoint(camera(), np.zeros(3), 4.0, np.array([0.0, -1, 0])))
    return opened


def balls() -> OpenedScene:
    """Five balls of which two move."""
    return opened_at(moving_scene(Sliding()))


def looking_at_balls(size: tuple[int, int] = (200, 150)) -> tuple[Session, list[SentImage]]:
    """A session with a camera, and the list of what it sends."""
    sent: list[SentImage] = []
    session = Session(balls(), sent.append)
    wxyz, position = pose_of(camera())
    session.move(BrowserCamera(tuple(wxyz), tuple(position), 0.7, size))
    return session, sent


class Control:
    """A control of a page without a page: ``set`` is what a user does with it."""

    def __init__(self, value: Any) -> None:
        self.value = self.content = value
        self._called: list[Callable[[Any], None]] = []
        self.on_update = self.on_click = self._called.append

    def set(self, value: Any = None) -> None:
        self.value = value
        for called in self._called:
            called(SimpleNamespace(client_id=1))


class Page:
    """A browser without a browser: its controls by label, and the files that it got."""

    def __init__(self, session: Session) -> None:
        self.session, self.loaded = session, session.opened
        self.controls: dict[str, Control] = {}
        self.files: dict[str, bytes] = {}
        self.client = self.gui = self
        self.on_move: Callable[[], None] = lambda: None
        self.went_to: list[int | None] = []
        self.go_to = self.went_to.append

    def add_dropdown(
        self, label: str, options: Sequence[str], initial_value: Any = None, **_: Any
    ) -> Control:
        return self._added(label, initial_value or options[0])

    def add_checkbox(self, label: str, value: bool, **_: Any) -> Control:
        return self._added(label, value)

    def add_slider(
        self, label: str, low: float, high: float, step: float, value: float, **_: Any
    ) -> Control:
        return self._added(label, value)

    def add_vector3(self, label: str, value: tuple[float, ...], **_: Any) -> Control:
        return self._added(label, value)

    add_rgb = add_vector3

    def add_button(self, label: str, **_: Any) -> Control:
        return self._added(label, False)

    add_markdown = add_button

    def add_folder(self, label: str, **_: Any) -> Any:
        return nullcontext()

    def send_file_download(self, name: str, data: bytes, **_: Any) -> None:
        self.files[name] = data

    def set(self, label: str, value: Any = None) -> None:
        """Change a control, and let the session draw the images that are due."""
        self.controls[label].set(value)
        while self.session.due() == 0.0:
            self.session.draw_next()

    def _added(self, label: str, value: Any) -> Control:
        self.controls[label] = Control(value)
        return self.controls[label]
