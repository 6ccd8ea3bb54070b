"""Steps are as coarse as the images allow."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from moving_scene import camera
from scenes import random_scene
from torch import Tensor

from dyngs.compress.measure import (
    Draw,
    Precision,
    compute_coarseness,
    measure_precision,
)
from dyngs.core.state import select_prefix
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import render
from dyngs.gaussians.static_scene import StaticScene
from dyngs.runs.stored_file import (
    MAX_COARSENESS,
    choose_coding,
    round_trip,
    tensors_to_store,
    to_checkpoint_tensors,
)


def tensors() -> dict[str, Tensor]:
    """Of a static scene."""
    gaussians = random_scene(n=60, seed=1).to(torch.float32).gaussians
    return {f"gaussians.{name}": x for name, x in gaussians.tensors().items()}


def scene_of(stored: Mapping[str, Tensor]) -> StaticScene:
    """The scene of a checkpoint's tensors."""
    return StaticScene(gaussians=Gaussians(**select_prefix(stored, "gaussians")))


def measured(stored: Mapping[str, Tensor], draw: Draw, max_change: float) -> Precision:
    """How exactly a static scene must be stored."""
    return measure_precision(tensors_to_store(scene_of(stored)), draw(stored), draw, max_change)


def draw(state: Mapping[str, Tensor]) -> list[Tensor]:
    """One image."""
    fields = ("means", "quats", "log_scales", "logit_opacities", "sh")
    return [
        render(Gaussians(**{name: state[f"gaussians.{name}"] for name in fields}), camera()).rgb[0]
    ]


@pytest.mark.parametrize("max_change", [0.1, 2.0])
def test_the_change_is_what_is_allowed_or_less(max_change: float) -> None:
    precision = measured(tensors(), draw, max_change)
    exact = tensors_to_store(scene_of(tensors()))
    rounded = {
        name: round_trip(x, choose_coding(name, x, precision.steps)) for name, x in exact.items()
    }
    before = draw(tensors())[0].clamp(0, 1)
    after = draw(to_checkpoint_tensors(rounded))[0].clamp(0, 1)
    change = 255 * float((before - after).double().square().mean().sqrt())
    assert precision.change == pytest.approx(change)
    assert max_change / 4 < change <= max_change


def test_coarseness_is_half_an_octave_per_octave() -> None:
    visibility = torch.tensor([1.0] * 8 + [2.0**-4, 0.0])
    assert compute_coarseness(visibility).tolist() == [0] * 8 + [2, MAX_COARSENESS]
    assert compute_coarseness(torch.zeros(0)).shape == (0,)
    assert compute_coarseness(torch.zeros(3)).tolist() == [MAX_COARSENESS] * 3


def change_after(
    stored: dict[str, Tensor], exact: dict[str, Tensor], steps: Mapping[str, float]
) -> float:
    """Grey levels by which rounding with ``steps`` changes the image."""
    rounded = {name: round_trip(x, choose_coding(name, x, steps)) for name, x in exact.items()}
    before = draw(stored)[0].clamp(0, 1)
    after = draw(to_checkpoint_tensors(rounded))[0].clamp(0, 1)
    return 255 * float((before - after).double().square().mean().sqrt())


@pytest.mark.parametrize("name", ["means", "sh", "log_scales"])
def test_an_outlier_does_not_decide_the_steps_of_the_others(name: str) -> None:
    """A Gaussian far behind the camera, or of absurd colour or size there."""
    usual = tensors()
    with_outlier = tensors()
    with_outlier["gaussians.means"][5] = torch.tensor([0.0, 0.0, -1e8])
    usual["gaussians.means"][5] = torch.tensor([0.0, 0.0, -50.0])
    if name != "means":
        with_outlier[f"gaussians.{name}"][5] = -1e8
    precision = measured(with_outlier, draw, 0.5)
    assert precision.change is not None
    assert precision.change <= 0.5
    assert change_after(
        with_outlier, tensors_to_store(scene_of(with_outlier)), precision.steps
    ) == pytest.approx(precision.change)
    stored = "sh_base" if name == "sh" else name
    steps = measured(usual, draw, 0.5).steps
    assert (
        steps[f"gaussians.{stored}"] / 4
        <= precision.steps[f"gaussians.{stored}"]
        <= 4 * steps[f"gaussians.{stored}"]
    )


def test_what_no_step_is_fine_enough_for_is_stored_as_it_is() -> None:
    """Half of the Gaussians are 1e9 times as far away as the others, beyond what one step can
    serve."""
    far = tensors()
    far["gaussians.means"][::2] *= 1e9
    precision = measured(far, draw, 0.01)
    assert precision.change is not None
    assert precision.change <= 0.01
    means = tensors_to_store(scene_of(far))["gaussians.means"]
    assert choose_coding("gaussians.means", means, precision.steps).kind == "exact"
