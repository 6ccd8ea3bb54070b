"""A run, or a person of an avatar file, as a page: where its viewer begins, and what moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dyngs.camera import Cameras
from dyngs.data.capture import Capture, View
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluation_background
from dyngs.export.html.page import Staging, WrittenPage, write_page
from dyngs.gaussians.scene import require_gaussians
from dyngs.human.avatar.light import LEFT_OUT
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.motion.placement import up_direction as up_of_clip
from dyngs.models.views import training_cameras
from dyngs.output.aim import look_at_point, up_direction
from dyngs.output.animation import with_motion
from dyngs.output.job_of_avatar import job_of_avatar
from dyngs.output.job_of_run import cameras_for_paths, view_to_show
from dyngs.output.orbit import frame_orbit_for_points
from dyngs.output.render_job import RenderJobOptions, axis
from dyngs.runs.checkpoint import LoadedRun, load_run

MOST_VIEWS = 24
"""Cameras of the capture that a page offers, evenly chosen."""
FRAME_RATE = 30.0
"""Assumed where a capture does not say."""
SHORTEST = 1.0
"""Seconds that a motion is played for at least."""


@dataclass(frozen=True)
class PageOptions:
    """What a page shows.

    Attributes:
        motion: motion file for a person; None: that of training.
        title: None: the name of the run's folder, or of the file.
        time: to begin with.
        up: axis that points up, such as "z" or "-y"; None: the direction that is up for the cameras or the person.
    """

    motion: Path | None = None
    title: str | None = None
    time: float = 0.0
    up: str | None = None


def write_run_page(
    source: Path, path: Path, options: PageOptions = PageOptions()
) -> tuple[WrittenPage, tuple[str, ...]]:
    """Write the page of a run or an avatar file; return what was written, and messages about what was chosen.

    Raises:
        DyngsError: no such run or file, a motion for a scene that is no person, or the file cannot be written.
    """
    title = options.title or source.resolve().stem
    if source.is_file():
        return _avatar_page(source, path, replace(options, title=title)), ()
    run = load_run(source)
    seconds: float | None = None
    if options.motion is not None:
        animated = with_motion(run, options.motion)
        run = animated.run
        seconds = len(run.scene.times) / animated.fps
    staging, notes = _staging(run, title, seconds, options.up)
    written = write_page(run.scene, run.scene.options, replace(staging, time=options.time), path)
    person = avatar_of(run.scene)
    if person is not None and person.light is not None:
        notes += (LEFT_OUT,)
    curves = written.header.get("curves", {})
    if curves.get("error"):
        fit = f"{curves['points']} control points for each of {curves['count']:,}, off by {curves['error']:.2g}"
        notes += (f"splines are fitted to the motion ({fit} world units)",)
    return written, notes


def _staging(run: LoadedRun, title: str, seconds: float | None, up: str | None) -> tuple[Staging, tuple[str, ...]]:
    """Return where the capture's cameras stood; around the Gaussians, with a message, where it cannot be read."""
    try:
        capture = read_capture(run.config.data)
    except DyngsError as error:
        notes = (f"without the capture ({error}) the page begins with a view from outside, {up or 'z'} up",)
        return _around(run, title, seconds, up or "z"), notes
    cameras, person = cameras_for_paths(capture, run.config.data), avatar_of(run.scene)
    first = view_to_show(capture)
    _, background = evaluation_background(run.config.data.background, capture.has_alpha)
    chosen = tuple(training_cameras([view], run.config.data)[0] for view in (first, *_some(capture)))
    red, green, blue = (0.0, 0.0, 0.0) if background is None else background.tolist()
    found = up_direction(cameras) if person is None else up_of_clip(person.clip).numpy()
    staging = Staging(
        title=title,
        views=chosen,
        target=_triple(look_at_point(cameras)),
        up=_triple(found) if up is None else axis(up),
        background=(red, green, blue),
        seconds=_seconds(run, capture.seconds, seconds),
    )
    return staging, ()


def _some(capture: Capture) -> list[View]:
    """Return training views at different places, evenly chosen."""
    views, seen = [], set()
    for view in capture.splits["train"]:
        pose = view.cam_from_world.tobytes()
        if pose not in seen:
            seen.add(pose)
            views.append(view)
    rows = np.linspace(0, len(views) - 1, min(len(views), MOST_VIEWS)).round().astype(int)
    return [views[i] for i in rows]


def _around(run: LoadedRun, title: str, seconds: float | None, up: str) -> Staging:
    means = run.scene.at(None).means.numpy()
    cameras = frame_orbit_for_points(means, 8, up=axis(up))
    white = run.info.background == "white"
    return Staging(
        title=title,
        views=tuple(cameras.select(i) for i in range(len(cameras))),
        target=_triple(np.median(means, axis=0)),
        up=axis(up),
        background=(1.0, 1.0, 1.0) if white else (0.0, 0.0, 0.0),
        seconds=_seconds(run, None, seconds),
    )


def _avatar_page(source: Path, path: Path, options: PageOptions) -> WrittenPage:
    asked = RenderJobOptions(path="orbit", motion=options.motion, num_frames=8, up=options.up)
    job = job_of_avatar(source, asked)
    front = job_of_avatar(source, replace(asked, path=None, num_frames=None, times=(0.0,))).path.cameras
    red, green, blue = (0.0, 0.0, 0.0) if job.background is None else job.background.tolist()
    cameras: Cameras = job.path.cameras
    staging = Staging(
        title=options.title or "",
        views=(front, *(cameras.select(i) for i in range(len(cameras)))),
        target=_triple(look_at_point(cameras)),
        up=_triple(up_direction(cameras)) if options.up is None else axis(options.up),
        background=(red, green, blue),
        seconds=max(len(job.scene.times) / job.path.fps, SHORTEST),
        time=options.time,
    )
    scene = require_gaussians(job.scene, str(source))
    return write_page(scene, scene.options, staging, path)


def _seconds(run: LoadedRun, known: float | None, of_motion: float | None) -> float:
    frames = max(len(run.scene.times), 1) / FRAME_RATE
    return max(of_motion if of_motion is not None else known if known is not None else frames, SHORTEST)


def _triple(point: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point)
    return x, y, z
