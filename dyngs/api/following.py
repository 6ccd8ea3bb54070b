"""Training in several processes: rank 0 leads, the other ranks follow its commands.

Rank 0 runs as in a single process: it reads the config, evaluates, prunes and writes files. Before
each step it sends the other ranks a command, and after changes of the scene outside of a step also
a checkpoint. The other ranks need no run folder and write nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict
from enum import IntEnum

import torch
from safetensors.torch import load, save

from dyngs.config import Config
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
from dyngs.ops.device import deterministic, keep_freed_memory, select_device
from dyngs.ops.native import kernel_threads
from dyngs.training.events import Event, TopologyChanged
from dyngs.training.loop import Interrupts, Trainable
from dyngs.training.new_trainer import build_trainer
from dyngs.training.processes import EXIT_INTERRUPTED, Processes
from dyngs.training.trainer import Trainer


class Order(IntEnum):
    """Command from rank 0 to the other ranks."""

    BUILD = 1
    """Build the trainer of the configuration that follows."""
    RESTORE = 2
    """Restore the checkpoint that follows."""
    STEP = 3
    END = 4


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
            config = json.dumps(self._config.model_dump(mode="json"))
            _send(self.processes, Order.BUILD, config.encode())
            self._has_built = True
            trainer.join(self.processes)
        if self._is_stale:
            _send(self.processes, Order.RESTORE, _packed(trainer.checkpoint()))
            self._is_stale = False
        _send(self.processes, Order.STEP)


def run_processes(lead: Callable[[Processes], int]) -> int:
    """Run in the processes started by ``torchrun`` and return the exit code: rank 0 calls ``lead``,
    the others follow."""
    with Processes.from_torchrun() as processes:
        if not processes.is_rank_zero:
            return EXIT_INTERRUPTED if run_follower(processes) else 0
        try:
            code = lead(processes)
        except KeyboardInterrupt as stopped:
            if stopped.args:  # between two steps, when the others wait for a command
                _send(processes, Order.END)
            raise
        _send(processes, Order.END)
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
        order, payload = _receive(processes)
        while order is Order.BUILD:
            order, payload = _follow_run(
                processes, Config.model_validate(json.loads(payload)), interrupts
            )
    return interrupts.requested


def _follow_run(
    processes: Processes, config: Config, interrupts: Interrupts
) -> tuple[Order, bytes]:
    bytewise = deterministic(select_device(config.run.device), config.run.deterministic)
    with kernel_threads(config.run.threads or 1), bytewise:
        trainer = build_trainer(config, restored=True)
        trainer.join(processes)
        while True:
            order, payload = _receive(processes)
            if interrupts.requested:
                processes.request_stop()
            match order:
                case Order.RESTORE:
                    trainer.restore(_unpacked(payload))
                case Order.STEP:
                    trainer.step()
                case _:
                    trainer.images.stop_prefetching()
                    return order, payload


def _send(processes: Processes, order: Order, payload: bytes = b"") -> None:
    if processes.size == 1:
        return
    processes.broadcast_(torch.tensor([order, len(payload)], dtype=torch.int64, device="cpu"))
    if payload:
        processes.broadcast_(torch.frombuffer(bytearray(payload), dtype=torch.uint8))


def _receive(processes: Processes) -> tuple[Order, bytes]:
    head = torch.zeros(2, dtype=torch.int64, device="cpu")
    processes.broadcast_(head)
    order, length = head.tolist()
    payload = torch.zeros(length, dtype=torch.uint8, device="cpu")
    if length:
        processes.broadcast_(payload)
    return Order(order), payload.numpy().tobytes()


def _packed(checkpoint: Checkpoint) -> bytes:
    tensors = {
        name: x.detach().cpu().contiguous().clone() for name, x in checkpoint.tensors.items()
    }
    return save(tensors, {"info": json.dumps(asdict(checkpoint.info))})


def _unpacked(payload: bytes) -> Checkpoint:
    header = json.loads(payload[8 : 8 + int.from_bytes(payload[:8], "little")])
    info = json.loads(header["__metadata__"]["info"])
    info["world_offset"] = tuple(info["world_offset"])
    return Checkpoint(CheckpointInfo(**info), load(payload))
