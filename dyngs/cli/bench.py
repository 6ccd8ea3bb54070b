"""``dyngs bench``: speed of the kernels and of training steps on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.cli.arguments import add_device, computing_device, input_path, output_path
from dyngs.errors import DyngsError


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``bench`` to the commands."""
    parser = commands.add_parser("bench", help="measure the speed of the rasterizer or of a deformation field")
    stages = parser.add_subparsers(dest="what", required=True, metavar="WHAT")
    raster = stages.add_parser("rasterize", help="projection, binning and blending, forward and backward")
    raster.add_argument(
        "--points",
        type=input_path,
        metavar="NPZ",
        help="points and cameras of gsplat's benchmark (default: random points)",
    )
    raster.add_argument(
        "--threads", type=int, nargs="+", metavar="N", help="numbers of threads (default: 1 and all cores)"
    )
    raster.add_argument("--repeats", type=int, default=30, metavar="N", help="repetitions (default 30)")
    add_device(raster, "cpu")
    raster.set_defaults(run=run_rasterize)
    deform = stages.add_parser(
        "deform", help="fraction of the field in a training step, with and without the static split"
    )
    deform.add_argument(
        "run_dir",
        type=input_path,
        nargs="?",
        metavar="RUN",
        help="run folder of a dynamic model (default: random Gaussians)",
    )
    deform.add_argument(
        "--kind",
        metavar="KIND",
        default="hexplane",
        help="kind of field if no RUN is given (default hexplane)",
    )
    deform.add_argument(
        "--gaussians",
        type=int,
        default=50_000,
        metavar="N",
        help="number of Gaussians if no RUN is given (default 50000)",
    )
    deform.add_argument(
        "--moving",
        type=float,
        default=0.1,
        metavar="SHARE",
        help="fraction of moving Gaussians if no RUN is given (default 0.1)",
    )
    deform.add_argument("--threads", type=int, metavar="N", help="number of threads (default: all cores)")
    deform.add_argument("--repeats", type=int, default=10, metavar="N", help="repetitions of five steps (default 10)")
    deform.set_defaults(run=run_deform)
    for one in (raster, deform):
        one.add_argument("--json", type=output_path, metavar="FILE", help="write the results as JSON as well")


def run_rasterize(arguments: argparse.Namespace) -> int:
    """Measure the rasterizer and print the table."""
    if arguments.repeats < 1 or min(arguments.threads or [1]) < 1:
        raise DyngsError("--repeats and --threads must be at least 1")
    import torch

    from dyngs.bench.rasterize import bench_rasterize, format_report, garden_workload, random_workload, write_report

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


def run_deform(arguments: argparse.Namespace) -> int:
    """Measure training steps of a dynamic model and print the table."""
    threads = 1 if arguments.threads is None else arguments.threads
    if min(arguments.repeats, arguments.gaussians, threads) < 1 or not 0 < arguments.moving <= 1:
        raise DyngsError("--repeats, --gaussians and --threads must be at least 1, --moving above 0 and at most 1")
    from tempfile import TemporaryDirectory

    import torch

    from dyngs.bench.deform import bench_deform, format_report, load_of_run, synthetic_load, write_report

    threads = arguments.threads or torch.get_num_threads()
    with TemporaryDirectory() as folder:
        if arguments.run_dir is not None:
            load = load_of_run(arguments.run_dir)
        else:
            load = synthetic_load(Path(folder), arguments.gaussians, arguments.moving, arguments.kind)
        report = bench_deform(load, threads, arguments.repeats)
    print(format_report(report))
    if arguments.json:
        write_report(report, arguments.json)
    return 0
