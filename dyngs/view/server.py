"""Web server of the viewer, with access control: localhost only, or holders of a token."""

from __future__ import annotations

import hmac
import http
import ipaddress
import re
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from dyngs.core.errors import DyngsError, format_one_line
from dyngs.runs.opened import OpenedScene
from dyngs.view.session import BrowserCamera, RenderScheduler, SentImage, Session
from dyngs.view.source import SceneSource
from dyngs.view.views import fitting_fov, initial_viewpoint, orbit_center, pose_of, views_of

if TYPE_CHECKING:
    import viser


COOKIE = "dyngs_view"


@dataclass(frozen=True)
class AccessPolicy:
    """Decides whether HTTP and websocket requests are allowed, by path and headers.

    Attributes:
        token: must be in the link or in the cookie set by the link. None allows only requests
            addressed to this machine, so that pages of other sites cannot reach the viewer.
    """

    token: str | None = None

    def refusal(self, path: str, headers: Mapping[str, str]) -> str | None:
        """Return why a request is refused, or None."""
        host = headers.get("Host", "")
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return "request from a page of another site"
        try:
            name = urlsplit(f"//{host}").hostname or ""
            cookie = SimpleCookie(headers.get("Cookie", "")).get(COOKIE)
        except (ValueError, CookieError):
            return "invalid headers"
        if self.token is None:
            return None if is_loopback(name) else "only requests to localhost are allowed"
        given = parse_qs(urlsplit(path).query).get("token", [])
        if cookie is not None:
            given.append(cookie.value)
        if any(hmac.compare_digest(word.encode(), self.token.encode()) for word in given):
            return None
        return "missing or wrong token; open the link printed by `dyngs view`"

    def cookie(self, path: str) -> str | None:
        """Return the ``Set-Cookie`` header for a request with a valid token in the link, else
        None."""
        if self.token is None or "token" not in parse_qs(urlsplit(path).query):
            return None
        return f"{COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"


def access_policy_for(host: str) -> AccessPolicy:
    """Return the access policy of a server on ``host``, with a new token unless it is a loopback
    address."""
    return AccessPolicy() if is_loopback(host) else AccessPolicy(secrets.token_urlsafe(24))


def is_loopback(host: str) -> bool:
    """Return whether ``host`` can be reached from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def link_to(host: str, port: int, token: str | None = None) -> str:
    """Return the URL of a server that listens on ``host`` and ``port``."""
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname() or "localhost"
    elif host == "127.0.0.1":
        host = "localhost"
    name = f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def free_port(host: str, port: int | None) -> int:
    """Return ``port``, or the first free port from 8080 on if it is None.

    Raises:
        DyngsError: the port is not available.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    problem = None
    for candidate in range(8080, 8130) if port is None else [port]:
        try:
            socket.create_server((host, candidate), family=family).close()
            return candidate
        except OSError as error:
            problem = error
    raise DyngsError(
        f"--host {host} --port {port or '8080 to 8129'}: cannot listen ({problem}); use another "
        "port, or "
        "omit --port to find a free one"
    )


@contextmanager
def enforce_access(policy: AccessPolicy) -> Iterator[None]:
    """Apply ``policy`` to all pages and websockets of servers that viser starts in this context.

    viser has no option for this; its server is started by ``websockets.asyncio.server.serve``.
    """
    from websockets.asyncio import server

    original = server.serve

    def serve(*args: Any, process_request: Any, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            refusal = policy.refusal(request.path, request.headers)
            if refusal is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"dyngs view: {refusal}\n")
            response = process_request(connection, request)
            cookie = policy.cookie(request.path)
            if response is not None and cookie is not None:
                response.headers["Set-Cookie"] = cookie
            return response

        return original(*args, process_request=checked, **options)

    server.serve = serve  # type: ignore[assignment]
    try:
        yield
    finally:
        server.serve = original


_PUNCTUATION = re.compile(r"([!-/:-@\[-`{-~])")
# Positions at which links are recognised even if punctuation is escaped
_IN_LINKS = re.compile(r"(?=://|@)|(?<=www)(?=\.)", re.IGNORECASE)


@dataclass(frozen=True)
class ServerOptions:
    """Options of the viewer server.

    Attributes:
        port: None uses the first free port from 8080 on.
        motions: motion files for people, by name.
        target: seconds per image while the view moves.
        in_thread: render in a thread of the server. Otherwise the caller uses ``drawer.draw_one``.
    """

    host: str = "127.0.0.1"
    port: int | None = None
    motions: Mapping[str, Path] = field(default_factory=dict)
    target: float = 1 / 14
    in_thread: bool = True


