"""What exposure and white balance that differ from photo to photo cost, and what `train.exposure`
wins back.

    python benchmarks/exposure.py FOLDER CAPTURE... [--seed 0] [--exposure never,always,auto]
    [key=value ...]

In a copy of each capture every training image has its own random gain (0.6 to 1.6) and white
balance (each channel 0.85 to 1.18), applied to the stored values and cut off at white as a camera
does; test images are as they were. The preset (static, with the overrides) is trained on the
capture as it is and on the copy. All are measured on the same untouched test images: as they are,
after one affine colour for all of them (the scene has the colours of the mean image), and right
halves after an affine colour fitted on left halves. FOLDER keeps copies and runs, which are reused.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from disturbed import Study, print_table

from dyngs.config import Config, DataConfig
from dyngs.core.metrics import psnr
from dyngs.data.images.images import read_image
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.evaluate.report import split_views
from dyngs.evaluate.view_scores import right_half_scores
from dyngs.gaussians.colour.network import apply_affine_colour, fit_affine_colour
from dyngs.io.write import write_image
from dyngs.models.views import evaluation_background
from dyngs.runs.checkpoint import load_run

GAINS = (0.6, 1.6)
WHITE_BALANCE = (0.85, 1.18)


def disturb(capture: Path, out: Path, seed: int) -> None:
    """Write a copy of ``capture`` whose training images have a gain and a white balance of their
    own."""
    shutil.copytree(capture, out)
    random = np.random.default_rng(seed)
    for view in read_capture(DataConfig(root=out)).splits["train"]:
        gain = _between(random, GAINS, 1) * _between(random, WHITE_BALANCE, 3)
        pixels = read_image(view.image_path).numpy().astype(np.float32)
        pixels[..., :3] = np.clip(pixels[..., :3] * gain, 0, 255)
        write_image(view.image_path, np.round(pixels).astype(np.uint8))


def _between(random: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    low, high = limits
    return np.exp(random.uniform(np.log(low), np.log(high), count))


@torch.no_grad()
def scores(run: Path) -> list[str]:
    """Return the cells of a run: what was used, and PSNR of test images.

    As they are, after one affine colour for all, of halves as they are, and of halves fitted.
    """
    loaded = load_run(run)
    config: Config = loaded.config
    capture = read_capture(config.data)
    images = ImageLoader(split_views(capture, "test"), config.data)
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    options = loaded.scene.options
    shown = []
    for image in (images[i] for i in range(len(images))):
        rendering = loaded.scene.render(
            image.cameras, image.time, options=options, background=background
        )
        shown.append((image, rendering))
    one = fit_affine_colour(shown, background)
    plain = [psnr(r.rgb[0], p.composite(background), p.mask) for p, r in shown]
    fitted = [
        psnr(apply_affine_colour(one, p, r, background), p.composite(background), p.mask)
        for p, r in shown
    ]
    halves = [right_half_scores(p, r, background) for p, r in shown]
    means = [
        fmean(plain),
        fmean(fitted),
        fmean(x.get("psnr_right", 0.0) for x in halves),
        fmean(x.get("psnr_right_fitted", 0.0) for x in halves),
    ]
    return [config.train.exposure, *(f"{mean:.2f}" for mean in means)]


STUDY = Study(
    text=__doc__ or "",
    worse="images",
    given="untouched",
    key="train.exposure",
    disturb=disturb,
    columns=("used", "PSNR", "one affine", "right halves", "fitted"),
    scores=scores,
)

if __name__ == "__main__":
    print_table(STUDY)
