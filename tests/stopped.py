"""Trainings that are interrupted, as by Ctrl-C."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.training.events import Event, StepDone


def stopped(config: Config, step: int) -> Path:
    """The folder of a run that is interrupted during ``step``, after which it saves what it has."""

    def interrupt(event: Event) -> None:
        if isinstance(event, StepDone) and event.step == step:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match=f"stopped after step {step}"):
        train(config, listeners=[interrupt])
    assert config.run.dir is not None
    return config.run.dir
