"""Networks that predict people, given the same few views of people that they were not trained on.

    python benchmarks/people.py HELD_OUT RUN [RUN ...] [--views 2 3 4] [--threads 1] [--pictures FOLDER]

HELD_OUT is a set of `dyngs data synth people` with another seed than that of training. Without --views four pairs of
neighbouring views are taken of each person, 30 and 45 degrees apart, and what is predicted of each pair is compared
with the view in the middle of the two, or next to it. With --views so many, evenly around the person, and every third
of the other views. Printed per run: PSNR and SSIM in the box of the person, on white, and CPU seconds from decoded
images to a scene, and to draw a picture; training on these images (`dyngs predict --steps`) is not counted.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch
from torch import Tensor

from dyngs.api.predict import network_config
from dyngs.config import DataConfig
from dyngs.data.capture import View
from dyngs.data.loader import ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.files.write import write_image
from dyngs.gps.pairs import lessons
from dyngs.human_fields.people import moments, spread
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

    group: str  # what it is predicted from
    psnr: float
    ssim: float
    seconds: float  # to the scene
    seconds_drawn: float


@dataclass(frozen=True)
class Question:
    """Views to predict from, and those to compare with."""

    group: str
    given: list[int]
    targets: list[int]


def questions(views: Sequence[View], counts: Sequence[int]) -> list[Question]:
    """Pairs of neighbours without ``counts``, else so many views around the person."""
    if not counts:
        known, found = lessons(views), []
        for between, name in ((1, "30 degrees"), (2, "45 degrees")):
            fitting = [lesson for lesson in known if len(lesson[1]) == between]
            chosen = fitting[:: max(1, len(fitting) // PAIRS)][:PAIRS]
            found += [Question(name, [pair.left, pair.right], targets[:1]) for pair, targets in chosen]
        return found
    ring = next(iter(moments(views).values()))
    given = [spread(ring, count) for count in counts]
    return [Question(f"{len(x)} views", x, [i for i in ring if i not in x][1::3]) for x in given]


def asked(predictor: Predictor, images: ImageLoader, question: Question) -> list[tuple[Score, Tensor]]:
    """Scores, and boxes of the person in truth, as predicted, and the error (H, W, 3) side by side."""
    start = time.process_time()
    scene: Renderable = predictor.predict(question.given)
    seconds, white, found = time.process_time() - start, torch.ones(3), []
    for target in question.targets:
        image, start = images[target], time.process_time()
        with torch.no_grad():
            drawn = scene.render(image.cameras, image.time, background=white).rgb[0].clamp(0, 1)
        took = time.process_time() - start
        assert image.alpha is not None
        rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
        box = np.s_[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
        drawn, truth = drawn[box], image.composite(white)[box]
        sheet = torch.cat([truth, drawn, (1 - 3 * (drawn - truth).abs()).clamp(0, 1)], dim=1)
        found.append((Score(question.group, psnr(drawn, truth), ssim(drawn, truth), seconds, took), sheet))
    return found


def scores_of(run: Path, data: DataConfig, given: argparse.Namespace, steps: int) -> list[Score]:
    """All questions about one person."""
    config, found = network_config(run), []
    own = config.data.model_copy(update={"root": data.root})
    checkpoint = latest_checkpoint(run)
    predictor = kind_of(config.model).predictor(config, checkpoint, own)
    images = ImageLoader(predictor.views, own)
    for question in questions(predictor.views, given.views):
        if steps:
            predictor = kind_of(config.model).predictor(config, checkpoint, own)
            predictor.adapt(question.given, steps, lambda *_: None)
        answers = asked(predictor, images, question)
        found += [score for score, _ in answers]
        if given.pictures is not None:
            for target, (_, sheet) in zip(question.targets, answers, strict=True):
                name = f"{run.name}_{data.root.name}_{question.group.replace(' ', '_')}_{target:02d}.png"
                write_image(given.pictures / name, sheet.numpy())
    return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", type=Path)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--views", type=int, nargs="+", default=[])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--people", type=int, help="the first of them only")
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    groups = [f"{count} views" for count in given.views] or ["30 degrees", "45 degrees"]
    columns = [*groups, "CPU seconds to the scene", "and a picture"]
    print(f"| network | {' | '.join(columns)} |\n{'|---' * (1 + len(columns))}|")
    for run in given.runs:
        adapts = network_config(run).model.kind == "human_predictor"
        for steps in (0, 10) if adapts else (0,):
            people = captures_in(DataConfig(root=given.held_out))[: given.people]
            found = [score for data in people for score in scores_of(run, data, given, steps)]
            cells = [run.name + (f", {steps} steps on the images" if steps else "")]
            for group in groups:
                own = [score for score in found if score.group == group]
                cells.append(f"{fmean(s.psnr for s in own):.2f} dB, {fmean(s.ssim for s in own):.3f}")
            cells += [f"{median(s.seconds for s in found):.2f}", f"{median(s.seconds_drawn for s in found):.2f}"]
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
