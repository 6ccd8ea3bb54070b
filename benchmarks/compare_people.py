"""Networks that predict people, given the same few views of people that they were not trained on.

    python benchmarks/compare_people.py PEOPLE NETWORK... --counts 2 3 4 [--spread] [--starts N]
                                        [--minutes M] --out FOLDER

``--minutes``: an avatar is trained on the same images alone for so long, too. Times are CPU seconds
of one thread. Writes the scores as .csv, the table as .md and pictures of truth, prediction and
error.
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from statistics import fmean, median

import numpy as np
import torch
from torch import Tensor

from dyngs.api.predict import read_trained_network, require_network
from dyngs.api.scene_file import num_bytes_exact
from dyngs.api.train import train
from dyngs.cli.output import numbers_table, print_messages, print_tables
from dyngs.config import DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info
from dyngs.core.metrics import psnr, ssim
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import list_captures, read_capture
from dyngs.human.predict.gps.rectification import angle_between_views, order_around_person
from dyngs.io.outputs import atomic_folder
from dyngs.io.write import write_image, write_text
from dyngs.models.prediction import Predictor
from dyngs.models.renderable import Renderable
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import load_run
from dyngs.runs.folder import require_empty
from dyngs.study.report import Table, csv_text, markdown_table

STEM = "comparison"
APART = 30.0
"""Degrees between neighbours in an arc."""
Method = Callable[[list[int]], tuple[Renderable, float, float]]
"""Makes a scene of views; returns it, the CPU seconds of that, and those of training on them
before."""


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
        starts: places of the ring that the views of each person start from, one after the other.
    """

    people: Path
    networks: Sequence[Path]
    counts: Sequence[int]
    spread: bool = False
    avatar_minutes: float | None = None
    data: Sequence[str] = ()
    starts: int = 1


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


def compare_people(bench: PeopleBench, out: Path) -> Table:
    """Write ``out`` with the scores as .csv, the table as .md, and pictures of truth, prediction
    and error; return the table. What does not suit a network is logged, and left out.

    Raises:
        DyngsError: no such networks or people, ``out`` is not empty, or nothing could be predicted.
    """
    require_empty(out)
    names = [network.stem for network in bench.networks]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DyngsError(
            f"two networks are named {twice}; the table needs one name each: rename a run"
        )
    loaded = [(network.stem, *read_trained_network(network)) for network in bench.networks]
    words = [f"data.root={bench.people}", *(f"data.{word}" for word in bench.data)]
    given = load_config(packaged_preset("static"), words).data
    changed = {word.partition("=")[0] for word in bench.data}
    found: list[Score] = []
    with atomic_folder(out, require_empty) as folder:
        pictures = folder / "pictures"
        for number, person in enumerate(list_captures(given)):
            for name, config, checkpoint in loaded:
                own = {key: getattr(given, key) for key in changed}
                data = config.data.model_copy(update={"root": person.root, "test_every": 0} | own)
                kind = require_network(config, Path(name))
                make = partial(
                    kind.networks()[1], config, checkpoint, data, log_info, ignore_progress
                )
                views = make().views
                methods: dict[str, Method] = {name: partial(_predicted, make, False)}
                if config.model.kind == "human_predictor":
                    methods[f"{name}, trained on the images"] = partial(_predicted, make, True)
                if bench.avatar_minutes is not None and name == names[0]:
                    runs = folder / "avatars" / person.root.name
                    label = f"avatar, {60 * bench.avatar_minutes:.0f} s"
                    methods[label] = partial(_avatar, data, views, bench.avatar_minutes, runs)
                tests = read_capture(data).splits.get("test", ())
                for label, method in methods.items():
                    try:
                        for count, start in product(bench.counts, range(bench.starts)):
                            first = number + start
                            sources, targets = task_of(views, tests, count, first, bench.spread)
                            if targets:
                                images = ImageLoader(tuple(targets), data)
                                made = method(sources)
                                found += _scores(
                                    label, made, images, count, person.root.name, pictures
                                )
                    except DyngsError as error:
                        log_info(f"{label} left out: {error}")
        if not found:
            raise DyngsError(f"{bench.people}: nothing could be predicted")
        table = _table(found, bench.counts)
        write_text(folder / f"{STEM}.csv", csv_text([asdict(score) for score in found]))
        write_text(folder / f"{STEM}.md", markdown_table(table.head, table.cells))
    return table


def task_of(
    views: tuple[View, ...], tests: tuple[View, ...], count: int, first: int, spread: bool
) -> tuple[list[int], list[View]]:
    """Return ``count`` views to predict from, as indices, from the one in place ``first`` of the
    ring on, and the views to compare with.

    They are compared with the views in the middle between neighbours, or where there is a split
    `test` with those of its views, in an arc those between neighbours.
    """
    moment = views[0].frame, views[0].time
    ring = order_around_person(
        views, [i for i, view in enumerate(views) if (view.frame, view.time) == moment]
    )
    step = len(ring) / count if spread else max(1, round(len(ring) * APART / 360))

    def at(place: float) -> int:
        return ring[(first + round(place * step)) % len(ring)]

    sources = [at(k) for k in range(count)]
    if not tests:
        return sources, [views[at(k + 0.5)] for k in range(count if spread else count - 1)]
    found = [view for view in tests if (view.frame, view.time) == moment]
    if not spread:
        gaps = [(views[a], views[b]) for a, b in pairwise(sources)]
        found = [
            x
            for x in found
            if any(
                angle_between_views(x, a) + angle_between_views(x, b)
                < 1.3 * angle_between_views(a, b)
                for a, b in gaps
            )
        ]
    return sources, found


