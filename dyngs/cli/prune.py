"""``dyngs prune``: prune a run within a given loss of PSNR."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.output import numbers_table, print_tables, redirect_messages
from dyngs.core.errors import DyngsError, quote_path

if TYPE_CHECKING:
    from dyngs.compress.search import PruneResult
    from dyngs.evaluate.report import RunMetrics

MAX_LOSS = 0.2
_EPILOG = """\
examples:
  dyngs prune runs/dance --out runs/dance_pruned                 as much as possible for 0.2 dB
  dyngs prune runs/dance --out runs/tiny --max-loss 1 --steps 2000
  dyngs prune runs/dance --out runs/fifth --prune 0.8            a fixed fraction of the Gaussians
  dyngs prune runs/dance model.alpha_min=0.02 --out runs/fast --prune 0.8
  dyngs train --resume runs/fifth                                continue an interrupted fine-tuning

As a stage of training: dyngs train CONFIG ... prune.fraction=0.8.
Guide: `dyngs docs smaller-and-faster`.
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "prune",
        run,
        "prune a run within a loss of 0.2 dB: a smaller, faster run and its file",
        "Remove Gaussians, faint contributions, SH coefficients and precision until the PSNR of "
        "held-out views drops by --max-loss. Every trial is fine-tuned. Writes a new run folder "
        "with its compressed file; prints quality, speed and size before and after.",
        _EPILOG,
    )
    parser.add_argument(
        "run_dir", type=args.input_path, metavar="RUN", help="run folder written by `dyngs train`"
    )
    parser.add_argument(
        "--out", type=args.output_path, required=True, metavar="RUN2", help="folder of the new run"
    )
    about = f"largest loss of PSNR of the file on held-out views, dB (default {MAX_LOSS})"
    parser.add_argument("--max-loss", type=_decibels, metavar="DB", help=about)
    about = "remove this fraction of the Gaussians, in [0, 1), without a search"
    parser.add_argument("--prune", metavar="R", help=about)
    scores = ("sensitivity", "contribution", "temporal", "variation")
    parser.add_argument(
        "--score", choices=scores, help="importance score of a Gaussian (default sensitivity)"
    )
    about = "number of key times of visibility masks, without a search (default: no masks)"
    parser.add_argument("--masks", metavar="K", help=about)
    parser.add_argument(
        "--steps", metavar="N", help="fine-tuning steps (default 1000 per trial, 2000 with --prune)"
    )
    args.add_threads(parser)
    args.add_run_device(parser)
    args.add_overrides(parser, "key=value", "other config keys of the run (`dyngs docs config`)")
    parser.set_defaults(takes_root=True)
    args.add_json(parser)


def run(arguments: argparse.Namespace) -> int:
    """Prune, and print a table that compares both runs."""
    from dyngs.api.prune import export_folder
    from dyngs.api.train import num_cores
    from dyngs.evaluate.report import compare_runs
    from dyngs.runs.checkpoint import load_run

    keys = {"prune": "fraction", "score": "score", "masks": "mask_times", "steps": "steps"}
    requested = {key: getattr(arguments, option) for option, key in keys.items()}
    overrides = [f"prune.{key}={value}" for key, value in requested.items() if value is not None]
    overrides += [
        f"run.threads={arguments.threads}",
        *args.run_device(arguments),
        *arguments.overrides,
    ]
    with redirect_messages(arguments.json):
        folder, promise = _pruned(arguments, overrides)
    pruned = load_run(folder)
    device = args.computing_device(pruned.config.run.device)
    before, after = compare_runs(
        [arguments.run_dir, export_folder(folder)],
        arguments.threads or num_cores(),
        device,
        pruned.config.data.root,
    )
    if arguments.json:
        print(json.dumps({"before": asdict(before), "after": asdict(after)}, indent=2))
        return 0
    head = ("", "before", "pruned file", "")
    print_tables(numbers_table("", head, cost_cells(before, after, promise)))
    if pruned.config.prune.mask_times > 1 and pruned.scene.masks is None:
        print("note: --masks was ignored, because the scene is static")
    print(
        f"written: {folder}, and the file in {export_folder(folder)}\n"
        f"next:    dyngs eval {quote_path(folder)}\n         dyngs render "
        f"{quote_path(export_folder(folder))} --out {quote_path(folder / 'images')}"
    )
    return 0


def _pruned(arguments: argparse.Namespace, overrides: list[str]) -> tuple[Path, PruneResult | None]:
    """Prune; return the new folder, and the result of the search if there was one."""
    from dyngs.api.prune import prune_run, prune_to_loss

    chosen = any(text.startswith(("prune.fraction=", "prune.mask_times=")) for text in overrides)
    if chosen and arguments.max_loss is not None:
        raise DyngsError("--max-loss searches the fraction to prune; remove --prune and --masks")
    if chosen:
        return prune_run(arguments.run_dir, arguments.out, overrides), None
    most = MAX_LOSS if arguments.max_loss is None else arguments.max_loss
    promise = prune_to_loss(arguments.run_dir, arguments.out, most, overrides)
    print(promise)
    return arguments.out, promise


def _decibels(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 100:
        raise argparse.ArgumentTypeError(f"{text!r}: must be from 0 to 100 dB")
    return value


def cost_cells(
    before: RunMetrics, after: RunMetrics, promise: PruneResult | None = None
) -> list[list[str]]:
    """Return the rows of a table that compares a run with the file of its pruned version."""
    ratio = before.num_gaussians / after.num_gaussians
    cells = [
        [
            "Gaussians",
            f"{before.num_gaussians:,}",
            f"{after.num_gaussians:,}",
            f"{ratio:.1f}x fewer",
        ]
    ]
    quality = [
        ("PSNR, training views", before.psnr_train, after.psnr_train),
        ("PSNR, held-out views", before.psnr_test, after.psnr_test),
    ]
    if promise is not None:
        quality.insert(1, (f"PSNR, {promise.views}", promise.before, promise.after))
    for label, old, new in quality:
        if old is not None and new is not None:
            cells.append([label, f"{old:.2f} dB", f"{new:.2f} dB", f"{new - old:+.2f} dB"])
    faster = f"{after.fps / before.fps:.1f}x as fast"
    cells.append(["rendering", f"{before.fps:.1f} fps", f"{after.fps:.1f} fps", faster])
    whole = before.megabytes
    for label, mb, digits in (("model", after.megabytes, 2), ("file", after.stored, 3)):
        if mb is not None:
            smaller = f"{whole / mb:.1f}x smaller"
            cells.append([label, f"{whole:.2f} MB", f"{mb:.{digits}f} MB", smaller])
    return cells
