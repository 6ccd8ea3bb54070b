"""The memory that a run will take: its images, its Gaussians with the state of Adam, and what a
step draws into."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from dyngs.config import Config
from dyngs.core.conventions import num_sh_terms
from dyngs.gaussians.schedule import densify_schedule, growth_per_change
from dyngs.ops.device import gpu_memory
from dyngs.training.trainer import Trainer

# float32 copies of the values of a Gaussian: value, gradient, two moments, and room for three more
# when their set changes (measured: 1.65 kB per Gaussian with 59 values)
COPIES = 7
SHAPE_VALUES = 11  # Values of a Gaussian next to its harmonics
DRAWING = 200  # Bytes per pixel of the largest image that a step draws into
STEP = 30_000_000  # Bytes of code and buffers that the first step touches
DECODING = 45  # Bytes per pixel of a file that is decoded, measured on photos of 12 megapixels
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
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
        free: bytes that may still be taken; None: unknown.
        largest: bytes of the largest part, a key, its value, and the power of the part's size with
            which that goes: what to lower where it is too much.
    """

    place: str
    program: int
    images: int
    drawing: int
    gaussians: int
    count: int
    free: int | None
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
        """Return a line where that is likely to be more than is there, with the key to lower and a
        value that makes the run fit."""
        if self.free is None or self.needed <= self.free:
            return None
        part, key, value, power = self.largest
        fraction = 1 - (self.needed - 0.95 * self.free) / max(self.processes * part, 1)
        fits = max(int(value * max(fraction, 0.02) ** power), 1)
        there = f"{_gb(self.free + self.program)} are there"
        needed = _gb(self.program + self.needed)
        return f"about {needed} GB of {self.place} are needed, and {there}: give {key}={fits}"


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
    decoded = images.pending_bytes + (images.num_prefetched // 2 or 1) * DECODING * files
    count = expected_gaussians(config, trainer.num_gaussians, side)
    gaussians = count * gaussian_bytes(config)
    drawing = STEP + DRAWING * pixels
    largest = max(
        (decoded, "data.cache_mb", 1e-6 * decoded, 1.0),
        (drawing, "data.longest_side", side, 0.5),
        (gaussians, *config.model.size_key(count)),
    )
    free = free_memory()
    program = resident_memory()
    gpu = gpu_memory(trainer.device)
    scene = (drawing, gaussians, count)
    if gpu is None:
        return [MemoryForecast("memory", program, decoded, *scene, free, processes, largest)]
    each = -(-processes // max(torch.cuda.device_count(), 1))
    shown = images.bytes_on_gpu
    return [
        MemoryForecast("memory of the GPU", 0, shown, *scene, gpu[0], each, largest),
        MemoryForecast("memory", program, decoded, STEP, 0, 0, free, processes, largest),
    ]


def stored_values(config: Config) -> int:
    """Return the number of values of a Gaussian that are trained, next to those of a field."""
    return SHAPE_VALUES + 3 * num_sh_terms(config.stored_sh_degree)


def gaussian_bytes(config: Config) -> int:
    """Return the bytes of memory that a Gaussian takes in training, where it moves if anything
    may."""
    return 4 * COPIES * stored_values(config) + config.model.bytes_per_moving_gaussian


def expected_gaussians(config: Config, now: int, longest_side: int = 400) -> int:
    """Return the Gaussians that a run which begins with ``now`` may end with: roughly, before
    anything is seen."""
    strategy: Any = config.strategy
    steps = config.train.steps
    changes = 0
    if strategy.stop > 0:
        schedule = densify_schedule(strategy, steps, white_background=False)
        last = min(schedule.stop, steps)
        changes = sum(schedule.densifies_at(step) for step in range(1, last + 1))
    if strategy.kind == "mcmc":
        grown = now * (1 + growth_per_change(steps)) ** min(changes, 200)
    else:
        # photos of 400 px led to 250,000 Gaussians by the 34 changes of 7,000 steps
        # (docs/benchmarks/index.md)
        factor = changes / 34
        factor = factor if factor < 1 else min(factor, 4.0) ** 0.5
        grown = 250_000 * min(longest_side / 400, 1.0) ** 0.5 * factor
    most = max(now, round(min(grown, strategy.growth_limit)))
    return most + config.model.num_added_for_motion


def resident_memory() -> int:
    """Return the bytes of memory that this process takes; 0 where that is not known."""
    return _kilobytes("/proc/self/status", "VmRSS") or 0


def free_memory() -> int | None:
    """Return the bytes that this process may still take, by the machine and the limit of its
    container."""
    found = []
    available = _kilobytes("/proc/meminfo", "MemAvailable")
    if available is not None:
        found.append(available)
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
