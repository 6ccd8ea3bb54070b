"""Exposures are learned where images differ in them; the mean one is the identity, and runs can be
resumed."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, RandomInit, RunConfig, TrainConfig
from dyngs.data.loader import Image
from dyngs.deform.keys import DynamicModel
from dyngs.models.model import RenderedView
from dyngs.models.renderable import Rendering
from dyngs.models.static_section import StaticModel
from dyngs.training.corrections.exposure import WARM_UP, ViewExposures
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

BLACK = torch.zeros(3)
STEPS = 200
GAINS = (0.7, 1.0, 1.3, 1.5)


def corrected(exposures: ViewExposures, index: int, step: int, image: Image, rgb: Tensor) -> Tensor:
    """Return the rendering ``rgb`` of a view as the loss compares it."""
    rendering = Rendering(rgb[None], torch.zeros(1, *rgb.shape[:2]), None)
    view = RenderedView(
        index, step, image, rendering, rgb, BLACK, lambda *_: rendering, lambda _: True
    )
    return exposures.after_render(view).rendered


def trained_on(gains: tuple[float, ...]) -> ViewExposures:
    """Return exposures after training on images, with ``gains``, of one scene, which learns its
    brightness, too."""
    exposures = ViewExposures(len(gains), STEPS)
    scene = (
        0.1 + 0.5 * torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(0))
    ).requires_grad_()
    given = scene.detach().clone()
    optimizer = torch.optim.Adam([scene], 0.01)
    for step in range(1, STEPS + 1):
        index = step % len(gains)
        image = Image(
            f"{index}",
            None,  # type: ignore[arg-type]
            (gains[index] * given).clamp_max(1),
            None,
            None,
            None,
        )
        rendered = corrected(exposures, index, step, image, scene)
        loss = (rendered - image.rgb_premultiplied).abs().mean()
        look: Any = SimpleNamespace(index=index)
        sum(exposures(look).values(), loss).backward()
        exposures.after_backward(index, step, image)
        optimizer.step()
        optimizer.zero_grad()
    return exposures


def brightness(exposures: ViewExposures, count: int) -> Tensor:
    """Return (V,) how bright each image shows middle grey."""
    grey = torch.tensor([0.4, 0.4, 0.4, 1.0])
    return torch.stack([(exposures.affine(i).detach() @ grey).mean() / 0.4 for i in range(count)])


def test_images_that_agree_keep_the_identity() -> None:
    found = brightness(trained_on((1.0, 1.0, 1.0, 1.0)), 4)
    torch.testing.assert_close(found, torch.ones(4), atol=0.02, rtol=0)


def test_saturated_pixels_are_not_blamed() -> None:
    exposures = ViewExposures(1, STEPS)
    step = round(WARM_UP * STEPS) + 1
    white = Image("", None, torch.ones(4, 4, 3), None, None, None)  # type: ignore[arg-type]
    rgb = torch.full((4, 4, 3), 1.4, requires_grad=True)
    out = corrected(exposures, 0, step, white, rgb)
    assert float(out.detach().max()) <= 1.0 + 1e-6


@pytest.mark.parametrize("name", ["values", "visits", "exp_avg.values"])
def test_a_state_of_other_images_is_refused(name: str) -> None:
    exposures = ViewExposures(2, STEPS)
    other = ViewExposures(1, STEPS)
    with pytest.raises(ValueError, match=name):
        exposures.load_state(exposures.state() | {name: other.state()[name]})


def trainer_of(root: Path, choice: str, model: StaticModel | DynamicModel) -> Trainer:
    return build_trainer(
        Config(
            data=DataConfig(root=root),
            model=model,
            init=RandomInit(num_random=60),
            train=TrainConfig(steps=40, exposure=choice),  # type: ignore[arg-type]
            run=RunConfig(threads=1),
        )
    )


@pytest.mark.parametrize("moves", [False, True])
def test_a_resumed_run_has_the_same_bytes(moves: bool, still: Path, moving: Path) -> None:
    root, model = (
        (moving, DynamicModel(sh_degree=0)) if moves else (still, StaticModel(sh_degree=0))
    )
    whole, first, second = (trainer_of(root, "always", model) for _ in range(3))
    for _ in range(24):
        whole.step()
    for _ in range(12):
        first.step()
    second.restore(first.checkpoint())
    for _ in range(12):
        second.step()
    ends = whole.checkpoint().tensors, second.checkpoint().tensors
    assert ends[0].keys() == ends[1].keys()
    assert bool(ends[0]["exposures.values"].any())
    assert all(torch.equal(x, ends[1][name]) for name, x in ends[0].items())
