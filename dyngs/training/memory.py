"""The memory that a run will take: its pictures, its Gaussians with the state of Adam, and what a step draws into."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

from dyngs.config import Config, DefaultStrategy, FixedStrategy, McmcStrategy
from dyngs.config.kinds import stored_sh_degree
from dyngs.conventions import num_sh_terms
from dyngs.training.schedule import densify_schedule
from dyngs.training.trainer import Trainer

COPIES = 7
"""Float32 copies of the values of a Gaussian: value, gradient, two moments, and room for three more when their set
changes. Measured: 1.65 kB per Gaussian with harmonics of degree 3, whose 59 values take 0.24 kB."""
SHAPE_VALUES = 11
"""Values of a Gaussian beside its harmonics: position, rotation, sizes, opacity."""
DRAWING_BYTES = 200
"""Bytes per pixel of the largest picture that a step takes beside them: rendering, truth, windows of SSIM."""
DECODING_BYTES = 45
"""Bytes per pixel of the file that decoding takes for a while: floats for shrinking and undistorting. Measured, as that
above, on photos of 12 megapixels."""
USUAL_GAUSSIANS, USUAL_CHANGES = 250_000, 34
"""Gaussians that photos led to in 7,000 steps (fox 268,000, cup 204,000, lego 173,000: docs/benchmarks.md), in which
their set changes so often."""
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_USED = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")


@dataclass(frozen=True)
class MemoryForecast:
    """Bytes that a run is expected to take at its peak.

    Attributes:
        program: taken already.
        pictures: that decoded ones will take, in the cache or on their way to it.
        drawing: for a step.
        gaussians: for ``count`` of them, those that may be expected.
        most: Gaussians that the strategy allows.
        each: bytes of a Gaussian.
        free: of this machine and this process's limits, beside what is taken already; None: not known.
        all_kept: every picture has its place in the cache.
    """

    program: int
    pictures: int
    drawing: int
    count: int
    most: int
    each: int
    free: int | None
    all_kept: bool

    @property
    def total(self) -> int:
        return self.program + self.pictures + self.drawing + self.count * self.each

    def __str__(self) -> str:
        kept = "all kept" if self.all_kept else "as many as data.cache_mb keeps"
        parts = f"{_gb(self.program)} program, {_gb(self.pictures)} pictures ({kept}), {_gb(self.drawing)} drawing, "
        parts += f"{_gb(self.count * self.each)} for some {self.count:,} Gaussians"
        if self.most > 2 * self.count:
            parts += f"; {_gb(self.most * self.each)} for the {self.most:,} that strategy.max_gaussians allows"
        free = "" if self.free is None else f" ({_gb(self.free + self.program)} are there)"
        return f"memory: about {_gb(self.total)} GB{free}: {parts}"

    def warning(self) -> str | None:
        """Return a line where that is more than is there; what to do is in it."""
        if self.free is None or self.total - self.program <= self.free:
            return None
        room = max(self.free - (self.total - self.program - self.pictures), 0)
        advice = ["data.longest_side=N (smaller pictures)", "strategy.max_gaussians=N"]
        if self.pictures > 0.2 * self.total:
            advice.insert(0, f"data.cache_mb={0.8e-6 * room:.0f} (pictures are then decoded again and again)")
        return (
            f"about {_gb(self.total)} GB of memory are needed, and {_gb(self.free + self.program)} are there: give "
            f"{', '.join(advice)}"
        )


def memory_forecast(trainer: Trainer) -> MemoryForecast:
    """Return the memory that the run of ``trainer``, which has not begun to step, is expected to take."""
    pictures, config = trainer.pictures, trainer.config
    pixels = max((width * height for width, height in pictures.sizes), default=0)
    files = max((view.width * view.height for view in pictures.views), default=0)
    waiting = (pictures.decoded_ahead // 2 or 1) * DECODING_BYTES * files
    return MemoryForecast(
        program=resident_memory(),
        pictures=pictures.bytes_to_come + waiting,
        drawing=DRAWING_BYTES * pixels,
        count=expected_gaussians(config, trainer.num_gaussians),
        most=max(config.strategy.growth_limit, trainer.num_gaussians),
        each=gaussian_bytes(config),
        free=free_memory(),
        all_kept=pictures.keeps_all,
    )


def gaussian_bytes(config: Config) -> int:
    """Return the bytes of memory that a Gaussian takes in training."""
    return 4 * COPIES * (SHAPE_VALUES + 3 * num_sh_terms(stored_sh_degree(config)))


def num_changes(config: Config, steps: int | None = None) -> int:
    """Return how often the set of Gaussians changes in a run, or in its first ``steps``."""
    match config.strategy:
        case DefaultStrategy() | McmcStrategy():
            schedule = densify_schedule(config.strategy, config.train.steps, white_background=False)
            last = min(schedule.stop, config.train.steps if steps is None else steps)
            return sum(schedule.densifies_at(step) for step in range(1, last + 1))
        case FixedStrategy():
            return 0


def expected_gaussians(config: Config, now: int) -> int:
    """Return the Gaussians that a run which begins with ``now`` may end with: roughly, before anything is seen."""
    match config.strategy:
        case McmcStrategy():
            return max(config.strategy.max_gaussians, now)
        case _:
            usual = round(USUAL_GAUSSIANS * min(num_changes(config) / USUAL_CHANGES, 4.0) ** 0.5)
            return max(now, min(usual, config.strategy.growth_limit))


def resident_memory() -> int:
    """Return the bytes of memory that this process takes; 0 where that is not known."""
    found = re.search(r"VmRSS:\s+(\d+) kB", _text("/proc/self/status"))
    return 1024 * int(found[1]) if found else 0


def peak_memory() -> int:
    """Return the largest number of bytes of memory that this process has taken; 0 where that is not known."""
    if sys.platform == "win32":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def free_memory() -> int | None:
    """Return the bytes that this process may still take, by the machine and the limit of its container."""
    found = []
    available = re.search(r"MemAvailable:\s+(\d+) kB", _text("/proc/meminfo"))
    if available:
        found.append(1024 * int(available[1]))
    elif hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        found.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for limit, used in zip(_LIMITS, _USED, strict=True):
        texts = _text(limit).strip(), _text(used).strip()
        if all(text.isdigit() for text in texts):
            found.append(max(int(texts[0]) - int(texts[1]), 0))
    return min(found, default=None)


def _text(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""


def _gb(count: float) -> str:
    return f"{1e-9 * count:.2g}" if count < 1e10 else f"{1e-9 * count:.0f}"
