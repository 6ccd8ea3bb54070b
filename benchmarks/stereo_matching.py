"""The two matchings of `gps`, and variants, trained for equal times on the same people.

    python benchmarks/stereo_matching.py PEOPLE --held-out OTHERS --captures FOLDER... --out OUT
                                         [--minutes 25] [--seeds 0 1] [--variants NAME...]
                                         [--set KEY=VALUE...]

PEOPLE and OTHERS are sets of `dyngs data synth people` with different seeds. ``--captures`` are
folders of other captures of people, without depth maps. A variant runs as many steps as its own
measured time per step allows: CPU seconds of one thread, or seconds on a GPU. OUT gets the runs,
`errors.csv`, `errors.md` with end-point errors in pixels on OTHERS after 1, 3 and 8 updates, and
one folder per set with the views between two views (`compare_people.py`). Finished runs are kept,
interrupted ones are continued.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from compare_people import PeopleBench, compare_people

from dyngs.api.predict import read_trained_network
from dyngs.api.train import train
from dyngs.cli.output import numbers_table, print_messages, print_tables
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, load_resolved, packaged_preset
from dyngs.core.errors import log_info
from dyngs.data.loader import ImageLoader
from dyngs.data.read import list_captures, read_capture
from dyngs.human.predict.gps.rectification import rectify_views, training_pairs
from dyngs.human.predict.gps.stereo import GpsNetwork, RecurrentNetwork, end_point_error
from dyngs.io.write import write_text
from dyngs.models.prediction import load_weights
from dyngs.ops.device import select_device, synchronize
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import latest_checkpoint
from dyngs.study.report import Table, csv_text, markdown_table
from dyngs.training.prediction import network_trainer

RECURRENT = ("model.matching=recurrent",)
VARIANTS: dict[str, tuple[str, ...]] = {
    "cost_volume": (),
    "recurrent": RECURRENT,
    "recurrent_8_updates": (*RECURRENT, "model.updates=8"),
    "recurrent_48_channels": (*RECURRENT, "model.channels=48"),
    "recurrent_slow": (*RECURRENT, "model.lr=4e-4"),
    "recurrent_inconsistent": (*RECURRENT, "model.consistency_weight=0"),
}
PILOT_STEPS = 12
"""Steps of either stage that are timed; as many before them are not."""
PAIRS_PER_PERSON = 4
UPDATES = (1, 3, 8)
"""Updates at which recurrent networks are scored, whatever they were trained with."""
FAR = 3.0
"""Error of a bad pixel, px."""


@dataclass(frozen=True)
class OffsetScore:
    """Errors of one network on the held-out people, means over their pairs."""

    variant: str
    seed: int
    updates: int
    end_point_error_px: float
    bad_pixels: float  # fraction with an error above ``FAR``
    seconds: float  # CPU seconds of one pair, without rectification


def config_of(people: Path, out: Path, variant: str, seed: int, words: Sequence[str]) -> Config:
    own = (f"data.root={people}", f"run.dir={out / 'runs' / f'{variant}_s{seed}'}")
    overrides = [*own, f"run.seed={seed}", "run.threads=1", *VARIANTS[variant], *words]
    return load_config(packaged_preset("gps"), overrides)


def seconds_per_step(config: Config) -> float:
    """Return the mean time of a step over both stages, weighted as in training."""
    steps = 4 * PILOT_STEPS
    section: Any = config.model
    fraction = section.depth_fraction
    model = section.model_copy(update={"depth_fraction": 0.5})
    pilot = config.model_copy(
        update={"model": model, "train": config.train.model_copy(update={"steps": steps})}
    )
    device = select_device(config.run.device)
    clock = time.perf_counter if device.type == "cuda" else time.process_time
    trainer = network_trainer(pilot)
    ends = [0.0]
    for _ in range(steps):
        trainer.step()
        synchronize(device)
        ends.append(clock())
    depth = (ends[2 * PILOT_STEPS] - ends[PILOT_STEPS]) / PILOT_STEPS
    joint = (ends[4 * PILOT_STEPS] - ends[3 * PILOT_STEPS]) / PILOT_STEPS
    return fraction * depth + (1 - fraction) * joint


def trained_run(config: Config, minutes: float) -> Path:
    """Train for so long, unless the run exists; return its folder."""
    folder = config.run.dir
    assert folder is not None
    if (folder / "config.yaml").is_file():
        return train(load_resolved(folder), resume_from=folder)
    seconds = seconds_per_step(config)
    steps = max(4, round(60 * minutes / seconds))
    log_info(f"{folder.name}: {1e3 * seconds:.0f} ms a step, {steps} steps")
    return train(
        config.model_copy(update={"train": config.train.model_copy(update={"steps": steps})})
    )


@torch.no_grad()
def offset_scores(run: Path, variant: str, seed: int, people: Path) -> list[OffsetScore]:
    """Return the errors of a network on ``people``, which have depth maps."""
    config, checkpoint = read_trained_network(run)
    section: Any = config.model
    network = GpsNetwork(torch.Generator(), section)
    load_weights(network, checkpoint)
    recurrent = network.stereo if isinstance(network.stereo, RecurrentNetwork) else None
    scores = []
    for updates in UPDATES if recurrent is not None else (1,):
        if recurrent is not None:
            recurrent.updates = updates
        errors = []
        bad = []
        times = []
        for data in list_captures(DataConfig(root=people, test_every=0)):
            views = read_capture(data).splits["train"]
            images = ImageLoader(views, data, with_maps=True)
            pairs = training_pairs(views)
            for left, right in (pair for pair, _ in pairs[:: -(-len(pairs) // PAIRS_PER_PERSON)]):
                rectified = rectify_views(images[left], images[right], section.person_px)
                start = time.process_time()
                offsets = network(rectified, with_gaussians=False)[0][-1]
                times.append(time.process_time() - start)
                errors.append(float(end_point_error(rectified, offsets)))
                known = rectified.solid & rectified.offsets.isfinite()
                wrong = (offsets - rectified.offsets)[known].abs() > FAR
                bad.append(float(wrong.float().mean()))
        scores.append(OffsetScore(variant, seed, updates, fmean(errors), fmean(bad), fmean(times)))
    return scores


def errors_table(scores: Sequence[OffsetScore], steps: dict[str, int]) -> Table:
    head = ["run", "steps", "updates", "end-point error, px", f"over {FAR:g} px", "CPU s a pair"]
    cells = []
    for score in scores:
        name = f"{score.variant}_s{score.seed}"
        cells.append(
            [
                name,
                str(steps[name]),
                str(score.updates) if score.variant != "cost_volume" else "-",
                f"{score.end_point_error_px:.2f}",
                f"{score.bad_pixels:.1%}",
                f"{score.seconds:.2f}",
            ]
        )
    return Table("end-point errors on held-out people", head, cells)


def main() -> None:
    """Train, compare, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("people", type=Path)
    parser.add_argument("--held-out", type=Path, required=True)
    parser.add_argument("--captures", type=Path, nargs="*", default=[])
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS)[:2])
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", dest="words")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    print_messages()
    runs = []
    steps = {}
    scores = []
    with kernel_threads(1):
        for seed in given.seeds:
            for variant in given.variants:
                config = config_of(given.people, given.out, variant, seed, given.words)
                run = trained_run(config, given.minutes)
                runs.append(run)
                steps[run.name] = latest_checkpoint(run).info.step
                scores += offset_scores(run, variant, seed, given.held_out)
        table = errors_table(scores, steps)
        write_text(given.out / "errors.csv", csv_text([asdict(score) for score in scores]))
        write_text(given.out / "errors.md", markdown_table(table.head, table.cells))
        tables = [table]
        for folder in (given.held_out, *given.captures):
            bench = PeopleBench(folder, runs, [2], starts=8)
            tables.append(compare_people(bench, given.out / f"views_{folder.name}"))
    for table in tables:
        print_tables(numbers_table(table.title, table.head, table.cells))


if __name__ == "__main__":
    main()
