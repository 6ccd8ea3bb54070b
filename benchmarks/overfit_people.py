"""Over-fit networks that predict fields of people on two people, beside what true depths would show.

    python benchmarks/overfit_people.py --out FOLDER [--steps N] [--kinds KIND...]
        [--variants NAME...] [--people N] [--size PX] [--cameras N]

A network that cannot over-fit two people has a fault. Each is trained on them (``runs``), as its
preset says and in each of ``VARIANTS``, and predicts them from two views 30 degrees apart
(``comparison``, see compare_people.py). ``ceilings.csv`` has the same views from true depth maps:
colours of the images where these show the true surface, blended evenly, with the true alpha, and
with one ray per pixel, which hits the person or misses it. PSNR in the box of the person on white.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import torch
from compare_people import PeopleBench, compare_people, task_of
from torch import Tensor

from dyngs.api.train import train
from dyngs.cli.output import numbers_table, print_messages, print_tables
from dyngs.config import DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.metrics import psnr
from dyngs.data.loader import Image
from dyngs.data.read import list_captures
from dyngs.human.body.body_reader import default_template
from dyngs.human.predict.fields.network import SourceFeatures
from dyngs.human.predict.people import (
    MARGIN,
    Person,
    Sources,
    cameras_in_metres,
    crop_source_images,
    crop_to_person,
    read_captured_person,
    sample_maps,
)
from dyngs.human.synthetic.capture import PeopleOptions, write_people
from dyngs.io.write import write_text
from dyngs.models.volume import camera_rays
from dyngs.ops.native import kernel_threads
from dyngs.runs.folder import require_empty
from dyngs.study.report import csv_text

KINDS = ("keypoint_nerf", "eg_human_nerf")
VARIANTS: dict[str, tuple[str, ...]] = {
    "preset": (),
    "rays": ("model.supersampling=2",),
}
"""Overrides of the presets."""
FAR = 1e3  # depth of the background, m
TOLERANCE = 0.02  # of the test whether an image shows a point, m


@dataclass(frozen=True)
class Ceiling:
    """One view from true depths; PSNR in the box of the person on white."""

    person: str
    view: str
    true_alpha: float
    one_ray: float
    partly_covered: float  # pixels with alpha between 0.05 and 0.95, relative to all of the person


def ceilings(person: Person) -> list[Ceiling]:
    """Return the views between neighbours of a person, as compare_people.py takes them."""
    found = []
    for first in range(0, len(person.views), 4):
        sources, targets = task_of(person.views, (), 2, first, False)
        for target in targets:
            image = person.images[person.views.index(target)]
            found.append(ceiling(person, [person.images[i] for i in sources], image))
    return found


def ceiling(person: Person, images: Sequence[Image], target: Image) -> Ceiling:
    """Return what two images show of the true surface of a third."""
    view = next(view for view in person.views if view.name == target.name)
    _, scale = person.body_in(view)
    sources = crop_source_images(images, scale)
    depths = true_depths(sources, images, scale)
    features = SourceFeatures(sources, sources.rgba, sources.rgba)
    rays, z = camera_rays(cameras_in_metres(target.cameras, scale))
    assert target.alpha is not None
    assert target.depth is not None
    alpha = target.alpha.flatten()[:, None]
    at = target.depth.flatten() / scale / z
    points = rays.origins + rays.directions * at[:, None]
    seen = features.sample(points)
    grid, depth = features.project(points)
    surface = sample_maps(depths, grid, "nearest")[..., 0]
    shown = (depth < surface + TOLERANCE) & (seen.alpha > 0.5)
    weights = torch.where(shown | ~shown.any(0), seen.alpha.clamp_min(1e-3), 0.0)
    colour = (weights[..., None] * seen.rgb).sum(0) / weights.sum(0)[:, None]
    white = target.composite(torch.ones(3))
    own = target.rgb_premultiplied.reshape(-1, 3) / alpha.clamp_min(1e-3)
    colour = torch.where(at[:, None] > 0, colour, own)  # outlines without a depth
    hits = (at[:, None] > 0).float()
    values = [
        psnr(box(c.view_as(white), target.alpha), box(white, target.alpha))
        for c in (colour * alpha + 1 - alpha, colour * hits + 1 - hits)
    ]
    partly = ((alpha > 0.05) & (alpha < 0.95)).sum() / (alpha > 0.5).sum()
    return Ceiling(person.name, target.name, values[0], values[1], float(partly))


def true_depths(sources: Sources, images: Sequence[Image], scale: float) -> Tensor:
    """Return the depth maps (V, 1, H, W) of ``sources``, m."""
    height, width = sources.rgba.shape[2:]
    depths = torch.full((len(images), 1, height, width), FAR)
    for target, image in zip(depths, images, strict=True):
        crop = crop_to_person(image, MARGIN)
        assert crop.depth is not None
        rows, columns = crop.depth.shape
        target[0, :rows, :columns] = torch.where(crop.depth > 0, crop.depth / scale, FAR)
    return depths


def box(image: Tensor, alpha: Tensor) -> Tensor:
    """Return the part of an image (H, W, 3) around the person."""
    rows, columns = ((alpha > 0).any(side).nonzero()[:, 0] for side in (1, 0))
    return image[int(rows[0]) : int(rows[-1]) + 1, int(columns[0]) : int(columns[-1]) + 1]


def main() -> None:
    """Write people, ceilings, runs and the comparison; print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=3000, help="of each run; 0: ceilings alone")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--variants", nargs="+", default=["preset", "rays"], choices=VARIANTS)
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--cameras", type=int, default=24)
    given = parser.parse_args()
    print_messages()
    require_empty(given.out)
    options = PeopleOptions(given.people, size=given.size, cameras=given.cameras, seed=1)
    people = write_people(given.out / "people", options)
    found: list[Ceiling] = []
    for capture in list_captures(DataConfig(root=people)):
        found += ceilings(read_captured_person(capture, default_template()))
    write_text(given.out / "ceilings.csv", csv_text([asdict(x) for x in found]))
    print(
        f"true depths: {fmean(x.true_alpha for x in found):.2f} dB with the true alpha, "
        f"{fmean(x.one_ray for x in found):.2f} dB with one ray per pixel; "
        f"{fmean(x.partly_covered for x in found):.1%} of the pixels are partly covered"
    )
    if not given.steps:
        return
    runs = []
    for kind in given.kinds:
        for name in given.variants:
            run = given.out / "runs" / f"{kind}-{name}"
            words = [f"data.root={people}", f"run.dir={run}", "run.threads=1"]
            words.append(f"train.steps={given.steps}")
            runs.append(train(load_config(packaged_preset(kind), [*words, *VARIANTS[name]])))
    with kernel_threads(1):
        table = compare_people(PeopleBench(people, runs, [2]), given.out / "comparison")
    print_tables(numbers_table(table.title, table.head, table.cells))


if __name__ == "__main__":
    main()
