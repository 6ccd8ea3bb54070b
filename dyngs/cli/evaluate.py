"""``dyngs eval``: evaluate a run on held-out views."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.imports import heavy_imports
from dyngs.cli.output import ProgressBar, numbers_table, print_notes, print_tables
from dyngs.core.errors import DyngsError, format_count, quote_path

if TYPE_CHECKING:
    from dyngs.evaluate.report import EvalReport

_OUTLINED, _REFINED = ", poses from silhouettes", ", poses refined"
"""Of the tested images, and on them."""
WORST_VIEWS = 5


def add_parser(commands: args.Commands) -> None:
    about = "Evaluate a run. Prints a table and writes metrics.json (metrics_SPLIT.json for other splits)."
    parser = args.add_command(commands, "eval", run, "evaluate a run on held-out views", about)
    parser.add_argument(
        "run_dir", type=args.input_path, metavar="RUN", help="run folder written by `dyngs train`"
    )
    args.add_split(parser)
    parser.add_argument(
        "--lpips-net",
        choices=("alex", "vgg"),
        default="alex",
        help="backbone of LPIPS (default alex)",
    )
    args.add_threads(parser)
    args.add_device(parser)
    args.add_data_root(parser)
    about = (
        "also evaluate with camera poses (or body poses of a person) refined on the evaluated "
        "images; always on for runs with camera.refine"
    )
    parser.add_argument("--refine", action="store_true", help=about)
    about = "more rows: worst views, right halves, per time, and why metrics are missing"
    parser.add_argument("--verbose", action="store_true", help=about)
    args.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate and print a table."""
    with heavy_imports():
        from dyngs.config.io import load_resolved
        from dyngs.evaluate.report import evaluate_run, report_path

    arguments.run_dir = args.run_of_scene_file(arguments.run_dir)
    if arguments.run_dir.is_file():
        word = quote_path(arguments.run_dir)
        raise DyngsError(
            f"{arguments.run_dir}: a file holds no images to compare with; give the run folder "
            f"written by `dyngs train`, or see the file with `dyngs view {word}`"
        )
    if arguments.refine and arguments.split != "train":
        load_resolved(arguments.run_dir)  # fails for anything but a run before the message
        print(
            "refining the poses of the evaluated images, this takes a while",
            file=sys.stderr,
        )
    with ProgressBar() as progress:
        report = evaluate_run(
            arguments.run_dir,
            arguments.split,
            lpips_net=arguments.lpips_net,
            threads=arguments.threads,
            refine_poses=arguments.refine,
            device=args.computing_device(arguments.device).type,
            data_root=args.data_root(arguments),
            on_progress=progress,
        )
    if arguments.json:
        print(report.to_json(), end="")
        return 0
    title = f"{format_count(report.num_views, 'view')} of the {report.split} split"
    rows = report_rows(report, verbose=arguments.verbose)
    print_tables(numbers_table(title, ("metric", "value"), rows))
    print_notes([*report.notes, *missing_metrics(report)], report.warnings)
    print(f"written: {report_path(arguments.run_dir, report.split)}")
    return 0


def report_rows(report: EvalReport, *, verbose: bool = False) -> list[tuple[str, str]]:
    """Return labels and values of the mean metrics that were measured, with ``verbose`` all."""
    rows = [("PSNR", f"{report.psnr:.2f} dB")]
    if report.psnr_own_poses is not None:
        rows.append((f"PSNR{_REFINED}", f"{report.psnr_own_poses:.2f} dB"))
    rows.append(("SSIM", f"{report.ssim:.4f}"))
    if report.flip is not None:
        part = "" if report.flip_views == report.num_views else f" of {report.flip_views} views"
        rows.append((f"FLIP{part}", f"{report.flip:.4f}"))
    if report.lpips is not None:
        rows.append((f"LPIPS ({report.lpips_net})", f"{report.lpips:.4f}"))
    rows += _rows_of_person(report)
    rows += _rows_of_regions(report)
    if report.num_gaussians:
        rows.append(("Gaussians", f"{report.num_gaussians:,}"))
    if report.num_moving:
        rows.append(("moving", f"{report.num_moving:,} ({report.moving_fraction:.1%})"))
    stored = "" if report.stored_mb is None else f"{report.stored_mb:.2f} MB on disk, as float32 "
    rows.append(("model", f"{stored}{report.model_mb:.1f} MB"))
    rows.append(("rendering", f"{report.fps:.1f} frames/s at {report.width}x{report.height}"))
    duration = f" in {report.seconds_train:.0f} s" if report.seconds_train else ""
    rows.append(("training", f"{format_count(report.step, 'step')}{duration}"))
    if verbose:
        rows += _further_rows(report)
    return rows


