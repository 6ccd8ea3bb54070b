"""What pruning, masks and fine-tuning each bring to a finished run: one row per way of compacting it.

    python benchmarks/compact.py RUN FOLDER [--rows scores|parts] [--prune 0.8] [--masks 6] [--steps 2000] [--threads 1]

FOLDER keeps the compacted runs, which are used again. `parts` compares pruning alone, masks alone and both, with and
without fine-tuning (one step); `scores` compares the scores. Pruning does not back off here. Printed as a table in
Markdown: Gaussians, PSNR on training and held-out views (at most 20 each), how many times as fast it draws as RUN, MB.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.train.checkpoint import checkpoint_paths
from dyngs.train.compacted import Cost, compact_run, compared


def rows(which: str, prune: float, masks: int, steps: int) -> dict[str, tuple[str, ...]]:
    """Name to what is asked for."""
    tuned, share, bits = f"compact.steps={steps}", f"compact.prune={prune}", f"compact.masks={masks}"
    if which == "scores":
        names = ("sensitivity", "contribution", "variation", "temporal")
        return {name: (tuned, share, f"compact.score={name}") for name in names}
    return {
        "masks only": (tuned, bits),
        "masks only, not fine-tuned": ("compact.steps=1", bits),
        "pruned only": (tuned, share),
        "pruned only, not fine-tuned": ("compact.steps=1", share),
        "both": (tuned, share, bits),
        "both, not fine-tuned": ("compact.steps=1", share, bits),
    }


def line(name: str, cost: Cost, before: Cost) -> str:
    """A row of the table."""
    test = "" if cost.psnr_test is None else f"{cost.psnr_test:.2f}"
    faster = f"{cost.fps / before.fps:.2f}"
    return f"| {name} | {cost.num_gaussians} | {cost.psnr_train:.2f} | {test} | {faster} | {cost.megabytes:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rows", choices=("parts", "scores"), default="parts")
    parser.add_argument("--prune", type=float, default=0.8)
    parser.add_argument("--masks", type=int, default=6)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    print("| | Gaussians | train dB | test dB | times as fast | MB |\n|---|---|---|---|---|---|")
    for name, asked in rows(given.rows, given.prune, given.masks, given.steps).items():
        out = given.folder / name.replace(", ", "_").replace(" ", "_")
        if not checkpoint_paths(out):
            compact_run(given.run_dir, out, (*asked, "compact.max_loss=1000", f"run.threads={given.threads}"))
        before, after = compared(given.run_dir, out, given.threads)
        print(line(name, after, before), flush=True)
    print(line("before", before, before))


if __name__ == "__main__":
    main()
