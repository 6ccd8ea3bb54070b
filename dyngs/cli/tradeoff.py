"""``dyngs tradeoff``: what each knob of a run costs in quality and brings in speed and size."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import threads
from dyngs.errors import DyngsError

if TYPE_CHECKING:
    from dyngs.tradeoff.distributed import ProcessGroup
    from dyngs.tradeoff.measurements import Measurement
    from dyngs.tradeoff.requirements import Goal, Requirement
    from dyngs.tradeoff.variant_runs import VariantRuns

_EPILOG = """\
examples:
  dyngs tradeoff runs/dance                                   all knobs that need no training -> runs/dance/tradeoff
  dyngs tradeoff runs/dance --vary prune=0.5,0.8 --vary storage --finetune 2000
  dyngs tradeoff runs/dance --require 'psnr>=30,fps>=20,mb<=5' --minimize mb
  dyngs tradeoff configs/static.yaml data.root=scans/bench --out bench_tradeoff     trained first; colours, too
  torchrun --nproc-per-node 4 -m dyngs tradeoff runs/dance    shared by four processes

Interrupted or repeated, the same command goes on and measures only what lacks. What is measured: docs/tradeoff.md.
"""
WIDTH = 100
"""Columns of tables where there is no terminal."""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``tradeoff`` to the commands."""
    parser = commands.add_parser(
        "tradeoff",
        help="what each knob of a run costs in quality and brings in speed and size",
        description="Vary a run one knob at a time and then several together; writes tradeoff.csv, .json, .svg, .png "
        "and .html, and picks the best run within limits.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("target", metavar="RUN_OR_CONFIG", help="a run folder, or a config that is trained first")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="for a config")
    parser.add_argument("--out", type=Path, metavar="DIR", help="for all that is made (default RUN/tradeoff)")
    parser.add_argument(
        "--vary",
        action="append",
        default=[],
        metavar="KNOB[=A,B]",
        help="only this knob, mild values first; repeatable",
    )
    parser.add_argument("--train", action="store_true", help="knobs that train the run anew, too")
    parser.add_argument("--finetune", type=int, default=0, metavar="N", help="steps after pruning (default: none)")
    parser.add_argument(
        "--combine", type=int, default=4, metavar="N", help="combinations in each direction (default 4)"
    )
    parser.add_argument("--split", choices=("test", "val", "train", "pose"), default="test")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="drawings of each timed view (default 5)")
    parser.add_argument("--require", metavar="LIST", help="for instance 'psnr>=30,fps>=20,mb<=5'; writes the best run")
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument("--minimize", metavar="FIGURE", help="what is best: psnr, ssim, lpips, fps, mb, memory_mb, ...")
    goal.add_argument("--maximize", metavar="FIGURE", help="(default psnr)")
    parser.add_argument("--threads", type=threads, default=0, metavar="N", help="0 = all cores")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print, write, choose; the first of several processes keeps others out of the folder."""
    from contextlib import nullcontext

    from dyngs.runs.lock import writing
    from dyngs.tradeoff.distributed import ProcessGroup

    for name, least in (("finetune", 0), ("combine", 0), ("rounds", 1), ("threads", 0)):
        if getattr(arguments, name) < least:
            raise DyngsError(f"--{name} {getattr(arguments, name)}: give a whole number from {least} on")
    target, ranks = Path(arguments.target), ProcessGroup.from_environment()
    out: Path | None = arguments.out or (target / "tradeoff" if target.is_dir() else None)
    with writing(out) if ranks.is_first and out is not None else nullcontext():
        return _run(arguments, ranks)


def _run(arguments: argparse.Namespace, ranks: ProcessGroup) -> int:
    from rich.console import Console

    from dyngs.tradeoff.report import write_report
    from dyngs.tradeoff.requirements import parse_goal, parse_requirements
    from dyngs.tradeoff.sweep import Plan, sweep
    from dyngs.tradeoff.variant_runs import VariantRuns
    from dyngs.tradeoff.variants import parse_variations

    is_run = Path(arguments.target).is_dir()
    settings = parse_variations(arguments.vary, trains=arguments.train or not is_run)
    asked = parse_requirements(arguments.require) if arguments.require is not None else ()
    name = arguments.minimize or arguments.maximize or "psnr"
    goal = parse_goal(name, smallest=arguments.minimize is not None)
    run_dir = Path(arguments.target) if is_run else _trained(arguments, ranks)
    models = VariantRuns(run_dir, arguments.out or run_dir / "tradeoff", arguments.threads or ranks.cores)
    plan = Plan(settings, arguments.finetune, arguments.combine, arguments.split, arguments.rounds, arguments.threads)
    try:
        points = sweep(models, plan, print, ranks)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("what was measured is kept; the same command goes on") from None
    if not ranks.is_first:
        return 0
    files = write_report(models.out, points)
    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    for table in _tables(points):
        console.print(table)
    print(f"written: {files[0]} and {', '.join(file.suffix for file in files[1:])}")
    if arguments.require or arguments.minimize or arguments.maximize:
        _choose(points, asked, goal, models)
    return 0


def _trained(arguments: argparse.Namespace, ranks: ProcessGroup) -> Path:
    """The run folder of a config, trained to its end by the first process."""
    from dyngs.config.io import find_preset, load_config
    from dyngs.tradeoff.variant_runs import finished

    try:
        config = find_preset(Path(arguments.target))
    except DyngsError as error:
        raise DyngsError(f"{error}; nor is it the folder of a run") from None
    if arguments.out is None:
        raise DyngsError(f"{arguments.target}: give --out DIR; a config is trained there first")
    folder = arguments.out / "run"
    overrides = [*arguments.overrides, f"run.dir={folder}", f"run.threads={arguments.threads}"]
    if ranks.is_first:
        finished(load_config(config, overrides), folder)
    ranks.wait()
    return folder


def _tables(points: list[Measurement]) -> list[object]:
    """Points and exchange rates, for people; the files have more."""
    from rich import box
    from rich.table import Table

    from dyngs.tradeoff.pareto import exchange_rates
    from dyngs.tradeoff.report import EXCHANGE_HEAD, exchange_cells, rows_of

    def table(title: str, head: Sequence[str]) -> Table:
        empty = Table(head[0], title=title, box=box.SIMPLE_HEAD)
        for name in head[1:]:
            empty.add_column(name, justify="right")
        return empty

    title = f"{points[0].num_views} views; * beaten by no other in PSNR, speed and size"
    rows = rows_of(points)
    optional = ("LPIPS",) if any(row.lpips is not None for row in rows) else ()
    shown = table(title, ("  changed", "PSNR", "SSIM", *optional, "fps", "speed x", "MB", "RAM MB"))
    for row in rows:
        lpips, memory = ("" if x is None else f"{x:.{n}f}" for x, n in ((row.lpips, 4), (row.memory_mb, 0)))
        quality = (f"{row.psnr:.2f}", f"{row.ssim:.4f}", *(lpips for _ in optional))
        name = f"{'* ' if row.on_front else '  '}{row.name}"
        shown.add_row(name, *quality, f"{row.fps:.1f}", f"{row.gain:.2f}", f"{row.mb:.2f}", memory)
    prices = table("each knob alone", EXCHANGE_HEAD)
    for exchange in exchange_rates(points[0], points):
        prices.add_row(*exchange_cells(exchange))
    return [shown, prices]


def _choose(points: list[Measurement], asked: tuple[Requirement, ...], goal: Goal, models: VariantRuns) -> None:
    """Write the best run and say what it is like."""
    from dyngs.tradeoff.requirements import choose
    from dyngs.tradeoff.sweep import figures_of
    from dyngs.tradeoff.variant_runs import write_chosen

    best = choose(figures_of(points), asked, goal)
    folder = write_chosen(models, best.variant)
    print(f"chosen:  {best.variant.name}: {best.psnr:.2f} dB, {best.fps:.1f} fps, {best.mb:.2f} MB")
    if best.variant.scale < 1:
        print(f"note: drawn at {best.variant.scale:g} of the size; to be enlarged where it is shown")
    print(f"written: {folder}")
