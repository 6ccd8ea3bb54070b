"""Sessions of the viewer: the view of one browser, the size of its next image, and the thread that
renders for all browsers. Independent of viser."""

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
from dyngs.export.camera_paths import Keyframes, interpolate_keyframes, resize_cameras, world_pose
from dyngs.runs.opened import Opened
from dyngs.view.layers import Layer, Part, Shot, draw
from dyngs.view.views import camera_at, nearest_view, views_of

_LOG = logging.getLogger(__name__)
STILL_AFTER = 0.2
"""Seconds without change after which the image is refined."""
_SHORTEST = 1 / 30
"""Seconds between two images at least."""
_SMALLEST_AREA = 320 * 240
"""Pixels of an image at least: where Gaussians take all the time, a smaller one would hardly come
sooner."""


class Pace:
    """Number of pixels that can be drawn within ``target`` seconds, by how long the last images
    took.

    Refined images may take ``longest`` seconds. ``area``: pixels of an image while something moves.
    ``largest``: most pixels of a refined image.
    """

    def __init__(self, target: float = 1 / 14, longest: float = math.inf) -> None:
        self._target, self._longest = target, longest
        self.area = float(_SMALLEST_AREA)
        self.largest = math.inf

    def observe(self, pixels: float, seconds: float) -> None:
        """Note how long an image took while something moves."""
        seconds = max(seconds, 1e-9)
        factor = min(max(self._target / seconds, 0.5), 2.0)
        self.area = max(pixels * math.sqrt(factor), _SMALLEST_AREA)
        self.largest = max(pixels * self._longest / seconds, self.area)


@dataclass(frozen=True)
class Eye:
    """The camera of a browser: wxyz and position as in ``camera_at``, vertical field of view in
    rad, window in px."""

    wxyz: tuple[float, ...]
    position: tuple[float, ...]
    fov: float
    size: tuple[int, int]

    @property
    def is_possible(self) -> bool:
        """Whether there is such a camera: browsers may send anything."""
        numbers = (*self.wxyz, *self.position, self.fov)
        has_direction = all(map(math.isfinite, numbers)) and math.hypot(*self.wxyz) > 1e-6
        return has_direction and self.fov > 0 and min(self.size) > 0

    def camera(self, size: tuple[int, int] | None = None) -> Cameras:
        """Return the camera for images of ``size``; None: that of the window."""
        return camera_at(self.wxyz, self.position, self.fov, size or self.size)


