"""Comparison of systems for moving scenes at equal minutes of training, by `dyngs compare`.

    python benchmarks/dynamic.py FOLDER --data CAPTURES [--jobs 2] [--minutes 1.5] [--seeds 0 1]
    python benchmarks/dynamic.py FOLDER --speeds
    python benchmarks/dynamic.py FOLDER --table [--store]
    python benchmarks/dynamic.py FOLDER --films [--captures rig stage]

One row per variant, capture and seed is stored as FOLDER/results/CAPTURE_VARIANT_SEED.json; stored
rows are not trained again. `--captures` takes names of CAPTURES (in the folder of --data) or
NAME=PATH[,KEY=VALUE...], `--variants` names of VARIANTS and PUBLISHED or
NAME=PRESET[,KEY=VALUE...]. Videos get poses once, by `dyngs data sfm`. `--speeds` times the models
of each capture alternately, which `--jobs` does not disturb; run it when the machine has nothing
else to do. `--store` keeps the rows for docs/results.md, which `python benchmarks/results.py
write` writes.

`--films` writes FOLDER/films/CAPTURE_VARIANT.mp4 for the first seed: the camera of the first held-out
view over time, truth left, rendering right; a bar below marks frames that were held out.

What moves is scored on the same pixels for all variants: motion masks of the capture, else pixels
of fixed cameras that differ from their median over time. One moving camera without masks has none.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from results import MOVING, comparison_table, current_commit, processor

from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced, static_cameras
from dyngs.evaluate.report import load_split_images
from dyngs.evaluate.view_scores import SceneRenderer, time_renders
from dyngs.export.video import video_writer
from dyngs.models.checkpoint import read_run_capture
from dyngs.models.views import evaluation_background
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import load_run
from dyngs.runs.opened import scene_of_split, split_views

# Path in the folder of --data and overrides of each capture. Images are so small that 1.5 minutes on
# one thread suffice for some thousand steps.
SMALL = ("data.longest_side=200",)
REAL = ("data.longest_side=320",)
CAPTURES: dict[str, tuple[str, tuple[str, ...]]] = {
    "stage": ("stage", SMALL),
    "rig": ("rig", REAL),
    "orbits": ("orbits", SMALL),
    "flag": ("flag", SMALL),
    "clip_dog": ("clip_dog/dog.mp4", REAL),
    "clip_duck": ("clip_duck", REAL),
}


def dynamic(kind: str, *overrides: str) -> tuple[str, ...]:
    """Return preset `dynamic` with a deformation field, without pilot runs."""
    return ("dynamic", "model.pilot_runs=false", f"model.deform.kind={kind}", *overrides)


# Preset and overrides by name
VARIANTS: dict[str, tuple[str, ...]] = {
    "free": dynamic("free"),
    "control_nodes": dynamic("control_nodes"),
    "gaussians_4d": dynamic("gaussians_4d"),
    "gaussians_4d_all": dynamic("gaussians_4d", "model.select_moving=false"),
    "hexplane": dynamic("hexplane"),
    "mlp": dynamic("mlp"),
}
# Published protocols, and single differences between them and the preset; only on request
PUBLISHED: dict[str, tuple[str, ...]] = {
    "4dgs": ("4dgs",),
    "4dgs_detached": ("4dgs", "model.deform.position_gradient=false"),
    "4dgs_selected": ("4dgs", "model.select_moving=true"),
    "hexplane_attached": dynamic("hexplane", "model.deform.position_gradient=true"),
    "hexplane_all": dynamic("hexplane", "model.select_moving=false"),
    "deformable_3dgs": ("deformable_3dgs",),
    "deformable_3dgs_small": ("deformable_3dgs", "init.num_random=5000"),
    "mlp_all": dynamic("mlp", "model.select_moving=false"),
}


@dataclass(frozen=True)
class Row:
    """One training of a variant on a capture."""

    folder: Path
    capture: str
    path: Path
    variant: str
    preset: str
    overrides: tuple[str, ...]
    seed: int
    minutes: float

    @property
    def out(self) -> Path:
        """Folder of `dyngs compare`."""
        return self.folder / "comparisons" / f"{self.capture}_{self.variant}_{self.seed}"

    @property
    def result(self) -> Path:
        return self.folder / "results" / f"{self.capture}_{self.variant}_{self.seed}.json"

    def words(self, capture: str) -> list[str]:
        """Return the words of the command after `dyngs`, without the output folder."""
        return [
            "compare", capture, "--models", self.preset, "--minutes", f"{self.minutes:g}",
            "--threads", "1", f"run.seed={self.seed}", *self.overrides,
        ]  # fmt: skip

    @property
    def command(self) -> str:
        """The command as it is stored, with the name of the capture in place of its path."""
        return " ".join(["dyngs", *self.words(self.path.name)])

    def stored(self) -> dict[str, Any] | None:
        """Return the stored result, or None. Exits if it was measured with another command.

        Refused rows are removed, since they may succeed now.
        """
        if not self.result.is_file():
            return None
        found = json.loads(self.result.read_text(encoding="utf-8"))
        if "refused" in found:
            shutil.rmtree(self.out, ignore_errors=True)
            self.result.unlink()
            return None
        if found["command"] != self.command:
            sys.exit(
                f"{self.result}: measured by another command; remove it, or use another FOLDER"
            )
        return found


def run_row(row: Row) -> bool:
    """Train, measure and store a row. Returns False for a failure that is not stored.

    A refusal of dyngs (exit code 2) is stored with its reason.
    """
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "dyngs", *row.words(str(row.path)), "--out", str(row.out)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    facts: dict[str, Any] = {
        "capture": row.capture,
        "variant": row.variant,
        "seed": row.seed,
        "minutes": row.minutes,
        "command": row.command,
        "commit": current_commit(),
        "date": date.today().isoformat(),
        "machine": processor(),
        "load": os.getloadavg()[0],
    }
    last_line = (done.stderr.strip() or "no message").splitlines()[-1]
    if done.returncode == 0:
        report = json.loads((row.out / "comparison.json").read_text(encoding="utf-8"))
        facts |= report["rows"][0]
        shown = f"{facts['psnr']:.2f} dB, {facts['steps']:,} steps in {facts['seconds']:.0f} s"
    elif done.returncode == 2:
        facts["refused"] = last_line.removeprefix("dyngs: error: ")
        shown = f"refused: {facts['refused']}"
    else:
        print(f"{row.result.stem}: exit code {done.returncode}: {last_line}", flush=True)
        return False
    write_result(row.result, facts)
    print(f"{row.result.stem}: {shown}", flush=True)
    return True


def write_result(path: Path, facts: dict[str, Any] | list[dict[str, Any]]) -> None:
    """Write a result in one step, so that an interruption leaves no half-written file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    part.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    part.replace(path)


