"""``dyngs tradeoff``: PSNR cost, speed and size of each setting of a run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import numbers_table, print_tables
from dyngs.core.errors import DyngsError, counted, show

if TYPE_CHECKING:
    from rich.table import Table

    from dyngs.study.tradeoff.measure import Measurement
    from dyngs.study.tradeoff.table import TableRow

_EPILOG = """\
examples:
  dyngs tradeoff runs/dance                                   all settings that need no training -> runs/dance/tradeoff
  dyngs tradeoff runs/dance --vary prune=0.5,0.8 --vary storage --finetune 2000
  dyngs tradeoff runs/dance --require 'psnr>=30,fps>=20,mb<=5' --minimize mb
  dyngs tradeoff configs/static.yaml data.root=scans/bench --out bench_tradeoff     train first; vary colours as well

An interrupted or repeated command continues and measures only what is missing. Details: docs/tradeoff.md.
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "tradeoff",
        run,
        "measure quality, speed and size of a run with other settings, and pick the best one",
        "Vary the settings of a run one at a time and then several together. Writes tradeoff.csv, .json, .html and, "
        "with the extra plots, .svg and .png, and picks the best run that meets requirements.",
        _EPILOG,
    )
    target = "run folder, or a config to train first"
    parser.add_argument("target", type=args.input_word, metavar="RUN_OR_CONFIG", help=target)
    args.add_overrides(parser, "key=value", "overrides of the config")
    parser.add_argument(
        "--out", type=args.output_path, metavar="DIR", help="output folder (default RUN/tradeoff)"
    )
    vary = "vary only this setting, weaker values first; repeatable (default: all settings)"
    parser.add_argument("--vary", action="append", default=[], metavar="SETTING[=A,B]", help=vary)
    parser.add_argument(
        "--train", action="store_true", help="also vary settings that need training from scratch"
    )
    for name, low, default, about in (
        ("finetune", 0, 0, "fine-tuning steps after pruning (default: none)"),
        ("combine", 0, 4, "combinations in each of three directions (default 4)"),
        ("rounds", 1, 5, "renders of each timed view (default 5)"),
    ):
        kind = args.whole("a number", low, 10**9)
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=about)
    args.add_split(parser)
    require = "requirements such as 'psnr>=30,fps>=20,mb<=5'; writes the best run"
    parser.add_argument("--require", metavar="LIST", help=require)
    goal = parser.add_mutually_exclusive_group()
    metrics = "choose by psnr, ssim, lpips, fps, mb, memory_mb or gaussians"
    goal.add_argument("--minimize", metavar="METRIC", help=metrics)
    goal.add_argument("--maximize", metavar="METRIC", help="likewise (default psnr)")
    args.add_threads(parser)
    args.add_device(parser)
    args.add_ray(parser)


def run(arguments: argparse.Namespace) -> int:
    """Measure, print and write the tables, and choose a run; the folder is locked against other
    commands."""
    from contextlib import nullcontext

    from dyngs.io.lock import writing

    target = Path(arguments.target)
    out: Path | None = arguments.out or (target / "tradeoff" if target.is_dir() else None)
    with nullcontext() if out is None else writing(out):
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    from dyngs.study.plots import MISSING, can_plot
    from dyngs.study.tradeoff.pareto import exchange_rates
    from dyngs.study.tradeoff.report import EXCHANGE_HEAD, exchange_cells, write_report
    from dyngs.study.tradeoff.sweep import Plan, sweep
    from dyngs.study.tradeoff.table import choose, parse_goal, parse_requirements, table_rows
    from dyngs.study.tradeoff.variant_runs import VariantRuns, write_chosen
    from dyngs.study.tradeoff.variants import parse_variations

    is_run = Path(arguments.target).is_dir()
    variations = parse_variations(arguments.vary, trains=arguments.train or not is_run)
    requirements = parse_requirements(arguments.require) if arguments.require is not None else ()
    goal = parse_goal(
        arguments.minimize or arguments.maximize or "psnr", smallest=arguments.minimize is not None
    )
    run_dir = Path(arguments.target) if is_run else _trained(arguments)
    runs = VariantRuns(
        run_dir, arguments.out or run_dir / "tradeoff", arguments.threads, arguments.device
    )
    plan = Plan(
        variations,
        arguments.finetune,
        arguments.combine,
        arguments.split,
        arguments.rounds,
        args.computing_device(arguments.device),
        arguments.ray,
    )
    try:
        measurements = sweep(runs, plan, show)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            "finished measurements are kept; the same command continues"
        ) from None
    files = write_report(runs.out, measurements)
    rows = table_rows(measurements)
    rates = exchange_rates(measurements[0], measurements)
    alone = numbers_table(
        "each setting alone", EXCHANGE_HEAD, [exchange_cells(rate) for rate in rates]
    )
    print_tables(_variants_table(rows, measurements), alone)
    print(f"written: {files[0]} and {', '.join(file.suffix for file in files[1:])}")
    if not can_plot():
        print(f"note: {MISSING}")
    if arguments.require or arguments.minimize or arguments.maximize:
        best = choose(rows, requirements, goal)
        folder = write_chosen(runs, best.variant)
        print(f"chosen:  {best.name}: {best.psnr:.2f} dB, {best.fps:.1f} fps, {best.mb:.2f} MB")
        if best.variant.scale < 1:
            print(
                f"note: rendered at {best.variant.scale:g} of the size; upscale it where it is shown"
            )
        print(f"written: {folder}")
    return 0


def _trained(arguments: argparse.Namespace) -> Path:
    """Train a config to its end; return the run folder."""
    from dyngs.config.io import find_preset, load_config
    from dyngs.study.runs import finished

    try:
        config = find_preset(Path(arguments.target))
    except DyngsError as error:
        raise DyngsError(f"{error}; nor is it the folder of a run") from None
    if arguments.out is None:
        raise DyngsError(f"{arguments.target}: give --out DIR; a config is trained there first")
    folder = arguments.out / "run"
    own = [
        f"run.dir={folder}",
        f"run.threads={arguments.threads}",
        f"run.device={arguments.device}",
    ]
    return finished(load_config(config, [*arguments.overrides, *own]), folder)


def _variants_table(rows: Sequence[TableRow], measurements: Sequence[Measurement]) -> Table:
    """Return a table of all variants, with fewer columns than the files."""
    optional = ("LPIPS",) if any(row.lpips is not None for row in rows) else ()
    head = ("  changed", "PSNR", "SSIM", *optional, "fps", "speed x", "MB", "RAM MB")
    cells = []
    for row in rows:
        lpips, memory = (
            "" if x is None else f"{x:.{n}f}" for x, n in ((row.lpips, 4), (row.memory_mb, 0))
        )
        quality = (f"{row.psnr:.2f}", f"{row.ssim:.4f}", *(lpips for _ in optional))
        name = f"{'* ' if row.on_front else '  '}{row.name}"
        cells.append((name, *quality, f"{row.fps:.1f}", f"{row.gain:.2f}", f"{row.mb:.2f}", memory))
    return numbers_table(
        f"{counted(measurements[0].num_views, 'view')}; * Pareto front of PSNR, speed and size",
        head,
        cells,
    )
