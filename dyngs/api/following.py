"""Training in several processes: rank 0 leads, the other ranks follow its commands.

Rank 0 runs as in a single process: it reads the config, evaluates, prunes and writes files. Before
each step it sends the other ranks a command, and after changes of the scene outside of a step also
a checkpoint. The other ranks need no run folder and write nothing.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout

from dyngs.config import Config
from dyngs.models.checkpoint import Checkpoint
from dyngs.ops.device import deterministic, keep_freed_memory, select_device
from dyngs.ops.native import kernel_threads
from dyngs.training.events import Event, TopologyChanged
from dyngs.training.loop import Interrupts, Trainable
from dyngs.training.new_trainer import build_trainer
from dyngs.training.processes import EXIT_INTERRUPTED, Processes
from dyngs.training.trainer import Trainer

STEP = "step"
Command = Config | Checkpoint | str | None
"""Command from rank 0 to the other ranks: build the trainer of a config, restore a checkpoint,
train for one ``STEP``, or end (None)."""


class Leader:
    """Rank 0: a listener that sends commands to the other ranks before each step."""

    def __init__(self, processes: Processes, config: Config, threads: int) -> None:
        self.processes = processes
        self._has_built = False
        self._is_stale = True
        run = config.run.model_copy(update={"threads": threads})
        self._config = config.model_copy(update={"run": run})

    def __call__(self, event: Event) -> None:
        if isinstance(event, TopologyChanged):
            self._is_stale = True

    def before_step(self, trainer: Trainable) -> None:
        """Start the next step of ``trainer`` on the other ranks."""
        if self.processes.size == 1 or not isinstance(trainer, Trainer):
            return
        if not self._has_built:
            self.processes.broadcast(self._config)
            self._has_built = True
            trainer.join(self.processes)
        if self._is_stale:
            self.processes.broadcast(trainer.checkpoint())
            self._is_stale = False
        self.processes.broadcast(STEP)


def run_processes(lead: Callable[[Processes], int]) -> int:
    """Run in the processes started by ``torchrun`` and return the exit code: rank 0 calls ``lead``,
    the others follow."""
    with Processes.from_torchrun() as processes:
        if processes.rank != 0:
            return EXIT_INTERRUPTED if run_follower(processes) else 0
        try:
            code = lead(processes)
        except KeyboardInterrupt as stopped:
            if stopped.args:  # between two steps, when the others wait for a command
                processes.broadcast(None)
            raise
        processes.broadcast(None)
    return code


def run_follower(processes: Processes) -> bool:
    """Execute the commands of rank 0 until the end, without output.

    Returns whether this process received a stop signal; rank 0 then stops after the next step.
    """
    keep_freed_memory()
    with (
        open(os.devnull, "w", encoding="utf-8") as nowhere,
        redirect_stdout(nowhere),
        redirect_stderr(nowhere),
        Interrupts() as interrupts,
    ):
        command: Command = processes.broadcast(None)
        while isinstance(command, Config):
            command = _follow_run(processes, command, interrupts)
    return interrupts.requested


def _follow_run(processes: Processes, config: Config, interrupts: Interrupts) -> Command:
    """Train the run of ``config``. Return the first command that belongs to no step of it."""
    bytewise = deterministic(select_device(config.run.device), config.run.deterministic)
    with kernel_threads(config.run.threads or 1), bytewise:
        trainer = build_trainer(config, restored=True)
        trainer.join(processes)
        while True:
            command: Command = processes.broadcast(None)
            if interrupts.requested:
                processes.request_stop()
            if isinstance(command, Checkpoint):
                trainer.restore(command)
            elif command == STEP:
                trainer.step()
            else:
                trainer.images.stop_prefetching()
                return command
