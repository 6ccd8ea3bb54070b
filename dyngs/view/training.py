"""The page that shows a scene while it is trained: a listener of the events that the progress bar
listens to."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.errors import DyngsError
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.kind import PredictsScenes, capability
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour
from dyngs.runs.opened import OpenedScene, SourceCapture
from dyngs.training.events import Event, StepDone
from dyngs.training.trainer import Trainer
from dyngs.view.server import ServerOptions, Viewer, free_port, require_viser
from dyngs.view.session import RenderScheduler
from dyngs.view.source import SceneSource
from dyngs.view.views import captured_views

REFRESH_SECONDS = 1.0
"""Seconds between two images of a browser in which nothing moves but the scene."""


class BetweenStepRenderer:
    """Draws for browsers in the thread that trains, between two steps, since steps change the scene
    in place.

    Images take at most ``fraction`` of the time. Without browsers a step costs one look at an empty
    list. Images change nothing of the training: they are drawn from a copy of the scene's shell,
    with caches of its own, and without gradients or random numbers.
    """

    def __init__(
        self,
        drawer: RenderScheduler,
        fraction: float = 0.2,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._drawer, self._fraction, self._clock = drawer, fraction, clock
        self._not_before = 0.0
        self._refreshed_at = -1e9

    def after_step(self, scene: GaussianScene) -> float:
        """Draw one image if one is due and time for it is left; return the seconds that it took."""
        sessions = self._drawer.sessions
        if not sessions:
            return 0.0
        start = self._clock()
        if start < self._not_before:
            return 0.0
        refreshes = start >= self._refreshed_at + REFRESH_SECONDS
        if refreshes:
            self._refreshed_at = start
        with torch.no_grad():
            for session in sessions:
                shell = _shell(scene, session.opened.background)
                session.update_scene(session.opened.with_scene(shell), refreshes=refreshes)
            while self._drawer.draw_one():
                if self._clock() - start > REFRESH_SECONDS * self._fraction:
                    break
        took = self._clock() - start
        self._not_before = start + took / self._fraction
        return took


class TrainingView:
    """Listener that serves a page with the scene of a training; a context manager. ``say`` is told
    the link.

    Raises DyngsError: a network is trained, which has no scene, viser is missing, or the port
    cannot be had.
    """

    def __init__(self, config: Config, serving: ServerOptions, log: Callable[[str], None]) -> None:
        if capability(config.model, PredictsScenes) is not None:
            raise DyngsError(
                "--view shows scenes, and a network has none; `dyngs predict` makes one"
            )
        require_viser()
        free_port(serving.host, serving.port)  # now, not after reading the capture
        self._say = log
        self._serving = replace(serving, in_thread=False, target=0.05)
        self._drawn: BetweenStepRenderer | None = None
        self._stack = ExitStack()

    def __enter__(self) -> TrainingView:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __call__(self, event: Event) -> None:
        """Draw what browsers ask for, after a step; serve the page after the first one."""
        if not isinstance(event, StepDone) or not isinstance(event.loop.trainer, Trainer):
            return
        trainer = event.loop.trainer
        start = time.perf_counter()
        begins = self._drawn is None
        if self._drawn is None:
            first = opened_training(trainer)
            source = SceneSource((first.name,), lambda _: first)
            viewer = self._stack.enter_context(Viewer(source, first, self._serving))
            self._say(f"viewing: {viewer.link} (until the training ends)")
            self._drawn = BetweenStepRenderer(viewer.drawer)
        if self._drawn.after_step(trainer.model.scene) or begins:
            event.loop.stopwatch.exclude(time.perf_counter() - start)


def opened_training(trainer: Trainer[Any]) -> OpenedScene:
    """Return the scene of a trainer with the views that it is trained on."""
    config = trainer.config
    views = trainer.images.views
    shown = captured_views(views, config.data, trainer.images)
    captured = SourceCapture(config.data, trainer.capture)
    captured.once("views", lambda: shown)
    with torch.no_grad():
        scene = _shell(trainer.model.scene, background_colour(trainer.background))
    return OpenedScene(
        config,
        scene,
        trainer.done,
        0.0,
        trainer.info,
        name=config.run.name,
        captured=captured,
        in_training=True,
    )


def _shell(scene: Renderable, background: Tensor) -> Renderable:
    """Return the same scene with caches of its own, to be drawn whatever its values are."""
    if isinstance(scene, GaussianScene):
        scene = replace(scene, options=replace(scene.options, nonfinite="skip"))
    return scene.on_background(background)