@dataclass(frozen=True)
class Timeline:
    """The time that is shown: ``time`` in [0, 1] when the clock read ``since``.

    Where it is ``playing``, it takes ``seconds`` / ``speed`` from 0 to 1, where it begins again or
    stops.
    """

    time: float = 0.0
    since: float = 0.0
    playing: bool = False
    loops: bool = True
    speed: float = 1.0
    seconds: float = 4.0

    def at(self, clock: float) -> float:
        """Return the time in [0, 1] when the clock reads ``clock``."""
        if not self.playing:
            return self.time
        passed = self.time + max(clock - self.since, 0.0) * self.speed / max(self.seconds, 1e-6)
        return passed % 1.0 if self.loops and passed > 1 else min(passed, 1.0)

    def changed(self, clock: float, **changes: bool | float) -> Timeline:
        """Return the timeline with other attributes; the time does not jump, but who plays from the
        end begins at 0."""
        now = self.at(clock)
        now = 0.0 if changes.get("playing") and now >= 1.0 else now
        return replace(self, time=now, since=clock, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Display:
    """What is shown.

    Attributes:
        layer, part, divide: as in ``Shot``.
        comparing: show the truth next to the render.
        view: index of the view that is compared with; None: the nearest.
        longest: most pixels of the longer side of an image.
    """

    layer: Layer = "colour"
    part: Part = "all"
    comparing: bool = False
    view: int | None = None
    divide: float = 0.5
    longest: int = 1600


@dataclass(frozen=True)
class Keyframe:
    """One camera, the time of the scene it shows, and the seconds until the next one."""

    camera: Cameras
    time: float | None
    seconds: float = 1.0


@dataclass(frozen=True)
class Recording:
    """Keyframes of a camera path in their order; ``loops``: the camera returns to the first one at
    the end."""

    keyframes: tuple[Keyframe, ...] = ()
    loops: bool = False

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def duration(self) -> float:
        """Seconds of the path; those after the last keyframe count only in a loop."""
        return sum(key.seconds for key in self.keyframes[: None if self.loops else -1])

    def keys(self) -> Keyframes:
        """Return at least one keyframe as the interpolation takes them."""
        cameras = [key.camera for key in self.keyframes]
        poses, matrices = (
            torch.cat(x).double().cpu().numpy()
            for x in zip(*((c.cam_from_world, c.intrinsics) for c in cameras), strict=True)
        )
        starts = np.cumsum([0.0, *(key.seconds for key in self.keyframes[:-1])])
        times = [key.time for key in self.keyframes if key.time is not None]
        has_times = len(times) == len(self)
        period = self.duration if self.loops and len(self) > 1 else None
        return Keyframes(poses, matrices, starts, np.array(times) if has_times else None, period)

    def document(self, size: tuple[int, int], fps: float, opened: Opened) -> str:
        """Return the path as JSON that ``dyngs render --path`` reads (docs/camera_paths.md), in the
        coordinates of the capture; focal lengths follow the height, px."""
        width, height = size
        keys: list[dict[str, Any]] = []
        for key, start in zip(self.keyframes, self.keys().seconds.tolist(), strict=True):
            camera = opened.frame.cameras(key.camera)
            pose = camera.cam_from_world[0].double().cpu().numpy()
            focal = float(camera.intrinsics[0, 1, 1]) * height / camera.height
            entry: dict[str, Any] = {"at": start, "fl_x": focal}
            entry["cam_from_world"] = world_pose(pose, opened.world_offset).tolist()
            keys.append(entry if key.time is None else entry | {"time": key.time})
        document = {"width": width, "height": height, "fps": fps, "loop": self.loops}
        if self.loops:
            document["seconds"] = self.duration
        return json.dumps({**document, "keyframes": keys}, indent=1) + "\n"

    def at(self, seconds: float) -> tuple[Cameras, float | None]:
        """Return the camera and the time of the scene after ``seconds`` of the path, of at least
        one keyframe."""
        first = self.keyframes[0].camera
        made = interpolate_keyframes(self.keys(), np.array([seconds]))
        pose, matrix = (
            first.cam_from_world.new_tensor(x) for x in (made.cam_from_world, made.intrinsics)
        )
        camera = replace(first, cam_from_world=pose, intrinsics=matrix)
        return camera, None if made.times is None else float(made.times[0])


@dataclass(frozen=True)
class Sent:
    """An image for the browser: (H, W, 3) uint8, whether it is a refined one, and the seconds that
    it took."""

    image: np.ndarray
    is_refined: bool
    seconds: float


class Session:
    """One browser's view of a scene.

    Several threads tell it what has changed; one thread calls ``draw_next``, and gets the newest
    state, for ``send``. Images are as large as ``pace`` says: by default fourteen a second while
    something moves, full when all is still.
    """

    def __init__(
        self,
        opened: Opened,
        send: Callable[[Sent], None],
        pace: Pace | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._lock = threading.RLock()
        self._send, self._clock = send, clock
        self._pace = pace or Pace()
        self._jobs: deque[tuple[str | None, Callable[[], None]]] = deque()
        self._changed_at = self._drawn_at = -1e9
        self._is_stale = True
        self._refined_area = 0.0  # pixels of the image that is shown, if it is of what is there now
        self._preview: tuple[Recording, float] | None = None
        self.on_change: Callable[[], None] = lambda: None
        self.on_play: Callable[[bool], None] = lambda playing: None
        self.opened, self.look = opened, Display()
        self.eye: Eye | None = None
        self.timeline = Timeline(seconds=opened.seconds)
        self.closed = False
        self.failure: str | None = None

    def move(self, eye: Eye) -> bool:
        """Look from ``eye`` from now on; return False, and go on as before, where there is no such
        camera."""
        if not eye.is_possible:
            return False
        if eye != self.eye:
            self.eye = eye
            self._note_change()
        return True

    def change(self, **changes: Any) -> None:
        """Show something else: attributes of ``Display``."""
        with self._lock:
            self.look = replace(self.look, **changes)
        self._note_change()

    def set_time(self, time: float) -> None:
        now = min(max(time, 0.0), 1.0)
        with self._lock:
            self.timeline = replace(self.timeline, time=now, since=self._clock())
        self._note_change()

    def change_timeline(self, **changes: bool | float) -> None:
        """Play, pause, loop or change the speed: attributes of ``Timeline``."""
        with self._lock:
            self.timeline = self.timeline.changed(self._clock(), **changes)
        self.on_play(self.timeline.playing)
        self._note_change()

    def show(self, opened: Opened) -> None:
        """Look at another scene, at the same time."""
        with self._lock:
            if self.look.view is not None and self.look.view >= len(views_of(opened)):
                self.look = replace(self.look, view=None)
            self.opened = opened
            self.timeline = self.timeline.changed(self._clock(), seconds=opened.seconds)
        self._note_change()

    def preview(self, recording: Recording) -> None:
        self._preview = (recording, self._clock()) if len(recording) else None
        self._note_change()

    def take(self, opened: Opened, *, refreshes: bool) -> None:
        """Look at a newer state of the scene; ``refreshes``: draw it, as large, even if nothing
        else has changed."""
        with self._lock:
            self.opened = opened
            self._is_stale = self._is_stale or refreshes

    def ask(self, job: Callable[[], None], kind: str | None = None) -> None:
        """Have ``job`` run by the thread that draws, before the next image, instead of waiting ones
        of its kind."""
        with self._lock:
            if kind is not None:
                self._jobs = deque(entry for entry in self._jobs if entry[0] != kind)
            self._jobs.append((kind, job))
        self.on_change()

    def close(self) -> None:
        """The browser is gone: nothing is drawn any more."""
        with self._lock:
            self.closed = True
            self._jobs.clear()

    @property
    def time(self) -> float:
        """The time that is shown, in [0, 1]."""
        return self.timeline.at(self._clock())

    @property
    def shown_view(self) -> int | None:
        """Index of the view whose truth is shown; None without any."""
        with self._lock:
            look = self.look
            eye = self.eye
            opened = self.opened
        has_truth = look.comparing or look.layer == "error"
        if eye is None or not has_truth or not len(views_of(opened)):
            return None
        return nearest_view(opened, eye.camera(), self.time) if look.view is None else look.view

    def due(self) -> float | None:
        """Return in how many seconds something is to be drawn; 0: now, None: not before something
        changes."""
        with self._lock:
            if self.closed or self.eye is None:
                return None
            if self._jobs:
                return 0.0
            now = self._clock()
            soonest = max(0.0, self._drawn_at + _SHORTEST - now)
            if self._is_moving or self._is_stale:
                return soonest
            if self._refined_area < 0.99 * self._most_pixels:
                return max(soonest, self._changed_at + STILL_AFTER - now)
            return None

    def draw_next(self) -> None:
        """Do what is due: a job, or the next image."""
        with self._lock:
            job = self._jobs.popleft()[1] if self._jobs and not self.closed else None
        if job is not None:
            job()
            return
        with self._lock:
            if self.closed or self.eye is None:
                return
            start = self._clock()
            is_moving = self._is_moving or start < self._changed_at + STILL_AFTER
            area = self._pace.area
            if not is_moving:  # in steps, so that a browser that moves again need not wait long
                area = max(area, 6.0 * self._refined_area)
            area = min(area, self._most_pixels)
            width, height = self._full_size
            scale = min(1.0, math.sqrt(area / (width * height)))
            size = max(16, round(width * scale)), max(16, round(height * scale))
            opened = self.opened
            version = self._changed_at
            self._is_stale = False
            self._refined_area = math.inf  # if it fails, it is not tried again
            self._drawn_at = start
            shot = replace(self.shot(size), is_moving=is_moving)
        image = draw(opened, shot)
        if not self.closed:
            self._send(Sent(image, not is_moving, self._clock() - start))
        now = self._clock()
        with self._lock:
            if is_moving:
                self._pace.observe(size[0] * size[1], now - start)
            is_current = version == self._changed_at
            # Also a full image is drawn once more when all is still: in better quality.
            self._refined_area = area * (0.9 if is_moving else 1.0) if is_current else 0.0
            timeline = self.timeline
            preview = self._preview
        if timeline.playing and not timeline.loops and timeline.at(now) >= 1.0:
            self.change_timeline(playing=False)
        if preview is not None and now - preview[1] > preview[0].duration:
            self.preview(Recording())

    def shot(self, size: tuple[int, int] | None = None) -> Shot:
        """Return what is shown now as an image of ``size``; None: that of the window."""
        with self._lock:
            if self.eye is None:
                raise ValueError("there is no camera yet")
            size = size or self._full_size
            time = self.time
            if self._preview is None:
                camera = self.eye.camera(size)
                view = self.shown_view
            else:
                recording, since = self._preview
                camera, recorded = recording.at(self._clock() - since)
                camera = resize_cameras(camera, *size)
                view = None
                time = time if recorded is None else recorded
            look = self.look
            shown = None if self.opened.renderable.is_static else time
        layer = "colour" if look.layer == "error" and view is None else look.layer
        return Shot(camera, shown, layer, look.part, view, look.divide if look.comparing else 1.0)

    @property
    def _is_moving(self) -> bool:
        is_playing = self.timeline.playing and not self.opened.renderable.is_static
        return is_playing or self._preview is not None

    @property
    def _full_size(self) -> tuple[int, int]:
        width, height = (640, 480) if self.eye is None else self.eye.size
        scale = min(1.0, self.look.longest / max(width, height))
        return max(16, round(width * scale)), max(16, round(height * scale))

    @property
    def _most_pixels(self) -> float:
        """Pixels of the image that is shown when all is still."""
        return min(math.prod(self._full_size), self._pace.largest)

    def _note_change(self) -> None:
        with self._lock:
            self._changed_at = self._clock()
            self._is_stale = True
            self._refined_area = 0.0
        self.on_change()


class Drawer:
    """The one thread that draws for all browsers: whoever waits longest is next, and gets the
    newest state.

    ``on_error`` is told what went wrong for one session, the others go on.
    """

    def __init__(self, on_error: Callable[[Session, str], None]) -> None:
        self._on_error = on_error
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
        session.close()
        with self._changed:
            if session in self._sessions:
                self._sessions.remove(session)

    def draw_one(self) -> bool:
        """Do what is due for one session; return whether anything was."""
        session, wait = self._next()
        if session is None or wait > 0:
            return False
        with self._changed:
            if session in self._sessions:  # served: last in the row
                self._sessions.remove(session)
                self._sessions.append(session)
        try:
            session.draw_next()
        except Exception as error:  # a fault of one session must not end the images of all
            self._fail(session, error)
        else:
            session.failure = None
        return True

    def start(self) -> None:
        """Draw in a thread of its own."""
        self._thread = threading.Thread(
            target=copy_context().run, args=(self._run,), name="dyngs-view", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """End the thread, after the image that it is at."""
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
        """Return the session that is due first, among equals that served longest ago, and when:
        within 0.5 s."""
        best: tuple[Session | None, float] = (None, 0.5)
        for session in self.sessions:
            wait = session.due()
            if wait is not None and wait < best[1]:
                best = (session, wait)
        return best

    def _fail(self, session: Session, error: Exception) -> None:
        """Say what went wrong, once in a row: what is played fails many times a second."""
        is_known = isinstance(error, DyngsError)
        message = str(error) if is_known else f"{type(error).__name__}: {error}"
        if session.closed or session.failure == message:
            return
        session.failure = message
        self._on_error(session, message)
        if not is_known:
            _LOG.error("the viewer failed to draw", exc_info=error)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()
