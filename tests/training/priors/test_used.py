from __future__ import annotations

from typing import Any, Literal, cast

import torch
from moving_scene import MOVING_ROWS, SETUP, Sliding, camera, row_of_balls

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.models.model import Drawn, Look, Model
from dyngs.training.priors.point_motion import Glance
from dyngs.training.priors.used import PointTracks, UsedPriors

HERE = camera(32, 24)
GENERATOR = torch.Generator().manual_seed(0)


def scene(speed: float) -> DynamicScene:
    gaussians = row_of_balls()
    gaussians = gaussians.replace(means=gaussians.means.clone().requires_grad_())
    field = Sliding(speed=speed, setup=SETUP)
    return DynamicScene(gaussians=gaussians, seen_at=(0.0, 1.0), field=field, moving=torch.tensor(MOVING_ROWS))


def image(**maps: torch.Tensor) -> Image:
    return Image("a", HERE, torch.zeros(24, 32, 3), None, None, 0.0, **maps)


class Seen:
    """A model of which times up to ``until`` are trained on."""

    def __init__(self, scene: DynamicScene, until: float) -> None:
        self.scene, self._until = scene, until

    def window(self, step: int) -> tuple[float, float]:
        return 0.0, self._until


def look(priors: UsedPriors, of: DynamicScene, own: Image, index: int = 0, until: float = 1.0) -> Look:
    depth: Literal["none", "expected"] = "expected" if priors.needs_depth(own) else "none"
    rendering = of.render(HERE, 0.0, options=RenderOptions(nonfinite="trust", depth=depth))
    rgb, model = rendering.rgb[0], cast(Model[Any], Seen(of, until))
    return Look(index, 1, own, Drawn(rendering), rgb, rgb, model, GENERATOR)


def terms(
    priors: UsedPriors, own: Image, *, index: int = 0, until: float = 1.0, speed: float = 0.5
) -> dict[str, float]:
    found = priors(look(priors, scene(speed), own, index, until))
    return {name: float(x.detach()) for name, x in found.items()}


def still_flow() -> UsedPriors:
    return UsedPriors(flow_to={0: Glance(HERE, 0.5)})


def test_flow_of_a_motion_that_is_not_there_costs() -> None:
    """Flow says that nothing moves: right at speed 0, wrong at another."""
    own = image(flow=torch.zeros(24, 32, 2))
    assert terms(still_flow(), own, speed=0.0)["flow"] < 1e-6
    wrong = terms(still_flow(), own)["flow"]
    assert wrong > 0.001


def test_times_outside_the_window_are_not_looked_at() -> None:
    own = image(flow=torch.zeros(24, 32, 2))
    assert terms(still_flow(), own, until=0.2) == {}
    assert terms(still_flow(), own, index=1) == {}
    assert terms(still_flow(), image()) == {}


def test_only_the_field_learns_from_motion() -> None:
    of, own = scene(0.5), image(flow=torch.zeros(24, 32, 2))
    loss = still_flow()(look(still_flow(), of, own))["flow"]
    assert not loss.requires_grad  # this field learns nothing, and the Gaussians have no part


def test_depth_is_drawn_only_where_it_is_needed() -> None:
    own = image(depth=torch.ones(24, 32))
    assert not UsedPriors().needs_depth(own)
    assert not UsedPriors(depth="depth").needs_depth(image())
    assert UsedPriors(depth="depth").needs_depth(own)


def test_tracks_pair_views_of_other_times_that_share_points() -> None:
    xy = torch.zeros(4, 5, 2)
    visible = torch.ones(4, 5, dtype=torch.bool)
    visible[1, :3] = False
    tracks = PointTracks(xy, visible, [Glance(HERE, time) for time in (0.0, 0.25, 0.5, 0.0)])
    found = [tracks.pair(0, lambda _: True, GENERATOR) for _ in range(8)]
    assert {None if pair is None else pair[0].time for pair in found} == {0.5}
    assert tracks.pair(0, lambda time: time < 0.4, GENERATOR) is None


def test_tracks_in_images_of_another_size() -> None:
    """Points of the full images, twice as large, on a ball that does not move."""
    of = row_of_balls().means
    k, pose = HERE.intrinsics[0], HERE.cam_from_world[0]
    local = of[list(MOVING_ROWS) * 2] @ pose[:3, :3].T + pose[:3, 3]
    full = Cameras(HERE.cam_from_world, torch.tensor([2.0, 2.0, 1.0])[:, None] * HERE.intrinsics, 64, 48)
    xy = 2 * (local[:, :2] / local[:, 2:] * k.diagonal()[:2] + k[:2, 2])
    glances = [Glance(full, 0.0), Glance(full, 0.5)]
    priors = UsedPriors(tracks=PointTracks(xy.expand(2, 4, 2), torch.ones(2, 4, dtype=torch.bool), glances))
    assert terms(priors, image(), speed=0.0)["tracks"] < 1e-6
    assert terms(priors, image())["tracks"] > 0.01
