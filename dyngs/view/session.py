"""What one browser looks at, and which image it gets next. Knows neither viser nor threads of its
own."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dyngs.core.camera import Cameras
from dyngs.runs.opened import Opened
from dyngs.view.cameras import camera_at, in_window, nearest_camera
from dyngs.view.captured_views import viewpoint_of, views_of
from dyngs.view.layers import Layer, Part, Shot, draw
from dyngs.view.pace import STILL_AFTER, Pace, size_within
from dyngs.view.recording import Recording

_SHORTEST = 1 / 30
"""Seconds between two images at least."""


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
        return (
            all(map(math.isfinite, numbers))
            and math.hypot(*self.wxyz) > 1e-6
            and self.fov > 0
            and min(self.size) > 0
        )

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

    def is_over(self, clock: float) -> bool:
        """Return whether it plays without a loop and has reached the end."""
        return self.playing and not self.loops and self.at(clock) >= 1.0

    def changed(self, clock: float, **changes: bool | float) -> Timeline:
        """Return the timeline with other attributes; the time does not jump, but who plays from the
        end begins at 0."""
        now = replace(self, time=self.at(clock), since=clock)
        if changes.get("playing") and now.time >= 1.0:
            now = replace(now, time=0.0)
        return replace(now, **changes)  # type: ignore[arg-type]


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
        self._pace = pace or Pace(1 / 14)
        self._jobs: deque[tuple[str | None, Callable[[], None]]] = deque()
        self._changed_at = self._drawn_at = -1e9
        self._is_stale = True
        self._drawn_area: float | None = None
        self._is_refined = False
        self._preview: tuple[Recording, float] | None = None
        self.on_change: Callable[[], None] = lambda: None
        self.on_play: Callable[[bool], None] = lambda playing: None
        self.opened, self.look = opened, Display()
        self.eye: Eye | None = None
        self.timeline = Timeline(seconds=opened.seconds)
        self.closed = False

    def move(self, eye: Eye) -> bool:
        """Look from ``eye`` from now on; return False, and go on as before, where there is no such
        camera."""
        if not eye.is_possible:
            return False
        with self._lock:
            if eye == self.eye:
                return True
            self.eye = eye
        self._note_change()
        return True

    def change(self, **changes: Any) -> None:
        """Show something else: attributes of ``Display``."""
        with self._lock:
            self.look = replace(self.look, **changes)
        self._note_change()

    def set_time(self, time: float) -> None:
        with self._lock:
            self.timeline = replace(
                self.timeline, time=min(max(time, 0.0), 1.0), since=self._clock()
            )
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
            self.opened = opened
            self.timeline = self.timeline.changed(self._clock(), seconds=opened.seconds)
            if self.look.view is not None and self.look.view >= len(views_of(opened)):
                self.look = replace(self.look, view=None)
        self._note_change()

    def preview(self, recording: Recording) -> None:
        with self._lock:
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
        if (
            eye is None
            or not len(views_of(opened))
            or not (look.comparing or look.layer == "error")
        ):
            return None
        if look.view is not None:
            return look.view
        shown = views_of(opened)
        time = None if opened.renderable.is_static else self.time
        return nearest_camera(
            eye.camera(), time, shown.poses, shown.times, viewpoint_of(opened).extent
        )

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
            if (
                self._drawn_area is None
                or not self._is_refined
                or self._drawn_area < 0.99 * self._refined_area
            ):
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
            is_moving = self._is_moving or self._clock() < self._changed_at + STILL_AFTER
            area = self._pace.next_area(
                int(self._refined_area), None if is_moving else self._drawn_area or 1.0
            )
            if self._is_stale and not is_moving:
                area = max(area, self._drawn_area or 0.0)
            opened = self.opened
            version = self._changed_at
            self._is_stale = False
            self._drawn_area = self._full_area
            self._is_refined = True  # if it fails, it is not tried again
            self._drawn_at = start = self._clock()
            shot = replace(self.shot(size_within(self._full_size, area)), is_moving=is_moving)
        image = draw(opened, shot)
        pixels = image.shape[0] * image.shape[1]
        if not self.closed:
            self._send(Sent(image, not is_moving, self._clock() - start))
        end = self._clock()
        with self._lock:
            self._pace.observe(pixels, end - start, is_refined=not is_moving)
            self._is_refined = not is_moving
            self._drawn_area = area if version == self._changed_at else None
            self._end_of_play()

    def shot(self, size: tuple[int, int] | None = None) -> Shot:
        """Return what is shown now as an image of ``size``; None: that of the window."""
        with self._lock:
            if self.eye is None:
                raise ValueError("there is no camera yet")
            size = size or self._full_size
            camera = self.eye.camera(size)
            time = self.time
            view = self.shown_view
            if self._preview is not None:
                recording, since = self._preview
                camera, recorded = recording.at(self._clock() - since)
                camera = in_window(camera, size)
                view = None
                time = time if recorded is None else recorded
            look = self.look
            opened = self.opened
        layer = "colour" if look.layer == "error" and view is None else look.layer
        shown = None if opened.renderable.is_static else time
        divide = look.divide if look.comparing else 1.0
        return Shot(camera, shown, layer, look.part, view, divide)

    @property
    def _is_moving(self) -> bool:
        is_playing = self.timeline.playing and not self.opened.renderable.is_static
        return is_playing or self._preview is not None

    @property
    def _full_size(self) -> tuple[int, int]:
        size = (640, 480) if self.eye is None else self.eye.size
        scale = min(1.0, self.look.longest / max(size))
        return max(16, round(size[0] * scale)), max(16, round(size[1] * scale))

    @property
    def _full_area(self) -> float:
        return float(math.prod(self._full_size))

    @property
    def _refined_area(self) -> float:
        """Pixels of the image that is shown when all is still."""
        return min(self._full_area, self._pace.largest)

    def _end_of_play(self) -> None:
        now = self._clock()
        stops = self.timeline.is_over(now)
        if stops:
            self.timeline = self.timeline.changed(now, playing=False)
            self.on_play(False)
        if self._preview is not None and now - self._preview[1] > self._preview[0].duration:
            self._preview, stops = None, True
        if stops:
            self._changed_at, self._is_stale = now, True

    def _note_change(self) -> None:
        with self._lock:
            self._changed_at = self._clock()
            self._is_stale = True
            self._drawn_area = None
        self.on_change()
