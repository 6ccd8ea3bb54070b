"""``dyngs bench``: speed of the kernels on this machine."""

from __future__ import annotations

import argparse
import json

from dyngs.cli.arguments import (
    Commands,
    add_command,
    add_device,
    add_json,
    computing_device,
    input_path,
    whole,
)
from dyngs.cli.output import numbers_table, print_tables


def add_parser(commands: Commands) -> None:
    parser = commands.add_parser("bench", help="measure the speed of the rasterizer")
    stages = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    about = "projection, binning and blending, forward and backward"
    parser = add_command(stages, "rasterize", run_rasterize, about)
    points = "points and cameras of gsplat's benchmark (default: random points)"
    parser.add_argument("--points", type=input_path, metavar="NPZ", help=points)
    threads = "numbers of threads (default: 1 and all cores)"
    kind = whole("a number of threads", 1, 1024)
    parser.add_argument("--threads", type=kind, nargs="+", metavar="N", help=threads)
    kind = whole("a number of repetitions", 1, 10**6)
    parser.add_argument(
        "--repeats", type=kind, default=30, metavar="N", help="repetitions (default 30)"
    )
    add_device(parser, "cpu")
    add_json(parser)


def run_rasterize(arguments: argparse.Namespace) -> int:
    """Measure the rasterizer and print the table."""
    import torch

    from dyngs.cli.kernel_bench import (
        bench_rasterize,
        garden_workload,
        random_workload,
        report_cells,
    )

    device = computing_device(arguments.device)
    threads = arguments.threads or [1, torch.get_num_threads()]
    if device.type != "cpu":
        threads = [1]
    workload = garden_workload(arguments.points) if arguments.points else random_workload()
    report = bench_rasterize(workload.to(device), sorted(set(threads)), arguments.repeats)
    if arguments.json:
        print(json.dumps(report, indent=2))
    else:
        print_tables(numbers_table(*report_cells(report)))
    return 0
