"""Runs for limits to act on, in memory."""

from __future__ import annotations

from pathlib import Path

from dyngs.api.budget.run import LimitedRun

from dyngs.training.clock import Stopwatch
from dyngs.training.events import Event, Message
from dyngs.training.loop import Loop
from dyngs.training.trainer import Trainer


def limited(trainer: Trainer, given: float = float("inf"), used: float = 0.0) -> LimitedRun:
    """A run of ``trainer`` with so many seconds, of which some are used; nothing listens yet."""
    watch = Stopwatch()
    watch.pause(-used)
    loop = Loop(trainer, trainer.config.total_steps, watch)
    return LimitedRun(Path("nowhere"), trainer.config, loop, trainer, given)


def said(run: LimitedRun) -> list[str]:
    """All that is said from now on, as it is said."""
    texts: list[str] = []

    def listen(event: Event) -> None:
        if isinstance(event, Message):
            texts.append(event.text)

    run.loop.subscribe(listen)
    return texts
