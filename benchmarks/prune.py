"""Effect of pruning on a finished run, as a table in Markdown.

    python benchmarks/prune.py RUN FOLDER [key=value ...] [--rows promise|where|stages] [--threads 1]
    python benchmarks/prune.py RUN FOLDER [key=value ...] --rows published [--jobs 2]
    python benchmarks/prune.py RUN FOLDER --rows speeds

FOLDER keeps the pruned runs, which are reused. `promise`: `dyngs prune --max-loss X` for each of
--max-loss, drawn from the file. `where`: the bytes of each tensor, and the time of each part of an
image. `stages`: a fraction of 0.8 pruned, fine-tuned, and stored by `dyngs export --format dyngs`.
Overrides (prune.steps=500, ...) apply to all rows. Columns: Gaussians, PSNR of 20 training views
and of the whole test split, speed relative to RUN, MB as float32 and as stored.

`published` trains the rows of --scores, --fractions and --masks, which are stored as
FOLDER/SCORE_FRACTION_MASKS.json; stored rows are not trained again. `speeds` times all stored rows
alternately at 400x400 on two threads and prints the table; run it when the machine has nothing
else to do. Columns: PSNR of the whole test split, MB as float32 and as stored, frames a second.
`--store CAPTURE` keeps that table for docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch
from dynamic import open_model, write_result
from results import PRUNING, current_commit, load_rows, pruning_table

from dyngs.api.prune import export_folder, prune_run, prune_to_loss
from dyngs.api.scene_file import write_scene_file
from dyngs.core.metrics import psnr
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.report import (
    RunMetrics,
    compare_runs,
    evaluate_run,
    parameter_megabytes,
    scene_of_split,
    split_views,
)
from dyngs.evaluate.view_scores import time_renders
from dyngs.gaussians.scene import require_gaussians
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import SCENE_FILE, checkpoint_paths, load_run
from dyngs.runs.stored_file import read_scene, tensors_to_store

ONCE = "prune.steps=1"
NO_MASKS = "prune.mask_times=0"
ROWS = {
    "stages": {"pruned": (ONCE,), "fine-tuned": ()},
}
# Scores of 4DGS-1K, and ours
SCORES = {
    "spatial": ("prune.score=contribution",),
    "temporal": ("prune.score=temporal",),
    "both_signed": ("prune.score=variation", "prune.signed=true"),
    "both": ("prune.score=variation",),
    "ours": ("prune.score=sensitivity",),
}
# No masks; masks as published; masks that keep what is visible only between key times
MASKS = {
    "none": (NO_MASKS,),
    "published": ("prune.mask_times=6", "prune.mask_between=false"),
    "ours": ("prune.mask_times=6", "prune.mask_between=true"),
}
SPEED_SIZE, SPEED_THREADS = 400, 2


@dataclass(frozen=True)
class Row:
    """A pruned run."""

    run_dir: Path
    folder: Path
    score: str
    fraction: float
    masks: str
    overrides: tuple[str, ...]

    @property
    def name(self) -> str:
        return f"{self.score}_{self.fraction:g}_{self.masks}"

    @property
    def out(self) -> Path:
        return self.folder / self.name

    @property
    def result(self) -> Path:
        return self.folder / f"{self.name}.json"

    def is_stored(self) -> bool:
        """Return whether the row has a result; exit if it was trained with other overrides."""
        if not self.result.is_file():
            return False
        if json.loads(self.result.read_text(encoding="utf-8"))["overrides"] != [*self.overrides]:
            sys.exit(f"{self.result}: trained with other overrides; use another FOLDER")
        return True


def run_row(row: Row) -> None:
    """Prune, fine-tune, evaluate and store a row."""
    started = time.perf_counter()
    chosen = (*SCORES[row.score], *MASKS[row.masks], f"prune.fraction={row.fraction}")
    file = export_folder(row.out) / SCENE_FILE
    if not file.is_file():
        shutil.rmtree(row.out, ignore_errors=True)  # interrupted
        prune_run(row.run_dir, row.out, ("run.threads=1", *row.overrides, *chosen))
    facts = {
        "score": row.score,
        "fraction": row.fraction,
        "masks": row.masks,
        "overrides": [*row.overrides],
        "stored_mb": 1e-6 * file.stat().st_size,
        **quality(row.out),
        "seconds": time.perf_counter() - started,
    }
    write_result(row.result, facts)
    print(f"{row.name}: {facts['psnr']:.2f} dB, {facts['seconds']:.0f} s", flush=True)


def quality(run_dir: Path) -> dict[str, Any]:
    """Return the size of a run and the mean PSNR of its test split."""
    model = open_model(run_dir)
    images = model.held_out
    with kernel_threads(1):
        scores = []
        for image in (images[i] for i in range(len(images))):
            drawn = model.renderer.image(image.cameras, image.time)
            scores.append(psnr(drawn, image.composite(model.renderer.background), image.mask))
    scene = require_gaussians(model.renderer.scene, str(run_dir))
    return {"psnr": fmean(scores), "gaussians": len(scene), "mb": parameter_megabytes(scene)}


def print_speeds(run_dir: Path, folder: Path, capture: str | None) -> None:
    """Time all stored rows alternately, print the table, and store it under ``capture``."""
    rows = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*.json")]
    orders = list(SCORES), list(MASKS)
    rows.sort(
        key=lambda x: (orders[0].index(x["score"]), x["fraction"], orders[1].index(x["masks"]))
    )
    names = [f"{row['score']}_{row['fraction']:g}_{row['masks']}" for row in rows]
    folders = [run_dir, *(folder / name for name in names)]
    trained = {"score": "not pruned", "fraction": 0.0, "masks": "none", **quality(run_dir)}
    models = [open_model(path) for path in folders]
    images = models[0].held_out
    views = []
    for i in evenly_spaced(len(images), 8):
        cameras = images[i].cameras.resized(SPEED_SIZE, SPEED_SIZE)
        views.append(replace(images[i], cameras=cameras))
    with kernel_threads(SPEED_THREADS):
        seconds = time_renders([model.renderer for model in models], views, rounds=3)
    timed = []
    for row, own in zip([trained, *rows], seconds, strict=True):
        facts = {"capture": capture, "commit": current_commit(), "fps": 1 / median(own.tolist())}
        timed.append(row | facts)
    print(pruning_table(timed))
    if capture is not None:
        others = [row for row in load_rows(PRUNING) if row["capture"] != capture]
        write_result(PRUNING, others + timed)


def run_rows(given: argparse.Namespace) -> None:
    """Run the rows that are not stored, several at a time."""
    os.environ["OMP_NUM_THREADS"] = "1"
    chosen = product(given.scores, given.fractions, given.masks)
    rows = [Row(given.run_dir, given.folder, *x, tuple(given.overrides)) for x in chosen]
    missing = [row for row in rows if not row.is_stored()]
    print(f"{len(missing)} of {len(rows)} rows", flush=True)
    with ProcessPoolExecutor(given.jobs, get_context("spawn")) as pool:
        list(pool.map(run_row, missing))


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
    kinds = ("promise", "where", "published", "speeds", *ROWS)
    parser.add_argument("--rows", choices=kinds, default="promise")
    parser.add_argument("--scores", nargs="+", choices=SCORES, default=list(SCORES))
    parser.add_argument("--fractions", nargs="+", type=float, default=[0.5, 0.7, 0.8, 0.85])
    parser.add_argument("--masks", nargs="+", choices=MASKS, default=["none", "published"])
    parser.add_argument("--jobs", type=int, default=1, help="rows at a time, one thread each")
    parser.add_argument("--store", metavar="CAPTURE", help="with speeds: keep the table")
    parser.add_argument("--max-loss", type=float, nargs="+", default=[0.2])
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    if given.rows == "where":
        where(given)
        return
    if given.rows == "published":
        run_rows(given)
        return
    if given.rows == "speeds":
        print_speeds(given.run_dir, given.folder, given.store)
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
