"""The server of the viewer's page: viser shows the page, dyngs draws what is behind it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.core.errors import DyngsError
from dyngs.runs.opened import Opened
from dyngs.view.cameras import fitting_fov, look_point, pose_of
from dyngs.view.captured_views import viewpoint_of, views_of
from dyngs.view.gate import free_port, gate_for, guarded, link_to, port_taken
from dyngs.view.markdown import as_text
from dyngs.view.pace import Pace
from dyngs.view.render_thread import Drawer
from dyngs.view.session import Eye, Sent, Session
from dyngs.view.source import Source

if TYPE_CHECKING:
    import viser

MOVING_QUALITY, STILL_QUALITY = 75, 95
"""JPEG qualities."""
_STATUS_EVERY = 0.5
"""Seconds between two changes of the line about the images, and of the time slider while it
plays."""


@dataclass(frozen=True)
class Serving:
    """How the page is served.

    Attributes:
        port: None: 8080 or the next that is free.
        motions: motion files for people, by name.
        target, longest: seconds that an image may take while something moves, and at all.
        in_thread: images are drawn in a thread of the server; else by whoever calls
            ``drawer.draw_one``.
    """

    host: str = "127.0.0.1"
    port: int | None = None
    motions: Mapping[str, Path] = field(default_factory=dict)
    target: float = 1 / 14
    longest: float = math.inf
    in_thread: bool = True


class Browsing:
    """One browser: its connection, its session, and the images that went to it; ``opened`` is what
    it sees first."""

    def __init__(self, client: viser.ClientHandle, opened: Opened, pace: Pace) -> None:
        self.client = client
        self.loaded = opened
        self.session = Session(opened, self.send, pace)
        self.status: viser.GuiMarkdownHandle | None = None
        self.time_slider: viser.GuiSliderHandle | None = None
        self.on_move: Callable[[], None] = lambda: None
        self.num_sent = 0
        self._told_at, self._since_told = 0.0, 0
        self._has_refused = False

    def send(self, sent: Sent) -> None:
        """Pass an image to the browser."""
        quality = STILL_QUALITY if sent.is_refined else MOVING_QUALITY
        self.client.scene.set_background_image(sent.image, format="jpeg", jpeg_quality=quality)
        self.num_sent += 1
        self._since_told += 1
        now = time.monotonic()
        if now - self._told_at >= _STATUS_EVERY or sent.is_refined:
            self._tell(sent, now)
        self.client.flush()

    def camera_moved(self) -> None:
        """Take over the camera of the browser."""
        camera = self.client.camera
        size = _window(camera)
        eye = Eye(
            tuple(camera.wxyz.tolist()), tuple(camera.position.tolist()), float(camera.fov), size
        )
        if self.session.move(eye):
            self.on_move()
        elif not self._has_refused:
            self._has_refused = True
            notify(
                self.client,
                "Camera ignored",
                "The browser sent a camera that cannot exist; the last one stays.",
            )

    def go_to(self, index: int | None) -> None:
        """Move the browser's camera to a view of the capture; None: to where it began."""
        opened = self.session.opened
        handle = self.client.camera
        begin = viewpoint_of(opened)
        camera = begin.start if index is None else views_of(opened).cameras[index]
        wxyz, position = pose_of(camera)
        with self.client.atomic():
            width, height = _window(handle)
            handle.fov = fitting_fov(camera, width / height)
            handle.position = position
            handle.look_at = look_point(camera, begin.center, begin.extent)
            handle.wxyz = wxyz
        self.camera_moved()

    def _tell(self, sent: Sent, now: float) -> None:
        height, width = sent.image.shape[:2]
        rate = self._since_told / max(now - self._told_at, 1e-6)
        shown = "still" if sent.is_refined else f"{rate:.0f} images/s"
        view = self.session.shown_view
        truth = (
            "" if view is None else f", truth: {as_text(views_of(self.session.opened).names[view])}"
        )
        if self.status is not None:
            self.status.content = (
                f"{width} x {height} px, {1000 * sent.seconds:.0f} ms, {shown}{truth}"
            )
        if self.time_slider is not None and self.session.timeline.playing:
            self.time_slider.value = round(self.session.time, 3)
        self._told_at, self._since_told = now, 0


