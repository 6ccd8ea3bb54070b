"""The memory that a run will take: its images, its Gaussians with the state of Adam, and what a
step draws into."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dyngs.config import Config, DefaultStrategy, FixedStrategy, McmcStrategy, RandomInit
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.gaussians.schedule import densify_schedule, growth_per_change
from dyngs.models.kind import kind_of
from dyngs.ops.device import gpu_memory
from dyngs.training.trainer import Trainer


@dataclass(frozen=True)
class _Costs:
    """Bytes and numbers of a forecast, measured on photos of 12 megapixels.

    Attributes:
        copies: float32 copies of the values of a Gaussian: value, gradient, two moments, and room
            for three more when their set changes (1.65 kB per Gaussian with 59 values).
        needed_copies: those that are there in every step.
        shape_values: of a Gaussian next to its harmonics.
        drawing: bytes per pixel of the largest image that a step draws into.
        step: bytes of code and buffers that the first step touches.
        decoding: bytes per pixel of a file that is decoded.
        usual_gaussians, usual_changes: Gaussians that photos led to in 7,000 steps, and the changes
            of their set (docs/benchmarks.md).
        usual_side: longest side of the images, px, from which that holds.
    """

    copies: int = 7
    needed_copies: int = 4
    shape_values: int = 11
    drawing: int = 200
    step: int = 30_000_000
    decoding: int = 45
    usual_gaussians: int = 250_000
    usual_changes: int = 34
    usual_side: int = 400


COSTS = _Costs()
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_SWAP = "/sys/fs/cgroup/memory.swap.max"
_USED = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")


@dataclass(frozen=True)
class MemoryForecast:
    """Bytes that each process of a run is expected to take at its peak.

    Attributes:
        place: "memory" or "memory of the GPU".
        program: taken already.
        images: decoded ones, in the cache or on their way to it.
        drawing: what a step draws into.
        gaussians: of ``count`` of them.
        certain: least that is taken next to the program.
        free, whole: bytes that may still be taken, and that the machine has; None: unknown.
        largest: bytes of the largest part, a key, its value, and the power of the part's size with
            which that goes: what to lower where it is too much.
    """

    place: str
    program: int
    images: int
    drawing: int
    gaussians: int
    count: int
    certain: int
    free: int | None
    whole: int | None
    processes: int
    largest: tuple[int, str, float, float]

    @property
    def needed(self) -> int:
        """Bytes that all processes will still take."""
        return self.processes * (self.images + self.drawing + self.gaussians)

    def __str__(self) -> str:
        there = "" if self.free is None else f" ({_gb(self.free + self.program)} are there)"
        return (
            f"{self.place}: about {_gb(self.program + self.needed)} GB{there}: {_gb(self.images)} images, "
            f"{_gb(self.drawing)} drawing, {_gb(self.gaussians)} for some {self.count:,} Gaussians"
        )

    def warning(self) -> str | None:
        """Return a line where that is likely to be more than is there."""
        if self.free is None or self.needed <= self.free:
            return None
        there = f"{_gb(self.free + self.program)} are there"
        needed = _gb(self.program + self.needed)
        return f"about {needed} GB of {self.place} are needed, and {there}: give {self._advice(self.free)}"

    def require_possible(self) -> None:
        """Raise where the run certainly needs more than this machine, or its container, has."""
        needed = self.program + self.processes * self.certain
        if self.whole is not None and needed > self.whole:
            raise DyngsError(
                f"at least {_gb(needed)} GB of {self.place} are needed, and this machine has "
                f"{_gb(self.whole)}: give {self._advice(self.whole)}"
            )

    def _advice(self, there: int) -> str:
        """Return the key to lower, with a value that makes the run fit into ``there`` bytes."""
        part, key, value, power = self.largest
        fraction = 1 - (self.needed - 0.95 * there) / max(self.processes * part, 1)
        return f"{key}={max(int(value * max(fraction, 0.02) ** power), 1)}"


def memory_forecasts(trainer: Trainer[Any], processes: int = 1) -> list[MemoryForecast]:
    """Return the memory that the run of ``trainer``, which has not begun to step, is expected to
    take.

    On a GPU first that of the GPU, with the scene, and then that of the machine.
    """
    images = trainer.images
    config = trainer.config
    pixels = max((width * height for width, height in images.sizes), default=0)
    side = max((max(size) for size in images.sizes), default=0)
    files = max((view.width * view.height for view in images.views), default=0)
    decoded = images.bytes_to_come + (images.decoded_ahead // 2 or 1) * COSTS.decoding * files
    now = trainer.num_gaussians
    count = expected_gaussians(config, now, side)
    gaussians = count * gaussian_bytes(config)
    needed = 4 * COSTS.needed_copies * now * stored_values(config)
    drawing = COSTS.step + COSTS.drawing * pixels
    largest = max(
        (decoded, "data.cache_mb", 1e-6 * decoded, 1.0),
        (drawing, "data.longest_side", side, 0.5),
        (gaussians, *config.model.size_key(count)),
    )
    machine = free_memory(), whole_memory(), processes, largest
    program = resident_memory()
    gpu = gpu_memory(trainer.device)
    if gpu is None:
        certain = decoded + needed
        return [
            MemoryForecast("memory", program, decoded, drawing, gaussians, count, certain, *machine)
        ]
    shown = images.bytes_on_gpu
    each = -(-processes // max(torch.cuda.device_count(), 1))
    on_gpu = MemoryForecast(
        "memory of the GPU", 0, shown, drawing, gaussians, count, needed, *gpu, each, largest
    )
    rest = MemoryForecast("memory", program, decoded, COSTS.step, 0, 0, decoded, *machine)
    return [on_gpu, rest]


def require_room(config: Config) -> None:
    """Raise where the random Gaussians that a run is to begin with cannot fit on this machine."""
    init = config.init
    whole = whole_memory()
    if (
        not isinstance(init, RandomInit)
        or whole is None
        or "init" not in kind_of(config.model).uses
    ):
        return
    each = 4 * COSTS.needed_copies * stored_values(config)
    if init.num_random * each > whole:
        raise DyngsError(
            f"init.num_random={init.num_random}: at least {_gb(init.num_random * each)} GB of memory "
            f"are needed, and this machine has {_gb(whole)}: give init.num_random={whole // (2 * each)}"
        )


def stored_values(config: Config) -> int:
    """Return the number of values of a Gaussian that are trained, next to those of a field."""
    return COSTS.shape_values + 3 * num_sh_terms(config.stored_sh_degree)


def gaussian_bytes(config: Config) -> int:
    """Return the bytes of memory that a Gaussian takes in training, where it moves if anything
    may."""
    return 4 * COSTS.copies * stored_values(config) + config.model.moving_bytes


def num_changes(config: Config, steps: int | None = None) -> int:
    """Return how often the set of Gaussians changes in a run, or in its first ``steps``."""
    strategy = config.strategy
    if isinstance(strategy, FixedStrategy):
        return 0
    schedule = densify_schedule(strategy, config.train.steps, white_background=False)
    last = min(schedule.stop, config.train.steps if steps is None else steps)
    return sum(schedule.densifies_at(step) for step in range(1, last + 1))


def expected_gaussians(config: Config, now: int, longest_side: int = COSTS.usual_side) -> int:
    """Return the Gaussians that a run which begins with ``now`` may end with: roughly, before
    anything is seen."""
    changes = num_changes(config)
    match config.strategy:
        case McmcStrategy():
            grown = now * (1 + growth_per_change(config.train.steps)) ** min(changes, 200)
        case DefaultStrategy() | FixedStrategy():
            detail = min(longest_side / COSTS.usual_side, 1.0) ** 0.5
            factor = changes / COSTS.usual_changes
            factor = factor if factor < 1 else min(factor, 4.0) ** 0.5
            grown = COSTS.usual_gaussians * detail * factor
    most = max(now, round(min(grown, config.strategy.growth_limit)))
    return most + config.model.added_for_motion


def resident_memory() -> int:
    """Return the bytes of memory that this process takes; 0 where that is not known."""
    return _kilobytes("/proc/self/status", "VmRSS") or 0


def peak_memory() -> int:
    """Return the largest number of bytes of memory that this process has taken; 0 where that is not
    known."""
    if sys.platform == "win32":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def whole_memory() -> int | None:
    """Return the bytes of memory and swap that this machine, or its container, has at all; None:
    not known."""
    found = []
    memory, swap = (_kilobytes("/proc/meminfo", name) for name in ("MemTotal", "SwapTotal"))
    if memory is not None and swap is not None:
        found.append(memory + swap)
    limits = [_number(_LIMITS[0]), _number(_SWAP)]
    if None not in limits:
        found.append(sum(x or 0 for x in limits))
    return min(found, default=None)


def free_memory() -> int | None:
    """Return the bytes that this process may still take, by the machine and the limit of its
    container."""
    found = []
    available = _kilobytes("/proc/meminfo", "MemAvailable")
    if available is not None:
        found.append(available)
    elif hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        found.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for limit, used in zip(_LIMITS, _USED, strict=True):
        most = _number(limit)
        now = _number(used)
        if most is not None and now is not None:
            found.append(max(most - now, 0))
    return min(found, default=None)


def _kilobytes(path: str, name: str) -> int | None:
    found = re.search(rf"{name}:\s+(\d+) kB", _text(path))
    return 1024 * int(found[1]) if found else None


def _number(path: str) -> int | None:
    text = _text(path).strip()
    return int(text) if text.isdigit() else None


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""


def _gb(count: float) -> str:
    return f"{1e-9 * count:.2g}" if count < 1e10 else f"{1e-9 * count:.0f}"
