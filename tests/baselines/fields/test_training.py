"""What both fields' training shares: errors of pixels that count."""

from __future__ import annotations

from pathlib import Path

import torch
from small_fields import NGP, config_of

from dyngs.baselines.fields.training import masked_mean, smooth_l1
from dyngs.training.new_trainer import assemble


def test_masked_pixels_do_not_count() -> None:
    error = torch.tensor([[[1.0, 1, 1], [5, 5, 5]]])
    assert float(masked_mean(error, None)) == 3
    assert float(masked_mean(error, torch.tensor([[1.0, 0.0]]))) == 1
    assert float(masked_mean(error, torch.zeros(1, 2))) == 0


def test_the_error_is_half_the_square_up_to_one() -> None:
    assert smooth_l1(torch.tensor([0.5, 3.0]), torch.zeros(2)).tolist() == [0.125, 2.5]


def test_a_step_draws_pixels_of_one_image(capture: Path) -> None:
    trainer = assemble(config_of(capture, *NGP))
    report = trainer.step()
    assert report.truth.shape == report.rendered.shape == (1, 2**12 // 256, 3)
