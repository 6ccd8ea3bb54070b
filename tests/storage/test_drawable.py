"""What is kept for drawing: equivalent Gaussians, in an order that everything follows."""

from __future__ import annotations

import pytest
import torch
from moving_scene import camera
from tiny_fields import KINDS, cloud, stirred_field, tiny_options, tiny_setup

from dyngs.config import DynamicModel, StaticModel
from dyngs.deform.fields import field_state
from dyngs.deform.scene import trained_scene
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.rendering import render
from dyngs.storage.drawable import completed, drawable, in_storage_order
from dyngs.visibility import VisibilityMasks

ROWS = (0, 2, 3, 6)


def tensors_of(gaussians: Gaussians, state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Of a checkpoint."""
    tensors = {f"gaussians.{name}": x for name, x in gaussians.tensors().items()}
    return tensors | {f"model.{name}": x for name, x in state.items()}


def moving_tensors(kind: str) -> tuple[dict[str, torch.Tensor], DynamicModel]:
    """A checkpoint's tensors in which some Gaussians move, and the model."""
    setup = tiny_setup(len(ROWS))
    state = {f"field.{name}": x for name, x in field_state(stirred_field(kind, len(ROWS)), setup).items()}
    state |= {"rows": torch.tensor(ROWS), "times": torch.tensor([0.0, 1.0], dtype=torch.float64)}
    return tensors_of(cloud(9), state), DynamicModel(deform=tiny_options(kind))


def picture(tensors: dict[str, torch.Tensor], model: DynamicModel | StaticModel, time: float) -> torch.Tensor:
    """What a checkpoint's tensors show at a time."""
    parts = {
        prefix: {n.removeprefix(f"{prefix}."): x for n, x in tensors.items() if n.startswith(f"{prefix}.")}
        for prefix in ("gaussians", "model")
    }
    scene = trained_scene(Gaussians(**parts["gaussians"]), parts["model"], model)
    return render(scene.at(time), camera()).rgb


@pytest.mark.parametrize("kind", KINDS)
def test_the_stored_form_looks_the_same(kind: str) -> None:
    tensors, model = moving_tensors(kind)
    kept = drawable(tensors)
    assert not [name for name in kept if "exp_avg" in name]
    stored = in_storage_order(kept, kept["gaussians.means"].numpy(), model)
    for time in (0.0, 0.7):
        # Blending goes by depth, not by order: what differs is the last bits of turned axes.
        torch.testing.assert_close(
            picture(completed(stored), model, time), picture(tensors, model, time), atol=1e-5, rtol=0
        )


def test_what_moves_is_in_front_and_followed() -> None:
    tensors, model = moving_tensors("trajectory")
    kept = drawable(tensors)
    stored = in_storage_order(kept, kept["gaussians.means"].numpy(), model)
    assert stored["model.rows"].tolist() == list(range(len(ROWS)))
    place = {tuple(mean): i for i, mean in enumerate(tensors["gaussians.means"].tolist())}
    came_from = [ROWS.index(place[tuple(mean)]) for mean in stored["gaussians.means"][: len(ROWS)].tolist()]
    name = "model.field.learned.means"
    assert torch.equal(stored[name], tensors[name][came_from])


def test_rows_that_are_not_understood_keep_the_order() -> None:
    tensors = tensors_of(cloud(9), {"something.new": torch.arange(9)})
    kept = drawable(tensors)
    stored = in_storage_order(kept, kept["gaussians.means"].numpy(), StaticModel())
    assert torch.equal(stored["gaussians.means"], tensors["gaussians.means"])


def test_training_state_is_left_out() -> None:
    tensors = tensors_of(cloud(9), {"near": torch.zeros(9, 5), "learned.exp_avg.poses": torch.zeros(3)})
    kept = drawable(tensors | {"exp_avg.means": torch.zeros(9, 3), "rng": torch.zeros(4)})
    assert {name for name in kept if not name.startswith("gaussians.")} == set()


def test_corrections_of_skinning_weights_are_applied() -> None:
    weights = torch.tensor([[0.75, 0.25], [1.0, 0.0]])
    corrections = torch.tensor([[0.0, 3.0]]).log1p().repeat(2, 1)
    state = {"anchors.weights": weights, "learned.weights": corrections}
    full = completed(drawable(tensors_of(cloud(2), state)))
    torch.testing.assert_close(full["model.anchors.weights"], torch.tensor([[3 / 7, 4 / 7], [1.0, 0.0]]))
    assert not full["model.learned.weights"].any()


def test_what_is_not_finite_is_refused() -> None:
    tensors = tensors_of(cloud(3), {})
    tensors["gaussians.means"][1, 1] = torch.nan
    with pytest.raises(DyngsError, match="means is not finite"):
        drawable(tensors)


def masked_tensors() -> tuple[dict[str, torch.Tensor], DynamicModel]:
    """As ``moving_tensors``; each Gaussian is seen at one of three key times."""
    tensors, model = moving_tensors("trajectory")
    masks = VisibilityMasks.pack((0.0, 0.5, 1.0), torch.arange(9)[None] % 3 == torch.arange(3)[:, None])
    return tensors | {f"model.masks.{name}": x for name, x in masks.state().items()}, model


def test_masks_follow_their_gaussians() -> None:
    tensors, model = masked_tensors()
    kept = drawable(tensors)
    stored = in_storage_order(kept, kept["gaussians.means"].numpy(), model)
    assert not torch.equal(stored["gaussians.means"], kept["gaussians.means"])
    for time in (0.1, 0.8):
        expected = picture(tensors, model, time)
        torch.testing.assert_close(picture(completed(stored), model, time), expected, atol=1e-5, rtol=0)
        unmasked = {name: x for name, x in tensors.items() if not name.startswith("model.masks.")}
        assert not torch.allclose(picture(unmasked, model, time), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("times", torch.tensor(0.5)),
        ("times", torch.tensor([0.0, 0.5, 0.5])),
        ("times", torch.tensor([0.0, 1.0])),
        ("bits", torch.zeros(3, 1, dtype=torch.uint8)),
        ("bits", torch.zeros(3, 2, dtype=torch.int64)),
        ("count", torch.tensor([8])),
        ("count", torch.tensor([[9, 9]])),
    ],
)
def test_masks_of_other_gaussians_are_refused(name: str, value: torch.Tensor) -> None:
    tensors, model = masked_tensors()
    kept = drawable(tensors)
    stored = in_storage_order(kept, kept["gaussians.means"].numpy(), model)
    completed(stored)
    with pytest.raises(ValueError, match="masks are not those of the Gaussians"):
        completed(stored | {f"model.masks.{name}": value})
