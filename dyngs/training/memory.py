"""Estimate of the memory of a run: images, Gaussians with Adam state, and render buffers."""

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

# float32 copies of each value of a Gaussian: value, gradient, two Adam moments, three more while
# Gaussians are rearranged (measured: 1.65 kB per Gaussian with 59 values).
COPIES = 7
SHAPE_VALUES = 11  # Values of a Gaussian without SH coefficients
DRAWING = 200  # Bytes of render buffers per pixel of the largest training image
STEP = 30_000_000  # Bytes of code and buffers allocated by the first step
DECODING = 45  # Bytes per pixel of a file while it is decoded (measured on 12 megapixel photos)
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_USED = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")


@dataclass(frozen=True)
class MemoryForecast:
    """Expected peak memory of each process of a run, in bytes.

    Attributes:
        place: "memory" or "GPU memory".
        program: memory already in use.
        images: decoded images, cached or prefetched.
        drawing: render buffers of a step.
        gaussians: Gaussians with gradients and Adam state, ``count`` of them.
        free: available bytes. None if unknown.
        largest: bytes of the largest part, the config key that lowers it, the value of the key, and
            the exponent that relates value and size.
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
        """Bytes that all processes will allocate."""
        return self.processes * (self.images + self.drawing + self.gaussians)

    def __str__(self) -> str:
        available = ""
        if self.free is not None:
            available = f" ({_gb(self.free + self.program)} GB available)"
        return (
            f"{self.place}: needs about {_gb(self.program + self.needed)} GB{available}: "
            f"images {_gb(self.images)}, rendering {_gb(self.drawing)}, "
            f"{self.count:,} Gaussians {_gb(self.gaussians)}"
        )

    def warning(self) -> str | None:
        """Return a warning if the run is likely to exceed the available memory, else None.

        The warning names a config key and a value with which the run fits.
        """
        if self.free is None or self.needed <= self.free:
            return None
        part, key, value, power = self.largest
        fraction = 1 - (self.needed - 0.95 * self.free) / max(self.processes * part, 1)
        fits = max(int(value * max(fraction, 0.02) ** power), 1)
        available = _gb(self.free + self.program)
        needed = _gb(self.program + self.needed)
        return f"{self.place}: needs about {needed} GB, {available} GB available; use {key}={fits}"


def memory_forecasts(trainer: Trainer[Any], processes: int = 1) -> list[MemoryForecast]:
    """Return the expected memory of a run before its first step.

    On a GPU, the first entry is the GPU memory and the second one the host memory.
    """
    images = trainer.images
    config = trainer.config
    pixels = max(width * height for width, height in images.sizes)
    side = max(map(max, images.sizes))
    files = max(view.width * view.height for view in images.views)
    decoded = images.pending_bytes + (images.num_prefetched // 2 or 1) * DECODING * files
    count = expected_gaussians(config, trainer.num_gaussians, side)
    # trained values per Gaussian, without those of a deformation field
    values = SHAPE_VALUES + 3 * num_sh_terms(config.stored_sh_degree)
    gaussians = count * (4 * COPIES * values + config.model.bytes_per_moving_gaussian)
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
        MemoryForecast("GPU memory", 0, shown, *scene, gpu[0], each, largest),
        MemoryForecast("memory", program, decoded, STEP, 0, 0, free, processes, largest),
    ]


def expected_gaussians(config: Config, now: int, longest_side: int = 400) -> int:
    """Return a rough estimate of the number of Gaussians at the end of a run, before training.

    Args:
        now: initial number of Gaussians.
        longest_side: of the training images, in pixels.
    """
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
        # Photos of 400 px gave 250,000 Gaussians after the 34 densifications of 7,000 steps.
        factor = changes / 34
        factor = factor if factor < 1 else min(factor, 4.0) ** 0.5
        grown = 250_000 * min(longest_side / 400, 1.0) ** 0.5 * factor
    most = max(now, round(min(grown, strategy.growth_limit)))
    return most + config.model.num_added_for_motion


def resident_memory() -> int:
    """Return the resident memory of this process in bytes, or 0 if unknown."""
    return _kilobytes("/proc/self/status", "VmRSS") or 0


def free_memory() -> int | None:
    """Return the memory available to this process in bytes, limited by machine and container."""
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
