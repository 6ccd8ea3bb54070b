"""A field as something to draw: depth, parts of a large image, times."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from moving_scene import camera
from small_fields import NERF, NGP, config_of

from dyngs.baselines.fields.keys import NgpModel
from dyngs.baselines.fields.ngp import NgpField
from dyngs.baselines.fields.scene import FieldScene, stored_space
from dyngs.core.errors import DyngsError
from dyngs.gaussians.restored import restored_model
from dyngs.models.renderable import DrawOptions
from dyngs.ops.rays import Space
from dyngs.training.new_trainer import assemble


def scene_of(space: Space) -> FieldScene:
    model = NgpModel(levels=3, log2_rows=8, finest=32, cells=8)
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


def test_an_image_does_not_depend_on_how_it_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(Space((0.0, 0.0, 0.0), 1.0, 3, 8))
    view = camera(12, 9)
    with torch.no_grad():
        whole = scene.render(view).rgb
        monkeypatch.setattr("dyngs.baselines.fields.scene.CHUNK", 7)
        # torch's own functions round the last few numbers of an array otherwise
        assert torch.allclose(scene.render(view).rgb, whole, atol=1e-6)


@pytest.mark.parametrize("keys", [NGP, NERF], ids=["ngp", "nerf"])
def test_with_time_it_moves(moving: Path, keys: list[str]) -> None:
    """It learns the times of the capture, and its scene is drawn at any."""
    trainer = assemble(config_of(moving, *keys, "model.time=true", "train.steps=20"))
    for _ in range(20):
        trainer.step()
    checkpoint = trainer.checkpoint()
    scene = restored_model(checkpoint, trainer.config.model)
    assert len(scene.times) > 1
    assert not scene.is_static
    image = trainer.images[0]
    with torch.no_grad():
        first, last = (scene.render(image.cameras, time).rgb for time in (0.0, 1.0))
    assert not torch.equal(first, last)


@pytest.mark.parametrize(
    "bad", [[0.0, 0, 0, -1, 1, 8], [0.0, 0, 0, 1, 99, 8], [0.0, 0, 0, 1, 1, 0.5]]
)
def test_a_space_that_is_none_is_refused(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="space"):
        stored_space({"space": torch.tensor(bad, dtype=torch.float64)})


def test_a_time_that_is_no_number_is_refused() -> None:
    with pytest.raises(DyngsError, match="not a number"):
        scene_of(Space((0.0, 0.0, 0.0), 1.0, 1, 8)).render(camera(4, 4), float("nan"))
