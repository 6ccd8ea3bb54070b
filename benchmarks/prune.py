"""Effect of pruning on a finished run, as a table in Markdown.

    python benchmarks/prune.py RUN FOLDER [key=value ...] [--rows promise|where|stages|parts|scores]
    [--threads 1]

FOLDER keeps the pruned runs, which are reused. `promise`: `dyngs prune --max-loss X` for each of
--max-loss, drawn from the file. `where`: the bytes of each tensor, and the time of each part of an
image. `stages`: a fraction of 0.8 pruned, fine-tuned, and stored by `dyngs export --format dyngs`.
`parts` compares pruning alone, masks alone and both, with and without fine-tuning (one step);
`scores` compares the scores. Overrides (prune.steps=500, ...) apply to all rows. Columns:
Gaussians, PSNR of 20 training views and of the whole test split, speed relative to RUN, MB as
float32 and as stored.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch

from dyngs.api.prune import export_folder, prune_run, prune_to_loss
from dyngs.api.scene_file import write_scene_file
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.evaluate.report import (
    RunMetrics,
    compare_runs,
    evaluate_run,
    scene_of_split,
    split_views,
)
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.stored_file import read_scene, tensors_to_store

ONCE = "prune.steps=1"
NO_MASKS, NO_PRUNING = "prune.mask_times=0", "prune.fraction=0"
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
    "scores": {
        name: (f"prune.score={name}",) for name in ("sensitivity", "contribution", "variation")
    },
}


def line(name: str, run: Path, cost: RunMetrics, before: RunMetrics, threads: int) -> str:
    """Return a row of the table without its last column."""
    test = evaluate_run(run, threads=threads).psnr
    faster = cost.fps / before.fps
    quality = f"{cost.psnr_train:.2f} | {test:.2f}"
    return f"| {name} | {cost.num_gaussians} | {quality} | {faster:.2f} | {cost.megabytes:.2f} |"


def stored(folder: Path, threads: int) -> str:
    """Return the last column: size and PSNR of the .dyngs file in ``folder``."""
    size = 1e-6 * (folder / "scene.dyngs").stat().st_size
    return f" {size:.3f}, {evaluate_run(folder, threads=threads).psnr:.2f} dB |"


def promises(given: argparse.Namespace) -> None:
    """Print a row for each loss that is allowed."""
    for most in given.max_loss:
        out = given.folder / f"loss_{most:g}"
        if not checkpoint_paths(out):
            overrides = (*given.overrides, f"run.threads={given.threads}")
            began = time.perf_counter()
            promise = prune_to_loss(given.run_dir, out, most, overrides)
            print(f"\n{promise}\n{time.perf_counter() - began:.0f} s\n", flush=True)
        before, after = compare_runs([given.run_dir, export_folder(out)], given.threads)
        print(
            line(f"{most:g} dB allowed", export_folder(out), after, before, given.threads), end=""
        )
        print(stored(export_folder(out), given.threads), flush=True)
    print(line("trained", given.run_dir, before, before, given.threads))


def where(given: argparse.Namespace) -> None:
    """Print bytes by tensor, and the time of an image by part (processor time of one thread,
    medians)."""
    run = load_run(given.run_dir)
    folder = given.folder / "stored"
    file = read_scene(write_scene_file(given.run_dir, folder).path)
    exact = {name: x.numel() * x.itemsize for name, x in tensors_to_store(run.scene).items()}
    print("| tensor | float | stored |\n|---|---|---|")
    for name, size in sorted(file.sizes.items(), key=lambda item: -item[1]):
        print(f"| {name} | {exact.get(name, 0)} | {size} |")
    print(f"| all | {sum(exact.values())} | {file.num_bytes} |")
    capture = read_capture(run.config.data)
    loader = ImageLoader(split_views(capture, "test"), run.config.data)
    images = [loader[i] for i in range(min(len(loader), 10))]
    whole = scene_of_split(run, capture, "test")
    one = whole.select(torch.arange(1))
    print("\n| | ms |\n|---|---|")
    with torch.no_grad(), kernel_threads(1):
        for name, scene in (("all", whole), ("one Gaussian: calls", one)):
            moments = [scene.time_step(p.time) for p in images]
            moved = milliseconds([lambda p=p, s=scene: s.time_step(p.time) for p in images])
            drawn = milliseconds(
                [
                    lambda p=p, m=m, s=scene: s.render(p.cameras, m)
                    for p, m in zip(images, moments, strict=True)
                ]
            )
            print(f"| {name}: moved to its time | {moved:.2f} |\n| {name}: drawn | {drawn:.2f} |")


def milliseconds(calls: list[Callable[[], object]], rounds: int = 5) -> float:
    """Return the median processor time of a call."""
    found = []
    for call in calls * rounds:
        began = time.thread_time()
        call()
        found.append(time.thread_time() - began)
    return 1e3 * median(found)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--rows", choices=("promise", "where", *ROWS), default="promise")
    parser.add_argument("--max-loss", type=float, nargs="+", default=[0.2])
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    if given.rows == "where":
        where(given)
        return
    print(
        "| | Gaussians | train dB | test dB | times as fast | MB | stored |\n|---|---|---|---|---|---|---|"
    )
    if given.rows == "promise":
        promises(given)
        return
    for name, asked in ROWS[given.rows].items():
        out = given.folder / name.replace(", ", "_").replace(" ", "_")
        if not checkpoint_paths(out):
            common = ("prune.fraction=0.8", f"run.threads={given.threads}")
            prune_run(given.run_dir, out, (*common, *given.overrides, *asked))
        before, after = compare_runs([given.run_dir, out], given.threads)
        print(line(name, out, after, before, given.threads), end="", flush=True)
        print(stored(export_folder(out), given.threads), flush=True)
    print(line("trained", given.run_dir, before, before, given.threads))


if __name__ == "__main__":
    main()
