"""Viewer sessions: state of one browser, resolution control, and rendering for all browsers.

Independent of viser.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextvars import copy_context
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.geometry import validate_pose
from dyngs.export.camera_paths import Keyframes, interpolate_keyframes, resize_cameras
from dyngs.runs.opened import OpenedScene
from dyngs.view.layers import Layer, Part, ViewRequest, draw
from dyngs.view.views import camera_at, nearest_view, views_of

_LOG = logging.getLogger(__name__)
REFINE_DELAY = 0.2  # Seconds without changes after which the image is rendered in full resolution
_SMALLEST_AREA = 320 * 240  # Smallest image in pixels; below, the cost of Gaussians dominates
_LONGEST_SIDE = 1600  # Longest side of an image in px


@dataclass(frozen=True)
class BrowserCamera:
    """Camera of a browser: pose as in ``camera_at``, vertical field of view in rad, window size in
    px."""

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    size: tuple[int, int]

    def camera(self, size: tuple[int, int] | None = None) -> Cameras:
        """Return the camera for images of ``size``, or of the window for None."""
        return camera_at(self.wxyz, self.position, self.fov, size or self.size)


@dataclass(frozen=True)
class Timeline:
    """Scene time in [0, 1] as a function of the clock.

    Playing takes ``seconds`` / ``speed`` from 0 to 1, then restarts or stops. ``time`` is the scene
    time at clock ``since``.
    """

    time: float = 0.0
    since: float = 0.0
    playing: bool = False
    loops: bool = True
    speed: float = 1.0
    seconds: float = 4.0

    def at(self, clock: float) -> float:
        """Return the scene time in [0, 1] at ``clock``."""
        if not self.playing:
            return self.time
        passed = max(clock - self.since, 0.0) * self.speed / max(self.seconds, 1e-6)
        if not self.loops:
            return min(self.time + passed, 1.0)
        return (self.time + passed) % 1.0 if passed else self.time

    def changed(self, clock: float, **changes: bool | float) -> Timeline:
        """Return the timeline with changed attributes at the current time. Playing restarts from
        the end."""
        now = self.at(clock)
        if changes.get("playing") and now == 1.0:
            now = 0.0
        return replace(self, **{"time": now, "since": clock, **changes})  # type: ignore[arg-type]


@dataclass(frozen=True)
class Display:
    """Display settings.

    Attributes:
        layer, part, divide, background: as in ``ViewRequest``.
        comparing: show the true image beside the rendering.
        view: index of the compared view. None uses the nearest one.
    """

    layer: Layer = "colour"
    part: Part = "all"
    comparing: bool = False
    view: int | None = None
    divide: float = 0.5
    background: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class Keyframe:
    """A camera, its scene time, and the seconds until the next keyframe."""

    camera: Cameras
    time: float | None
    seconds: float = 1.0


@dataclass(frozen=True)
class Recording:
    """Keyframes of a camera path. With ``loops``, the camera returns to the first one."""

    keyframes: tuple[Keyframe, ...] = ()
    loops: bool = False

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def duration(self) -> float:
        """Seconds of the path. Those after the last keyframe count only in a loop."""
        return sum(key.seconds for key in self.keyframes[: None if self.loops else -1])

    def at(self, seconds: float, size: tuple[int, int]) -> tuple[Cameras, float]:
        """Return the camera for images of ``size`` px, and the scene time, after ``seconds`` of the
        path."""
        cameras = [resize_cameras(key.camera, *size) for key in self.keyframes]
        poses = np.concatenate([camera.cam_from_world.numpy() for camera in cameras])
        matrices = np.concatenate([camera.intrinsics.numpy() for camera in cameras])
        starts = np.cumsum([0.0, *(key.seconds for key in self.keyframes[:-1])])
        times = np.array([key.time or 0.0 for key in self.keyframes])
        keys = Keyframes(poses, matrices, starts, times, self.duration if self.loops else None)
        frame = interpolate_keyframes(keys, np.array([seconds]))
        pose, matrix = (
            torch.from_numpy(x).float() for x in (frame.cam_from_world, frame.intrinsics)
        )
        time = 0.0 if frame.times is None else float(frame.times[0])
        return Cameras(pose, matrix, *size), time

    def document(self, size: tuple[int, int], fps: float, opened: OpenedScene) -> str:
        """Return the path as JSON for ``dyngs render --path``, in capture coordinates.

        Args:
            size: image size in px.
        """
        keys: list[dict[str, Any]] = []
        start = 0.0
        for key in self.keyframes:
            camera = opened.frame.cameras(resize_cameras(key.camera, *size))
            # Orthonormalise before shifting, as readers do, so that far cameras do not move.
            pose, _ = validate_pose(camera.cam_from_world[0].double().cpu().numpy(), "camera")
            pose[:3, 3] -= pose[:3, :3] @ opened.world_offset
            entry: dict[str, Any] = {"at": start, "fl_x": float(camera.intrinsics[0, 1, 1])}
            entry["cam_from_world"] = pose.tolist()
            keys.append(entry if key.time is None else entry | {"time": key.time})
            start += key.seconds
        document = {"width": size[0], "height": size[1], "fps": fps, "loop": self.loops}
        if self.loops:
            document["seconds"] = self.duration
        return json.dumps({**document, "keyframes": keys}, indent=1) + "\n"


@dataclass(frozen=True)
class SentImage:
    """An image (H, W, 3) uint8 for the browser, whether it has full resolution, and its render
    seconds."""

    image: np.ndarray
    is_refined: bool
    seconds: float


class Session:
    """State of one browser.

    Several threads change it, and one thread calls ``draw_next``, which passes images to ``send``.
    While the view moves, the resolution is adapted so that an image takes ``target`` seconds.
    Otherwise it is full.
    """

    def __init__(
        self,
        opened: OpenedScene,
        send: Callable[[SentImage], None],
        target: float = 1 / 14,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lock = threading.Lock()
        self._send, self._target, self._clock = send, target, clock
        self._jobs: deque[Callable[[], None]] = deque()
        self._changed_at = self._drawn_at = -1e9
        self._is_stale = True
        self._area = float(_SMALLEST_AREA)  # pixels of an image while something moves
        self._is_refined = False  # the shown image is current and has full resolution
        self._preview: tuple[Recording, float] | None = None  # a path and its start time
        self.on_change: Callable[[], None] = lambda: None
        self.on_play: Callable[[bool], None] = lambda playing: None
        self.on_error: Callable[[str], None] = lambda message: None
        self.opened, self.display = opened, Display()
        self.browser_camera: BrowserCamera | None = None
        self.timeline = Timeline(seconds=opened.seconds)
        self.closed = False
        self.failure: str | None = None

    def move(self, browser_camera: BrowserCamera) -> None:
        """Set the browser camera."""
        if browser_camera != self.browser_camera:
            self.browser_camera = browser_camera
            self._note_change()

    def change(self, **changes: Any) -> None:
        """Change attributes of ``Display``."""
        with self._lock:
            self.display = replace(self.display, **changes)
        self._note_change()

    def set_time(self, time: float) -> None:
        self.change_timeline(time=min(max(time, 0.0), 1.0))

    def change_timeline(self, **changes: bool | float) -> None:
        """Change attributes of ``Timeline``, such as playing or speed."""
        with self._lock:
            self.timeline = self.timeline.changed(self._clock(), **changes)
        self.on_play(self.timeline.playing)
        self._note_change()

    def show(self, opened: OpenedScene) -> None:
        """Show another scene at the same time."""
        self.opened = opened
        self.change_timeline(seconds=opened.seconds)

    def preview(self, recording: Recording) -> None:
        """Play a recorded camera path once."""
        self._preview = recording, self._clock()
        self._note_change()

    def update_scene(self, opened: OpenedScene, *, refreshes: bool) -> None:
        """Replace the scene by a newer state. ``refreshes`` requests a new image."""
        self.opened = opened
        self._is_stale |= refreshes

    def submit_job(self, job: Callable[[], None]) -> None:
        """Run ``job`` in the render thread before the next image."""
        self._jobs.append(job)
        self.on_change()

    @property
    def time(self) -> float:
        """Current scene time in [0, 1]."""
        return self.timeline.at(self._clock())

    @property
    def shown_view(self) -> int | None:
        """Index of the view whose true image is shown, or None."""
        display = self.display
        browser_camera = self.browser_camera
        opened = self.opened
        has_truth = display.comparing or display.layer == "error"
        if browser_camera is None or not has_truth or not len(views_of(opened)):
            return None
        return (
            nearest_view(opened, browser_camera.camera(), self.time)
            if display.view is None
            else display.view
        )

    def due(self) -> float | None:
        """Return the seconds until the next job or image, or None if nothing is pending."""
        if self.closed or self.browser_camera is None:
            return None
        if self._jobs:
            return 0.0
        now = self._clock()
        soonest = max(0.0, self._drawn_at + 1 / 30 - now)
        if self._is_moving or self._is_stale:
            return soonest
        if not self._is_refined:
            return max(soonest, self._changed_at + REFINE_DELAY - now)
        return None

    def draw_next(self) -> None:
        """Run the next job, or render the next image."""
        if self.closed or self.browser_camera is None:
            return
        if self._jobs:
            self._jobs.popleft()()
            return
        start = self._drawn_at = self._clock()
        if self._preview is not None and start > self._preview[1] + self._preview[0].duration:
            self._preview = None
        if self.timeline.playing and not self.timeline.loops and self.time == 1.0:
            self.change_timeline(playing=False)
        version = self._changed_at
        is_moving = self._is_moving or start < version + REFINE_DELAY
        full = self._full_size
        size = _scaled(full, math.sqrt(self._area / math.prod(full))) if is_moving else full
        self._is_stale = False
        self._is_refined = True  # do not retry if rendering fails
        image = draw(self.opened, replace(self.view_request(size), is_moving=is_moving))
        if not self.closed:
            self._send(SentImage(image, not is_moving, self._clock() - start))
        now = self._clock()
        if is_moving:
            factor = min(max(self._target / max(now - start, 1e-9), 0.5), 2.0)
            self._area = max(math.prod(size) * math.sqrt(factor), _SMALLEST_AREA)
        self._is_refined = not is_moving and version == self._changed_at

    def view_request(self, size: tuple[int, int] | None = None) -> ViewRequest:
        """Return the request for an image of ``size``, or of the window size for None."""
        if self.browser_camera is None:
            raise ValueError("no camera received from the browser")
        display = self.display
        size = size or self._full_size
        camera = self.browser_camera.camera(size)
        view = self.shown_view
        time = self.time
        if self._preview is not None:
            recording, start = self._preview
            camera, time = recording.at(self._clock() - start, size)
            view = None
        layer = "colour" if display.layer == "error" and view is None else display.layer
        shown = None if self.opened.renderable.is_static else time
        divide = display.divide if display.comparing else 1.0
        return ViewRequest(camera, shown, layer, display.part, view, divide, display.background)

    @property
    def _is_moving(self) -> bool:
        is_playing = self.timeline.playing and not self.opened.renderable.is_static
        return is_playing or self._preview is not None

    @property
    def _full_size(self) -> tuple[int, int]:
        size = (640, 480) if self.browser_camera is None else self.browser_camera.size
        return _scaled(size, _LONGEST_SIDE / max(size))

    def _note_change(self) -> None:
        self._changed_at = self._clock()
        self._is_stale = True
        self._is_refined = False
        self.on_change()


def _scaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """Return ``size`` in px reduced by ``factor``, at least 16 x 16."""
    width, height = (max(16, round(side * min(factor, 1.0))) for side in size)
    return width, height


class RenderScheduler:
    """Renders for all browsers, the longest waiting session first, with its newest state.

    Errors of a session are reported to its ``on_error`` and do not affect others.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._sessions: list[Session] = []
        self._thread: threading.Thread | None = None
        self._is_stopped = False

    @property
    def sessions(self) -> tuple[Session, ...]:
        with self._changed:
            return tuple(self._sessions)

    def add(self, session: Session) -> None:
        session.on_change = self._wake
        with self._changed:
            self._sessions.append(session)
        self._wake()

    def remove(self, session: Session) -> None:
        session.closed = True
        with self._changed:
            if session in self._sessions:
                self._sessions.remove(session)

    def draw_one(self) -> bool:
        """Run one pending job or image. Return whether there was one."""
        session, wait = self._next()
        if session is None or wait > 0:
            return False
        with self._changed:
            if session in self._sessions:  # move to the end of the queue
                self._sessions.remove(session)
                self._sessions.append(session)
        try:
            session.draw_next()
            session.failure = None
        except Exception as error:  # keep rendering for other sessions
            is_known = isinstance(error, DyngsError)
            message = str(error) if is_known else f"{type(error).__name__}: {error}"
            # Report repeated failures of an animation once.
            if not session.closed and session.failure != message:
                session.failure = message
                session.on_error(message)
                if not is_known:
                    _LOG.error("the viewer failed to draw", exc_info=error)
        return True

    def start(self) -> None:
        """Start a render thread."""
        self._thread = threading.Thread(
            target=copy_context().run, args=(self._run,), name="dyngs-view", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread after the current image."""
        self._is_stopped = True
        self._wake()
        if self._thread is not None:
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while not self._is_stopped:
            if not self.draw_one():
                _, wait = self._next()
                with self._changed:
                    if not self._is_stopped:
                        self._changed.wait(wait)

    def _next(self) -> tuple[Session | None, float]:
        """Return the session with the earliest due time, and the seconds until then, at most
        0.5."""
        best: tuple[Session | None, float] = (None, 0.5)
        for session in self.sessions:
            wait = session.due()
            if wait is not None and wait < best[1]:
                best = (session, wait)
        return best

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()