class BrowserConnection:
    """A connected browser with its session; ``opened`` is shown first."""

    def __init__(self, client: viser.ClientHandle, opened: OpenedScene, target: float) -> None:
        self.client = client
        self.loaded = opened
        self.session = Session(opened, self.send, target)
        self.session.on_error = lambda message: self.notify("Error", message)
        self.status: viser.GuiMarkdownHandle | None = None
        self.time_slider: viser.GuiSliderHandle | None = None
        self.on_move: Callable[[], None] = lambda: None
        self.num_sent = 0
        self._shown_at = 0.0  # time of the last status, and number of images then
        self._shown_count = 0

    def send(self, sent: SentImage) -> None:
        """Send an image to the browser, and update status and time slider twice per second."""
        quality = 95 if sent.is_refined else 75
        self.client.scene.set_background_image(sent.image, format="jpeg", jpeg_quality=quality)
        self.num_sent += 1
        passed = max(time.monotonic() - self._shown_at, 1e-6)
        if passed >= 0.5 or sent.is_refined:
            height, width = sent.image.shape[:2]
            rate = (self.num_sent - self._shown_count) / passed
            shown = "full resolution" if sent.is_refined else f"{rate:.0f} fps"
            view = self.session.shown_view
            if view is not None:
                shown += f", truth: {escape_markdown(views_of(self.session.opened).names[view])}"
            if self.status is not None:
                text = f"{width} x {height} px, {1000 * sent.seconds:.0f} ms, {shown}"
                self.status.content = text
            if self.time_slider is not None and self.session.timeline.playing:
                self.time_slider.value = round(self.session.time, 3)
            self._shown_at += passed
            self._shown_count = self.num_sent
        self.client.flush()

    def camera_moved(self) -> None:
        """Update the session with the camera of the browser."""
        camera = self.client.camera
        wxyz, position = tuple(camera.wxyz.tolist()), tuple(camera.position.tolist())
        self.session.move(BrowserCamera(wxyz, position, float(camera.fov), _window(camera)))
        self.on_move()

    def go_to(self, index: int | None) -> None:
        """Move the browser camera to a view of the capture, or to the initial view for None."""
        opened = self.session.opened
        handle = self.client.camera
        begin = initial_viewpoint(opened)
        camera = begin.start if index is None else views_of(opened).cameras[index]
        wxyz, position = pose_of(camera)
        with self.client.atomic():
            width, height = _window(handle)
            handle.fov = fitting_fov(camera, width / height)
            handle.position = position
            handle.look_at = orbit_center(camera, begin)
            handle.wxyz = wxyz
        self.camera_moved()

    def notify(self, title: str, body: str) -> None:
        """Show a notification for some seconds."""
        self.client.add_notification(title, body, auto_close_seconds=12.0)


def _window(camera: viser.CameraHandle) -> tuple[int, int]:
    """Return width and height of a browser window in px, at least 16."""
    return max(16, int(camera.image_width)), max(16, int(camera.image_height))


def escape_markdown(text: str) -> str:
    """Return Markdown that shows ``text`` literally, without HTML, links, images or emphasis.

    viser would execute scripts in HTML.
    """
    return _PUNCTUATION.sub(r"\\\1", _IN_LINKS.sub("\u200b", format_one_line(text)))


class Viewer:
    """Web page that shows scenes to any number of browsers, each with its own camera, time and
    settings.

    A context manager that serves the page. New browsers see the scene ``first``.

    Raises:
        DyngsError: viser is not installed, or the port is not available.
    """

    def __init__(
        self, source: SceneSource, first: OpenedScene, serving: ServerOptions = ServerOptions()
    ) -> None:
        require_viser()
        import viser

        self.source, self.first, self.serving = source, first, serving
        self.drawer = RenderScheduler()
        self._connections: dict[int, BrowserConnection] = {}
        policy = access_policy_for(serving.host)
        port = free_port(serving.host, serving.port)
        with enforce_access(policy), silence_viser():
            self.server = viser.ViserServer(host=serving.host, port=port, verbose=False)
        self.link = link_to(serving.host, self.server.get_port(), policy.token)
        self._prepare()

    @property
    def connections(self) -> tuple[BrowserConnection, ...]:
        """All connected browsers."""
        return tuple(self._connections.values())

    def __enter__(self) -> Viewer:
        if self.serving.in_thread:
            self.drawer.start()
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving the page."""
        for connection in self.connections:
            self.drawer.remove(connection.session)
        self.drawer.stop()
        with silence_viser():
            self.server.stop()

    def show(self, opened: OpenedScene) -> None:
        """Show a newer state of the scene in all browsers, also in those that connect later."""
        self.first = opened
        for session in self.drawer.sessions:
            session.update_scene(opened, refreshes=True)

    def _prepare(self) -> None:
        """Set the theme, the initial camera and the up direction of all browsers."""
        from viser import _messages

        server = self.server
        for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            # Sharing would route the page through an external host.
            server._websock_server.unregister_handler(kind)
        server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        server.gui.main_panel.dock_right()  # beside the image
        begin = initial_viewpoint(self.first)
        start = begin.start
        server.scene.set_up_direction(tuple(begin.up))
        camera = server.initial_camera
        _, camera.position = pose_of(start)
        camera.look_at = orbit_center(start, begin)
        camera.up = begin.up
        camera.fov = fitting_fov(start, start.width / start.height)
        camera.near = 1e-3 * begin.extent
        camera.far = 1e3 * begin.extent

    def _connected(self, client: viser.ClientHandle) -> None:
        from dyngs.view.controls import Controls

        connection = BrowserConnection(client, self.first, self.serving.target)
        self._connections[client.client_id] = connection
        Controls(connection, self.source, self.serving.motions)

        async def moved(_: viser.CameraHandle) -> None:
            connection.camera_moved()

        client.camera.on_update(moved)
        self.drawer.add(connection.session)
        connection.go_to(None)
        if client.client_id not in self.server.get_clients():  # disconnected in the meantime
            self._disconnected(client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        connection = self._connections.pop(client.client_id, None)
        if connection is not None:
            self.drawer.remove(connection.session)


def require_viser() -> None:
    """Raise DyngsError if viser is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise DyngsError(
            f"the viewer needs viser ({error}); run pip install 'dyngs[view]'"
        ) from error


@contextmanager
def silence_viser() -> Iterator[None]:
    """Suppress the console output of viser."""
    import rich

    console = rich.get_console()
    before = console.quiet
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = before
