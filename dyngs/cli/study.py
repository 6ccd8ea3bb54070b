"""``dyngs compare``: compare models on one capture. ``dyngs tradeoff``: quality, speed and size of
the settings of a run."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import (
    numbers_table,
    print_lines,
    print_notes,
    print_tables,
    redirect_messages,
)
from dyngs.core.errors import DyngsError, format_count

if TYPE_CHECKING:
    from dyngs.study.report import Report

_COMPARE = """\
examples:
  dyngs compare scans/bench --models static,mip,static_mcmc --minutes 2       -> compare/bench
  dyngs compare scans/dance --models static,dynamic,mine.yaml --steps 7000 data.longest_side=400
  dyngs compare scans/bench --models static,mip --max-mb 2 --out study

Each model is a preset or a YAML file. Run an interrupted command again to continue it.
"""
_TRADEOFF = """\
examples:
  dyngs tradeoff runs/dance                                   all settings -> runs/dance/tradeoff
  dyngs tradeoff runs/dance --vary prune=0.5,0.8 --vary storage --finetune 2000
  dyngs tradeoff runs/dance --vary storage --vary sh_degree --combine 1

Run an interrupted command again to continue it; only missing results are measured.
"""
_FRONT = "* Pareto front of PSNR, speed and size"
_CONTINUES = "finished results are kept; run the same command again to continue"


def add_parser(commands: args.Commands) -> None:
    """Add ``dyngs compare``."""
    parser = args.add_command(
        commands,
        "compare",
        run_compare,
        "train several models on one capture with the same time, steps or size, and compare them",
        "Train each model on the same views and evaluate it on the same held-out views. Writes "
        "comparison.csv, .json, .md, a page with synchronised crops (.html) and, with the extra "
        "plots, quality over time (.svg).",
        _COMPARE,
    )
    about = "capture with cameras, in any format"
    parser.add_argument("capture", type=args.input_path, metavar="CAPTURE", help=about)
    args.add_overrides(parser, "key=value", "overrides for all models")
    names = "presets and YAML files, separated by commas"
    parser.add_argument("--models", required=True, metavar="A,B,...", help=names)
    limit = parser.add_mutually_exclusive_group()
    about = "train each model for this many minutes"
    limit.add_argument("--minutes", type=amount, metavar="M", help=about)
    kind = args.integer_type("a number of steps", 1, 10**8)
    limit.add_argument("--steps", type=kind, metavar="N", help="train each model for N steps")
    about = "limit the file size of each model, 1e6 bytes"
    limit.add_argument("--max-mb", type=amount, metavar="MB", help=about)
    _add_common(parser, "compare/CAPTURE")


def add_tradeoff_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "tradeoff",
        run_tradeoff,
        "measure quality, speed and size of a run with other settings",
        "Vary the settings of a run one at a time, then several together. Writes tradeoff.csv, "
        ".json, .md, .html and, with the extra plots, .svg, and a run folder of each variant.",
        _TRADEOFF,
    )
    parser.add_argument("run_dir", type=args.input_path, metavar="RUN", help="run folder")
    vary = "vary only this setting, weaker values first; may be repeated (default: all settings)"
    parser.add_argument("--vary", action="append", default=[], metavar="SETTING[=A,B]", help=vary)
    for name, low, default, about in (
        ("finetune", 0, 0, "fine-tuning steps after pruning (default: none)"),
        ("combine", 0, 4, "number of combinations in each of three directions (default 4)"),
    ):
        kind = args.integer_type("a number", low, 10**9)
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=about)
    _add_common(parser, "RUN/tradeoff")


def _add_common(parser: argparse.ArgumentParser, out: str) -> None:
    about = f"output folder (default {out})"
    parser.add_argument("--out", type=args.output_path, metavar="DIR", help=about)
    args.add_split(parser)
    args.add_threads(parser)
    args.add_device(parser)
    about = (
        "run several jobs in parallel with Ray (pip install 'dyngs[ray]'), each with this many "
        "cores, on this machine or the cluster of RAY_ADDRESS with a shared file system"
    )
    kind = args.integer_type("a number of cores", 1, 1024)
    parser.add_argument("--ray", type=kind, metavar="CORES", help=about)
    args.add_json(parser)


def amount(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a number above 0, for instance 2")
    return value


def run_compare(arguments: argparse.Namespace) -> int:
    """Train and compare the models, and print the table."""
    from dyngs.study.compare import compare

    if arguments.minutes is None and arguments.steps is None and arguments.max_mb is None:
        raise DyngsError("a common limit is required: --minutes M, --steps N or --max-mb MB")
    args.computing_device(arguments.device)
    with redirect_messages(arguments.json):
        try:
            result = compare(
                arguments.capture,
                arguments.models.split(","),
                minutes=arguments.minutes,
                steps=arguments.steps,
                max_mb=arguments.max_mb,
                out=arguments.out,
                split=arguments.split,
                threads=arguments.threads,
                device=arguments.device,
                ray_cores=arguments.ray,
                overrides=arguments.overrides,
            )
        except KeyboardInterrupt:
            raise KeyboardInterrupt(_CONTINUES) from None
    _print_report(result, is_json=arguments.json)
    return 0


def _print_report(report: Report, *, is_json: bool) -> None:
    """Print the tables of a study, or only its .json."""
    from dyngs.study.report import MATPLOTLIB_MISSING, can_plot

    paths = report.files
    if is_json:
        print(paths[1].read_text(encoding="utf-8"), end="")
        return
    table = report.table
    print_tables(numbers_table(table.title, table.head, table.cells))
    for name, problem in report.left_out.items():
        print_lines(f"skipped: {name}: {problem}")
    print(f"written: {paths[0]} and {', '.join(path.suffix for path in paths[1:])}")
    if not can_plot():
        print_notes((MATPLOTLIB_MISSING,))


def run_tradeoff(arguments: argparse.Namespace) -> int:
    """Measure the variants, print and write the table; locks the folder."""
    from dyngs.io.outputs import lock_folder

    if not arguments.run_dir.is_dir():
        raise DyngsError(
            f"{arguments.run_dir}: not a run folder; give a folder written by `dyngs train`"
        )
    out: Path = arguments.out or arguments.run_dir / "tradeoff"
    with lock_folder(out):
        return _tradeoff(arguments, out)


def _tradeoff(arguments: argparse.Namespace, out: Path) -> int:
    from dyngs.study import tradeoff
    from dyngs.study.report import Report, build_table, can_plot, plot_variants, write_report

    args.computing_device(arguments.device)
    study = tradeoff.Tradeoff(
        arguments.run_dir,
        out,
        tradeoff.parse_variations(arguments.vary),
        arguments.finetune,
        arguments.combine,
        arguments.split,
        arguments.threads,
        arguments.device,
        arguments.ray,
    )
    with redirect_messages(arguments.json):
        try:
            found = study.run()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(_CONTINUES) from None
    variants = list(found)
    rows = tradeoff.build_rows(list(found.values()))
    about = f"{format_count(found[variants[0]].num_views, 'view')}; {_FRONT}"
    settings = [variant.setting for variant in variants]
    report = Report(
        "Quality, speed and size",
        about,
        rows,
        build_table(about, rows),
        {"changes": [variant.changes for variant in variants]},
        figure=plot_variants(rows, settings) if can_plot() else None,
    )
    report = replace(report, files=write_report(out / "tradeoff", report))
    _print_report(report, is_json=arguments.json)
    if not arguments.json:
        print(f"run folders of the variants: {out / 'models'}")
    return 0