def missing_metrics(report: EvalReport) -> list[str]:
    """Return a line about FLIP and LPIPS if they were not measured, else nothing."""
    missing = {"FLIP": report.reasons.get("flip"), "LPIPS": report.reasons.get("lpips")}
    reasons = [f"no {name}: {reason}" for name, reason in missing.items() if reason]
    return ["; ".join(reasons)] if reasons else []


def _further_rows(report: EvalReport) -> list[tuple[str, str]]:
    """Return labels and values for ``--verbose``, and the reasons for metrics without a value."""
    rows: list[tuple[str, str]] = []
    worst = sorted(report.per_view, key=lambda view: view.psnr)[:WORST_VIEWS]
    rows += [(f"PSNR of {view.name}", f"{view.psnr:.2f} dB") for view in worst]
    if report.psnr_white is not None and report.psnr_black is not None:
        both = f"{report.psnr_white:.2f} dB, {report.psnr_black:.2f} dB"
        rows.append(("PSNR on white, on black", both))
    if report.psnr_right is not None and report.psnr_right_fitted is not None:
        rows.append(("PSNR of right halves", f"{report.psnr_right:.2f} dB"))
        rows.append(("with colours of left halves", f"{report.psnr_right_fitted:.2f} dB"))
    if report.psnr_per_time:
        values = [at.psnr for at in report.psnr_per_time]
        lowest = min(report.psnr_per_time, key=lambda at: at.psnr)
        spread = f"{lowest.psnr:.2f} (time {lowest.time:g}) to {max(values):.2f} dB"
        rows.append((f"PSNR at {format_count(len(values), 'time')}", spread))
        rows.append(("first, last of these times", f"{values[0]:.2f}, {values[-1]:.2f} dB"))
    if report.flicker_static is not None and report.flicker_static_images is not None:
        flicker = f"{report.flicker_static:.4f} (images {report.flicker_static_images:.4f})"
        rows.append(("flicker of what is static", flicker))
    if report.num_moving:
        rows.append(("deformation field", f"{report.field_mb:.1f} MB"))
        rows.append(("time for deforming", f"{report.deform_fraction:.0%} of rendering"))
    if report.num_gaussians:
        rows.append(("colour", f"{report.colour_floats:.1f} numbers per Gaussian"))
    rows.append(("background", report.background))
    names: dict[str, list[str]] = {}
    for name, reason in report.reasons.items():
        if name not in ("flip", "lpips"):
            names.setdefault(reason, []).append(name)
    rows += [(f"no {', '.join(group)}", reason) for reason, group in names.items()]
    return rows


def _rows_of_person(report: EvalReport) -> list[tuple[str, str]]:
    """Return labels and values of the scores of a person: with given, silhouette-fitted and refined
    poses."""
    rows: list[tuple[str, str]] = []
    for scores, suffix in (
        (report, ""),
        (report.silhouette_poses, _OUTLINED),
        (report.own_poses, _REFINED),
    ):
        if scores is None:
            continue
        for label, psnr, ssim, lpips in (
            ("in the person's box", scores.psnr_person, scores.ssim_person, None),
            ("on black", scores.psnr_black, scores.ssim_black, scores.lpips_black),
        ):
            if psnr is not None and ssim is not None:
                distance = "" if lpips is None else f", LPIPS {lpips:.4f}"
                rows.append((f"{label}{suffix}", f"{psnr:.2f} dB, SSIM {ssim:.4f}{distance}"))
    return rows


def _rows_of_regions(report: EvalReport) -> list[tuple[str, str]]:
    """Return labels and values of the PSNR of image regions."""
    rows = []
    if report.psnr_foreground is not None:
        rows.append(("on the foreground", f"{report.psnr_foreground:.2f} dB"))
    if report.psnr_moving is not None:
        ssim = "" if report.ssim_moving is None else f", SSIM {report.ssim_moving:.4f}"
        flip = "" if report.flip_moving is None else f", FLIP {report.flip_moving:.4f}"
        source = f" (by {report.moving_from})"
        rows.append(("on what moves", f"{report.psnr_moving:.2f} dB{ssim}{flip}{source}"))
    if report.psnr_static is not None:
        rows.append(("on what does not", f"{report.psnr_static:.2f} dB"))
    return rows
