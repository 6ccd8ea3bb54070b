"""Rendering on a CUDA GPU, forward and backward, beside gsplat where it is installed.

    python benchmarks/gpu.py [--points garden.npz | --splat FILE] [--gaussians N ..] [--sizes WxH
    ..] [--repeats 50]

Both are called with the same arguments (gsplat 1.5's ``rasterization``; dyngs has its signature),
and how far their images are apart is printed. Times are medians of CUDA events after a tenth as
many calls that do not count, of a GPU that nothing else uses. Memory is the most that torch had
allocated during a call. Without a GPU that can be used it says why in one line and measures
nothing.

The workload of gsplat's benchmark, 1 and 5 million Gaussians, and a file at three sizes:

    python benchmarks/gpu.py --points garden_points.npz --gaussians 110000 1000000 5000000
    python benchmarks/gpu.py --splat scene.ply --sizes 800x800 1920x1080 3840x2160
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import import_module, util
from pathlib import Path
from statistics import median
from typing import Any

import torch
from rasterize import Workload, garden_workload, random_workload
from torch import Tensor

from dyngs.compat.rendering import rasterization
from dyngs.core.camera import Cameras
from dyngs.export.orbits import frame_orbit_for_points
from dyngs.io.formats.formats import read_splats
from dyngs.io.formats.similarity import parse_axis
from dyngs.ops.device import gpu_unavailable_reason

Rasterize = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]
Arguments = dict[str, Any]

JITTER = 0.01
"""Standard deviation of the shifts of copies, world units, where points are repeated."""


def repeated(workload: Workload, count: int) -> Workload:
    """``count`` Gaussians: copies of the workload's, each shifted a little."""
    rows = torch.arange(count) % len(workload.means)
    shift = JITTER * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    shift[: len(workload.means)] = 0
    names = ("means", "quats", "scales", "opacities")
    found = {name: getattr(workload, name)[rows] for name in names}
    return replace(
        workload, **found | {"means": found["means"] + shift}, colors=workload.colors[:, rows]
    )


def resized(cameras: Cameras, width: int, height: int) -> Cameras:
    """The same cameras with images of another size: the shorter side shows as much as before."""
    scale = min(width, height) / min(cameras.width, cameras.height)
    lens = cameras.intrinsics.clone()
    lens[:, :2] *= scale
    lens[:, 0, 2] = width / 2
    lens[:, 1, 2] = height / 2
    return Cameras(cameras.cam_from_world, lens, width, height)


def of_workload(workload: Workload) -> Arguments:
    """The arguments of ``rasterization``, on the CPU."""
    names = ("means", "quats", "scales", "opacities")
    trained = {name: getattr(workload, name) for name in names} | {"colors": workload.colors[0]}
    return trained | seen_by(workload.cameras)


def of_file(path: Path, size: tuple[int, int]) -> Arguments:
    """The same of a file of Gaussians, seen from a little above."""
    file = read_splats(path, nonfinite="skip")
    splat = file.gaussians
    cameras = frame_orbit_for_points(
        splat.means.double().numpy(), 1, size, parse_axis(file.up or "z")
    )
    trained = {
        "means": splat.means,
        "quats": splat.quats,
        "scales": splat.log_scales.exp(),
        "opacities": splat.logit_opacities.sigmoid(),
        "colors": splat.sh,
    }
    return trained | seen_by(cameras) | {"sh_degree": splat.sh_degree}


def seen_by(cameras: Cameras) -> Arguments:
    """The arguments that say what is seen."""
    size = {"width": cameras.width, "height": cameras.height, "near_plane": 0.2, "packed": False}
    return {"viewmats": cameras.cam_from_world, "Ks": cameras.intrinsics} | size


def on_gpu(arguments: Arguments) -> Arguments:
    """The same on the GPU; Gaussians collect gradients."""
    fixed = ("viewmats", "Ks")
    return {
        name: x.to("cuda").requires_grad_(name not in fixed) if isinstance(x, Tensor) else x
        for name, x in arguments.items()
    }


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """The median over ``repeats`` calls, by CUDA events."""
    times = []
    for i in range(-max(repeats // 10, 3), repeats):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        call()
        end.record()
        end.synchronize()
        if i >= 0:
            times.append(begin.elapsed_time(end))
    return median(times)


def measured(
    name: str, rasterize: Rasterize, arguments: Arguments, repeats: int
) -> tuple[str, Tensor]:
    """A line about one rasterizer, milliseconds forward, with backward, and megabytes; and its
    image."""
    leaves = [x for x in arguments.values() if isinstance(x, Tensor) and x.requires_grad]

    def forward() -> Tensor:
        with torch.no_grad():
            return rasterize(**arguments)[0]

    def both() -> None:
        torch.autograd.grad(rasterize(**arguments)[0].sum(), leaves)

    first = milliseconds(forward, repeats)
    torch.cuda.reset_peak_memory_stats()
    second = milliseconds(both, repeats)
    megabytes = torch.cuda.max_memory_allocated() / 1e6
    line = f"{name:12s} forward {first:8.3f} ms   forward and backward {second:8.3f} ms   {megabytes:8.0f} MB"
    return line, forward()


def compared(arguments: Arguments, repeats: int) -> None:
    """Measure and print one workload."""
    size = f"{arguments['width']}x{arguments['height']} px"
    print(f"{torch.cuda.get_device_name()}, {len(arguments['means']):,} Gaussians, {size}")
    line, ours = measured("dyngs", rasterization, arguments, repeats)
    print(line)
    if util.find_spec("gsplat") is None:
        print("gsplat is not installed: pip install gsplat==1.5.3")
        return
    line, theirs = measured("gsplat", import_module("gsplat").rasterization, arguments, repeats)
    apart = (ours - theirs).abs()
    print(
        f"{line}\nimages differ by {float(apart.max()):.1e} at most, {float(apart.mean()):.1e} on average\n"
    )


def workloads(options: argparse.Namespace) -> Iterator[Arguments]:
    """Everything that was asked for."""
    sizes = [tuple(int(side) for side in text.split("x")) for text in options.sizes]
    if options.splat is not None:
        for width, height in sizes or [(800, 800)]:
            yield of_file(options.splat, (width, height))
        return
    given = garden_workload(options.points) if options.points else random_workload()
    for count in options.gaussians or [len(given.means)]:
        for width, height in sizes or [given.size]:
            made = repeated(given, count)
            yield of_workload(replace(made, cameras=resized(made.cameras, width, height)))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--points", type=Path, metavar="NPZ", help="points and cameras of gsplat's benchmark"
    )
    parser.add_argument("--splat", type=Path, metavar="FILE", help="a file of Gaussians instead")
    parser.add_argument(
        "--gaussians", type=int, nargs="+", metavar="N", help="repeat the points to so many"
    )
    parser.add_argument("--sizes", nargs="+", default=[], metavar="WxH", help="of the image, px")
    parser.add_argument("--repeats", type=int, default=50, metavar="N")
    options = parser.parse_args()
    reason = gpu_unavailable_reason()
    if reason is not None:
        print(f"nothing measured: {reason}")
        return
    for arguments in workloads(options):
        compared(on_gpu(arguments), options.repeats)


if __name__ == "__main__":
    main()
