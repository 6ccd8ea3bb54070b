"""``dyngs compare``: several models on one capture. ``dyngs tradeoff``: the
PSNR cost, speed and size of each setting of a run."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import (
    numbers_table,
    print_lines,
    print_notes,
    print_tables,
    results_alone,
)
from dyngs.core.errors import DyngsError, counted

if TYPE_CHECKING:
    from dyngs.study.report import Report

_COMPARE = """\
examples:
  dyngs compare scans/bench --models static,mip,static_mcmc --minutes 2       -> compare/bench
  dyngs compare scans/dance --models static,dynamic,mine.yaml --steps 7000 data.longest_side=400
  dyngs compare scans/bench --models static,mip --max-mb 2 --out study

Each model is a preset or a YAML file. An interrupted command continues when it is given again. Details: docs/cli.md.
"""
_TRADEOFF = """\
examples:
  dyngs tradeoff runs/dance                                   all settings that need no training -> runs/dance/tradeoff
  dyngs tradeoff runs/dance --vary prune=0.5,0.8 --vary storage --finetune 2000
  dyngs tradeoff runs/dance --require 'psnr>=30,fps>=20,mb<=5' --minimize mb
  dyngs tradeoff configs/static.yaml data.root=scans/bench --out bench_tradeoff     train first; vary colours as well