class Viewer:
    """A page that shows scenes to any number of browsers, each with its own camera, time and
    settings.

    A context manager: the page is there from ``__enter__`` on. A new browser sees the scene
    ``first``.

    Raises:
        DyngsError: viser is not installed, or the port cannot be had.
    """

    def __init__(self, source: Source, first: Opened, serving: Serving = Serving()) -> None:
        require_viser()
        self.source, self.first, self.serving = source, first, serving
        self.drawer = Drawer(self._tell_error)
        self._browsing: dict[int, Browsing] = {}
        self._lock = threading.Lock()
        gate = gate_for(serving.host)
        self._token = gate.token
        port = free_port(serving.host, serving.port)
        import viser

        with guarded(gate), quiet():
            self.server = viser.ViserServer(host=serving.host, port=port, verbose=False)
        if serving.port is not None and self.server.get_port() != serving.port:
            self.server.stop()
            raise port_taken(serving.port)
        self._prepare()

    @property
    def link(self) -> str:
        """Address of the page, with the token if there is one."""
        return link_to(self.serving.host, self.server.get_port(), self._token)

    @property
    def browsing(self) -> tuple[Browsing, ...]:
        """All browsers that are connected."""
        with self._lock:
            return tuple(self._browsing.values())

    def __enter__(self) -> Viewer:
        if self.serving.in_thread:
            self.drawer.start()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._gone)
        return self

    def __exit__(self, *_: object) -> None:
        """Close the page; browsers that show it say so."""
        for browsing in self.browsing:
            self.drawer.remove(browsing.session)
        self.drawer.stop()
        with quiet():
            self.server.stop()

    def _prepare(self) -> None:
        """Set what all browsers share: the theme, the first camera, the up direction."""
        from viser import _messages

        server = self.server
        first = self.first
        for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            # it would pass the page through a host of others
            server._websock_server.unregister_handler(kind)
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        server.gui.main_panel.dock_right()  # next to the image, not over it
        begin = viewpoint_of(first)
        _, position = pose_of(begin.start)
        server.scene.set_up_direction(tuple(begin.up))
        camera = server.initial_camera
        camera.position, camera.look_at = (
            position,
            look_point(begin.start, begin.center, begin.extent),
        )
        camera.up, camera.fov = (
            begin.up,
            fitting_fov(begin.start, begin.start.width / begin.start.height),
        )
        camera.near = 1e-3 * begin.extent
        camera.far = 1e3 * begin.extent

    def _connected(self, client: viser.ClientHandle) -> None:
        from dyngs.view.controls import Controls

        browsing = Browsing(client, self.first, Pace(self.serving.target, self.serving.longest))
        with self._lock:
            self._browsing[client.client_id] = browsing
        Controls(browsing, self.source, self.serving)

        async def moved(_: viser.CameraHandle) -> None:
            browsing.camera_moved()

        client.camera.on_update(moved)
        self.drawer.add(browsing.session)
        browsing.go_to(None)
        if client.client_id not in self.server.get_clients():  # it went while all this was made
            self._gone(client)

    def _gone(self, client: viser.ClientHandle) -> None:
        with self._lock:
            browsing = self._browsing.pop(client.client_id, None)
        if browsing is not None:
            self.drawer.remove(browsing.session)

    def _tell_error(self, session: Session, message: str) -> None:
        for browsing in self.browsing:
            if browsing.session is session:
                notify(browsing.client, "Error", message)


def _window(camera: viser.CameraHandle) -> tuple[int, int]:
    """Return width and height of the window of a browser, px: at least 16, also of one that has
    none yet."""
    return max(16, int(camera.image_width)), max(16, int(camera.image_height))


def notify(client: viser.ClientHandle, title: str, body: str) -> None:
    """Show a message in a browser for some seconds."""
    client.add_notification(title, body, auto_close_seconds=12.0)


def require_viser() -> None:
    """Raise DyngsError where viser is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise DyngsError(
            f"the viewer needs viser ({error}); install it with: pip install 'dyngs[view]'"
        ) from error


@contextmanager
def quiet() -> Iterator[None]:
    """Keep viser from printing its own lines."""
    import rich

    console = rich.get_console()
    before = console.quiet
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = before
