"""Variants of ``bg_triangle`` and Gaussians with as many numbers, in equal time.

    python benchmarks/polyhedra.py FOLDER --size 200
    python benchmarks/triangles.py runs/triangles polyhedra=FOLDER lego=LEGO --minutes 5 \\
        --numbers 100000 343500

Prints a row per variant: numbers learned, seconds of training, and the errors of
``benchmarks/edges.py`` in test views and close-ups. Runs that are there are not trained again.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from edges import SPLITS, errors, num_values

from dyngs.api.train import train
from dyngs.baselines.triangles.scene import SHAPE_SEGMENTS
from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.core.conventions import num_sh_terms
from dyngs.ops.patches import NUM_POINTS, lattice_size
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.opened import open_run

POINTS = "model.gaussian_steps=0"
SPLATTED = "model.primitives=gaussians"
UNWEIGHTED = "model.boundary_weights=false"
VARIANTS = {
    "static": ["static"],
    "faces": ["bg_triangle"],
    "faces-points": ["bg_triangle", POINTS],
    "gaussians": ["bg_triangle", SPLATTED],
    "gaussians-points": ["bg_triangle", SPLATTED, POINTS],
    "gaussians-unweighted": ["bg_triangle", SPLATTED, UNWEIGHTED],
    "gaussians-unweighted-points": ["bg_triangle", SPLATTED, UNWEIGHTED, POINTS],
}
"""Presets and keys."""


def limit(config: Config, numbers: int) -> str:
    """Return the key that limits a run to ``numbers`` learned numbers."""
    model: Any = config.model
    terms = num_sh_terms(model.sh_degree)
    if model.kind == "static":
        return f"strategy.max_gaussians={numbers // (11 + 3 * terms)}"
    size = 3 * (NUM_POINTS + lattice_size(model.texture) + terms - 1)
    if model.primitives == "gaussians":
        size += 7 * lattice_size(SHAPE_SEGMENTS)
    return f"model.max_triangles={numbers // size}"


def trained(folder: Path, preset: str, keys: list[str], numbers: int) -> Path:
    """Train a run in ``folder`` unless it is there; return ``folder``."""
    keys = [*keys, f"run.dir={folder}"]
    if not (folder.is_dir() and checkpoint_paths(folder)):
        train(load_config(preset, [*keys, limit(load_config(preset, keys), numbers)]))
    return folder


def scores(run: Path) -> list[str]:
    opened = open_run(run)
    cells = [f"{num_values(opened.renderable):,}", f"{load_run(run).seconds_train:.0f}"]
    for split in SPLITS:
        found = errors(opened, split) if opened.capture.splits[split] else [float("nan")] * 4
        psnr, ssim, flip, near = found
        cells += [f"{psnr:.2f}", f"{ssim:.4f}", f"{flip:.4f}", f"{near:.2f}"]
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("captures", nargs="+", metavar="NAME=FOLDER")
    parser.add_argument("--numbers", nargs="+", type=int, default=[100_000, 343_500])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--keys", nargs="*", default=[], help="KEY=VALUE of all runs")
    given = parser.parse_args()
    errors_of = "PSNR | SSIM | FLIP | near edges"
    print(f"| capture | variant | numbers | s | {errors_of} | close-up {errors_of} |")
    print("|---" * 12 + "|")
    for text in given.captures:
        name, _, root = text.partition("=")
        for numbers in given.numbers:
            for variant in given.variants:
                preset, *own = VARIANTS[variant]
                keys = [f"data.root={root}", f"train.minutes={given.minutes}", *own, *given.keys]
                run = given.folder / name / f"{numbers}-{variant}"
                row = [name, variant, *scores(trained(run, preset, keys, numbers))]
                print(f"| {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
