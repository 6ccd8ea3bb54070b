"""Effect of pruning, masks, fine-tuning and quantisation on a finished run, as a table in Markdown.

    python benchmarks/prune.py RUN FOLDER [key=value ...] [--rows stages|parts|scores] [--threads 1]

FOLDER keeps the pruned runs, which are reused. `stages`: pruned, fine-tuned, and stored by `dyngs export --format
dyngs`. `parts` compares pruning alone, masks alone and both, with and without fine-tuning (one step); `scores` compares
the scores. The requested share is always removed. Overrides (prune.mask_times=6, ...) apply to all rows. Columns:
Gaussians, PSNR of 20 training views and of the whole test split, speed relative to RUN, MB as float32 and as stored.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.api.prune import Cost, compared, prune_run
from dyngs.evaluate.report import evaluate_run
from dyngs.export.scene_file import write_scene_file
from dyngs.runs.checkpoint import checkpoint_paths

ONCE = "prune.steps=1"
NO_MASKS, NO_PRUNING = "prune.mask_times=0", "prune.share=0"
ROWS = {
    "stages": {"pruned": (ONCE,), "fine-tuned": ()},
    "parts": {
        "masks only": (NO_PRUNING,),
        "masks only, not fine-tuned": (NO_PRUNING, ONCE),
        "pruned only": (NO_MASKS,),
        "pruned only, not fine-tuned": (NO_MASKS, ONCE),
        "both": (),
        "both, not fine-tuned": (ONCE,),
    },
    "scores": {name: (f"prune.score={name}",) for name in ("sensitivity", "contribution", "variation", "temporal")},
}


def line(name: str, run: Path, cost: Cost, before: Cost, threads: int) -> str:
    """Return a row of the table without its last column."""
    test, faster = evaluate_run(run, threads=threads).psnr, cost.fps / before.fps
    quality = f"{cost.psnr_train:.2f} | {test:.2f}"
    return f"| {name} | {cost.num_gaussians} | {quality} | {faster:.2f} | {cost.megabytes:.2f} |"


def stored(run: Path, threads: int) -> str:
    """Return the last column: size and PSNR of the .dyngs file."""
    folder = run / "stored"
    size = 1e-6 * write_scene_file(run, folder).num_bytes
    return f" {size:.3f}, {evaluate_run(folder, threads=threads).psnr:.2f} dB |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--rows", choices=tuple(ROWS), default="stages")
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    print("| | Gaussians | train dB | test dB | times as fast | MB | stored |\n|---|---|---|---|---|---|---|")
    for name, asked in ROWS[given.rows].items():
        out = given.folder / name.replace(", ", "_").replace(" ", "_")
        if not checkpoint_paths(out):
            common = ("prune.share=0.8", "prune.max_loss=1000", f"run.threads={given.threads}")
            prune_run(given.run_dir, out, (*common, *given.overrides, *asked))
        before, after = compared(given.run_dir, out, given.threads)
        print(line(name, out, after, before, given.threads), end="", flush=True)
        print(stored(out, given.threads), flush=True)
    print(line("trained", given.run_dir, before, before, given.threads))


if __name__ == "__main__":
    main()
