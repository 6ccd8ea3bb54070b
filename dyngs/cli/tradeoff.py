"""``dyngs tradeoff``: PSNR cost, speed and size of each setting of a run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import add_device, computing_device, input_word, output_path, threads
from dyngs.errors import DyngsError, counted

if TYPE_CHECKING:
    from rich.table import Table

    from dyngs.tradeoff.measurements import Measurement
    from dyngs.tradeoff.sweep import ProcessGroup
    from dyngs.tradeoff.table import Goal, Requirement, TableRow
    from dyngs.tradeoff.variant_runs import VariantRuns

_EPILOG = """\
examples:
  dyngs tradeoff runs/dance                                   all settings that need no training -> runs/dance/tradeoff
  dyngs tradeoff runs/dance --vary prune=0.5,0.8 --vary storage --finetune 2000
  dyngs tradeoff runs/dance --require 'psnr>=30,fps>=20,mb<=5' --minimize mb
  dyngs tradeoff configs/static.yaml data.root=scans/bench --out bench_tradeoff     train first; vary colours as well
  torchrun --nproc-per-node 4 -m dyngs tradeoff runs/dance    shared by four processes

An interrupted or repeated command continues and measures only what is missing. Details: docs/tradeoff.md.
"""
WIDTH = 100
"""Columns of the tables where there is no terminal."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``tradeoff`` to the commands."""
    parser = commands.add_parser(
        "tradeoff",
        help="measure quality, speed and size of a run with other settings, and pick the best one",
        description="Vary the settings of a run one at a time and then several together. Writes tradeoff.csv, .json, "
        ".html and, with the extra plots, .svg and .png, and picks the best run that meets requirements.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "target", type=input_word, metavar="RUN_OR_CONFIG", help="run folder, or a config to train first"
    )
    parser.add_argument("overrides", nargs="*", default=[], metavar="key=value", help="overrides of the config")
    parser.add_argument("--out", type=output_path, metavar="DIR", help="output folder (default RUN/tradeoff)")
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="SETTING[=A,B]",
        help="vary only this setting, weaker values first; repeatable (default: all settings)",
    )
    parser.add_argument("--train", action="store_true", help="also vary settings that need training from scratch")
    parser.add_argument(
        "--finetune", type=int, default=0, metavar="N", help="fine-tuning steps after pruning (default: none)"
    )
    parser.add_argument(
        "--combine", type=int, default=4, metavar="N", help="combinations in each of three directions (default 4)"
    )
    parser.add_argument("--split", choices=("test", "val", "train", "pose"), default="test", help="default test")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="renders of each timed view (default 5)")
    parser.add_argument(
        "--require", metavar="LIST", help="requirements such as 'psnr>=30,fps>=20,mb<=5'; writes the best run"
    )
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument(
        "--minimize", metavar="METRIC", help="choose by psnr, ssim, lpips, fps, mb, memory_mb or gaussians"
    )
    goal.add_argument("--maximize", metavar="METRIC", help="likewise (default psnr)")
    parser.add_argument("--threads", type=threads, default=0, metavar="N", help="number of threads, 0 = all cores")
    add_device(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print and write the tables, and choose a run; the folder is locked against other commands."""
    from contextlib import nullcontext

    from dyngs.runs.lock import writing
    from dyngs.tradeoff.sweep import ProcessGroup

    for name, least in (("finetune", 0), ("combine", 0), ("rounds", 1), ("threads", 0)):
        if getattr(arguments, name) < least:
            raise DyngsError(f"--{name} {getattr(arguments, name)}: give a whole number from {least} on")
    target, group = Path(arguments.target), ProcessGroup.from_environment()
    out: Path | None = arguments.out or (target / "tradeoff" if target.is_dir() else None)
    with writing(out) if group.is_first and out is not None else nullcontext():
        return _run(arguments, group)


def _run(arguments: argparse.Namespace, group: ProcessGroup) -> int:
    from rich.console import Console

    from dyngs.tradeoff.plot import MISSING, can_plot
    from dyngs.tradeoff.report import write_report
    from dyngs.tradeoff.sweep import Plan, sweep
    from dyngs.tradeoff.table import parse_goal, parse_requirements, table_rows
    from dyngs.tradeoff.variant_runs import VariantRuns
    from dyngs.tradeoff.variants import parse_variations

    is_run = Path(arguments.target).is_dir()
    variations = parse_variations(arguments.vary, trains=arguments.train or not is_run)
    asked = parse_requirements(arguments.require) if arguments.require is not None else ()
    name = arguments.minimize or arguments.maximize or "psnr"
    goal = parse_goal(name, smallest=arguments.minimize is not None)
    run_dir = Path(arguments.target) if is_run else _trained(arguments, group)
    runs = VariantRuns(
        run_dir, arguments.out or run_dir / "tradeoff", arguments.threads or group.cores, arguments.device
    )
    plan = Plan(
        variations,
        arguments.finetune,
        arguments.combine,
        arguments.split,
        arguments.rounds,
        arguments.threads,
        computing_device(arguments.device),
    )
    try:
        measurements = sweep(runs, plan, print, group)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("finished measurements are kept; the same command continues") from None
    if not group.is_first:
        return 0
    files = write_report(runs.out, measurements)
    console, rows = Console(width=None if sys.stdout.isatty() else WIDTH), table_rows(measurements)
    console.print(_variants_table(rows, measurements[0].num_views))
    console.print(_exchange_table(measurements))
    print(f"written: {files[0]} and {', '.join(file.suffix for file in files[1:])}")
    if not can_plot():
        print(f"note: {MISSING}")
    if arguments.require or arguments.minimize or arguments.maximize:
        _write_best(rows, asked, goal, runs)
    return 0


def _trained(arguments: argparse.Namespace, group: ProcessGroup) -> Path:
    """Train a config to its end in the first process; return the run folder."""
    from dyngs.config.io import find_preset, load_config
    from dyngs.tradeoff.variant_runs import finished

    try:
        config = find_preset(Path(arguments.target))
    except DyngsError as error:
        raise DyngsError(f"{error}; nor is it the folder of a run") from None
    if arguments.out is None:
        raise DyngsError(f"{arguments.target}: give --out DIR; a config is trained there first")
    folder = arguments.out / "run"
    own = [f"run.dir={folder}", f"run.threads={arguments.threads}", f"run.device={arguments.device}"]
    overrides = [*arguments.overrides, *own]
    if group.is_first:
        finished(load_config(config, overrides), folder)
    group.wait()
    return folder


def _variants_table(rows: Sequence[TableRow], num_views: int) -> Table:
    """Return a table of all variants, with fewer columns than the files."""
    optional = ("LPIPS",) if any(row.lpips is not None for row in rows) else ()
    head = ("  changed", "PSNR", "SSIM", *optional, "fps", "speed x", "MB", "RAM MB")
    table = _table(f"{counted(num_views, 'view')}; * Pareto front of PSNR, speed and size", head)
    for row in rows:
        lpips, memory = ("" if x is None else f"{x:.{n}f}" for x, n in ((row.lpips, 4), (row.memory_mb, 0)))
        quality = (f"{row.psnr:.2f}", f"{row.ssim:.4f}", *(lpips for _ in optional))
        name = f"{'* ' if row.on_front else '  '}{row.name}"
        table.add_row(name, *quality, f"{row.fps:.1f}", f"{row.gain:.2f}", f"{row.mb:.2f}", memory)
    return table


def _exchange_table(measurements: Sequence[Measurement]) -> Table:
    """Return a table of the exchange rate of each setting."""
    from dyngs.tradeoff.pareto import exchange_rates
    from dyngs.tradeoff.report import EXCHANGE_HEAD, exchange_cells

    table = _table("each setting alone", EXCHANGE_HEAD)
    for rate in exchange_rates(measurements[0], measurements):
        table.add_row(*exchange_cells(rate))
    return table


def _table(title: str, head: Sequence[str]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(head[0], title=title, box=box.SIMPLE_HEAD)
    for name in head[1:]:
        table.add_column(name, justify="right")
    return table


def _write_best(rows: Sequence[TableRow], asked: tuple[Requirement, ...], goal: Goal, runs: VariantRuns) -> None:
    """Write the best run that meets the requirements and print its metrics."""
    from dyngs.tradeoff.table import choose
    from dyngs.tradeoff.variant_runs import write_chosen

    best = choose(rows, asked, goal)
    folder = write_chosen(runs, best.variant)
    print(f"chosen:  {best.name}: {best.psnr:.2f} dB, {best.fps:.1f} fps, {best.mb:.2f} MB")
    if best.variant.scale < 1:
        print(f"note: rendered at {best.variant.scale:g} of the size; upscale it where it is shown")
    print(f"written: {folder}")
