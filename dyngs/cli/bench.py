"""``dyngs bench``: speed of the kernels on this machine."""

from __future__ import annotations

import argparse

from dyngs.cli.arguments import (
    Commands,
    add_command,
    add_device,
    computing_device,
    input_path,
    output_path,
    whole,
)


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
    parser.add_argument(
        "--json", type=output_path, metavar="FILE", help="write the results as JSON as well"
    )


def run_rasterize(arguments: argparse.Namespace) -> int:
    """Measure the rasterizer and print the table."""
    import torch

    from dyngs.cli.kernel_bench import (
        bench_rasterize,
        format_report,
        garden_workload,
        random_workload,
        write_report,
    )

    device = computing_device(arguments.device)
    threads = arguments.threads or [1, torch.get_num_threads()]
    if device.type != "cpu":
        threads = [1]
    workload = garden_workload(arguments.points) if arguments.points else random_workload()
    report = bench_rasterize(workload.to(device), sorted(set(threads)), arguments.repeats)
    print(format_report(report))
    if arguments.json:
        write_report(report, arguments.json)
    return 0
