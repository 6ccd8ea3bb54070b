"""Networks that predict people, given the same two to four views of people that they were not trained on.

    python benchmarks/people.py HELD_OUT NET [NET ...] [--steps 0,10] [--people N] [--threads 1] [--pictures FOLDER]

HELD_OUT is a set of `dyngs data synth people` with another seed than that of training; NET are runs of networks, or
files of weights. Of each person one arc of cameras is taken, 30 degrees apart, and its first 2, 3 or 4 are predicted
from. What is predicted is compared with the views in the middle between neighbours. Printed: PSNR and SSIM in the box
of the person, on white, and CPU seconds from decoded images to a scene, then again after training on these images for
as many steps (`dyngs predict --steps`; its time is in brackets). Without body parameters in HELD_OUT they are fitted to
all its views first, as `dyngs predict` does, which is not counted.
"""

from __future__ import annotations

import argparse
import time
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch
from torch import Tensor

from dyngs.api.predict import trained_network
from dyngs.config import DataConfig
from dyngs.conventions import report_nothing
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.errors import DyngsError
from dyngs.files.write import write_image
from dyngs.gps.pairs import angle, around
from dyngs.metrics import psnr, ssim
from dyngs.models.kind import kind_of
from dyngs.models.prediction import Predictor
from dyngs.models.renderable import Renderable

APART = 30.0
"""Degrees between neighbours that are predicted from."""
COUNTS = (2, 3, 4)


@dataclass(frozen=True)
class Score:
    """One predicted view."""

    steps: int
    count: int  # of views predicted from
    psnr: float
    ssim: float
    seconds: float  # of the prediction
    training: float  # seconds of training on these images


def arc_of(predictor: Predictor, which: int) -> list[int]:
    """Return indices of views in order around the person of which every other one is predicted from."""
    views = predictor.views
    ring = around(views, range(len(views)))
    size = 2 * max(COUNTS) - 1
    arcs = [[ring[(i + k) % len(ring)] for k in range(size)] for i in range(len(ring))]
    even = [arc for arc in arcs if all(abs(angle(views[a], views[b]) - APART / 2) < 1 for a, b in pairwise(arc))]
    if not even:
        raise DyngsError(f"{predictor.name}: no {size} views {APART / 2:g} degrees apart; give a ring of 24 cameras")
    return even[which % len(even)]


def boxes(scene: Renderable, image: Image) -> tuple[Tensor, Tensor]:
    """Return the box of the person as predicted and in truth (H, W, 3), on white."""
    white = torch.ones(3)
    with torch.no_grad():
        drawn = scene.render(image.cameras, image.time, background=white).rgb[0].clamp(0, 1)
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    box = np.s_[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
    return drawn[box], image.composite(white)[box]


def scores_of(network: Path, data: DataConfig, which: int, steps: list[int], pictures: Path | None) -> list[Score]:
    """Return those of one person."""
    config, checkpoint = trained_network(network)
    own, found = config.data.model_copy(update={"root": data.root}), []
    trained = kind_of(config.model).predictor(config, checkpoint, own, say=print, report=report_nothing)
    arc, images = arc_of(trained, which), ImageLoader(trained.views, own)
    for count, number in ((count, number) for number in steps for count in COUNTS):
        predictor, views = deepcopy(trained), arc[: 2 * count - 1 : 2]
        began = time.process_time()
        if number:
            predictor.adapt(views, number, report_nothing)
        start = time.process_time()
        scene = predictor.predict(views)
        seconds = time.process_time() - start
        for target in arc[1 : 2 * count - 2 : 2]:
            drawn, truth = boxes(scene, images[target])
            found.append(Score(number, count, psnr(drawn, truth), ssim(drawn, truth), seconds, start - began))
            if pictures is not None:
                error = (1 - 3 * (drawn - truth).abs()).clamp(0, 1)
                name = f"{network.stem}_{data.root.name}_{count}_{number}_{target:02d}.png"
                write_image(pictures / name, torch.cat([truth, drawn, error], dim=1).numpy())
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", type=Path)
    parser.add_argument("networks", type=Path, nargs="+")
    parser.add_argument("--steps", default="0,10", help="for human_predictor: of training on the images")
    parser.add_argument("--people", type=int, help="only the first N")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    print("| network | 2 views | 3 views | 4 views | CPU seconds |\n|---|---|---|---|---|")
    people = captures_in(DataConfig(root=given.held_out))[: given.people]
    for network in given.networks:
        adapts = trained_network(network)[0].model.kind == "human_predictor"
        steps = [int(number) for number in given.steps.split(",")] if adapts else [0]
        found = [s for i, data in enumerate(people) for s in scores_of(network, data, i, steps, given.pictures)]
        for number in steps:
            same = [s for s in found if s.steps == number]
            cells = [network.stem + (f", {number} steps on the images" if number else "")]
            for count in COUNTS:
                own = [s for s in same if s.count == count]
                cells.append(f"{fmean(s.psnr for s in own):.2f} dB, {fmean(s.ssim for s in own):.3f}")
            seconds = "/".join(f"{median(s.seconds for s in same if s.count == count):.2f}" for count in COUNTS)
            cells.append(seconds + (f" (+{median(s.training for s in same):.1f})" if number else ""))
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
