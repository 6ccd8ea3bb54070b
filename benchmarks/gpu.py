"""Rendering on a CUDA card, forward and backward, beside gsplat where it is installed.

    python benchmarks/gpu.py [--points garden.npz] [--gaussians 110000] [--repeats 50]

Both are called with the same arguments (gsplat 1.5's ``rasterization``; dyngs has its signature). Times are medians of
CUDA events after a tenth as many calls that do not count, of a card that nothing else uses. Memory is the most that
torch had allocated during a call. Without a card that can be used it says why in one line and measures nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib import import_module, util
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from dyngs.bench.rasterize import Workload, garden_workload, random_workload
from dyngs.compat import rasterization
from dyngs.ops.device import why_no_card

Rasterize = Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]


def on_card(workload: Workload) -> dict[str, Any]:
    """The arguments of ``rasterization``, with tensors that collect gradients."""
    cameras = workload.cameras
    trained = {
        "means": workload.means,
        "quats": workload.quats,
        "scales": workload.scales,
        "opacities": workload.opacities,
        "colors": workload.colors[0],
    }
    arguments: dict[str, Any] = {name: x.to("cuda").requires_grad_() for name, x in trained.items()}
    arguments |= {"viewmats": cameras.cam_from_world.to("cuda"), "Ks": cameras.intrinsics.to("cuda")}
    return arguments | {"width": cameras.width, "height": cameras.height, "near_plane": 0.2, "packed": False}


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


def measured(name: str, rasterize: Rasterize, arguments: dict[str, Any], repeats: int) -> str:
    """A line about one rasterizer: milliseconds forward, with backward, and megabytes."""
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
    return f"{name:12s} forward {first:8.3f} ms   forward and backward {second:8.3f} ms   {megabytes:8.0f} MB"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=Path, metavar="NPZ", help="points and cameras of gsplat's benchmark")
    parser.add_argument("--gaussians", type=int, default=110_000, metavar="N", help="random ones without --points")
    parser.add_argument("--repeats", type=int, default=50, metavar="N")
    options = parser.parse_args()
    reason = why_no_card()
    if reason is not None:
        print(f"nothing measured: {reason}")
        return
    workload = garden_workload(options.points) if options.points else random_workload(options.gaussians)
    arguments = on_card(workload)
    print(
        f"{torch.cuda.get_device_name()}, {len(workload.means):,} Gaussians, {workload.size[0]}x{workload.size[1]} px"
    )
    print(measured("dyngs", rasterization, arguments, options.repeats))
    if util.find_spec("gsplat") is None:
        print("gsplat is not installed: pip install gsplat==1.5.3")
    else:
        print(measured("gsplat", import_module("gsplat").rasterization, arguments, options.repeats))


if __name__ == "__main__":
    main()
