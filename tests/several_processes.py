"""Several processes that are connected, as torchrun would start them, and what they do in tests.

They are forked from a server that has imported torch once.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from pretend_gpu import GPU, pretend_gpu

from dyngs.api.following import run_processes
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config import Config
from dyngs.core.errors import DyngsError
from dyngs.training import new_trainer
from dyngs.training import processes as module
from dyngs.training.processes import Processes
from dyngs.training.trainer import StepReport, Trainer


def run_in(
    count: int, target: Callable[..., int], folder: Path, *arguments: Any
) -> tuple[list[int], list[str]]:
    """Call ``target`` in ``count`` connected processes; return the exit codes and what each has
    printed.

    Args:
        count: of processes.
        target: of this module; returns an exit code.
        folder: that exists, for what they print.
        arguments: of ``target``.
    """
    context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
    if sys.platform == "linux":
        context.set_forkserver_preload(["dyngs.api.train", "dyngs.api.following"])
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    started = []
    for rank in range(count):
        process = context.Process(
            target=_begin, args=(rank, count, port, folder, target, arguments)
        )
        process.start()
        started.append(process)
    for process in started:
        process.join(120)
    codes = [-1 if process.exitcode is None else process.exitcode for process in started]
    for process in started:
        process.kill()
    return codes, [
        (folder / f"said_{rank}.txt").read_text(encoding="utf-8") for rank in range(count)
    ]


def _begin(
    rank: int, count: int, port: int, folder: Path, target: Callable[..., int], arguments: Any
) -> None:
    names = {"RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count, "MASTER_PORT": port}
    os.environ |= {name: str(value) for name, value in names.items()} | {"MASTER_ADDR": "127.0.0.1"}
    torch.set_num_threads(1)
    with (
        (folder / f"said_{rank}.txt").open("w", encoding="utf-8") as said,
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        try:
            code = target(*arguments)
        except DyngsError as error:
            print(f"dyngs: error: {error}")
            code = 2
        except KeyboardInterrupt as error:
            print(f"dyngs: interrupted: {error}")
            code = 130
    sys.exit(code)


def trained(configs: list[Config], fails: str = "") -> int:
    """Train all of ``configs``.

    ``fails``: "step" in the last process, "weights" of the last process go astray, or it dies or is
    told to end.
    """
    last = int(os.environ["RANK"]) == int(os.environ["WORLD_SIZE"]) - 1
    if fails == "step" and last:
        _before_step(4, _refuse)
    if fails == "weights" and last:
        _before_step(4, _nudge)
    if fails == "death" and last:
        _before_step(4, lambda _: os._exit(9))
    if fails == "SIGTERM" and last:
        _before_step(4, lambda _: signal.raise_signal(signal.SIGTERM))

    def lead(processes: Processes) -> int:
        for config in configs:
            train(config, processes=processes)
        return 0

    return run_processes(lead)


def trained_on_gpu(configs: list[Config]) -> int:
    """Train like ``trained`` with the scene on the pretended GPU."""
    new_trainer.select_device = lambda _: GPU
    with pretend_gpu():
        return trained(configs)


def resumed(run: Path) -> int:
    """Resume a run from the command line."""
    return main(["train", "--resume", str(run)])


def summed() -> int:
    """Sum tensors and gradients over the processes, and compare what is the same in all."""
    module.CHUNK = 5  # so that small tensors go through in parts
    with Processes.from_torchrun() as processes:
        rank = processes.rank
        size = processes.size
        values = torch.tensor([0.1, 1e8, -1e8, 3.0, 1e-8, 7.0, 2.0]) * (1 + rank)
        expected = torch.zeros(7)
        for k in range(size):
            expected += torch.tensor([0.1, 1e8, -1e8, 3.0, 1e-8, 7.0, 2.0]) * (1 + k)
        table = torch.full((2, 3), float(rank))
        none = torch.zeros(0, 3)
        processes.sum_([values, none, table])
        assert torch.equal(values, expected)
        assert torch.equal(table, torch.full((2, 3), float(sum(range(size)))))
        everywhere, somewhere, nowhere = (torch.zeros(3, requires_grad=True) for _ in range(3))
        everywhere.grad = torch.full((3,), 1.0 + rank)
        somewhere.grad = torch.tensor([1.0, 2.0, 3.0]) if rank == 1 else None
        loss = torch.tensor([float(rank)])
        processes.sum_gradients_([everywhere, somewhere, nowhere], loss)
        assert loss.item() == sum(range(size))
        assert everywhere.grad.tolist() == [sum(range(1, size + 1))] * 3
        assert somewhere.grad is not None
        assert somewhere.grad.tolist() == [1.0, 2.0, 3.0]
        assert nowhere.grad is None
        processes.require_same({"x": values}, "after step 7")
        processes.require_same({"x": torch.tensor([float(rank == 1)])}, "after step 8")
    return 0


def _before_step(step: int, act: Callable[[Trainer], object]) -> None:
    real = Trainer.step

    def changed(self: Trainer) -> StepReport:
        if self.done + 1 == step:
            act(self)
        return real(self)

    Trainer.step = changed


def _refuse(trainer: Trainer) -> None:
    raise DyngsError("image 3 is damaged")


def _nudge(trainer: Trainer) -> None:
    with torch.no_grad():
        trainer.model.scene.gaussians.means[0, 0] += 1e-6
