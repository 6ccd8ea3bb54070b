"""The memory that a run will take: its images, its Gaussians with the state of Adam, and what a
step draws into."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from typing_extensions import assert_never

from dyngs.config import Config, DefaultStrategy, FixedStrategy, McmcStrategy, RandomInit
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.gaussians.schedule import densify_schedule, growth_per_change
from dyngs.models.kind import HasGaussians, capability
from dyngs.ops.device import gpu_memory, num_gpus
from dyngs.training.trainer import Trainer

COPIES = 7
"""Float32 copies of the values of a Gaussian: value, gradient, two moments, and room for three more
when their set changes. Measured: 1.65 kB per Gaussian with harmonics of degree 3, whose 59 values
take 0.24 kB."""
NEEDED_COPIES = 4  # Of these, what is there in every step: value, gradient, two moments
FIELD_COPIES = 5
"""Float32 copies of what all Gaussians of a field share: value, gradient, two moments, and one for
the penalties."""
SHAPE_VALUES = 11  # Values of a Gaussian next to its harmonics: position, rotation, sizes, opacity
DRAWING_BYTES = 200
"""Bytes per pixel of the largest image that a step takes next to them: rendering, truth, windows of
SSIM."""
STEP_BYTES = 30_000_000  # Bytes of any step: code and buffers that the first one touches
DECODING_BYTES = 45
"""Bytes per pixel of the file that decoding takes for a while: floats for shrinking and
undistorting. Measured, as that above, on photos of 12 megapixels."""
USUAL_GAUSSIANS, USUAL_CHANGES = 250_000, 34
"""Gaussians that photos led to in 7,000 steps (fox 268,000, cup 204,000, lego 173,000:
docs/benchmarks.md), in which their set changes so often; fewer in proportion in shorter runs."""
# Longest side of the images, px, from which on that holds; below it goes with the root of the side
USUAL_SIDE = 400
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
_SWAP = "/sys/fs/cgroup/memory.swap.max"
_USED = ("/sys/fs/cgroup/memory.current", "/sys/fs/cgroup/memory/memory.usage_in_bytes")


@dataclass(frozen=True)
class MemoryForecast:
    """Bytes that a run is expected to take at its peak."""

    program: int
    images: int  # that decoded ones will take, in the cache or on their way to it
    drawing: int
    field: int  # of what all Gaussians share: grids and networks of a deformation field
    count: int  # Gaussians that may be expected
    most: int  # Gaussians that the strategy allows
    least: int  # Gaussians that there will certainly be at some time
    each: int
    least_each: int
    # of this machine and this process's limits, next to what is taken already; None: not known
    free: int | None
    # of this machine with its swap, or the limit of its container; None: not known
    whole: int | None
    all_kept: bool  # every image has its place in the cache
    processes: int = 1
    longest_side: int = 0
    on_gpu: bool = False  # it is the memory of a GPU, where images take no more than their share
    # key that limits the number of Gaussians, and its value at ``count`` of them
    limits: tuple[str, int] = ("strategy.max_gaussians", 0)

    @property
    def total(self) -> int:
        return self.program + self.images + self.drawing + self.field + self.count * self.each

    @property
    def certain(self) -> int:
        """What a process takes at least: without the room that an allocator needs, and whatever is
        drawn."""
        return self.program + self.images + self.least * self.least_each

    def __str__(self) -> str:
        limit = "a quarter of it" if self.on_gpu else "data.cache_mb"
        kept = "all kept" if self.all_kept else f"as many as {limit} keeps"
        parts = f"{_gb(self.program)} program, " if self.program else ""
        parts += f"{_gb(self.images)} images ({kept}), {_gb(self.drawing)} drawing, "
        parts += f"{_gb(self.field)} field, " if self.field else ""
        parts += (
            f"{_gb(self.count * self.each)} for some {self.count:,} Gaussians"
            if self.count
            else "no Gaussians"
        )
        if self.most > 2 * self.count:
            parts += f"; {_gb(self.most * self.each)} for the {self.most:,} that strategy.max_gaussians allows"
            room = self._gaussians_that_fit()
            if room is not None and self.count <= room < self.most:
                parts += f", of which {room:,} fit"
        there = "" if self.free is None else f" ({_gb(self.free + self.program)} are there)"
        each = f" in each of {self.processes} processes" if self.processes > 1 else ""
        return f"{self._place}: about {_gb(self.total)} GB{each}{there}: {parts}"

    def warning(self) -> str | None:
        """Return a line where that is likely to be more than is there; what to set to which value
        is in it."""
        if self.free is None or self._growth <= self.free:
            return None
        needed = self.program + self._growth
        there = f"{_gb(self.free + self.program)} are there"
        return f"about {_gb(needed)} GB of {self._place} are needed, and {there}: give {self._advice()}"

    def require_possible(self) -> None:
        """Raise where the run certainly needs more than this machine, or its container, can ever
        give it."""
        needed = self.program + self.processes * (self.certain - self.program)
        if self.whole is None or needed <= self.whole:
            return
        raise DyngsError(
            f"at least {_gb(needed)} GB of {self._place} are needed, and this {'GPU' if self.on_gpu else 'machine'} "
            f"gives {_gb(self.whole)}: give {self._advice()}"
        )

    @property
    def _place(self) -> str:
        return "memory of the GPU" if self.on_gpu else "memory"

    @property
    def _growth(self) -> int:
        """Bytes that all processes on this machine will still take."""
        return self.processes * (self.total - self.program)

    @property
    def _fraction(self) -> int:
        """Bytes that this process may still take."""
        return min(x for x in (self.free, self.whole) if x is not None) // self.processes

    def _gaussians_that_fit(self) -> int | None:
        """Return how many Gaussians there is room for next to the rest; None: not known."""
        if self.free is None:
            return None
        return (
            max(self._fraction - (self.total - self.program - self.count * self.each), 0)
            // self.each
        )

    def _advice(self) -> str:
        """Return the keys to lower, with values that make the run fit, the least that does
        first."""
        rest = self.total - self.program - self.images
        room = 0.95 * self._fraction
        gaussians = self.count * self.each
        if rest < room and not self.on_gpu:
            return f"data.cache_mb={1e-6 * (room - rest):.0f} (images are then decoded again and again)"
        found = []
        left = room - 0.2 * room
        if self.images > 0.2 * room and not self.on_gpu:
            found.append(f"data.cache_mb={0.2e-6 * room:.0f}")
        else:
            left = room - self.images
        fixed = self.drawing + self.field
        if fixed > 0.5 * left and self.drawing and self.longest_side:
            allowed = max(0.5 * left - self.field, 0.05 * left)
            side = int(self.longest_side * (min(allowed / self.drawing, 1.0)) ** 0.5)
            found.append(f"data.longest_side={max(side, 16)}")
            fixed = min(fixed, round(allowed) + self.field)
        if gaussians > left - fixed:
            found.append(self._limit(int(max(left - fixed, 0.05 * left) / self.each)))
        return ", ".join(found) + (" and fewer processes" if self.processes > 1 else "")

    def _limit(self, count: int) -> str:
        key, value = self.limits
        if key == "model.resolution":
            return f"{key}={max(int(value * (count / self.count) ** 0.5), 16)}"
        return f"{key}={max(count, 1)}"


def memory_forecasts(trainer: Trainer, processes: int = 1) -> list[MemoryForecast]:
    """Return the memory that the run of ``trainer``, which has not begun to step, is expected to
    take.

    On a GPU first that of the GPU, with the scene, and then that of the machine, with what stays on
    the CPU.
    """
    whole = memory_forecast(trainer, processes)
    gpu = gpu_memory(trainer.device)
    if gpu is None:
        return [whole]
    free, there = gpu
    on_gpu = replace(
        whole,
        program=0,  # the driver and torch have taken theirs when this is asked
        images=trainer.images.bytes_on_gpu,
        free=free,
        whole=there,
        all_kept=trainer.images.keeps_all_on_gpu,
        processes=-(-processes // num_gpus()),
        on_gpu=True,
    )
    return [on_gpu, replace(whole, drawing=STEP_BYTES, field=0, count=0, most=0, least=0)]


def memory_forecast(trainer: Trainer, processes: int = 1) -> MemoryForecast:
    """Return what ``memory_forecasts`` says of the machine, as if the scene were there."""
    images = trainer.images
    config = trainer.config
    pixels = max((width * height for width, height in images.sizes), default=0)
    files = max((view.width * view.height for view in images.views), default=0)
    waiting = (images.decoded_ahead // 2 or 1) * DECODING_BYTES * files
    now = trainer.num_gaussians
    side = max((max(size) for size in images.sizes), default=0)
    return MemoryForecast(
        program=resident_memory(),
        images=images.bytes_to_come + waiting,
        drawing=STEP_BYTES + DRAWING_BYTES * pixels,
        field=field_bytes(config, len(set(images.times))),
        count=expected_gaussians(config, now, side),
        most=max(config.strategy.growth_limit, now),
        least=now,
        each=gaussian_bytes(config),
        least_each=4 * NEEDED_COPIES * stored_values(config),
        free=free_memory(),
        whole=whole_memory(),
        all_kept=images.keeps_all,
        processes=processes,
        longest_side=side,
        limits=_limit_of_gaussians(config),
    )


def _limit_of_gaussians(config: Config) -> tuple[str, int]:
    made_of = capability(config.model, HasGaussians)
    own = None if made_of is None else made_of.count_limit(config.model)
    if own is not None:
        return own
    match config.strategy:
        case DefaultStrategy() | McmcStrategy():
            return "strategy.max_gaussians", config.strategy.max_gaussians
        case FixedStrategy():
            return "init.num_random", config.init.num_random
        case _:
            assert_never(config.strategy)


def require_room(config: Config) -> None:
    """Raise where the random Gaussians that a run is to begin with cannot fit on this machine."""
    if capability(config.model, HasGaussians) is None:
        return
    whole = whole_memory()
    each = 4 * NEEDED_COPIES * stored_values(config)
    match config.init:
        case RandomInit() if whole is not None and config.init.num_random * each > whole:
            raise DyngsError(
                f"init.num_random={config.init.num_random}: at least {_gb(config.init.num_random * each)} GB of memory "
                f"are needed, and this machine gives {_gb(whole)}: give init.num_random={whole // (2 * each)}"
            )
        case _:
            pass


def stored_values(config: Config) -> int:
    """Return the number of values of a Gaussian that are trained, next to those of a field."""
    return SHAPE_VALUES + 3 * num_sh_terms(config.stored_sh_degree)


def gaussian_bytes(config: Config) -> int:
    """Return the bytes of memory that a Gaussian takes in training, where it moves if anything
    may."""
    made_of = capability(config.model, HasGaussians)
    moving = 0 if made_of is None else made_of.moving_bytes(config.model)
    return 4 * COPIES * stored_values(config) + moving


def field_bytes(config: Config, num_times: int) -> int:
    """Return the bytes of memory of what a model learns next to its Gaussians."""
    made_of = capability(config.model, HasGaussians)
    shared = 0 if made_of is None else made_of.num_shared(config.model, num_times)
    return 4 * FIELD_COPIES * shared


def num_changes(config: Config, steps: int | None = None) -> int:
    """Return how often the set of Gaussians changes in a run, or in its first ``steps``."""
    match config.strategy:
        case DefaultStrategy() | McmcStrategy():
            schedule = densify_schedule(config.strategy, config.train.steps, white_background=False)
            last = min(schedule.stop, config.train.steps if steps is None else steps)
            return sum(schedule.densifies_at(step) for step in range(1, last + 1))
        case FixedStrategy():
            return 0


def expected_gaussians(config: Config, now: int, longest_side: int = USUAL_SIDE) -> int:
    """Return the Gaussians that a run which begins with ``now`` may end with: roughly, before
    anything is seen."""
    match config.strategy:
        case McmcStrategy():
            return _mcmc_gaussians(config, config.strategy, now)
        case _:
            changes = num_changes(config) / USUAL_CHANGES
            detail = min(longest_side / USUAL_SIDE, 1.0) ** 0.5
            usual = round(
                USUAL_GAUSSIANS * detail * (changes if changes < 1 else min(changes, 4.0) ** 0.5)
            )
            return max(now, min(usual, config.strategy.growth_limit)) + _num_added(config)


def _num_added(config: Config) -> int:
    made_of = capability(config.model, HasGaussians)
    return 0 if made_of is None else made_of.num_added(config.model)


def _mcmc_gaussians(config: Config, strategy: McmcStrategy, now: int) -> int:
    """Return how many Gaussians the strategy ends with: each change adds the same share, up to the
    cap."""
    grown = now * (1 + growth_per_change(config.train.steps)) ** min(num_changes(config), 200)
    return max(int(min(strategy.max_gaussians, grown)), now)


def resident_memory() -> int:
    """Return the bytes of memory that this process takes; 0 where that is not known."""
    found = re.search(r"VmRSS:\s+(\d+) kB", _text("/proc/self/status"))
    return 1024 * int(found[1]) if found else 0


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
    memory, swap = (
        re.search(rf"{x}:\s+(\d+) kB", _text("/proc/meminfo")) for x in ("MemTotal", "SwapTotal")
    )
    if memory and swap:
        found.append(1024 * (int(memory[1]) + int(swap[1])))
    limits = [_text(_LIMITS[0]).strip(), _text(_SWAP).strip()]
    if all(text.isdigit() for text in limits):
        found.append(sum(int(text) for text in limits))
    return min(found, default=None)


def free_memory() -> int | None:
    """Return the bytes that this process may still take, by the machine and the limit of its
    container."""
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
