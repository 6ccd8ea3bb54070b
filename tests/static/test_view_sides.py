"""Gaussians observed from several sides: a camera renders those of its nearest side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from camera_rings import ring_of
from splat_scenes import cloud

from dyngs.core.state import strip_roles
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.static_scene import StaticScene, ViewSides

PARTS = [cloud(40), cloud(60)]
EYES = [torch.tensor([4.0, 0.0, 1.5]), torch.tensor([-4.0, 0.0, 1.5])]
RING = ring_of(4, np.zeros(3)).to(dtype=torch.float32)  # from +x on, anticlockwise


def two_sides() -> StaticScene:
    return StaticScene(gaussians=Gaussians.joined(PARTS), sides=ViewSides.joined(PARTS, EYES))


@pytest.mark.parametrize(("camera", "side"), [(0, 0), (2, 1)])
def test_camera_renders_only_the_nearest_side(camera: int, side: int) -> None:
    options = RenderOptions(depth="expected")
    both = two_sides().render(RING, options=options)
    alone = StaticScene(gaussians=PARTS[side]).render(RING.select(camera), options=options)
    torch.testing.assert_close(both.rgb[camera], alone.rgb[0])
    torch.testing.assert_close(both.transmittance[camera], alone.transmittance[0])
    assert both.depth is not None
    assert alone.depth is not None
    torch.testing.assert_close(both.depth[camera], alone.depth[0])
    assert float(alone.alpha.mean()) > 0.01
    assert both.radii.shape == (4, 100, 2), (
        "one row for every Gaussian: training counts in which images it is seen"
    )


def test_images_train_only_the_visible_sides() -> None:
    scene = two_sides()
    probe = torch.zeros(1, 100, 4, requires_grad=True)
    colours = scene.gaussians.sh.clone().requires_grad_()
    scene = scene.with_gaussians(scene.gaussians.replace(sh=colours))
    scene.render(RING.select(2), probe=probe).rgb.sum().backward()
    assert colours.grad is not None
    assert probe.grad is not None
    assert not colours.grad[:40].any()
    assert colours.grad[40:].any()
    assert probe.grad[0, 40:].any()


def test_sides_follow_their_gaussians_and_are_stored() -> None:
    kept = torch.arange(0, 100, 3)
    scene = two_sides().apply_edit(TopologyEdit.select(kept))
    tensors = {name.removeprefix("model."): x for name, x in strip_roles(scene.state()).items()}
    again = StaticScene.from_state(scene.gaussians, tensors)
    assert again.sides is not None
    assert torch.equal(again.sides.side_ids, (kept >= 40).long())
    assert torch.equal(again.render(RING).rgb, scene.render(RING).rgb)
    assert not torch.equal(again.render(RING).rgb, replace(again, sides=None).render(RING).rgb)
    assert StaticScene.from_state(scene.gaussians, {}).sides is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("of", torch.full((100,), 2, dtype=torch.int64)),
        ("of", torch.zeros(99, dtype=torch.int64)),
        ("of", torch.zeros(100)),
        ("toward", torch.zeros(2, 2)),
        ("middle", torch.full((3,), torch.nan)),
    ],
)
def test_sides_that_do_not_fit_are_refused(name: str, value: torch.Tensor) -> None:
    tensors = {
        name.removeprefix("model."): x for name, x in strip_roles(two_sides().state()).items()
    }
    with pytest.raises(ValueError, match=name):
        ViewSides.from_state(tensors | {f"sides.{name}": value}, 100)
