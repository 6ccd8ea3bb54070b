"""Number of images that the initial motion search reads."""

from __future__ import annotations

from pathlib import Path

import pytest

import dyngs
from dyngs.deform.training import DynamicTraining
from dyngs.gaussians.model import GaussianModel
from dyngs.training.new_trainer import build_trainer


@pytest.mark.parametrize(
    ("steps", "minutes", "count"),
    [(49, "null", None), (400, "null", 8), (3000, "null", 16), (3000, "0.2", 4)],
)
def test_number_of_searched_images_follows_run_length(
    moving: Path, steps: int, minutes: str, count: int | None
) -> None:
    """The search takes at most a tenth of the run, so a short run reads fewer than 16 images."""
    keys = (
        f"data.root={moving}",
        f"train.steps={steps}",
        f"train.minutes={minutes}",
        "init.num_random=20",
    )
    model = build_trainer(dyngs.load_config("dynamic", keys)).model
    assert isinstance(model, GaussianModel)
    assert isinstance(model.training, DynamicTraining)
    shots = model.training.capture.frame_stack(model.scene.gaussians)
    assert (None if shots is None else len(shots)) == count
