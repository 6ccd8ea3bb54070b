"""``dyngs prune``: remove the least important Gaussians of a run and fine-tune the rest."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import threads

if TYPE_CHECKING:
    from rich.table import Table

    from dyngs.api.prune import Cost

_EPILOG = """\
examples:
  dyngs prune runs/dance --out runs/dance_pruned                 the recommended settings
  dyngs prune runs/dance --out runs/tiny --prune 0.95 --max-loss 20 --steps 5000
  dyngs prune runs/dance model.alpha_min=0.02 --out runs/fast    fine-tuned for a higher opacity cut-off
  dyngs train --resume runs/tiny                                 continue an interrupted fine-tuning

As a stage of training: dyngs train CONFIG ... prune.share=0.8. All options are explained in docs/prune.md.
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``prune`` to the commands."""
    parser = commands.add_parser(
        "prune",
        help="remove the least important Gaussians of a run and fine-tune the rest",
        description="Remove the Gaussians of a run that contribute least to its pictures and fine-tune the others. "
        "Writes a new run folder and prints quality, speed and size before and after.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run_dir", type=Path, metavar="RUN", help="run folder written by `dyngs train`")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN2", help="folder of the new run")
    parser.add_argument("--prune", default="0.8", metavar="R", help="share to remove, in [0, 1) (default 0.8)")
    parser.add_argument(
        "--score",
        choices=("variation", "sensitivity", "contribution", "temporal"),
        help="importance score of a Gaussian (default sensitivity)",
    )
    parser.add_argument(
        "--max-loss",
        metavar="DB",
        help="remove fewer if PSNR falls by more than this before fine-tuning (default 10)",
    )
    parser.add_argument("--masks", metavar="K", help="number of key times of visibility masks (default: no masks)")
    parser.add_argument("--steps", metavar="N", help="fine-tuning steps (default 2000)")
    parser.add_argument("--threads", type=threads, default=0, metavar="N", help="number of threads, 0 = all cores")
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="other config keys of the run (docs/cli.md)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Prune, fine-tune, compare with the run before, and print a table."""
    from rich.console import Console

    from dyngs.api.prune import compared, prune_run
    from dyngs.runs.checkpoint import load_run

    keys = {"prune": "share", "score": "score", "max_loss": "max_loss", "masks": "mask_times", "steps": "steps"}
    asked = {key: getattr(arguments, option) for option, key in keys.items()}
    overrides = [f"prune.{key}={value}" for key, value in asked.items() if value is not None]
    overrides += [f"run.threads={arguments.threads}", *arguments.overrides]
    folder = prune_run(arguments.run_dir, arguments.out, overrides)
    before, after = compared(arguments.run_dir, folder, arguments.threads)
    Console().print(cost_table(before, after))
    pruned = load_run(folder)
    if pruned.config.prune.mask_times > 1 and pruned.scene.masks is None:
        print("note: --masks was ignored; they are for scenes in which a deformation field moves something")
    print(f"written: {folder}\nnext:    dyngs eval {folder}\n         dyngs render {folder} --out {folder}/pictures")
    return 0


def cost_table(before: Cost, after: Cost) -> Table:
    """Return a table that compares two runs."""
    from rich.table import Table

    table = Table("", "before", "after", "")
    ratio = before.num_gaussians / after.num_gaussians
    table.add_row("Gaussians", f"{before.num_gaussians:,}", f"{after.num_gaussians:,}", f"{ratio:.1f} times fewer")
    for label, old, new in (
        ("PSNR, training views", before.psnr_train, after.psnr_train),
        ("PSNR, held-out views", before.psnr_test, after.psnr_test),
    ):
        if old is not None and new is not None:
            table.add_row(label, f"{old:.2f} dB", f"{new:.2f} dB", f"{new - old:+.2f} dB")
    faster, smaller = after.fps / before.fps, before.megabytes / after.megabytes
    table.add_row("rendering", f"{before.fps:.1f} fps", f"{after.fps:.1f} fps", f"{faster:.1f} times as fast")
    table.add_row("model", f"{before.megabytes:.2f} MB", f"{after.megabytes:.2f} MB", f"{smaller:.1f} times smaller")
    return table
