"""Speed of the rasterizer on this machine, next to a matrix product.

    python benchmarks/rasterize.py [--points NPZ] [--threads N ..] [--repeats N] [--device cuda]

``--points``: points and cameras of gsplat's benchmark; otherwise random points.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from dyngs.cli.output import numbers_table, print_tables
from dyngs.core.camera import Cameras
from dyngs.core.errors import format_count, wrap_read_errors
from dyngs.core.state import move_fields_to
from dyngs.io.numpy_files import read_arrays
from dyngs.ops.native import active_isa, kernel_threads
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions, Tally, TileEntries, bin_tiles, rasterize, tally

T = TypeVar("T")

SGEMM_SIZE = 2048
STAGES = ("project", "bin + sort", "blend", "blend backward", "project backward", "sgemm")


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
        return move_fields_to(self, device)


def garden_workload(path: Path) -> Workload:
    """Read the workload of gsplat's benchmark: points within 2 units of the origin with random
    shapes, first camera."""
    keys = ("means3d", "colors", "viewmats", "Ks", "width", "height")
    data = read_arrays(path, lambda names: [key for key in keys if key in names])
    with wrap_read_errors(path, "give a workload of gsplat's benchmark"):
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


def bench_rasterize(load: Workload, threads: list[int], repeats: int) -> dict[str, Any]:
    """Measure every stage, interleaved over thread counts so that other load affects them alike;
    return the report, whose ``runs`` hold milliseconds.

    A workload on a GPU is timed by CUDA events.
    """
    with torch.no_grad():
        projection = project(
            load.means, load.quats, load.scales, load.opacities, load.cameras, _LIMITS
        )
    opacities = load.opacities[None]
    entries = bin_tiles(projection, opacities, load.size)
    pairs = float(tally(projection, opacities, load.size, Tally.PIXELS).double().sum())
    samples = {count: {name: [] for name in STAGES} for count in threads}
    for repeat in range(repeats + 2):
        for count in threads:
            taken = _time_stages(load, projection, entries, count)
            if repeat >= 2:  # the first two warm up caches and allocator
                for name, seconds in taken.items():
                    samples[count][name].append(1e3 * seconds)
    device = load.means.device
    return {
        "isa": active_isa(),
        "device": "cpu" if device.type == "cpu" else torch.cuda.get_device_name(device),
        "num_gaussians": len(load.means),
        "num_visible": int((projection.radii[0, :, 0] > 0).sum()),
        "width": load.size[0],
        "height": load.size[1],
        "entries": len(entries.gaussians),
        "pairs": int(pairs),
        "runs": [
            {
                "threads": count,
                "milliseconds": {name: statistics.median(x) for name, x in found.items()},
                "fastest": {name: min(x) for name, x in found.items()},
            }
            for count, found in samples.items()
        ],
    }


_LIMITS = ProjectionOptions(near=0.01)


def _time_stages(
    load: Workload, projection: Projection, entries: TileEntries, threads: int
) -> dict[str, float]:
    """Run each stage once and return its seconds."""
    leaves = [x.clone().requires_grad_() for x in (load.means, load.quats, load.scales)]
    splats = [projection.means2d, projection.factors, load.opacities[None], load.colors]
    means2d, factors, opacities, colors = (x.clone().requires_grad_() for x in splats)
    flat = replace(projection, means2d=means2d, factors=factors)
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
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    a = torch.ones(SGEMM_SIZE, SGEMM_SIZE, device=load.means.device)
    timed(lambda: a @ a)  # starts the threads
    seconds["sgemm"], _ = timed(lambda: a @ a)
    torch.set_num_threads(before)
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


def report_cells(report: dict[str, Any]) -> tuple[str, list[str], list[list[str]]]:
    """Return title, head and cells of the table: median and best milliseconds by stage."""
    runs = report["runs"]
    is_cpu = report["device"] == "cpu"
    where = f"instruction set {report['isa']}" if is_cpu else report["device"]
    title = (
        f"{format_count(report['num_gaussians'], 'Gaussian')}, {report['num_visible']:,} visible at "
        f"{report['width']}x{report['height']}, {report['entries']:,} tile entries, "
        f"{report['pairs'] / 1e6:.1f} M blended pairs; {where}"
    )
    head = [
        "median (best) ms",
        *(format_count(run["threads"], "thread") if is_cpu else "cuda" for run in runs),
    ]
    cells = [
        [name, *(f"{run['milliseconds'][name]:.2f} ({run['fastest'][name]:.2f})" for run in runs)]
        for name in STAGES
    ]
    totals = [sum(run["milliseconds"].values()) - run["milliseconds"]["sgemm"] for run in runs]
    cells.append(["all stages", *(f"{total:.2f}" for total in totals)])
    cells.append(["speed-up", *(f"{totals[0] / total:.2f}x" for total in totals)])
    for name in ("blend", "blend backward"):
        rates = (1e-3 * report["pairs"] / run["milliseconds"][name] for run in runs)
        cells.append([f"{name}, M pairs/s", *(f"{rate:.0f}" for rate in rates)])
    rates = (2e-6 * SGEMM_SIZE**3 / run["milliseconds"]["sgemm"] for run in runs)
    cells.append(["sgemm, GFLOP/s", *(f"{rate:.0f}" for rate in rates)])
    return title, head, cells


def main() -> None:
    """Measure the rasterizer and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=Path)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, torch.get_num_threads()])
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    threads = sorted(set(arguments.threads)) if device.type == "cpu" else [1]
    workload = garden_workload(arguments.points) if arguments.points else random_workload()
    report = bench_rasterize(workload.to(device), threads, arguments.repeats)
    print_tables(numbers_table(*report_cells(report)))


if __name__ == "__main__":
    main()
