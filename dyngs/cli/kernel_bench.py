"""Benchmark of the rasterizer, next to a matrix product on the same machine."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import counted, reading
from dyngs.core.state import fields_moved_to
from dyngs.io.numpy_files import read_arrays
from dyngs.io.write import write_text
from dyngs.ops.native import active_isa, kernel_threads
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions, Tally, TileEntries, bin_tiles, rasterize, tally

T = TypeVar("T")

SGEMM_SIZE = 2048
STAGES = ("project", "bin + sort", "blend", "blend backward", "project backward")


@dataclass(frozen=True)
class Workload:
    """N Gaussians, with colours (1, N, 3), and one camera, as inputs of the kernels."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    cameras: Cameras

    @property
    def size(self) -> tuple[int, int]:
        return self.cameras.width, self.cameras.height

    def to(self, device: torch.device) -> Workload:
        """Return the same workload on ``device``."""
        return fields_moved_to(self, device)


@dataclass(frozen=True)
class StageTimes:
    """Median and shortest times by stage, and the rate of a float32 matrix product, at one number
    of threads."""

    threads: int
    milliseconds: dict[str, float]
    fastest: dict[str, float]
    sgemm_gflops: float

    @property
    def total(self) -> float:
        return sum(self.milliseconds.values())


@dataclass(frozen=True)
class RasterizeReport:
    """Results of ``dyngs bench rasterize``.

    Attributes:
        entries, pairs: numbers of (tile, Gaussian) pairs, and of blended (pixel, Gaussian) pairs.
        lanes_used: fraction of the computed pairs that were blended.
        runs: times per number of threads; on a GPU one.
        device: "cpu", or the name of the GPU.
    """

    isa: str
    num_gaussians: int
    num_visible: int
    width: int
    height: int
    entries: int
    pairs: int
    lanes_used: float
    runs: list[StageTimes]
    device: str = "cpu"


def garden_workload(path: Path) -> Workload:
    """Read the workload of gsplat's benchmark: points within 2 units of the origin with random
    shapes, first camera."""
    keys = ("means3d", "colors", "viewmats", "Ks", "width", "height")
    data = read_arrays(path, lambda names: [key for key in keys if key in names])
    with reading(path, "give a workload of gsplat's benchmark"):
        near = (np.abs(data["means3d"]) <= 2).all(axis=1)
        means = torch.from_numpy(data["means3d"][near]).float()
        colors = torch.from_numpy(data["colors"][near]).float()[None] / 255
        view, intrinsics = (torch.from_numpy(data[name][:1]).float() for name in ("viewmats", "Ks"))
        if means.shape[1:] != (3,) or colors.shape[2:] != (3,):
            raise ValueError("means3d and colors must have rows of three")
        if not all(bool(x.isfinite().all()) for x in (colors, view, intrinsics)):
            raise ValueError("a number in it is not finite")
        return _with_random_shapes(
            means, colors, Cameras(view, intrinsics, int(data["width"]), int(data["height"]))
        )


def random_workload(num_gaussians: int = 110_000) -> Workload:
    """Return a similar workload without a file: a plate of random points."""
    generator = torch.Generator("cpu").manual_seed(0)
    size = torch.tensor([4.0, 4.0, 1.0], device="cpu")
    means = (torch.rand(num_gaussians, 3, generator=generator, device="cpu") - 0.5) * size
    view = torch.eye(4, device="cpu")
    view[2, 3] = 3.0
    intrinsics = torch.tensor([[480.0, 0, 324], [0, 480, 210], [0, 0, 1]], device="cpu")
    colors = torch.rand(1, num_gaussians, 3, generator=generator, device="cpu")
    return _with_random_shapes(means, colors, Cameras(view[None], intrinsics[None], 648, 420))


def _with_random_shapes(means: Tensor, colors: Tensor, cameras: Cameras) -> Workload:
    generator = torch.Generator("cpu").manual_seed(42)
    n = len(means)
    scales = torch.rand(n, 3, generator=generator, device="cpu") * 0.02
    quats = torch.nn.functional.normalize(
        torch.randn(n, 4, generator=generator, device="cpu"), dim=-1
    )
    opacities = torch.rand(n, generator=generator, device="cpu")
    return Workload(means, quats, scales, opacities, colors.contiguous(), cameras)


def bench_rasterize(load: Workload, threads: list[int], repeats: int) -> RasterizeReport:
    """Measure every stage, interleaved over thread counts so that other load affects them alike.

    A workload on a GPU is timed by CUDA events.
    """
    with torch.no_grad():
        projection = project(
            load.means, load.quats, load.scales, load.opacities, load.cameras, _LIMITS
        )
    opacities = load.opacities[None]
    entries = bin_tiles(projection, opacities, load.size)
    pairs, lanes = (
        float(tally(projection, opacities, load.size, kind).double().sum())
        for kind in (Tally.PIXELS, Tally.LANES)
    )
    samples = {count: {name: [] for name in (*STAGES, "sgemm")} for count in threads}
    for repeat in range(repeats + 2):
        for count in threads:
            taken = _time_stages(load, projection, entries, count)
            if repeat >= 2:  # the first two warm up caches and allocator
                for name, seconds in taken.items():
                    samples[count][name].append(seconds)
    return RasterizeReport(
        isa=active_isa(),
        num_gaussians=len(load.means),
        num_visible=int((projection.radii[0, :, 0] > 0).sum()),
        width=load.size[0],
        height=load.size[1],
        entries=len(entries.gaussians),
        pairs=int(pairs),
        lanes_used=pairs / max(lanes, 1.0),
        runs=[_summary(count, samples[count]) for count in threads],
        device="cpu"
        if load.means.device.type == "cpu"
        else torch.cuda.get_device_name(load.means.device),
    )


