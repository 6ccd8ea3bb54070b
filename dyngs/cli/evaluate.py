"""``dyngs eval``: how good a run is on pictures that it has not seen."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table

    from dyngs.train.evaluate import EvalReport


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``eval`` to the commands."""
    parser = commands.add_parser(
        "eval",
        help="measure a run on held-out pictures",
        description="Measure a run; prints a table and writes metrics.json (metrics_SPLIT.json for another split).",
    )
    parser.add_argument("run_dir", type=Path, metavar="RUN", help="folder that `dyngs train` wrote")
    parser.add_argument("--split", choices=("test", "val", "train"), default="test")
    parser.add_argument("--lpips-net", choices=("alex", "vgg"), default="alex", help="backbone of LPIPS (default alex)")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="0 = all cores")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate and print."""
    from rich.console import Console

    from dyngs.train.evaluate import evaluate_run, report_path

    report = evaluate_run(arguments.run_dir, arguments.split, lpips_net=arguments.lpips_net, threads=arguments.threads)
    Console().print(report_table(report))
    for note in report.notes:
        print(f"note: {note}")
    print(f"written: {report_path(arguments.run_dir, report.split)}")
    return 0


def report_table(report: EvalReport) -> Table:
    """The means of a report as a table of two columns, with the reason where a value is missing."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("metric", "value", title=f"{report.num_views} views of the {report.split} split")
    table.add_row("PSNR", f"{report.psnr:.2f} dB")
    table.add_row("SSIM", f"{report.ssim:.4f}")
    for label, name, value in (
        ("FLIP", "flip", report.flip),
        (f"LPIPS ({report.lpips_net})", "lpips", report.lpips),
    ):
        reason = escape(report.reasons.get(name, "not measured"))
        table.add_row(label, reason if value is None else f"{value:.4f}")
    table.add_row("picture size", f"{report.width}x{report.height} on {report.background}")
    table.add_row("Gaussians", f"{report.num_gaussians:,}")
    table.add_row("model", f"{report.model_mb:.1f} MB")
    table.add_row("rendering", f"{report.fps:.1f} frames/s")
    table.add_row("training", f"{report.step:,} steps in {report.seconds_train:.0f} s")
    return table
