"""What exposure and white balance that differ from photo to photo cost, and what `train.exposure` wins back.

    python benchmarks/exposure.py FOLDER CAPTURE... [--seed 0] [--exposure never,always,auto] [key=value ...]

In a copy of each capture every training picture has its own random gain (0.6 to 1.6) and white balance (each channel
0.85 to 1.18), applied to the stored values and cut off at white as a camera does; test pictures are as they were. The
preset (configs/static.yaml with the overrides) is trained on the capture as it is and on the copy. All are measured on
the same untouched test pictures: as they are, after one affine colour for all of them (the scene has the colours of the
mean picture), and right halves after an affine colour fitted on left halves. FOLDER keeps copies and runs, which are
reused.
"""

from __future__ import annotations

import argparse
import re
import resource
import shutil
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from dyngs.api.train import train
from dyngs.colour.affine import fitted_affine, recoloured
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config
from dyngs.data.loader import PictureLoader
from dyngs.data.pictures.images import read_picture
from dyngs.data.read import read_capture
from dyngs.evaluate.half_fit import right_half_scores
from dyngs.evaluate.report import split_views
from dyngs.files.write import write_image
from dyngs.metrics import psnr
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.scene import render_options
from dyngs.training.background import evaluation_background

PRESET = Path(__file__).parents[1] / "configs" / "static.yaml"
GAINS, WHITE_BALANCE = (0.6, 1.6), (0.85, 1.18)


def disturb(capture: Path, out: Path, seed: int) -> None:
    """Write a copy of ``capture`` whose training pictures have a gain and a white balance of their own."""
    shutil.copytree(capture, out)
    random = np.random.default_rng(seed)
    for view in read_capture(DataConfig(root=out)).splits["train"]:
        gain = _between(random, GAINS, 1) * _between(random, WHITE_BALANCE, 3)
        pixels = read_picture(view.image_path).numpy().astype(np.float32)
        pixels[..., :3] = np.clip(pixels[..., :3] * gain, 0, 255)
        write_image(view.image_path, np.round(pixels).astype(np.uint8))


def _between(random: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    low, high = limits
    return np.exp(random.uniform(np.log(low), np.log(high), count))


@torch.no_grad()
def scores(run: Path) -> tuple[float, float, float, float]:
    """Return PSNR of test pictures as they are, after one affine colour for all, of halves as they are and fitted."""
    loaded = load_run(run)
    config: Config = loaded.config
    capture = read_capture(config.data)
    pictures = PictureLoader(split_views(capture, "test"), config.data)
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    options = render_options(config.model)
    shown = []
    for picture in (pictures[i] for i in range(len(pictures))):
        rendering = loaded.scene.render(picture.cameras, picture.time, options=options, background=background)
        shown.append((picture, rendering))
    one = fitted_affine(shown, background)
    plain = [psnr(r.rgb[0], p.composite(background), p.mask) for p, r in shown]
    fitted = [psnr(recoloured(one, p, r, background), p.composite(background), p.mask) for p, r in shown]
    halves = [right_half_scores(p, r, background) for p, r in shown]
    return fmean(plain), fmean(fitted), fmean(x.plain or 0.0 for x in halves), fmean(x.fitted or 0.0 for x in halves)


def row(root: Path, run: Path, exposure: str, overrides: Sequence[str]) -> str:
    """Return the cells of a run, trained where it is not there."""
    seconds = ""
    if not checkpoint_paths(run):
        begun = resource.getrusage(resource.RUSAGE_SELF).ru_utime
        train(load_config(PRESET, [f"data.root={root}", f"run.dir={run}", f"train.exposure={exposure}", *overrides]))
        seconds = f"{resource.getrusage(resource.RUSAGE_SELF).ru_utime - begun:.0f}"
    cells = " | ".join(f"{score:.2f}" for score in scores(run))
    taken = load_run(run).config.train.exposure
    return f"{taken} | {cells} | {seconds}"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("words", nargs="+", help="captures, and key=value")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exposure", default="never,always,auto")
    parser.add_argument("--pictures", default="untouched,disturbed")
    options = parser.parse_intermixed_args(words)
    captures = [Path(word) for word in options.words if not re.match(r"[\w.]+=", word)]
    overrides = [word for word in options.words if re.match(r"[\w.]+=", word)]
    print(
        "| capture | pictures | train.exposure | used | PSNR | one affine | right halves | fitted | CPU s |\n|"
        + "---|" * 9
    )
    with kernel_threads(torch.get_num_threads()):
        for capture in captures:
            copy = options.folder / f"{capture.name}_disturbed"
            if not copy.exists():
                disturb(capture, copy, options.seed)
            for pictures in options.pictures.split(","):
                root = copy if pictures == "disturbed" else capture
                for exposure in options.exposure.split(","):
                    run = options.folder / f"{capture.name}_{pictures}_{exposure}"
                    cells = row(root, run, exposure, overrides)
                    print(f"| {capture.name} | {pictures} | {exposure} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
