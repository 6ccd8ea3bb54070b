"""The network that predicts people, on held-out synthetic people, compared with mean textures.

    python benchmarks/human_predictor.py FOLDER [--people 48] [--held-out 6] [--size 128] [--steps 4000] [--threads 1]

People differ in body shape, clothes, light and clips. Usual clothes are worn by every other training person, and by the
second half of the held-out ones. FOLDER keeps the captures and the run, which are reused. Printed per held-out person,
for other cameras (`test`) and another clip (`pose`): PSNR in the box of the person / of the whole image, from three
images of one time or from one, by

- network: the result of `dyngs predict`;
- as trained: the same without adaptation to the images (`--steps 0`);
- seen, else nearby: the template with the colours of the three images where visible, elsewhere with colours nearby;
- mean texture: the template with the mean texture of the training people;
and the seconds from images in memory or on disk to Gaussians.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch

from dyngs.api.predict import network_config, predict, write_run
from dyngs.api.train import train
from dyngs.config import Config, HumanPredictorModel
from dyngs.config.io import load_config, packaged_preset
from dyngs.evaluate.report import evaluate_run
from dyngs.gaussians.schedule import Rates
from dyngs.human.prediction.learner import (
    PersonPredictor,
    filmed,
    human_options,
    load_network,
    new_network,
    scene_of,
)
from dyngs.human.prediction.network import predict_gaussians
from dyngs.human.prediction.person import spread_views
from dyngs.human.prediction.texel_maps import from_atlas
from dyngs.human.synthetic.capture import HumanOptions, varied, write_human_capture
from dyngs.human.template.body_reader import load_template
from dyngs.runs.checkpoint import checkpoint_paths, latest_checkpoint, seconds_at

FIRST_HELD_OUT = 101
"""Seed of the first held-out person."""

SPLITS = ("test", "pose")

ADAPTED = 10
"""Steps on the images of a person, as `dyngs predict` has it."""


@dataclass(frozen=True)
class Row:
    """Results of one method for one person: name, PSNR by split (box, whole image), seconds."""

    name: str
    psnr: dict[str, tuple[float, float]]
    seconds: float


def captures(folder: Path, seeds: range, options: HumanOptions, usual: range) -> None:
    """Write the synthetic people that do not exist yet, those of the seeds ``usual`` in usual clothes."""
    for seed in seeds:
        if not (folder / f"p{seed:03d}").exists():
            person = varied(replace(options, usual_clothes=seed in usual), seed)
            write_human_capture(folder / f"p{seed:03d}", person)


def trained(folder: Path, run: Path, steps: int, threads: int) -> Path:
    """Train the network, or continue its run; return the run folder."""
    words = [f"data.root={folder}", f"run.dir={run}", f"run.threads={threads}", f"train.steps={steps}"]
    config: Config = load_config(packaged_preset("human_predictor"), words)
    return train(config, resume_from=run if checkpoint_paths(run) else None)


def scored(name: str, run: Path, seconds: float) -> Row:
    """PSNR of a run on both splits."""
    reports = {split: evaluate_run(run, split, threads=1) for split in SPLITS}
    return Row(name, {split: (r.psnr_person or 0.0, r.psnr) for split, r in reports.items()}, seconds)


def predicted(network: Path, capture: Path, out: Path, views: int, steps: int) -> Row:
    """The result of `dyngs predict` from so many images, after so many steps on these."""
    name = f"network, {views} views" + ("" if steps else ", as trained")
    run = out / f"network_{views}_{steps}"
    if not checkpoint_paths(run):
        predict(network, capture, run, views, steps=steps)
    return scored(name, run, seconds_at(run, 0))


def baselines(network: Path, capture: Path, out: Path, count: int) -> list[Row]:
    """The bare template, coloured without the network."""
    config = network_config(network)
    model = config.model
    untrained = new_network(model, torch.Generator("cpu"))
    mean = load_network(untrained, latest_checkpoint(network), model.resolution)
    bare: HumanPredictorModel = model.model_copy(update={"scaffold_heights": (min(model.scaffold_heights),)})
    data = config.data.model_copy(update={"root": capture.absolute()})
    person = filmed(data, bare, load_template(human_options(bare)))
    predictor, rows = PersonPredictor(config, bare, untrained, mean, person, data), []
    for name in ("seen, else nearby", "mean texture"):
        start = time.perf_counter()
        maps = person.look(spread_views(person.sitter, count))
        if name == "mean texture":
            maps = replace(maps, seen=torch.zeros_like(maps.seen), nearby=from_atlas(mean, person.sitter.texels))
        avatar = predict_gaussians(person.sitter, maps, mean, None, bare.min_silhouette_fraction)
        seconds = time.perf_counter() - start
        run = out / name.replace(", ", "_").replace(" ", "_")
        if not checkpoint_paths(run):
            scene = scene_of(human_options(bare), avatar, Rates(1))[0]
            write_run(run, predictor, [], scene, seconds)
        rows.append(scored(name, run, seconds))
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--people", type=int, default=48)
    parser.add_argument("--held-out", type=int, default=6)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    options = HumanOptions(size=given.size, num_frames=5, num_new=0, num_test=0)
    seeds = range(1, given.people + 1)
    captures(given.folder / "train", seeds, options, seeds[1::2])
    held_out = range(FIRST_HELD_OUT, FIRST_HELD_OUT + given.held_out)
    captures(
        given.folder / "held_out", held_out, replace(options, num_new=4, num_test=4), held_out[len(held_out) // 2 :]
    )
    network = trained(given.folder / "train", given.folder / "network", given.steps, given.threads)
    torch.set_num_threads(given.threads)
    table: dict[str, list[Row]] = {}
    for seed in held_out:
        capture, out = given.folder / "held_out" / f"p{seed:03d}", given.folder / "predicted" / f"p{seed:03d}"
        rows = [predicted(network, capture, out, *which) for which in ((3, ADAPTED), (3, 0), (1, ADAPTED), (1, 0))]
        for row in (*rows, *baselines(network, capture, out, 3)):
            table.setdefault(row.name, []).append(row)
            print(line(f"{seed} {row.name}", [row]), flush=True)
    for name, rows in table.items():
        print(line(f"mean {name}", rows))


def line(name: str, rows: list[Row]) -> str:
    """A row of a table in Markdown: means."""
    cells = [" / ".join(f"{fmean(row.psnr[split][which] for row in rows):.2f}" for which in (0, 1)) for split in SPLITS]
    return f"| {name} | {' | '.join(cells)} | {fmean(row.seconds for row in rows):.2f} s |"


if __name__ == "__main__":
    main()