def run_rows(rows: Sequence[Row], jobs: int) -> bool:
    """Run the rows that are not stored, several at a time. Returns whether all succeeded."""
    missing = [row for row in rows if row.stored() is None]
    minutes = sum(row.minutes for row in missing) / jobs
    print(f"{len(missing)} of {len(rows)} rows, {minutes:.0f} minutes of training", flush=True)
    pool = ThreadPoolExecutor(jobs)
    try:
        return all(list(pool.map(run_row, missing)))
    finally:
        pool.shutdown(cancel_futures=True)


def posed_capture(path: Path, folder: Path, name: str) -> Path:
    """Return the capture, or for a video the folder with its frames and estimated poses."""
    if not path.is_file():
        return path
    posed = folder / "captures" / name
    if not posed.exists():
        words = [sys.executable, "-m", "dyngs", "data", "sfm", str(path), str(posed)]
        subprocess.run(words, check=True)
    return posed


def load_results(folder: Path) -> list[dict[str, Any]]:
    """Return all stored results, in the order of CAPTURES and VARIANTS, then by name."""
    paths = sorted((folder / "results").glob("*.json"))
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    captures = list(CAPTURES)
    variants = list(VARIANTS)
    captures += sorted({x["capture"] for x in found} - set(captures))
    variants += sorted({x["variant"] for x in found} - set(variants))
    return sorted(
        found,
        key=lambda x: (captures.index(x["capture"]), variants.index(x["variant"]), x["seed"]),
    )


def run_of(folder: Path, result: Mapping[str, Any]) -> Path:
    """Return the run folder of a result."""
    name = f"{result['capture']}_{result['variant']}_{result['seed']}"
    return next((folder / "comparisons" / name / "runs").iterdir())


def time_models(folder: Path, captures: Sequence[str]) -> None:
    """Time the models of each capture alternately, and store their frames per second."""
    found = [result for result in load_results(folder) if "refused" not in result]
    for capture in captures:
        chosen = [result for result in found if result["capture"] == capture]
        opened = [open_model(run_of(folder, result)) for result in chosen]
        if not opened:
            continue
        loader = opened[0].held_out
        images = [loader[i] for i in evenly_spaced(len(loader), 4)]
        with kernel_threads(1):
            seconds = time_renders([model.renderer for model in opened], images, rounds=5)
        for result, own in zip(chosen, seconds, strict=True):
            name = f"{capture}_{result['variant']}_{result['seed']}"
            result["fps"] = 1 / median(own.tolist())
            write_result(folder / "results" / f"{name}.json", result)
            print(f"{name}: {result['fps']:.0f} frames/s", flush=True)


