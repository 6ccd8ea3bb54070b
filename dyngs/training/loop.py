"""Training loop: runs steps until the end or an interrupt, and emits events."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from statistics import fmean
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
    Paused,
    Started,
    StepDone,
    StepReport,
    TopologyChanged,
    TotalChanged,
)
from dyngs.training.trainer import TrainingEdit


class Trainable(Protocol):
    """Interface of the trainers that the loop runs: scene trainers and network trainers."""

    config: Any
    done: int  # completed steps

    @property
    def bad_gradients(self) -> Count:
        """Number of parameter rows skipped because their gradient was not finite."""
        ...

    @property
    def num_gaussians(self) -> int: ...

    @property
    def num_moving(self) -> int:
        """Number of Gaussians that depend on time or pose."""
        ...

    def step(self) -> StepReport:
        """Run one training step."""
        ...

    def apply(self, edit: TrainingEdit) -> None:
        """Change the model or the schedule between two steps."""
        ...

    def checkpoint(self) -> Checkpoint:
        """Return the state that ``restore`` needs."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the state of ``checkpoint``."""
        ...


WINDOW = 50  # Steps over which the mean PSNR is computed

# Returns the edit to apply between two steps, or None
Editor = Callable[["Loop"], TrainingEdit | None]


class Loop:
    """Runs the steps of a trainer and sends events to listeners, in the order of their
    subscription.

    Args:
        stopwatch: measures the seconds of training.
        advice: returns text that is appended to the error message of a failed step.
        stages: editors called before each step.
        limits: editors called after each step, before its ``StepDone`` event.
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
        self._recent_psnr = deque[float](maxlen=WINDOW)
        self._listeners: list[Listener] = []
        self._is_stopped: Callable[[], bool] = lambda: False

    def subscribe(self, *listeners: Listener) -> None:
        self._listeners += listeners

    def emit(self, event: Event) -> None:
        for listener in self._listeners:
            listener(event)

    def run(self, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Train until the last step, or until ``is_stopped`` returns true between two steps."""
        self._is_stopped = is_stopped
        self.emit(Started(self.trainer.done, self.total))
        while self.trainer.done < self.total and not is_stopped():
            self._edit(self._stages)
            report = self._step()
            quality = report.sampled_psnr
            if math.isfinite(quality):  # not where masks exclude all pixels
                self._recent_psnr.append(quality)
            for line in (report.message or "").splitlines():
                self.emit(Message(f"step {report.step}: {line}"))
            self._edit(self._limits)
            self.emit(StepDone(report, self))

    @property
    def mean_psnr(self) -> float | None:
        """Mean PSNR of the views of the last ``WINDOW`` steps, dB; None if masks excluded all."""
        return fmean(self._recent_psnr) if self._recent_psnr else None

    def pause(self, is_paused: Callable[[], bool]) -> None:
        """Wait while ``is_paused`` returns true, until the run is stopped. Listeners may call this.

        The waiting time does not count as training.
        """
        start = time.perf_counter()
        while is_paused() and not self._is_stopped():
            time.sleep(0.01)
        seconds = time.perf_counter() - start
        self.stopwatch.exclude(seconds)
        self.emit(Paused(seconds))

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
            elif edit.keep is not None or edit.stops_densification:
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
    """Context manager in which Ctrl-C, SIGTERM and SIGHUP only set ``requested``.

    A second Ctrl-C raises KeyboardInterrupt. SIGHUP stays ignored under ``nohup``. Has no effect
    outside the main thread, because Python delivers signals only there.
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
