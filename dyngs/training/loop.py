"""The training loop: steps until the end or an interrupt, and events that tell of them."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Any, Protocol

from dyngs.core.errors import DyngsError
from dyngs.models.checkpoint import Checkpoint
from dyngs.ops.adam import Count
from dyngs.training.clock import Stopwatch
from dyngs.training.events import (
    Event,
    Listener,
    Message,
    Started,
    StepDone,
    StepReport,
    TopologyChanged,
    TotalChanged,
)
from dyngs.training.trainer import TrainingEdit


class Trainable(Protocol):
    """Interface of the trainers that the loop runs: of a scene, or of a network that predicts
    scenes."""

    config: Any
    done: int
    """Steps done."""

    @property
    def bad_gradients(self) -> Count:
        """How often something was left out of a step because its gradient was not finite."""
        ...

    @property
    def num_gaussians(self) -> int: ...

    @property
    def num_moving(self) -> int:
        """Gaussians that depend on time or pose."""
        ...

    @property
    def has_test_views(self) -> bool: ...

    def step(self) -> StepReport:
        """Train on one image, or one choice of them."""
        ...

    def apply(self, edit: TrainingEdit) -> None:
        """Change the training between two steps."""
        ...

    def checkpoint(self) -> Checkpoint:
        """Return everything that ``restore`` needs."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to where ``checkpoint`` was taken."""
        ...


Editor = Callable[["Loop"], TrainingEdit | None]
"""Returns the change of the training that it requests between two steps, if any."""


class Loop:
    """Steps of a trainer, and events for listeners in their order.

    Args:
        watch: seconds of training.
        advice: added to the message of a step that fails.
        stages: editors that are asked before each step.
        limits: editors that are asked after each step, before its event.
        before_step: called with the trainer before each step.
    """

    def __init__(
        self,
        trainer: Trainable,
        total: int,
        stopwatch: Stopwatch,
        advice: Callable[[], str] | None = None,
        *,
        stages: Sequence[Editor] = (),
        limits: Sequence[Editor] = (),
        before_step: Callable[[Trainable], None] = lambda _: None,
    ) -> None:
        self.trainer = trainer
        self.total = total
        self.stopwatch = stopwatch
        self._advice = advice
        self._stages = stages
        self._limits = limits
        self._before_step = before_step
        self._listeners: list[Listener] = []

    def subscribe(self, *listeners: Listener) -> None:
        self._listeners += listeners

    def emit(self, event: Event) -> None:
        for listener in self._listeners:
            listener(event)

    def run(self, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Step until the end, or until ``is_stopped`` between two steps."""
        self.emit(Started(self.trainer.done, self.total))
        while self.trainer.done < self.total and not is_stopped():
            self._edit(self._stages)
            report = self._step()
            for line in (report.message or "").splitlines():
                self.emit(Message(f"step {report.step}: {line}"))
            self._edit(self._limits)
            self.emit(StepDone(report, self))

    def _edit(self, editors: Sequence[Editor]) -> None:
        for editor in editors:
            edit = editor(self)
            if edit is None:
                continue
            trainer = self.trainer
            before = trainer.num_gaussians
            trainer.apply(edit)
            if edit.message:
                self.emit(Message(f"step {trainer.done}: {edit.message}"))
            if edit.steps is not None:
                self.total = edit.steps
                self.emit(TotalChanged(self.total))
            elif edit.kept is not None or edit.stops_densification:
                self.emit(TopologyChanged(trainer.done, before, trainer.num_gaussians))

    def _step(self) -> StepReport:
        try:
            self._before_step(self.trainer)
            return self.trainer.step()
        except DyngsError as error:
            if self._advice is None:
                raise
            raise DyngsError(f"{error}. {self._advice()}") from error


class Interrupts:
    """A context manager in which a signal only sets ``requested``: Ctrl-C, SIGTERM, or SIGHUP from
    a closed terminal.

    A second Ctrl-C raises as usual. SIGHUP stays ignored under ``nohup``. Does nothing outside the
    main thread, where Python delivers no signals.
    """

    def __init__(self) -> None:
        self.requested = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            signals = [signal.SIGINT, signal.SIGTERM]
            if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
                signals.append(signal.SIGHUP)
            self._before = {number: signal.signal(number, self._request) for number in signals}
        return self

    def __exit__(self, *_: object) -> None:
        for which, handler in self._before.items():
            signal.signal(which, handler)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.requested = True