def boxes(scene: Renderable, image: Image) -> tuple[Tensor, Tensor]:
    """Return the box of the person as predicted and in truth (H, W, 3), on white."""
    white = torch.ones(3, device=scene.device)
    with torch.no_grad():
        drawn = scene.render(image.cameras, image.time, background=white).rgb[0].clamp(0, 1).cpu()
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    box = np.s_[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]
    return drawn[box], image.composite(white.cpu())[box]


def _predicted(
    make: Callable[[], Predictor], adapts: bool, sources: list[int]
) -> tuple[Renderable, float, float]:
    """Predict with one network, after training on the images if it ``adapts``."""
    predictor = make()
    began = time.process_time()
    if adapts:
        predictor.adapt(sources, None, ignore_progress)
    start = time.process_time()
    scene = predictor.predict(sources)
    return scene, time.process_time() - start, start - began


def _avatar(
    data: DataConfig, views: tuple[View, ...], minutes: float, runs: Path, sources: list[int]
) -> tuple[Renderable, float, float]:
    """Train an avatar on the same images; a camera of the capture has one view of the first
    moment."""
    cameras = [[v for v in views if v.frame == views[i].frame].index(views[i]) for i in sources]
    words = [
        f"data.root={data.root}",
        f"data.train_cameras={cameras}",
        "data.test_every=0",
        f"train.minutes={minutes}",
        "run.threads=1",
        f"run.dir={runs / str(len(sources))}",
    ]
    words += [] if data.longest_side is None else [f"data.longest_side={data.longest_side}"]
    words += [] if views[0].frame is None else ["data.frames=0:1"]
    began = time.process_time()
    scene = load_run(train(load_config(packaged_preset("human"), words))).renderable
    return scene, 0.0, time.process_time() - began


def _scores(
    method: str,
    made: tuple[Renderable, float, float],
    images: ImageLoader,
    count: int,
    person: str,
    pictures: Path,
) -> Iterator[Score]:
    """Yield those of one person, and write the pictures."""
    scene, seconds, training = made
    megabytes = 1e-6 * num_bytes_exact(scene)
    boxes(scene, images[0])  # what is found out once is not part of a picture's time
    for image in (images[i] for i in range(len(images))):
        start = time.process_time()
        drawn, truth = boxes(scene, image)
        drawing = time.process_time() - start
        values = psnr(drawn, truth), ssim(drawn, truth), seconds, training, drawing, megabytes
        yield Score(method, person, image.name, count, *values)
        error = (1 - 3 * (drawn - truth).abs()).clamp(0, 1)
        words = re.sub(r"[, ]+", "_", method), person, str(count), Path(image.name).stem
        path = pictures / f"{'_'.join(words)}.png"
        write_image(path, torch.cat([truth, drawn, error], dim=1).numpy())


def _table(found: Sequence[Score], counts: Sequence[int]) -> Table:
    """Return the table: means over people and views, medians of times."""
    last = ("scene, CPU s", "trained, CPU s", "ms a picture", "MB")
    head = ["method", *(format_count(n, "view") for n in counts), *last]
    cells = []
    for name in dict.fromkeys(score.method for score in found):
        own = [score for score in found if score.method == name]
        by_count = [[score for score in own if score.count == n] for n in counts]
        quality = [
            f"{fmean(s.psnr for s in x):.2f} dB, {fmean(s.ssim for s in x):.3f}" if x else "-"
            for x in by_count
        ]
        seconds = [f"{median(s.seconds for s in x):.2f}" if x else "-" for x in by_count]
        cells.append(
            [
                name,
                *quality,
                ", ".join(seconds),
                f"{median(s.training for s in own):.1f}",
                f"{1e3 * median(s.drawing for s in own):.0f}",
                f"{median(s.megabytes for s in own):.2f}",
            ]
        )
    return Table("box of the person on white", head, cells)


def main() -> None:
    """Compare, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("people", type=Path)
    parser.add_argument("networks", type=Path, nargs="+")
    parser.add_argument("--counts", type=int, nargs="+", default=[2, 3, 4])
    parser.add_argument("--spread", action="store_true")
    parser.add_argument("--starts", type=int, default=1)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--data", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    print_messages()
    bench = PeopleBench(
        given.people,
        given.networks,
        given.counts,
        given.spread,
        given.minutes,
        given.data,
        given.starts,
    )
    with kernel_threads(1):
        table = compare_people(bench, given.out)
    print_tables(numbers_table(table.title, table.head, table.cells))


if __name__ == "__main__":
    main()
