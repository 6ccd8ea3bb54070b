"""Viewer page of a running training, as a listener of training events."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
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
from dyngs.training.events import Event, Message, StepDone
from dyngs.training.trainer import Trainer
from dyngs.view.server import ServerOptions, Viewer, free_port, require_viser
from dyngs.view.session import RenderScheduler
from dyngs.view.source import SceneSource
from dyngs.view.views import captured_views

PAUSE, RESUME = "Pause training", "Resume training"
REFRESH_SECONDS = 1.0  # Seconds between images of a browser in which only the scene changes


class BetweenStepRenderer:
    """Renders for browsers in the training thread between steps, since steps change the scene in
    place.

    Rendering takes at most ``fraction`` of the time. It does not affect the training: a shallow
    copy of the scene with its own caches is rendered, without gradients or random numbers.
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
        """Render an image if one is due and the time budget allows. Return the seconds it took."""
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
    """Listener that serves a page with the scene in training; a context manager.

    Args:
        log: receives the link to the page.
        figures: returns the numbers to display by name, such as step and PSNR.

    Raises:
        DyngsError: a network is trained, viser is missing, or the port is not available.
    """

    def __init__(
        self,
        config: Config,
        serving: ServerOptions,
        log: Callable[[str], None],
        figures: Callable[[], Mapping[str, str]] = dict,
    ) -> None:
        if capability(config.model, PredictsScenes) is not None:
            raise DyngsError(
                "--view: a network has no scene to show; create one with `dyngs predict`"
            )
        require_viser()
        free_port(serving.host, serving.port)  # fail before reading the capture
        self._log = log
        self._figures = figures
        self._serving = replace(serving, in_thread=False, target=0.05)
        self._page: TrainingPage | None = None
        self._stack = ExitStack()

    def __enter__(self) -> TrainingView:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def link(self) -> str | None:
        """Link to the page. None if no step was trained."""
        return None if self._page is None else self._page.viewer.link

    def __call__(self, event: Event) -> None:
        """Serve the page after the first step, and render requested images after each step."""
        if not isinstance(event, StepDone) or not isinstance(event.loop.trainer, Trainer):
            return
        trainer = event.loop.trainer
        start = time.perf_counter()
        is_first_step = self._page is None
        if self._page is None:
            first = opened_training(trainer)
            source = SceneSource((first.name,), lambda _: first)
            viewer = self._stack.enter_context(Viewer(source, first, self._serving))
            self._log(f"viewer: {viewer.link}")
            self._page = TrainingPage(viewer)
        page = self._page
        scene = trainer.model.scene
        if page.renderer.after_step(scene) or is_first_step:
            page.show_figures(self._figures())
            event.loop.stopwatch.exclude(time.perf_counter() - start)
        if event.is_last:
            page.finish(scene, self._figures())
        elif page.is_paused:
            page.show_scene(scene)
            event.loop.emit(Message("training paused in the viewer"))
            event.loop.pause(page.draw_while_paused)
            if not page.is_paused:  # otherwise a signal ended the pause
                event.loop.emit(Message("training resumed"))

    def serve(self) -> None:
        """Start a render thread, so that the page stays usable after training."""
        if self._page is not None:
            self._page.viewer.drawer.start()


class TrainingPage:
    """Page of one training, with a panel of numbers and a pause button that all browsers share."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer = viewer
        self.renderer = BetweenStepRenderer(viewer.drawer)
        self.is_paused = False
        gui = viewer.server.gui
        with gui.add_folder("Training", order=-1):
            self._text = gui.add_markdown("")
            self._button = gui.add_button(PAUSE)
        self._button.on_click(lambda _: self._toggle())

    def _toggle(self) -> None:
        self.is_paused = not self.is_paused
        self._button.label = RESUME if self.is_paused else PAUSE

    def show_figures(self, figures: Mapping[str, str]) -> None:
        self._text.content = "\n\n".join(f"{name}: **{x}**" for name, x in figures.items())

    def show_scene(self, scene: GaussianScene) -> None:
        """Show a constant scene in all browsers, also in those that connect later."""
        first = self.viewer.first
        self.viewer.show(first.with_scene(_shell(scene, first.background)))

    def draw_while_paused(self) -> bool:
        """Render all requested images. Return whether training is still paused."""
        while self.viewer.drawer.draw_one():
            pass
        return self.is_paused

    def finish(self, scene: GaussianScene, figures: Mapping[str, str]) -> None:
        """Show the final scene and numbers."""
        self.show_scene(scene)
        self.show_figures(figures)
        self._button.visible = False


def opened_training(trainer: Trainer[Any]) -> OpenedScene:
    """Return the scene of a trainer with its training views."""
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
    """Return a shallow copy of the scene with its own caches, which skips non-finite Gaussians."""
    if isinstance(scene, GaussianScene):
        scene = replace(scene, options=replace(scene.options, nonfinite="skip"))
    return scene.on_background(background)
