"""The training loop: steps until the end, and events that tell of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dyngs.errors import DyngsError
from dyngs.models.checkpoint import Checkpoint
from dyngs.ops.adam import Count
from dyngs.training.clock import Stopwatch
from dyngs.training.events import Event, Listener, Message, Started, StepDone, StepReport, TotalChanged


class Trainable(Protocol):
    """Interface of the trainers that the loop runs: of a scene, or of a network that predicts scenes."""

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

    def checkpoint(self) -> Checkpoint:
        """Return everything that ``restore`` needs."""
        ...

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to where ``checkpoint`` was taken."""
        ...


class Loop:
    """Steps of a trainer, told to listeners in their order.

    Args:
        watch: seconds of training.
        advice: added to the message of a step that fails.

    Attributes:
        trainer: a listener may exchange it for one on other schedules.
        before_step: is told the trainer of each step that is about to begin.
    """

    def __init__(
        self, trainer: Trainable, total: int, watch: Stopwatch, advice: Callable[[], str] | None = None
    ) -> None:
        self.trainer, self.total, self.watch = trainer, total, watch
        self._advice = advice
        self.before_step: Callable[[Trainable], None] = lambda _: None
        self._listeners: list[Listener] = []

    def subscribe(self, *listeners: Listener) -> None:
        self._listeners += listeners

    def tell(self, event: Event) -> None:
        for listener in self._listeners:
            listener(event)

    def expect(self, total: int) -> None:
        """Do another number of steps from now on."""
        self.total = total
        self.tell(TotalChanged(total))

    def run(self, is_stopped: Callable[[], bool] = lambda: False) -> None:
        """Step until the end, or until ``is_stopped`` between two steps."""
        self.tell(Started(self.trainer.done, self.total))
        while self.trainer.done < self.total and not is_stopped():
            report = self._step()
            for line in (report.finding or "").splitlines():
                self.tell(Message(f"step {report.step}: {line}"))
            self.tell(StepDone(report, self))

    def _step(self) -> StepReport:
        try:
            self.before_step(self.trainer)
            return self.trainer.step()
        except DyngsError as error:
            if self._advice is None:
                raise
            raise DyngsError(f"{error}. {self._advice()}") from error
