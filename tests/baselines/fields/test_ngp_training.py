"""Instant-NGP learns a small capture, on rays that fill its steps; its schedule."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_fields import NGP, config_of

from dyngs.baselines.fields.ngp import NgpField, NgpTraining, cells_in_view
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import psnr
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.models.volume import camera_rays
from dyngs.ops.native import kernel_threads
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer


def trained(capture: Path, steps: int, *keys: str) -> Trainer[NgpTraining]:
    trainer = build_trainer(config_of(capture, *NGP, f"train.steps={steps}", *keys))
    for _ in range(steps):
        trainer.step()
    return trainer


def held_out_psnr(trainer: Trainer[NgpTraining]) -> float:
    images = ImageLoader(trainer.capture.splits["test"], trainer.config.data)
    scene = trainer.model.scene
    white = torch.ones(3)
    with torch.no_grad():
        drawn = [
            scene.render(x.cameras, background=white).rgb[0]
            for x in (images[i] for i in range(len(images)))
        ]
    return sum(psnr(x, images[i].composite(white)) for i, x in enumerate(drawn)) / len(drawn)


def test_views_that_were_held_out_are_learned(capture: Path) -> None:
    """The PSNR floor is 1 dB below the measured value; a white image scores 10 dB."""
    trainer = trained(capture, 150)
    assert held_out_psnr(trainer) > 15.5
    field = trainer.model.scene.field
    assert isinstance(field, NgpField)
    assert 0.02 < float(field.occupied.float().mean()) < 0.6, "empty cells were found"
    image = trainer.images[0]
    which = torch.randint(
        24 * 24, (trainer.model.num_rays,), generator=torch.Generator().manual_seed(0)
    )
    rays, _ = camera_rays(image.cameras, which)
    samples = field.render_rays(rays, 0.0, near=0.1).num_samples
    assert 0.4 < samples / 2**12 < 2.5, "rays fill a step, about"


def test_untouched_rows_stay_as_they_are(capture: Path) -> None:
    trainer = build_trainer(config_of(capture, *NGP))
    table = trainer.model.scene.field.parameters["table"]
    before = table.detach().clone()
    for _ in range(3):
        trainer.step()
    moved = (table.detach() != before).any(1)
    assert 0 < float(moved.float().mean()) < 1


def test_cells_that_no_camera_sees_are_never_occupied(capture: Path) -> None:
    config = config_of(capture, *NGP, "model.surroundings=always")
    trainer = build_trainer(config)
    field = trainer.model.scene.field
    seen = cells_in_view(field.space, trainer.capture.splits["train"])
    assert torch.equal(field.occupied, seen)
    assert not bool(seen.all())
    for _ in range(34):
        trainer.step()
    assert not bool((field.occupied & ~seen).any())


def test_a_cube_that_no_camera_sees_is_refused(capture: Path) -> None:
    config = config_of(capture, *NGP, "model.half_extent=0.1")
    read = read_capture(config.data)
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    views = [
        replace(view, cam_from_world=away @ view.cam_from_world) for view in read.splits["train"]
    ]
    with pytest.raises(DyngsError, match="no training camera sees the cube of the field"):
        build_trainer(config, replace(read, splits={**read.splits, "train": views}))


def test_the_same_bytes_on_any_number_of_threads(capture: Path) -> None:
    found = []
    for threads in (1, 3):
        with kernel_threads(threads):
            found.append(trained(capture, 20).checkpoint().tensors)
    assert all(torch.equal(x, found[1][name]) for name, x in found[0].items())
