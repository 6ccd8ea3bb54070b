"""``dyngs compare``: several models on one capture, or networks on people, with the same time,
steps, size or views."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import numbers_table, print_lines, print_notes, print_tables
from dyngs.core.errors import DyngsError, counted, show

if TYPE_CHECKING:
    from dyngs.study.compare.plan import Bench

_EPILOG = """\
examples:
  dyngs compare scans/bench --models static,mip,static_mcmc --minutes 2       -> compare/bench
  dyngs compare scans/dance --models static,dynamic,mine.yaml --steps 7000 data.longest_side=400
  dyngs compare scans/bench --models static,mip --max-mb 2 --out study
  dyngs compare HELD_OUT_PEOPLE --models gps,runs/net --predict 2,3,4    networks that predict people from 2, 3, 4 views

Each model is a preset or a YAML file. An interrupted command continues when it is given again. Details: docs/cli.md.
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "compare",
        run,
        "train several models on one capture with the same time, steps or size, and compare them",
        "Train each model on the same views and evaluate all on the same held-out ones. Writes comparison.csv, .md, a "
        "page with synchronised crops (.html) and, with the extra plots, quality over seconds (.svg, .png).",
        _EPILOG,
    )
    parser.add_argument(
        "capture",
        type=args.input_path,
        metavar="CAPTURE",
        help="capture with cameras, in any format",
    )
    args.add_overrides(parser, "key=value", "overrides for all models")
    names = "presets and YAML files, or networks that predict people, separated by commas"
    parser.add_argument("--models", type=_names, required=True, metavar="A,B,...", help=names)
    limit = parser.add_mutually_exclusive_group()
    limit.add_argument(
        "--minutes", type=_positive, metavar="M", help="train each for so many minutes"
    )
    limit.add_argument(
        "--steps",
        type=args.whole("a number of steps", 1, 10**8),
        metavar="N",
        help="or so many steps",
    )
    limit.add_argument(
        "--max-mb", type=_positive, metavar="MB", help="or to a file of at most so many 1e6 bytes"
    )
    parser.add_argument(
        "--out",
        type=args.output_path,
        metavar="DIR",
        help="output folder (default compare/CAPTURE)",
    )
    predict = "predict each person of a folder of captures from so many views, and compare with views between them"
    parser.add_argument("--predict", type=_counts, metavar="N,N,...", help=predict)
    spread = "with --predict: from views evenly around the person, not 30 degrees apart"
    parser.add_argument("--spread", action="store_true", help=spread)
    kind = args.whole("a number of views", 1, 20)
    parser.add_argument(
        "--views", type=kind, default=4, metavar="N", help="views on the page (default 4)"
    )
    args.add_split(parser)
    args.add_threads(parser)
    args.add_device(parser)
    args.add_ray(parser)


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise argparse.ArgumentTypeError(
            f"{text!r} has an empty name; write for instance static,mip"
        )
    return names


def _counts(text: str) -> list[int]:
    return [args.whole("a number of views", 1, 100)(part) for part in text.split(",")]


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


def run(arguments: argparse.Namespace) -> int:
    """Train, compare, print the table and write the report; the folder is locked against other
    commands."""
    if arguments.predict is not None:
        return _predict(arguments)
    if arguments.spread:
        raise DyngsError("--spread goes with --predict")
    from dyngs.io.lock import writing
    from dyngs.runs.inputs import inputs_of
    from dyngs.study.compare.bench import compare, is_finished, require_same_comparison
    from dyngs.study.compare.plan import planned
    from dyngs.study.compare.report import about, table_cells, table_rows, write_report
    from dyngs.study.plots import MISSING, can_plot

    bench = _bench(arguments)
    args.computing_device(bench.device)
    plan = planned(bench, arguments.models)
    for entry in plan.entries:
        inputs_of(entry.config).require_output(bench.out)
    print_notes(plan.notes)
    with writing(bench.out):
        require_same_comparison(bench, plan)
        was_finished = is_finished(bench, plan)
        try:
            results, left_out = compare(bench, plan, show, arguments.ray)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                "finished models are kept; the same command continues"
            ) from None
        files = write_report(bench, results, left_out)
    print_tables(numbers_table(about(bench, results), *table_cells(table_rows(results))))
    for name, problem in left_out.items():
        print_lines(f"left out: {name}: {problem}")
    if was_finished:
        print(
            f"{arguments.out or bench.out}: holds just this comparison, finished: nothing was trained"
        )
    print(f"written: {files[0]} and {', '.join(file.suffix for file in files[1:])}")
    if not can_plot():
        print(f"note: {MISSING}")
    if arguments.ray is not None and arguments.minutes is not None:
        print(
            f"note: {counted(len(results), 'model')} by Ray: the same minutes are less on a slower or busier machine"
        )
    return 0


def _predict(arguments: argparse.Namespace) -> int:
    """Compare networks that predict people; with --minutes an avatar that is trained on the same
    images, too."""
    from dyngs.ops.native import kernel_threads
    from dyngs.study.compare.people import STEM, PeopleBench, compare_people

    for option in ("steps", "max_mb", "ray"):
        if getattr(arguments, option) is not None:
            raise DyngsError(f"--{option.replace('_', '-')} does not go with --predict")
    other = [word for word in arguments.overrides if not word.startswith("data.")]
    if other:
        raise DyngsError(
            f"{other[0]}: networks are compared as they were trained; only data.* can be given"
        )
    bench = PeopleBench(
        people=arguments.capture,
        networks=[Path(name) for name in arguments.models],
        counts=arguments.predict,
        spread=arguments.spread,
        avatar_minutes=arguments.minutes,
        data=[word.removeprefix("data.") for word in arguments.overrides],
    )
    out = arguments.out or Path("compare", Path(os.path.abspath(arguments.capture)).name)
    with kernel_threads(arguments.threads or 1):
        # its times are CPU seconds, of which waiting threads take some
        head, cells = compare_people(bench, out)
    print_tables(numbers_table("box of the person on white", head, cells))
    print(f"written: {out / STEM}.md, .csv and pictures of truth, prediction and error")
    return 0


def _bench(arguments: argparse.Namespace) -> Bench:
    from dyngs.study.compare.plan import Bench, Limit

    if arguments.minutes is None and arguments.steps is None and arguments.max_mb is None:
        raise DyngsError(
            "say what all models get the same of: --minutes M, --steps N or --max-mb MB"
        )
    capture = Path(os.path.abspath(arguments.capture))  # so that it has a name, also as . or ..
    return Bench(
        capture=capture,
        out=(arguments.out or Path("compare", capture.name)).absolute(),
        limit=Limit(arguments.minutes, arguments.steps, arguments.max_mb),
        split=arguments.split,
        overrides=tuple(arguments.overrides),
        threads=arguments.threads,
        device=arguments.device,
        num_shown=arguments.views,
    )
