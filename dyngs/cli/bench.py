"""``dyngs bench``: how fast the kernels are on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.errors import DyngsError


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench`` to the commands."""
    parser = commands.add_parser("bench", help="measure the speed of the rasterizer (dyngs bench rasterize)")
    stages = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    raster = stages.add_parser("rasterize", help="projection, binning and blending, forward and backward")
    raster.add_argument("--points", type=Path, metavar="NPZ", help="means3d, colors, viewmats, Ks, width, height")
    raster.add_argument("--threads", type=int, nargs="+", metavar="N", help="default: 1 and all cores")
    raster.add_argument("--repeats", type=int, default=30, metavar="N", help="medians are taken over (default 30)")
    raster.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    raster.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure and print the table."""
    if arguments.repeats < 1 or min(arguments.threads or [1]) < 1:
        raise DyngsError("--repeats and --threads must be at least 1")
    import torch

    from dyngs.bench import bench_rasterize, format_report, garden_workload, random_workload, write_report

    threads = arguments.threads or [1, torch.get_num_threads()]
    workload = garden_workload(arguments.points) if arguments.points else random_workload()
    report = bench_rasterize(workload, sorted(set(threads)), arguments.repeats)
    print(format_report(report))
    if arguments.json:
        write_report(report, arguments.json)
    return 0
