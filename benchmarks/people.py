"""Networks that predict people, given the same two to four views of people that they were not trained on.

    python benchmarks/people.py HELD_OUT NET [NET ...] [--spread] [--counts 2,3,4] [--steps 0,10] [--avatar SECONDS]
        [--people N] [--turns 1] [--size PX] [--threads 1] [--pictures FOLDER]

HELD_OUT is a set of `dyngs data synth people` with another seed than that of training, or a folder of captures with a
split `test`; NET are runs of networks, or files of weights. Of each person the views of an arc, 30 degrees apart, are
predicted from; with --spread views evenly around the person. What is predicted is compared with the views in the middle
between neighbours, or where there is a split `test` with those of its views, in an arc those between neighbours.

Printed: PSNR and SSIM in the box of the person, on white; CPU seconds from decoded images to a scene, and milliseconds
of a picture; megabytes of the scene's tensors. `human_predictor` comes again after training on these images for so many
--steps (its time is in brackets); --avatar trains `human` on these images alone for so many CPU seconds. Without body
parameters in HELD_OUT they are fitted to all its views first, as `dyngs predict` does, which is not counted.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch
from torch import Tensor

from dyngs.api.predict import trained_network
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.conventions import report_nothing
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.files.write import write_image
from dyngs.gps.pairs import angle, around
from dyngs.kinds import assemble
from dyngs.metrics import psnr, ssim
from dyngs.models.kind import kind_of
from dyngs.models.prediction import Predictor
from dyngs.models.renderable import Renderable
from dyngs.training.clock import with_steps

APART = 30.0
"""Degrees between neighbours in an arc."""
TRIED = 20  # Steps of an avatar from which their number follows


@dataclass(frozen=True)
class Score:
    """One view of a scene."""

    name: str
    count: int  # of views predicted from
    psnr: float
    ssim: float
    seconds: float  # of the prediction
    training: float  # seconds of training on these images
    drawing: float  # seconds
    megabytes: float


@dataclass(frozen=True)
class Task:
    """Views to predict from, as indices of those of the capture, and views to compare with."""

    sources: list[int]
    targets: list[View]


def task_of(views: tuple[View, ...], tests: tuple[View, ...], count: int, first: int, spread: bool) -> Task:
    """Return that for ``count`` views from the one in place ``first`` of the ring on."""
    moment = views[0].frame, views[0].time
    ring = around(views, [i for i, view in enumerate(views) if (view.frame, view.time) == moment])
    step = len(ring) / count if spread else max(1, round(len(ring) * APART / 360))

    def at(place: float) -> int:
        return ring[(first + round(place * step)) % len(ring)]

    sources = [at(k) for k in range(count)]
    if not tests:
        return Task(sources, [views[at(k + 0.5)] for k in range(count if spread else count - 1)])
    found = [view for view in tests if (view.frame, view.time) == moment]
    if not spread:
        gaps = [(views[a], views[b]) for a, b in pairwise(sources)]
        found = [x for x in found if any(angle(x, a) + angle(x, b) < 1.3 * angle(a, b) for a, b in gaps)]
    return Task(sources, found)


def boxes(scene: Renderable, image: Image) -> tuple[Tensor, Tensor]:
    """Return the box of the person as predicted and in truth (H, W, 3), on white."""
    white = torch.ones(3)
    with torch.no_grad():
        drawn = scene.render(image.cameras, image.time, background=white).rgb[0].clamp(0, 1)
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    box = np.s_[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
    return drawn[box], image.composite(white)[box]


@dataclass(frozen=True)
class Method:
    """How a scene is made of views; ``make`` returns it, seconds, and those of training on them before."""

    name: str
    make: Callable[[list[int]], tuple[Renderable, float, float]]


def methods_of(trained: Callable[[], Predictor], name: str, steps: list[int]) -> Iterator[Method]:
    """Return the ways of one network with one person; ``trained`` returns it as it was trained."""
    for number in steps:

        def make(views: list[int], number: int = number) -> tuple[Renderable, float, float]:
            predictor, began = trained(), time.process_time()
            if number:
                predictor.adapt(views, number, report_nothing)
            start = time.process_time()
            scene = predictor.predict(views)
            return scene, time.process_time() - start, start - began

        yield Method(name + (f", {number} steps on the images" if number else ""), make)


def avatar_of(data: DataConfig, views: tuple[View, ...], seconds: float) -> Method:
    """Return the way of `human`; a camera of the capture has one view of the first moment."""

    def make(chosen: list[int]) -> tuple[Renderable, float, float]:
        cameras = [[v for v in views if v.frame == views[i].frame].index(views[i]) for i in chosen]
        words = [f"data.root={data.root}", f"data.train_cameras={cameras}", "run.threads=1", "data.test_every=0"]
        moment = [] if views[0].frame is None else ["data.frames=0:1"]
        config = load_config(packaged_preset("human"), words + moment)
        _, setup, stepping = trained_avatar(config, TRIED)
        steps = max(TRIED, round((seconds - setup) / stepping * TRIED))
        scene, *spent = trained_avatar(config, steps)
        return scene, 0.0, sum(spent)

    return Method(f"avatar, {seconds:g} s of training", make)


def trained_avatar(config: Config, steps: int) -> tuple[Renderable, float, float]:
    """Return an avatar after so many steps, and the CPU seconds before and of these."""
    began = time.process_time()
    trainer = assemble(with_steps(config, steps))
    ready = time.process_time()
    for _ in range(steps):
        trainer.step()
    return trainer.model.scene, ready - began, time.process_time() - ready


def scores_of(method: Method, tasks: list[Task], data: DataConfig, pictures: Path | None) -> Iterator[Score]:
    """Return those of one person."""
    for task in tasks:
        scene, seconds, training = method.make(task.sources)
        stored = sum(x.numel() * x.element_size() for x in (y.tensor for y in scene.drawing_state().values())) / 1e6
        images = ImageLoader(tuple(task.targets), data)
        if task.targets:
            boxes(scene, images[0])  # what is found out once is not part of a picture's time
        for i, target in enumerate(task.targets):
            start = time.process_time()
            drawn, truth = boxes(scene, images[i])
            drawing = time.process_time() - start
            count, values = len(task.sources), (psnr(drawn, truth), ssim(drawn, truth))
            yield Score(method.name, count, *values, seconds, training, drawing, stored)
            if pictures is not None:
                error = (1 - 3 * (drawn - truth).abs()).clamp(0, 1)
                name = f"{method.name.replace(', ', '_').replace(' ', '_')}_{data.root.name}_{count}"
                write_image(
                    pictures / f"{name}_{Path(target.name).stem}.png", torch.cat([truth, drawn, error], dim=1).numpy()
                )


def line(name: str, found: list[Score], counts: list[int]) -> str:
    """Return a line of the table."""
    cells, times = [name], []
    for count in counts:
        own = [s for s in found if s.count == count]
        cells.append(f"{fmean(s.psnr for s in own):.2f} dB, {fmean(s.ssim for s in own):.3f}")
        times.append(f"{median(s.seconds for s in own):.2f}")
    training = median(s.training for s in found)
    cells.append("/".join(times) + (f" (+{training:.1f})" if training > 0.01 else ""))
    cells += [f"{1e3 * median(s.drawing for s in found):.0f}", f"{median(s.megabytes for s in found):.2f}"]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("held_out", type=Path)
    parser.add_argument("networks", type=Path, nargs="+")
    parser.add_argument("--spread", action="store_true", help="views evenly around the person, not of an arc")
    parser.add_argument("--counts", default="2,3,4", help="of views to predict from")
    parser.add_argument("--steps", default="0,10", help="for human_predictor: of training on the images")
    parser.add_argument("--avatar", type=float, help="CPU seconds for which an avatar is trained on the images")
    parser.add_argument("--people", type=int, help="only the first N")
    parser.add_argument("--turns", type=int, default=1, help="so many choices of views of each person")
    parser.add_argument("--size", type=int, help="longest side of images, px")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    counts = [int(number) for number in given.counts.split(",")]
    print(f"| network | {' | '.join(f'{n} views' for n in counts)} | CPU s | ms | MB |\n|{'---|' * (4 + len(counts))}")
    options = DataConfig(root=given.held_out, longest_side=given.size)
    people = captures_in(options)[: given.people]
    found: dict[str, list[Score]] = {}
    for network in given.networks:
        config, checkpoint = trained_network(network)
        steps = [int(number) for number in given.steps.split(",")] if config.model.kind == "human_predictor" else [0]
        for i, data in enumerate(people):
            own = config.data.model_copy(update={"root": data.root, "longest_side": given.size, "test_every": 0})
            trained = partial(
                kind_of(config.model).predictor, config, checkpoint, own, say=print, report=report_nothing
            )
            views = trained().views
            tests = read_capture(own).splits.get("test", ())
            tasks = [task_of(views, tests, n, i + 2 * k, given.spread) for n in counts for k in range(given.turns)]
            methods = [*methods_of(trained, network.stem, steps)]
            if given.avatar and network == given.networks[0]:
                methods.append(avatar_of(own, views, given.avatar))
            for method in methods:
                try:
                    found.setdefault(method.name, []).extend(scores_of(method, tasks, own, given.pictures))
                except DyngsError as error:
                    print(f"{method.name}: {error}")
    for name, scores in found.items():
        print(line(name, scores, counts))


if __name__ == "__main__":
    main()