_LIMITS = ProjectionOptions(near=0.01)


def _time_stages(
    load: Workload, projection: Projection, entries: TileEntries, threads: int
) -> dict[str, float]:
    """Run each stage once and return its seconds."""
    leaves = [x.clone().requires_grad_() for x in (load.means, load.quats, load.scales)]
    splats = [projection.means2d, projection.factors, load.opacities[None], load.colors]
    means2d, factors, opacities, colors = (x.clone().requires_grad_() for x in splats)
    flat = Projection(
        means2d, projection.depths, factors, projection.compensations, projection.radii
    )
    seconds: dict[str, float] = {}
    timed = partial(_timed, load.means.device)
    with kernel_threads(threads):
        seconds["project"], projected = timed(
            lambda: project(*leaves, load.opacities, load.cameras, _LIMITS)  # type: ignore[misc]
        )
        seconds["bin + sort"], _ = timed(
            lambda: bin_tiles(projection, load.opacities[None], load.size)
        )
        seconds["blend"], blended = timed(
            lambda: rasterize(
                flat, opacities, colors, load.size, options=BlendOptions(), entries=entries
            )
        )
        grad = torch.ones_like(blended.color)
        seconds["blend backward"], _ = timed(lambda: torch.autograd.backward(blended.color, grad))
        outputs = [projected.means2d, projected.factors, projected.depths]
        grads = [torch.ones_like(x) for x in outputs]
        seconds["project backward"], _ = timed(lambda: torch.autograd.backward(outputs, grads))
    seconds["sgemm"] = _sgemm_seconds(load.means.device, threads)
    return seconds


def _timed(device: torch.device, work: Callable[[], T]) -> tuple[float, T]:
    """Run ``work`` on ``device``; return its seconds and its result."""
    if device.type == "cuda":
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        result = work()
        end.record()
        end.synchronize()
        return 1e-3 * begin.elapsed_time(end), result
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


def _sgemm_seconds(device: torch.device, threads: int) -> float:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    a = torch.ones(SGEMM_SIZE, SGEMM_SIZE, device=device)
    _timed(device, lambda: a @ a)  # starts the threads
    seconds, _ = _timed(device, lambda: a @ a)
    torch.set_num_threads(before)
    return seconds


def _summary(threads: int, samples: dict[str, list[float]]) -> StageTimes:
    milliseconds = {name: 1e3 * statistics.median(samples[name]) for name in STAGES}
    fastest = {name: 1e3 * min(samples[name]) for name in STAGES}
    return StageTimes(
        threads, milliseconds, fastest, 2e-9 * SGEMM_SIZE**3 / statistics.median(samples["sgemm"])
    )


def write_report(report: RasterizeReport, path: Path) -> None:
    write_text(path, json.dumps(asdict(report), indent=2) + "\n")


def format_report(report: RasterizeReport) -> str:
    labels = [
        counted(run.threads, "thread") if report.device == "cpu" else "cuda" for run in report.runs
    ]
    preparing = [
        (run.milliseconds["project"] + run.milliseconds["bin + sort"]) / run.total
        for run in report.runs
    ]
    lines = [
        f"{counted(report.num_gaussians, 'Gaussian')}, {report.num_visible:,} visible at "
        f"{report.width}x{report.height}, {report.entries:,} tile entries, {report.pairs / 1e6:.1f} M blended pairs, "
        f"{report.lanes_used:.0%} of the lanes used; "
        + (f"instruction set {report.isa}" if report.device == "cpu" else report.device),
        f"{'stage, median (best) ms':<26}" + "".join(f"{label:>20}" for label in labels),
    ]
    for name in STAGES:
        cells = [
            f"{run.milliseconds[name]:10.2f} ({run.fastest[name]:6.2f})" for run in report.runs
        ]
        lines.append(f"{name:<26}" + "".join(f"{cell:>20}" for cell in cells))
    rows = [
        ("all stages", [f"{run.total:.2f}" for run in report.runs]),
        ("speed-up", [f"{report.runs[0].total / run.total:.2f}x" for run in report.runs]),
        ("project + bin, fraction", [f"{fraction:.0%}" for fraction in preparing]),
        ("sgemm, GFLOP/s", [f"{run.sgemm_gflops:.0f}" for run in report.runs]),
    ]
    for name in ("blend", "blend backward"):
        rates = [1e-3 * report.pairs / run.milliseconds[name] for run in report.runs]
        rows.append((f"{name}, M pairs/s", [f"{rate:.0f}" for rate in rates]))
        per_flop = [rate / run.sgemm_gflops for rate, run in zip(rates, report.runs, strict=True)]
        rows.append(("  per sgemm GFLOP/s", [f"{x:.2f}" for x in per_flop]))
    lines += [f"{name:<26}" + "".join(f"{cell:>20}" for cell in cells) for name, cells in rows]
    return "\n".join(lines)
