"""What people who walk through a static scene cost, and what masks found in training
(`train.robust`) win back.

    python benchmarks/walkers.py FOLDER CAPTURE... [--share 0.33] [--seed 0] [--robust never,always]
    [key=value ...]

In a copy of each capture drawn people stand at random places in a fraction of the training images;
test images are as they were, and `walkers/` holds the true masks. The preset (configs/static.yaml
with the overrides) is trained on the capture as it is and on the copy, without and with masks, and
all are measured on the same clean test images. FOLDER keeps copies and runs, which are reused.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dyngs.api.train import train
from dyngs.config import DataConfig
from dyngs.config.io import load_config
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.io.write import write_image
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths

PRESET = Path(__file__).parents[1] / "configs" / "static.yaml"
PEOPLE = (
    ((0.75, 0.15, 0.15), (0.15, 0.18, 0.35)),
    ((0.85, 0.80, 0.35), (0.30, 0.28, 0.25)),
    ((0.20, 0.45, 0.30), (0.60, 0.55, 0.50)),
)
"""Colours of shirt and trousers of those who walk through."""
SKIN = (0.78, 0.58, 0.46)
STRIPE = 0.55
"""Colour of heads, and how dark every second stripe of a shirt is."""
HEIGHTS = (0.4, 0.8)
"""Height of a person as a fraction of the image's."""


@dataclass(frozen=True)
class Person:
    """A drawn person: the middle of the feet as fractions of the image's size, the height as one of
    its height."""

    x: float
    feet: float
    height: float
    look: int

    def drawn(self, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the colours (H, W, 3) in [0, 1], and where the person is, (H, W) in [0, 1]."""
        rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
        size = self.height * height
        up = (self.feet * height - rows - 0.5) / size
        aside = (columns + 0.5 - self.x * width) / size
        shirt, trousers = PEOPLE[self.look]
        parts = (
            (_ellipse(up - 0.24, aside - 0.07, 0.25, 0.06), trousers),
            (_ellipse(up - 0.24, aside + 0.07, 0.25, 0.06), trousers),
            (_ellipse(up - 0.62, aside, 0.24, 0.16), shirt),
            (_ellipse(up - 0.91, aside, 0.09, 0.07), SKIN),
        )
        colours = np.zeros((height, width, 3), np.float32)
        inside = np.zeros((height, width), np.float32)
        light = 0.75 + 0.25 * np.cos(4 * aside)
        stripes = np.where(np.floor(up * 16) % 2 == 0, 1.0, STRIPE)
        for distance, colour in parts:
            covers = np.clip(0.5 - distance * size, 0, 1)  # about one pixel of soft rim
            shade = light * (stripes if colour is shirt else 1.0)
            paint = shade[..., None] * np.asarray(colour, np.float32)
            colours = colours + covers[..., None] * (paint - colours)
            inside = np.maximum(inside, covers)
        return np.clip(colours, 0, 1), inside


def _ellipse(up: np.ndarray, aside: np.ndarray, tall: float, wide: float) -> np.ndarray:
    """Return about how far a point lies outside of an ellipse with half-axes ``tall`` and
    ``wide``."""
    return (np.hypot(up / tall, aside / wide) - 1) * min(tall, wide)


def compose(capture: Path, out: Path, fraction: float, seed: int) -> None:
    """Write a copy of ``capture`` with people in ``share`` of its training images, and their masks
    to ``walkers/``.

    PNG stays lossless; other formats are encoded anew.
    """
    shutil.copytree(capture, out)
    views = read_capture(DataConfig(root=out)).splits["train"]
    random = np.random.default_rng(seed)
    for index in sorted(random.permutation(len(views))[: round(fraction * len(views))].tolist()):
        path = views[index].image_path
        pixels = read_image(path).numpy().astype(np.float32) / 255
        tall = random.uniform(*HEIGHTS)
        person = Person(
            random.uniform(0.1, 0.9),
            random.uniform(0.7, 1.1),
            tall,
            int(random.integers(len(PEOPLE))),
        )
        colours, inside = person.drawn(pixels.shape[1], pixels.shape[0])
        alpha = inside[..., None]
        pixels[..., :3] += alpha * (colours - pixels[..., :3])
        if pixels.shape[-1] == 4:
            pixels[..., 3:] = np.maximum(pixels[..., 3:], alpha)
        write_image(path, np.round(255 * pixels).astype(np.uint8))
        write_image(
            out / "walkers" / f"{path.stem}.png", np.round(255 * inside).astype(np.uint8)[..., None]
        )


def row(
    root: Path, run: Path, robust: str, overrides: Sequence[str]
) -> tuple[float, float, int, float]:
    """Return PSNR and SSIM on the test images, Gaussians and seconds of a run, trained where it is
    not there."""
    if not checkpoint_paths(run):
        keys = [f"data.root={root}", f"run.dir={run}", f"train.robust={robust}", *overrides]
        train(load_config(PRESET, keys))
    report = evaluate_run(run)
    return report.psnr, report.ssim, report.num_gaussians, report.seconds_train or 0.0


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("words", nargs="+", help="captures, and key=value")
    parser.add_argument("--share", type=float, default=1 / 3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robust", default="never,always")
    options = parser.parse_intermixed_args(words)
    captures = [Path(word) for word in options.words if "=" not in word]
    overrides = [word for word in options.words if "=" in word]
    print(
        "| capture | images | train.robust | PSNR / SSIM | Gaussians | seconds |\n|---|---|---|---|---|---|"
    )
    with kernel_threads(torch.get_num_threads()):
        for capture in captures:
            busy = options.folder / f"{capture.name}_walkers"
            if not busy.exists():
                compose(capture, busy, options.fraction, options.seed)
            for root, images in ((capture, "clean"), (busy, "walkers")):
                for robust in options.robust.split(","):
                    run = options.folder / f"{capture.name}_{images}_{robust}"
                    psnr, ssim, count, seconds = row(root, run, robust, overrides)
                    shown = f"{psnr:.2f} dB / {ssim:.3f} | {count:,} | {seconds:.0f}"
                    print(f"| {capture.name} | {images} | {robust} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