An interrupted or repeated command continues and measures only what is missing. Details: docs/tradeoff.md.
"""
_CONTINUES = "what is finished is kept; the same command continues"


def add_parser(commands: args.Commands) -> None:
    """Add ``dyngs compare``."""
    parser = args.add_command(
        commands,
        "compare",
        run_compare,
        "train several models on one capture with the same time, steps or size, and compare them",
        "Train each model on the same views and evaluate all on the same held-out ones. Writes comparison.csv, .json, "
        ".md, a page with synchronised crops (.html) and, with the extra plots, quality over seconds (.svg, .png).",
        _COMPARE,
    )
    about = "capture with cameras, in any format"
    parser.add_argument("capture", type=args.input_path, metavar="CAPTURE", help=about)
    args.add_overrides(parser, "key=value", "overrides for all models")
    names = "presets and YAML files, separated by commas"
    parser.add_argument("--models", type=_names, required=True, metavar="A,B,...", help=names)
    limit = parser.add_mutually_exclusive_group()
    about = "train each for so many minutes"
    limit.add_argument("--minutes", type=_positive, metavar="M", help=about)
    kind = args.whole("a number of steps", 1, 10**8)
    limit.add_argument("--steps", type=kind, metavar="N", help="or so many steps")
    about = "or to a file of at most so many 1e6 bytes"
    limit.add_argument("--max-mb", type=_positive, metavar="MB", help=about)
    kind = args.whole("a number of views", 1, 20)
    about = "views on the page (default 4)"
    parser.add_argument("--views", type=kind, default=4, metavar="N", help=about)
    _add_common(parser, "compare/CAPTURE")


def add_tradeoff_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "tradeoff",
        run_tradeoff,
        "measure quality, speed and size of a run with other settings, and pick the best one",
        "Vary the settings of a run one at a time and then several together. Writes tradeoff.csv, .json, .md, .html "
        "and, with the extra plots, .svg and .png, and picks the best run that meets requirements.",
        _TRADEOFF,
    )
    target = "run folder, or a config to train first"
    parser.add_argument("target", type=args.input_word, metavar="RUN_OR_CONFIG", help=target)
    args.add_overrides(parser, "key=value", "overrides of the config")
    vary = "vary only this setting, weaker values first; repeatable (default: all settings)"
    parser.add_argument("--vary", action="append", default=[], metavar="SETTING[=A,B]", help=vary)
    about = "also vary settings that need training from scratch"
    parser.add_argument("--train", action="store_true", help=about)
    for name, low, default, about in (
        ("finetune", 0, 0, "fine-tuning steps after pruning (default: none)"),
        ("combine", 0, 4, "combinations in each of three directions (default 4)"),
        ("rounds", 1, 5, "renders of each timed view (default 5)"),
    ):
        kind = args.whole("a number", low, 10**9)
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=about)
    require = "requirements such as 'psnr>=30,fps>=20,mb<=5'; writes the best run"
    parser.add_argument("--require", metavar="LIST", help=require)
    goal = parser.add_mutually_exclusive_group()
    metrics = "choose by psnr, ssim, lpips, fps, mb, memory_mb or gaussians"
    goal.add_argument("--minimize", metavar="METRIC", help=metrics)
    goal.add_argument("--maximize", metavar="METRIC", help="likewise (default psnr)")
    _add_common(parser, "RUN/tradeoff")


def _add_common(parser: argparse.ArgumentParser, out: str) -> None:
    about = f"output folder (default {out})"
    parser.add_argument("--out", type=args.output_path, metavar="DIR", help=about)
    args.add_split(parser)
    args.add_threads(parser)
    args.add_device(parser)
    about = (
        "do several at once by Ray (pip install 'dyngs[ray]'), with so many cores for each, on this machine or the "
        "cluster of RAY_ADDRESS, whose machines must share the files"
    )
    kind = args.whole("a number of cores", 1, 1024)
    parser.add_argument("--ray", type=kind, metavar="CORES", help=about)
    args.add_json(parser)


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise argparse.ArgumentTypeError(
            f"{text!r} has an empty name; write for instance static,mip"
        )
    return names


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not possible; write a number above 0, for instance 2"
        )
    return value


def run_compare(arguments: argparse.Namespace) -> int:
    """Train, compare, print the table and write the report; the folder is locked against other
    commands."""
    capture = Path(os.path.abspath(arguments.capture))  # so that it has a name, also as . or ..
    out = (arguments.out or Path("compare", capture.name)).absolute()
    if arguments.minutes is None and arguments.steps is None and arguments.max_mb is None:
        raise DyngsError(
            "say what all models get the same of: --minutes M, --steps N or --max-mb MB"
        )
    from dyngs.io.outputs import writing
    from dyngs.runs.folder import inputs_of
    from dyngs.study import report as files
    from dyngs.study.models import Comparison, compare, planned, require_same_comparison
    from dyngs.study.sweep import table_rows

    args.computing_device(arguments.device)
    comparison = Comparison(
        capture,
        out,
        arguments.minutes,
        arguments.steps,
        arguments.max_mb,
        arguments.split,
        tuple(arguments.overrides),
        arguments.threads,
        arguments.device,
        arguments.views,
    )
    plan = planned(comparison, arguments.models)
    for config in plan.configs.values():
        inputs_of(config).require_output(out)
    print_notes(plan.notes)
    with writing(out), results_alone(arguments.json):
        require_same_comparison(comparison, plan)
        try:
            results, left_out = compare(comparison, plan, arguments.ray)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(_CONTINUES) from None
    rows = sorted(table_rows(results), key=lambda row: -row["psnr"])
    views = f"{results[0].num_views} held-out views (split {comparison.split})"
    about = f"{capture.name}: {comparison.limit} each, {views}; PSNR in dB, seconds of training"
    has_curves = files.can_plot() and any(result.curve for result in results)
    report = files.Report(
        "Comparison",
        about,
        rows,
        [files.scores_table(about, rows, files.MODEL_COLUMNS)],
        left_out=left_out,
        views=files.shown_views(out, results),
        figure=files.plot_curves(results) if has_curves else None,
    )
    _print_report(report, out / "comparison", is_json=arguments.json)
    return 0


def _print_report(report: Report, stem: Path, *, is_json: bool) -> None:
    """Write the files of a study and print its tables, or its .json alone."""
    from dyngs.study.report import MISSING, can_plot, write_report

    paths = write_report(stem, report)
    if is_json:
        print(stem.with_suffix(".json").read_text(encoding="utf-8"), end="")
        return
    tables = []
    for table in report.tables:
        marks = table.marked or [False] * len(table.cells)
        cells = [
            [f"{'* ' if mark else '  '}{row[0]}" if any(marks) else row[0], *row[1:]]
            for row, mark in zip(table.cells, marks, strict=True)
        ]
        tables.append(numbers_table(table.title, table.head, cells))
    print_tables(*tables)
    for name, problem in report.left_out.items():
        print_lines(f"left out: {name}: {problem}")
    print(f"written: {paths[0]} and {', '.join(path.suffix for path in paths[1:])}")
    if not can_plot():
        print_notes((MISSING,))


def run_tradeoff(arguments: argparse.Namespace) -> int:
    """Measure, print and write the tables, and choose a run; the folder is locked against other
    commands."""
    from contextlib import nullcontext

    from dyngs.io.outputs import writing

    target = Path(arguments.target)
    out: Path | None = arguments.out or (target / "tradeoff" if target.is_dir() else None)
    with nullcontext() if out is None else writing(out):
        return _tradeoff(arguments)


def _tradeoff(arguments: argparse.Namespace) -> int:
    from dataclasses import asdict

    from dyngs.study import report as files
    from dyngs.study.sweep import (
        Plan,
        choose,
        exchange_rates,
        parse_goal,
        parse_requirements,
        sweep,
        table_rows,
    )
    from dyngs.study.variants import VariantRuns, parse_variations, write_chosen

    is_run = Path(arguments.target).is_dir()
    variations = parse_variations(arguments.vary, trains=arguments.train or not is_run)
    requirements = parse_requirements(arguments.require) if arguments.require is not None else ()
    metric = arguments.minimize or arguments.maximize
    goal = parse_goal(metric or "psnr", smallest=arguments.minimize is not None)
    args.computing_device(arguments.device)
    plan = Plan(
        variations,
        arguments.finetune,
        arguments.combine,
        arguments.split,
        arguments.rounds,
        arguments.ray,
    )
    with results_alone(arguments.json):
        run_dir = Path(arguments.target) if is_run else _trained(arguments)
        out = arguments.out or run_dir / "tradeoff"
        runs = VariantRuns(run_dir, out, arguments.threads, arguments.device)
        try:
            measurements = sweep(runs, plan)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(_CONTINUES) from None
    rows = table_rows(measurements)
    rates = exchange_rates(measurements)
    count = counted(measurements[0].num_views, "view")
    settings = [m.variant.setting for m in measurements]
    report = files.Report(
        "Quality, speed and size",
        count,
        rows,
        [files.scores_table(count, rows, files.VARIANT_COLUMNS), files.exchange_table(rates)],
        {
            "exchange_rates": [asdict(rate) for rate in rates],
            "changes": [m.changes for m in measurements],
        },
        figure=files.plot_variants(rows, settings) if files.can_plot() else None,
    )
    _print_report(report, out / "tradeoff", is_json=arguments.json)
    if arguments.require or metric:
        number = choose(rows, requirements, goal)
        best = rows[number]
        variant = measurements[number].variant
        folder = write_chosen(runs, variant)
        if not arguments.json:
            scores = f"{best['psnr']:.2f} dB, {best['fps']:.1f} fps, {best['mb']:.2f} MB"
            print(f"chosen:  {best['name']}: {scores}")
            if variant.scale < 1:
                print_notes((f"rendered at {variant.scale:g} of the size; upscale it",))
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
