"""Networks that predict people, given the same few views of people that they were not trained
on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch
from torch import Tensor

from dyngs.api.predict import require_network, trained_network
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import report_nothing
from dyngs.core.errors import DyngsError, counted, show
from dyngs.core.metrics import psnr, ssim
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.data.read import read_capture
from dyngs.human.predict.gps.pairs import angle, around
from dyngs.io.outputs import new_folder
from dyngs.io.write import write_image, write_text
from dyngs.models.prediction import Predictor
from dyngs.models.renderable import Renderable
from dyngs.runs.folder import require_empty
from dyngs.study.tables import csv_text, markdown_table
from dyngs.training.clock import with_steps
from dyngs.training.new_trainer import assemble

STEM = "comparison"
APART = 30.0
"""Degrees between neighbours in an arc."""
_TRIED = 20  # Steps of an avatar from which their number follows


@dataclass(frozen=True)
class PeopleBench:
    """What is compared with what.

    Attributes:
        people: a set of `dyngs data synth people` with another seed than that of training, or a
            folder of captures.
        networks: runs, files of weights, or names of published ones.
        counts: of views to predict from.
        spread: views evenly around the person; else of an arc, ``APART`` apart.
        avatar_minutes: a `human` avatar is trained on the same images alone for so long; None: none
            is.
        data: overrides of the section ``data``, as "longest_side=256".
    """

    people: Path
    networks: Sequence[Path]
    counts: Sequence[int]
    spread: bool = False
    avatar_minutes: float | None = None
    data: Sequence[str] = ()


@dataclass(frozen=True)
class Score:
    """One view of one person by one method; PSNR and SSIM in the box of the person, on white."""

    method: str
    person: str
    view: str
    count: int  # of views predicted from
    psnr: float
    ssim: float
    seconds: float  # CPU, of the prediction
    training: float  # CPU seconds of training on these images before
    drawing: float  # CPU seconds
    megabytes: float


@dataclass(frozen=True)
class Task:
    """Views to predict from, as indices of those of the capture, and views to compare with."""

    sources: list[int]
    targets: list[View]


@dataclass(frozen=True)
class Method:
    """How a scene is made of views; ``make`` returns it, CPU seconds, and those of training on them
    before."""

    name: str
    make: Callable[[list[int]], tuple[Renderable, float, float]]


def compare_people(
    bench: PeopleBench, out: Path, say: Callable[[str], None] = show
) -> tuple[list[str], list[list[str]]]:
    """Write ``out`` with the scores as .csv, the table as .md, and pictures of truth, prediction
    and error.

    Return head and cells of the table. What does not suit a network is told, and left out.

    Raises:
        DyngsError: no such networks or people, ``out`` is not empty, or nothing could be predicted.
    """
    require_empty(out)
    names = [network.stem for network in bench.networks]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise DyngsError(
            f"two networks are named {twice}; the table needs one name each: rename a run"
        )
    loaded = [(network.stem, *trained_network(network)) for network in bench.networks]
    given = DataConfig.model_validate({"root": bench.people})
    if bench.data:
        given = load_config(
            packaged_preset("static"),
            [f"data.root={bench.people}", *(f"data.{x}" for x in bench.data)],
        ).data
    changed = {
        word.partition("=")[0]: getattr(given, word.partition("=")[0]) for word in bench.data
    }
    found: list[Score] = []
    with new_folder(out, require_empty) as folder:
        for number, person in enumerate(captures_in(given)):
            for name, config, checkpoint in loaded:
                data = config.data.model_copy(
                    update={"root": person.root, "test_every": 0} | changed
                )
                make = partial(
                    require_network(config, bench.people).networks()[1],
                    config,
                    checkpoint,
                    data,
                    say,
                    report_nothing,
                )
                views = make().views
                methods = [*_methods(make, name, config)]
                if bench.avatar_minutes is not None and name == loaded[0][0]:
                    methods.append(_avatar(data, views, 60 * bench.avatar_minutes))
                tests = read_capture(data).splits.get("test", ())
                for method in methods:
                    try:
                        for count in bench.counts:
                            task = task_of(views, tests, count, number, bench.spread)
                            found += _scores(method, task, data, folder / "pictures")
                    except DyngsError as error:
                        say(f"{method.name} left out: {error}")
        if not found:
            raise DyngsError(f"{bench.people}: nothing could be predicted")
        head, cells = _table(found, bench.counts)
        write_text(folder / f"{STEM}.csv", csv_text([asdict(score) for score in found]))
        write_text(folder / f"{STEM}.md", markdown_table(head, cells))
    return head, cells


def task_of(
    views: tuple[View, ...], tests: tuple[View, ...], count: int, first: int, spread: bool
) -> Task:
    """Return that for ``count`` views from the one in place ``first`` of the ring on.

    They are compared with the views in the middle between neighbours, or where there is a split
    `test` with those of its views, in an arc those between neighbours.
    """
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
        found = [
            x for x in found if any(angle(x, a) + angle(x, b) < 1.3 * angle(a, b) for a, b in gaps)
        ]
    return Task(sources, found)


def boxes(scene: Renderable, image: Image) -> tuple[Tensor, Tensor]:
    """Return the box of the person as predicted and in truth (H, W, 3), on white."""
    white = torch.ones(3, device=scene.device)
    with torch.no_grad():
        drawn = scene.render(image.cameras, image.time, background=white).rgb[0].clamp(0, 1).cpu()
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    box = np.s_[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
    return drawn[box], image.composite(white.cpu())[box]


def _methods(trained: Callable[[], Predictor], name: str, config: Config) -> Iterator[Method]:
    """Yield the ways of one network with one person: as it is, and after training on the images
    where it does that."""
    for adapts in (False, True) if config.model.kind == "human_predictor" else (False,):

        def make(views: list[int], adapts: bool = adapts) -> tuple[Renderable, float, float]:
            predictor = trained()
            began = time.process_time()
            if adapts:
                predictor.adapt(views, None, report_nothing)
            start = time.process_time()
            scene = predictor.predict(views)
            return scene, time.process_time() - start, start - began

        yield Method(name + (", trained on the images" if adapts else ""), make)


def _avatar(data: DataConfig, views: tuple[View, ...], seconds: float) -> Method:
    """Return the way of `human`; a camera of the capture has one view of the first moment."""

    def make(chosen: list[int]) -> tuple[Renderable, float, float]:
        cameras = [[v for v in views if v.frame == views[i].frame].index(views[i]) for i in chosen]
        words = [
            f"data.root={data.root}",
            f"data.train_cameras={cameras}",
            "run.threads=1",
            "data.test_every=0",
        ]
        moment = [] if views[0].frame is None else ["data.frames=0:1"]
        config = load_config(packaged_preset("human"), words + moment)
        config = config.model_copy(
            update={"data": config.data.model_copy(update={"longest_side": data.longest_side})}
        )
        _, setup, stepping = _trained_avatar(config, _TRIED)
        steps = max(_TRIED, round((seconds - setup) / stepping * _TRIED))
        scene, *spent = _trained_avatar(config, steps)
        return scene, 0.0, sum(spent)

    return Method(f"avatar, {seconds:.0f} s", make)


def _trained_avatar(config: Config, steps: int) -> tuple[Renderable, float, float]:
    """Return an avatar after so many steps, and the CPU seconds before and of these."""
    began = time.process_time()
    trainer = assemble(with_steps(config, steps))
    ready = time.process_time()
    for _ in range(steps):
        trainer.step()
    return trainer.model.scene, ready - began, time.process_time() - ready


def _scores(method: Method, task: Task, data: DataConfig, pictures: Path) -> Iterator[Score]:
    """Yield those of one person, and write the pictures."""
    if not task.targets:
        return
    scene, seconds, training = method.make(task.sources)
    stored = (
        sum(
            x.numel() * x.element_size() for x in (y.tensor for y in scene.drawing_state().values())
        )
        / 1e6
    )
    images = ImageLoader(tuple(task.targets), data)
    count = len(task.sources)
    boxes(scene, images[0])  # what is found out once is not part of a picture's time
    for i, target in enumerate(task.targets):
        start = time.process_time()
        drawn, truth = boxes(scene, images[i])
        drawing = time.process_time() - start
        values = psnr(drawn, truth), ssim(drawn, truth), seconds, training, drawing, stored
        yield Score(method.name, data.root.name, target.name, count, *values)
        error = (1 - 3 * (drawn - truth).abs()).clamp(0, 1)
        name = f"{method.name.replace(', ', '_').replace(' ', '_')}_{data.root.name}_{count}_{Path(target.name).stem}"
        write_image(pictures / f"{name}.png", torch.cat([truth, drawn, error], dim=1).numpy())


def _table(found: Sequence[Score], counts: Sequence[int]) -> tuple[list[str], list[list[str]]]:
    """Return head and cells: means over people and views, medians of times."""
    head = [
        "method",
        *(counted(n, "view") for n in counts),
        "scene, CPU s",
        "trained, CPU s",
        "ms a picture",
        "MB",
    ]
    cells = []
    for name in dict.fromkeys(score.method for score in found):
        by_count = [[s for s in found if s.method == name and s.count == n] for n in counts]
        own = [s for some in by_count for s in some]
        cells.append(
            [
                name,
                *(
                    f"{fmean(s.psnr for s in x):.2f} dB, {fmean(s.ssim for s in x):.3f}"
                    if x
                    else "-"
                    for x in by_count
                ),
                ", ".join(f"{median(s.seconds for s in x):.2f}" if x else "-" for x in by_count),
                f"{median(s.training for s in own):.1f}",
                f"{1e3 * median(s.drawing for s in own):.0f}",
                f"{median(s.megabytes for s in own):.2f}",
            ]
        )
    return head, cells
