from __future__ import annotations

import torch
from moving_scene import MOVING_ROWS, SETUP, Sliding, camera, row_of_balls

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.rendering import RenderOptions
from dyngs.training.priors.point_motion import Glance
from dyngs.training.priors.used import PointTracks, StepView, UsedPriors

HERE = camera(32, 24)
GENERATOR = torch.Generator().manual_seed(0)


def scene(speed: float) -> DynamicScene:
    gaussians = row_of_balls()
    gaussians = gaussians.replace(means=gaussians.means.clone().requires_grad_())
    field = Sliding(speed=speed, setup=SETUP)
    return DynamicScene(gaussians=gaussians, seen_at=(0.0, 1.0), field=field, moving=torch.tensor(MOVING_ROWS))


def image(**maps: torch.Tensor) -> Image:
    return Image("a", HERE, torch.zeros(24, 32, 3), None, None, 0.0, **maps)


def view(index: int = 0, until: float = 1.0) -> StepView:
    return StepView(index, lambda time: time <= until, RenderOptions(nonfinite="trust"))


def terms(priors: UsedPriors, own: Image, step: StepView, speed: float = 0.5) -> dict[str, float]:
    of = scene(speed)
    rendering = of.render(HERE, 0.0, options=priors.options(step.options, own))
    return {name: float(x.detach()) for name, x in priors.terms(of, own, rendering, step, GENERATOR).items()}


def still_flow() -> UsedPriors:
    return UsedPriors(flow_to={0: Glance(HERE, 0.5)})


def test_flow_of_a_motion_that_is_not_there_costs() -> None:
    """Flow says that nothing moves: right at speed 0, wrong at another."""
    own = image(flow=torch.zeros(24, 32, 2))
    assert terms(still_flow(), own, view(), speed=0.0)["flow"] < 1e-6
    wrong = terms(still_flow(), own, view())["flow"]
    assert wrong > 0.001


def test_times_outside_the_window_are_not_looked_at() -> None:
    own = image(flow=torch.zeros(24, 32, 2))
    assert terms(still_flow(), own, view(until=0.2)) == {}
    assert terms(still_flow(), own, view(index=1)) == {}
    assert terms(still_flow(), image(), view()) == {}


def test_only_the_field_learns_from_motion() -> None:
    of, own = scene(0.5), image(flow=torch.zeros(24, 32, 2))
    rendering = of.render(HERE, 0.0)
    loss = still_flow().terms(of, own, rendering, view(), GENERATOR)["flow"]
    assert not loss.requires_grad  # this field learns nothing, and the Gaussians have no part


def test_depth_is_drawn_only_where_it_is_needed() -> None:
    own, options = image(depth=torch.ones(24, 32)), RenderOptions()
    assert UsedPriors().options(options, own) is options
    assert UsedPriors(depth="depth").options(options, image()) is options
    assert UsedPriors(depth="depth").options(options, own).depth == "expected"


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
    assert terms(priors, image(), view(), speed=0.0)["tracks"] < 1e-6
    assert terms(priors, image(), view())["tracks"] > 0.01


def test_lines_are_told_once() -> None:
    priors = UsedPriors(lines=["one", "two"])
    assert priors.told("three") == "one\ntwo\nthree"
    assert priors.told(None) is None
