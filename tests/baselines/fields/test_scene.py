"""A field as a scene: depth, tiles of a large image, times."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from moving_scene import camera
from small_fields import NERF, NGP, config_of

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.ngp import NgpField
from dyngs.baselines.fields.scene import FieldScene
from dyngs.models.checkpoint import restore_model
from dyngs.models.renderable import DrawOptions
from dyngs.ops.rays import Space
from dyngs.training.new_trainer import build_trainer


def scene_of(space: Space) -> FieldScene:
    model = NgpModel(sizes="tiny")
    return FieldScene(
        NgpField.new(model, space, torch.Generator().manual_seed(0)), background=torch.ones(3)
    )


def test_depth_is_along_the_axis_of_the_camera_and_expected_is_divided_by_alpha() -> None:
    view = camera(12, 9)
    centre = (view.centers[0] + 3 * view.cam_from_world[0, 2, :3]).tolist()
    scene = scene_of(Space((centre[0], centre[1], centre[2]), 0.5, 1, 8))
    with torch.no_grad():
        whole, sums = (
            scene.render(view, options=DrawOptions(0.1, x)) for x in ("expected", "accumulated")
        )
    assert whole.depth is not None
    assert sums.depth is not None
    hit = whole.alpha > 0.02
    assert 5 < int(hit.sum()) < 108
    assert torch.allclose(whole.depth[hit] * whole.alpha[hit], sums.depth[hit], atol=1e-5)
    assert bool(((whole.depth[hit] > 2.1) & (whole.depth[hit] < 3.9)).all())
    assert torch.equal(
        whole.rgb[~hit & (whole.alpha == 0)], torch.ones_like(whole.rgb[~hit & (whole.alpha == 0)])
    )


@pytest.mark.parametrize("keys", [NGP, NERF], ids=["ngp", "nerf"])
def test_deformed_field_changes_with_time(moving: Path, keys: list[str]) -> None:
    """Trained at the times of the capture, rendered at any time."""
    trainer = build_trainer(config_of(moving, *keys, "model.time=true", "train.steps=20"))
    for _ in range(20):
        trainer.step()
    checkpoint = trainer.checkpoint()
    scene = restore_model(checkpoint, trainer.config.model)
    assert len(scene.times) > 1
    assert not scene.is_static
    image = trainer.images[0]
    with torch.no_grad():
        first, last = (scene.render(image.cameras, time).rgb for time in (0.0, 1.0))
    assert not torch.equal(first, last)
