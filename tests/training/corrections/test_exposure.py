"""Exposures are learned where images differ in them; the mean one is the identity, and runs can be
resumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, RandomInit, RunConfig, TrainConfig
from dyngs.data.loader import Image
from dyngs.deform.keys import DynamicModel
from dyngs.models.renderable import Rendering
from dyngs.static.keys import StaticModel
from dyngs.training.corrections.exposure import WARM_UP, ViewExposures
from dyngs.training.new_trainer import assemble
from dyngs.training.trainer import Trainer

BLACK = torch.zeros(3)
STEPS = 200
GAINS = (0.7, 1.0, 1.3, 1.5)


def shown(rgb: Tensor) -> Rendering:
    return Rendering(rgb[None], torch.zeros(1, *rgb.shape[:2]), None)


def trained_on(
    gains: tuple[float, ...], beside: list[list[int]] | None = None, hidden: int = -1
) -> ViewExposures:
    """Return exposures after training on images of one scene, which learns its brightness, too.

    Args:
        gains: of the images.
        beside: neighbours of each in a video.
        hidden: of which all pixels are masked.
    """
    exposures = ViewExposures(beside or [[] for _ in gains], STEPS)
    scene = (
        0.1 + 0.5 * torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(0))
    ).requires_grad_()
    given = scene.detach().clone()
    optimizer = torch.optim.Adam([scene], 0.01)
    for step in range(1, STEPS + 1):
        index = step % len(gains)
        mask = torch.full((12, 12), float(index != hidden))
        image = Image(f"{index}", None, (gains[index] * given).clamp_max(1), None, mask, None)  # type: ignore[arg-type]
        rendered = exposures.applied((index, step), image, shown(scene), BLACK)
        loss = ((rendered - image.rgb_premultiplied).abs() * mask[..., None]).mean()
        sum(exposures.penalties(index).values(), loss).backward()
        exposures.optimize(index, step)
        optimizer.step()
        optimizer.zero_grad()
    return exposures


def brightness(exposures: ViewExposures, count: int) -> Tensor:
    """Return (V,) how bright each image shows middle grey."""
    grey = torch.tensor([0.4, 0.4, 0.4, 1.0])
    return torch.stack([(exposures.affine(i).detach() @ grey).mean() / 0.4 for i in range(count)])


def test_gains_are_learned_and_their_mean_is_the_identity() -> None:
    exposures = trained_on(GAINS)
    found = brightness(exposures, len(GAINS))
    given = torch.tensor(GAINS)
    torch.testing.assert_close(found, given / given.mean(), atol=0.06, rtol=0)
    mean = torch.stack([exposures.affine(i).detach() for i in range(len(GAINS))]).mean(0)
    torch.testing.assert_close(mean, torch.eye(3, 4), atol=1e-5, rtol=0)


def first_gain(scene: Tensor, truth: Tensor) -> float:
    """Return the gain that an image begins with, by its rendering alone."""
    exposures = ViewExposures([[]], STEPS)
    image = Image("0", None, truth, None, None, None)  # type: ignore[arg-type]
    exposures.applied((0, STEPS), image, shown(scene), BLACK)
    return float(exposures.affine(0)[0, 0].detach())


def test_the_first_gain_is_that_of_pixels_that_are_not_saturated() -> None:
    scene = torch.full((32, 32, 3), 0.3)
    scene[:20] = 0.9
    assert first_gain(scene, (1.5 * scene).clamp_max(1)) == pytest.approx(1.5)


@pytest.mark.parametrize("gain", [18.0, 1 / 18])
def test_the_first_gain_has_limits(gain: float) -> None:
    scene = torch.full((32, 32, 3), 0.05 * max(1.0, 1 / gain))
    assert first_gain(scene, gain * scene) == pytest.approx(8 if gain > 1 else 1 / 8)


def test_images_that_agree_keep_the_identity() -> None:
    found = brightness(trained_on((1.0, 1.0, 1.0, 1.0)), 4)
    torch.testing.assert_close(found, torch.ones(4), atol=0.02, rtol=0)


def test_in_a_video_a_image_that_says_nothing_takes_after_those_beside_it() -> None:
    """All pixels of the third are masked; in a capture without order nothing is known of it."""
    gains = (1.0, 1.0, 1.3, 1.3, 1.3)
    hidden = 3
    row = [[1], [0, 2], [1, 3], [2, 4], [3]]
    free, video = (trained_on(gains, beside, hidden) for beside in (None, row))
    assert abs(float(brightness(video, 5)[hidden] - brightness(video, 5)[4])) < 0.03
    assert abs(float(brightness(free, 5)[hidden] - brightness(free, 5)[4])) > 0.08
    assert torch.equal(ViewExposures(row, 10).affine(2), torch.eye(3, 4))


def test_saturated_pixels_are_not_blamed() -> None:
    exposures = ViewExposures([[]], STEPS)
    step = round(WARM_UP * STEPS) + 1
    white = Image("", None, torch.ones(4, 4, 3), None, None, None)  # type: ignore[arg-type]
    rgb = torch.full((4, 4, 3), 1.4, requires_grad=True)
    out = exposures.applied((0, step), white, shown(rgb), BLACK)
    assert float(out.detach().max()) <= 1.0 + 1e-6


def test_first_steps_show_images_as_they_are() -> None:
    exposures = ViewExposures([[]], STEPS)
    rgb = torch.rand(4, 4, 3)
    image = Image("", None, 2 * rgb, None, None, None)  # type: ignore[arg-type]
    assert torch.equal(exposures.applied((0, 1), image, shown(rgb), BLACK), rgb)


@pytest.mark.parametrize("name", ["values", "visits", "exp_avg.values"])
def test_a_state_of_other_images_is_refused(name: str) -> None:
    exposures = ViewExposures([[], []], STEPS)
    other = ViewExposures([[]], STEPS)
    with pytest.raises(ValueError, match=name):
        exposures.load_state(exposures.state() | {name: other.state()[name]})


def trainer_of(root: Path, choice: str, model: StaticModel | DynamicModel) -> Trainer:
    return assemble(
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


@pytest.mark.parametrize("choice", ["never", "auto"])
def test_without_them_nothing_is_kept_for_them(still: Path, choice: str) -> None:
    """Auto is decided before a run begins."""
    trainer = trainer_of(still, choice, StaticModel(sh_degree=0))
    assert trainer.exposures is None
    assert not any(name.startswith("exposures") for name in trainer.checkpoint().tensors)


def test_other_configs_checkpoints_are_refused(still: Path) -> None:
    without = trainer_of(still, "never", StaticModel(sh_degree=0)).checkpoint()
    with pytest.raises(Exception, match="was its config changed"):
        trainer_of(still, "always", StaticModel(sh_degree=0)).restore(replace(without))
