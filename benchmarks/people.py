"""Networks that predict people, given the same two views of people that they were not trained on.

    python benchmarks/people.py HELD_OUT RUN [RUN ...] [--threads 1] [--pictures FOLDER]

HELD_OUT is a set of `dyngs data synth people` with another seed than that of training. Of each person four pairs of
neighbouring views are taken, 30 and 45 degrees apart, and what is predicted of each pair is compared with the view in
the middle of the two, or next to it. Printed per run: PSNR and SSIM in the box of the person, on white, and CPU seconds
from decoded images to a scene, training on these two images (`dyngs predict --steps`) and not counted.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from dyngs.api.predict import network_config
from dyngs.config import DataConfig
from dyngs.data.loader import ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.files.write import write_image
from dyngs.gps.pairs import Pair, lessons
from dyngs.metrics import psnr, ssim
from dyngs.models.kind import kind_of
from dyngs.models.prediction import Predictor
from dyngs.models.renderable import Renderable
from dyngs.runs.checkpoint import latest_checkpoint

PAIRS = 4
"""Of each person and angle."""


@dataclass(frozen=True)
class Score:
    """One predicted view."""

    views_between: int  # 1: 30 degrees, 2: 45 degrees, on a ring of 24 cameras
    psnr: float
    ssim: float
    seconds: float


def compared(predictor: Predictor, images: ImageLoader, pair: Pair, target: int) -> tuple[Tensor, Tensor, float]:
    """Box of the person in the target view as predicted and in truth (H, W, 3), and CPU seconds to the scene."""
    start = time.process_time()
    scene: Renderable = predictor.predict([pair.left, pair.right])
    seconds = time.process_time() - start
    image, white = images[target], torch.ones(3)
    with torch.no_grad():
        drawn = scene.render(image.cameras, image.time, background=white).rgb[0].clamp(0, 1)
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    box = np.s_[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
    return drawn[box], image.composite(white)[box], seconds


def scores_of(run: Path, data: DataConfig, steps: int, pictures: Path | None) -> list[Score]:
    """All pairs of one person."""
    config, found = network_config(run), []
    own = config.data.model_copy(update={"root": data.root})
    checkpoint = latest_checkpoint(run)
    predictor = kind_of(config.model).predictor(config, checkpoint, own)
    images = ImageLoader(predictor.views, own)
    known = lessons(predictor.views)
    for between in (1, 2):
        fitting = [lesson for lesson in known if len(lesson[1]) == between]
        for pair, targets in fitting[:: max(1, len(fitting) // PAIRS)][:PAIRS]:
            if steps:
                predictor = kind_of(config.model).predictor(config, checkpoint, own)
                predictor.adapt([pair.left, pair.right], steps, lambda *_: None)
            drawn, truth, seconds = compared(predictor, images, pair, targets[0])
            found.append(Score(between, psnr(drawn, truth), ssim(drawn, truth), seconds))
            if pictures is not None:
                error = (1 - 3 * (drawn - truth).abs()).clamp(0, 1)
                name = f"{run.name}_{data.root.name}_{between}_{pair.left:02d}.png"
                write_image(pictures / name, torch.cat([truth, drawn, error], dim=1).numpy())
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    print("| network | 30 degrees | 45 degrees | CPU seconds |\n|---|---|---|---|")
    for run in given.runs:
        adapts = network_config(run).model.kind == "human_predictor"
        for steps in (0, 10) if adapts else (0,):
            people = captures_in(DataConfig(root=given.held_out))
            found = [score for data in people for score in scores_of(run, data, steps, given.pictures)]
            cells = [run.name + (f", {steps} steps on the two" if steps else "")]
            for between in (1, 2):
                own = [score for score in found if score.views_between == between]
                cells.append(f"{fmean(s.psnr for s in own):.2f} dB, {fmean(s.ssim for s in own):.3f}")
            print(f"| {' | '.join(cells)} | {sorted(s.seconds for s in found)[len(found) // 2]:.2f} |", flush=True)


if __name__ == "__main__":
    main()
