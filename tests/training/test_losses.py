"""The loss of a step and the errors about non-finite values."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import random_scene

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.loader import Image
from dyngs.models.model import LossInput, RenderOutput
from dyngs.models.renderable import Rendering
from dyngs.training.losses import SilhouetteLoss, StepCheck

CPU = torch.device("cpu")
MOVES_BY = "field", "model.deform"


@pytest.fixture
def image() -> Image:
    cameras = Cameras(torch.eye(4)[None], torch.eye(3)[None], 2, 2)
    return Image("r_7", cameras, torch.zeros(2, 2, 3), alpha=None, mask=None, time=0.25)


@pytest.mark.parametrize(
    ("name", "advice"), [("image", "check that image"), ("alpha", "lower its weight")]
)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_term_that_is_not_finite_is_named(
    image: Image, name: str, advice: str, value: float
) -> None:
    terms = {"image": torch.tensor(0.5), "alpha": torch.tensor(0.1)} | {name: torch.tensor(value)}
    with pytest.raises(
        DyngsError, match=rf"^step 3, view 'r_7': loss term '{name}' is {value}; {advice}"
    ):
        StepCheck(terms, {}, CPU).loss(3, image, MOVES_BY)


def test_gaussians_that_are_not_finite_come_first(image: Image) -> None:
    """Non-finite Gaussians are reported first, since they cause all other non-finite values."""
    gaussians = random_scene().gaussians
    gaussians.means[3, 1] = torch.nan
    terms = {"image": torch.tensor(torch.nan)}
    message = (
        r"the field produced non-finite means at time 0\.25; "
        r"lower the learning rates in model\.deform$"
    )
    with pytest.raises(DyngsError, match=rf"^step 3, view 'r_7': {message}"):
        StepCheck(terms, gaussians.tensors(), CPU).loss(3, image, MOVES_BY)


def test_the_error_of_alpha_counts_where_the_mask_does_and_fully_late_in_the_run(
    image: Image,
) -> None:
    """Three of four pixels are opaque, nothing is rendered, and the mask ignores one of these."""
    alpha = torch.tensor([[1.0, 1.0], [1.0, 0.0]])
    mask = torch.tensor([[0.0, 1.0], [1.0, 1.0]])
    nothing = RenderOutput(Rendering(torch.zeros(1, 2, 2, 3), torch.ones(1, 2, 2), None))
    loss = SilhouetteLoss(0.1, early=0.2, full_from=60)

    def at(step: int, image: Image) -> float:
        black = torch.zeros(2, 2, 3)
        look = LossInput(0, step, image, nothing, black, black, None, torch.Generator())
        return float(loss(look).get("alpha", 0.0))

    opaque = replace(image, alpha=alpha)
    assert at(100, opaque) == pytest.approx(0.1 * 3 / 4)
    assert at(59, opaque) == pytest.approx(0.2 * 0.1 * 3 / 4)
    assert at(60, opaque) == pytest.approx(0.1 * 3 / 4)
    assert at(100, replace(opaque, mask=mask)) == pytest.approx(0.1 * 2 / 4)
    assert at(100, image) == 0.0
