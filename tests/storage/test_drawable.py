"""What is kept for drawing: equivalent Gaussians, in an order that everything follows."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from moving_scene import camera
from tiny_fields import KINDS, cloud, stirred_field, tiny_options

from dyngs.config import DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import Scene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.avatar.corrections import new_corrections
from dyngs.human.avatar.posing import Skeleton
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.clip import MotionClip
from dyngs.state import Role, part_of
from dyngs.static.scene import StaticScene
from dyngs.storage.drawable import completed, drawable, stored_edit

ROWS = (0, 2, 3, 6)


def moving(kind: str) -> tuple[DynamicScene, DynamicModel]:
    """A scene of which some Gaussians move, and its model."""
    field = stirred_field(kind, len(ROWS))
    scene = DynamicScene(gaussians=cloud(9), seen_at=(0.0, 1.0), field=field, moving=torch.tensor(ROWS))
    return scene, DynamicModel(deform=tiny_options(kind))


def stored(scene: Scene) -> dict[str, torch.Tensor]:
    """What a file holds of a scene, in its order."""
    return drawable(scene.edited(stored_edit(scene, scene.gaussians.means.numpy())))


def read(tensors: dict[str, torch.Tensor], model: DynamicModel) -> DynamicScene:
    """The scene of what a file holds."""
    full = completed(tensors)
    return DynamicScene.restored(model, Gaussians(**part_of(full, "gaussians")), part_of(full, "model"))


@pytest.mark.parametrize("kind", KINDS)
def test_the_stored_form_looks_the_same(kind: str) -> None:
    scene, model = moving(kind)
    kept = stored(scene)
    assert not [name for name in kept if "exp_avg" in name]
    again = read(kept, model)
    for time in (0.0, 0.7):
        # Blending goes by depth, not by order: what differs is the last bits of turned axes.
        torch.testing.assert_close(
            again.render(camera(), time).rgb, scene.render(camera(), time).rgb, atol=1e-5, rtol=0
        )


def test_what_moves_is_in_front_and_followed() -> None:
    scene, _ = moving("trajectory")
    kept = stored(scene)
    assert kept["model.rows"].tolist() == list(range(len(ROWS)))
    place = {tuple(mean): i for i, mean in enumerate(scene.gaussians.means.tolist())}
    came_from = [ROWS.index(place[tuple(mean)]) for mean in kept["gaussians.means"][: len(ROWS)].tolist()]
    name = "model.field.learned.means"
    assert torch.equal(kept[name], scene.state()[name].tensor[came_from])


@pytest.mark.parametrize("kind", KINDS)
def test_training_state_is_left_out(kind: str) -> None:
    scene, _ = moving(kind)
    for_training = {name for name, x in scene.state().items() if x.role is Role.TRAINING}
    assert any("exp_avg" in name for name in for_training)
    assert for_training.isdisjoint(drawable(scene))
    still = StaticScene(gaussians=scene.gaussians)
    assert {name for name in drawable(still) if not name.startswith("gaussians.")} == set()


def person(weights: torch.Tensor, corrections: torch.Tensor) -> HumanScene:
    """Two Gaussians on the first two of 24 joints, with learned corrections of their weights (2, 2)."""
    times, poses = torch.zeros(1).double(), torch.zeros(1, 24, 3)
    zeros, clip = torch.zeros(2), MotionClip(times, poses, torch.zeros(1, 3), torch.ones(1))
    anchors = Anchors(
        points=torch.zeros(2, 3),
        size=torch.ones(2),
        joints=torch.tensor([[0, 1], [0, 1]]),
        weights=weights,
        face=zeros.long(),
        barycentric=torch.ones(2, 3) / 3,
        uv=torch.zeros(2, 2),
        height=zeros,
    )
    skeleton = Skeleton(torch.zeros(24, 3), (-1, *[0] * 23))
    learned = new_corrections(clip, skeleton, anchors)
    learned.values()["weights"].copy_(corrections)
    gaussians = cloud(2).replace(sh=torch.zeros(2, 1, 3))
    return HumanScene(gaussians=gaussians, anchors=anchors, skeleton=skeleton, clip=clip, learned=learned)


def test_corrections_of_skinning_weights_are_applied() -> None:
    weights = torch.tensor([[0.75, 0.25], [1.0, 0.0]])
    corrections = torch.tensor([[0.0, 3.0]]).log1p().repeat(2, 1)
    full = completed(drawable(person(weights, corrections)))
    torch.testing.assert_close(full["model.anchors.weights"], torch.tensor([[3 / 7, 4 / 7], [1.0, 0.0]]))
    again = HumanScene.restored(Gaussians(**part_of(full, "gaussians")), part_of(full, "model"))
    assert not again.learned["weights"].any()


def test_what_is_not_finite_is_refused() -> None:
    gaussians = cloud(3)
    gaussians.means[1, 1] = torch.nan
    with pytest.raises(DyngsError, match="means is not finite"):
        drawable(StaticScene(gaussians=gaussians))


def masked() -> tuple[DynamicScene, DynamicModel]:
    """As ``moving``; each Gaussian is seen at one of three key times."""
    scene, model = moving("trajectory")
    masks = VisibilityMasks.pack((0.0, 0.5, 1.0), torch.arange(9)[None] % 3 == torch.arange(3)[:, None])
    return replace(scene, masks=masks), model


def test_masks_follow_their_gaussians() -> None:
    scene, model = masked()
    kept = stored(scene)
    assert not torch.equal(kept["gaussians.means"], scene.gaussians.means)
    again = read(kept, model)
    for time in (0.1, 0.8):
        expected = scene.render(camera(), time).rgb
        torch.testing.assert_close(again.render(camera(), time).rgb, expected, atol=1e-5, rtol=0)
        assert not torch.allclose(scene.unmasked().render(camera(), time).rgb, expected, atol=1e-3)


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
    scene, model = masked()
    kept = stored(scene)
    read(kept, model)
    with pytest.raises(ValueError, match="masks are not those of the Gaussians"):
        read(kept | {f"model.masks.{name}": value}, model)
