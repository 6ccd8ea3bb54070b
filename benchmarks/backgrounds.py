"""How solid objects are that were trained on images with alpha: PSNR on white and on black, and
pixels with holes.

    python benchmarks/backgrounds.py FOLDER CAPTURE... [--preset static] [--seeds 42] [--rules
    none,preset,random,both]
        [key=value ...]

Each capture is trained with the preset and the overrides. Rules: ``preset`` as the preset has it,
``none`` on one background alone, ``random`` with a random background in each step instead of the
loss of alpha, ``both``. Columns: mean PSNR of the test views on white and on black, and the
fraction of the pixels with a true alpha of 1 that are rendered with an alpha below 0.9. The capture
``demo`` is the scene of `dyngs demo`, trained as there. FOLDER keeps the runs, which are reused.
"""

from __future__ import annotations

import argparse
import re
import time
from pathlib import Path
from statistics import fmean

import torch

from dyngs.api.train import train
from dyngs.cli.demo import NUM_TIMES, SIZE, demo_config
from dyngs.config.io import load_config, packaged_preset, save_config
from dyngs.core.metrics import psnr
from dyngs.data.loader import ImageLoader
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.runs.opened import open_run

RULES = {
    "preset": [],
    "none": ["train.alpha_weight=0"],
    "random": ["train.alpha_weight=0", "data.background=random"],
    "both": ["data.background=random"],
}
SOLID = 0.9  # Alpha below which a pixel that should be opaque counts as a hole


@torch.no_grad()
def scores(run: Path, split: str = "test") -> list[str]:
    """Return the cells of a run: PSNR on white and on black, and the fraction of opaque pixels with
    holes."""
    opened = open_run(run)
    scene = opened.renderable
    images = ImageLoader(opened.capture.splits[split], opened.config.data)
    on_white = []
    on_black = []
    solid = 0
    holes = 0
    for image in (images[i] for i in range(len(images))):
        rendering = scene.render(
            image.cameras, image.time, options=scene.options, background=torch.zeros(3)
        )
        black = rendering.rgb[0]
        through = rendering.transmittance[0]
        white = black + through[..., None]
        on_white.append(psnr(white, image.composite(torch.ones(3)), image.mask))
        on_black.append(psnr(black, image.composite(torch.zeros(3)), image.mask))
        opaque = image.alpha >= 1
        solid += int(opaque.sum())
        holes += int((opaque & (through > 1 - SOLID)).sum())
    return [f"{fmean(on_white):.2f}", f"{fmean(on_black):.2f}", f"{holes / max(solid, 1):.2%}"]


def main() -> None:
    """Train what is not there yet, and print a row for each run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("words", nargs="+", help="captures, and key=value")
    parser.add_argument("--preset", default="static")
    parser.add_argument("--seeds", default="42")
    parser.add_argument("--rules", default="none,preset,random,both")
    options = parser.parse_intermixed_args()
    keys = [word for word in options.words if re.match(r"[\w.]+=", word)]
    print(
        "| capture | preset | rule | seed | on white | on black | holes | seconds |\n"
        + "|---" * 8
        + "|"
    )
    for capture in (Path(word) for word in options.words if word not in keys):
        for rule in options.rules.split(","):
            for seed in options.seeds.split(","):
                run = options.folder / f"{capture.name}_{options.preset}_{rule}_{seed}"
                seconds = _trained(
                    run, capture, options.preset, [*RULES[rule], f"run.seed={seed}", *keys]
                )
                cells = [capture.name, options.preset, rule, seed, *scores(run), seconds]
                print(f"| {' | '.join(cells)} |", flush=True)


def _trained(run: Path, capture: Path, preset: str, keys: list[str]) -> str:
    """Train a run that is not there; return its seconds, empty where it was there."""
    if checkpoint_paths(run):
        return ""
    if capture.name == "demo":
        root = run.parent / "demo"
        if not root.exists():
            write_dynamic_capture(
                "spin", root, DynamicOptions(size=SIZE, num_times=NUM_TIMES, samples=3)
            )
        written = run.parent / "demo.yaml"
        save_config(demo_config(root, run), written)
        config = load_config(written, [f"run.dir={run}", *keys])
    else:
        config = load_config(
            packaged_preset(preset), [f"data.root={capture}", f"run.dir={run}", *keys]
        )
    begun = time.perf_counter()
    train(config)
    return f"{time.perf_counter() - begun:.0f}"


if __name__ == "__main__":
    main()