@dataclass(frozen=True)
class OpenedModel:
    """A trained model with its images."""

    renderer: SceneRenderer
    images: ImageLoader  # of all splits
    held_out: ImageLoader


def open_model(run_dir: Path) -> OpenedModel:
    """Return the renderer of a run, and its images with the cameras that training refined."""
    run = load_run(run_dir)
    capture = read_run_capture(run.config.data, run.info)
    held_out = split_views(capture, "test")
    views = [view for split in capture.splits.values() for view in split]
    _, background = evaluation_background(run.config.data.background, capture.has_alpha)
    scene = scene_of_split(run, capture, "test")
    return OpenedModel(
        SceneRenderer(scene, scene.options, background),
        load_split_images(capture, views, run_dir, run),
        load_split_images(capture, held_out, run_dir, run),
    )


def write_films(folder: Path, captures: Sequence[str]) -> None:
    """Write a film of each model of the first seed, beside the true images."""
    done = set[tuple[str, str]]()
    for result in load_results(folder):
        capture = result["capture"]
        about = (capture, result["variant"])
        if capture not in captures or "refused" in result or about in done:
            continue
        done.add(about)
        model = open_model(run_of(folder, result))
        views = model.images.views
        held_out = {view.name for view in model.held_out.views}
        first = next(i for i, view in enumerate(views) if view.name in held_out)
        cameras = [indices for indices in static_cameras(views) if first in indices]
        # One moving camera: its held-out frames
        shown = cameras[0] if cameras else [i for i, v in enumerate(views) if v.name in held_out]
        path = folder / "films" / f"{capture}_{result['variant']}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        with video_writer(path, fps=10) as add:
            for i in sorted(shown, key=lambda i: views[i].time or 0.0):
                image = model.images[i]
                truth = image.composite(model.renderer.background)
                rendered = model.renderer.image(image.cameras, image.time)
                frame = torch.cat([truth, rendered], dim=1)
                bar = torch.full((6, frame.shape[1], 3), float(views[i].name in held_out))
                frame = torch.cat([frame, bar]).clamp(0, 1)
                add((255 * frame).round().byte().numpy())
        print(f"{path}: {len(shown)} frames, {len(held_out)} views held out in all", flush=True)


def parse_named(word: str, known: dict[str, tuple[str, ...]]) -> tuple[str, tuple[str, ...]]:
    """Return name and words of NAME or NAME=FIRST[,KEY=VALUE...]."""
    name, equals, rest = word.partition("=")
    if equals:
        return name, tuple(rest.split(","))
    if name not in known:
        sys.exit(f"{name}: unknown; use {', '.join(known)} or NAME=...")
    return name, known[name]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("--data", type=Path, default=Path("."), help="folder of the captures")
    parser.add_argument("--captures", nargs="+", default=list(CAPTURES), metavar="CAPTURE")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), metavar="VARIANT")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--minutes", type=float, default=1.5, help="of each training")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time, one thread each")
    parser.add_argument("--speeds", action="store_true", help="time stored models, do not train")
    parser.add_argument("--films", action="store_true", help="write films of stored models")
    parser.add_argument("--table", action="store_true", help="print the table, do not train")
    parser.add_argument("--store", action="store_true", help="with --table: for docs/results.md")
    options = parser.parse_args()
    if options.table:
        rows = load_results(options.folder)
        print(comparison_table(rows))
        if options.store:
            write_result(MOVING, rows)
        return
    names = [word.partition("=")[0] for word in options.captures]
    if options.speeds or options.films:
        if options.speeds:
            time_models(options.folder, names)
        if options.films:
            write_films(options.folder, names)
        return
    known = {name: (str(options.data / path), *words) for name, (path, words) in CAPTURES.items()}
    captures = dict(parse_named(word, known) for word in options.captures)
    variants = dict(parse_named(word, VARIANTS | PUBLISHED) for word in options.variants)
    folder = options.folder.absolute()
    rows = []
    for seed in options.seeds:
        for name, (path, *of_capture) in captures.items():
            posed = posed_capture(Path(path).absolute(), folder, name)
            make = partial(Row, folder, name, posed, seed=seed, minutes=options.minutes)
            for variant, (preset, *of_variant) in variants.items():
                rows.append(
                    make(variant=variant, preset=preset, overrides=(*of_capture, *of_variant))
                )
    if not run_rows(rows, options.jobs):
        sys.exit(1)


if __name__ == "__main__":
    main()
