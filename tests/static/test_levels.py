"""Levels of detail of a static scene: the camera chooses the level."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from moving_scene import moving_scene, sliding_nodes
from scene_kinds import onlooker, scene_of_kind
from small_triangles import bent
from splat_scenes import AROUND, cloud

from dyngs.baselines.triangles.scene import TriangleOptions, TriangleScene
from dyngs.core.errors import DyngsError
from dyngs.gaussians import levels
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.static_scene import StaticScene, ViewSides


def test_close_views_use_the_full_scene() -> None:
    still = StaticScene(
        gaussians=cloud(),
        filter_std=torch.full((400,), 0.02),
        background=torch.tensor([0.2, 0.5, 0.9]),
    )
    options = RenderOptions(depth="expected", mode="antialiased")  # type: ignore[arg-type]
    one, other = (x.render(AROUND, options=options) for x in (still, LevelScene.from_scene(still)))
    assert one.depth is not None
    assert other.depth is not None
    for name in (
        "rgb",
        "transmittance",
        "depth",
    ):  # not to the last bit: levels are in another order, and sums with them
        torch.testing.assert_close(getattr(one, name), getattr(other, name), atol=1e-6, rtol=1e-5)


def test_cut_respects_max_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(levels, "BLOCK", 16)
    still = StaticScene(gaussians=cloud(2000))
    coarse = LevelScene.from_scene(still, max_gaussians=300).on_background(torch.ones(3))
    image = coarse.render(AROUND).rgb
    truth = still.on_background(torch.ones(3)).render(AROUND).rgb
    assert not torch.equal(image, truth)
    assert float((image - truth).abs().mean()) < 0.08


def test_colours_of_a_network_are_drawn_too() -> None:
    coloured = scene_of_kind("control_nodes")
    still = StaticScene(gaussians=coloured.at(0.5), colour=coloured.colour)
    image = still.render(onlooker()).rgb
    assert torch.equal(LevelScene.from_scene(still).render(onlooker()).rgb, image)
    assert not torch.equal(image, replace(still, colour=None).render(onlooker()).rgb)


def test_other_scenes_are_refused() -> None:
    with pytest.raises(DyngsError, match="need a static scene"):
        LevelScene.from_scene(moving_scene(sliding_nodes()))
    sides = ViewSides(torch.zeros(400, dtype=torch.int64), torch.eye(3)[:2], torch.zeros(3))
    with pytest.raises(DyngsError, match="one per viewing direction"):
        LevelScene.from_scene(StaticScene(gaussians=cloud(), sides=sides))
    with pytest.raises(DyngsError, match="needs a scene of Gaussians"):
        LevelScene.from_scene(TriangleScene(bent(2), 1.0, TriangleOptions(), torch.ones(3)))
