"""Motion before cameras that stand still: changes in their images, hulls of these, and Gaussians on
them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from static_balls import BLACK, Ball, Balls, cameras, drawn, filmed
from tiny_fields import cloud

from dyngs.data.loader import Image
from dyngs.deform.fixed_cameras import (
    LONGEST_SIDE,
    Hull,
    TimedGaussians,
    changes,
    first_motion,
    fixed_camera_clip,
    hull_gaussians,
    hulls_in,
    linked,
    pays,
    surface,
    surface_changes,
    travels,
    views_at,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions

TIMES = tuple(i / 8 for i in range(9))


def still(noise: float = 0.0, count: int = 9) -> np.ndarray:
    """Images (T, H, W, 3) of one camera, nothing moves."""
    shown = [drawn(cameras(1)[0], [], noise, seed) for seed in range(count)]
    return (255 * torch.stack(shown)).round().to(torch.uint8).numpy()


def with_patch(factor: tuple[float, float, float], at: int = 0) -> np.ndarray:
    """The same with the light in a square changed in the image ``at``."""
    images = still().copy()
    images[at, 20:40, 20:40] = (
        (images[at, 20:40, 20:40] * np.array(factor)).clip(0, 255).astype(np.uint8)
    )
    return images


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_ball_is_found_where_it_is(noise: float) -> None:
    """Each image: the pixels whose rays meet the ball, but for those at its rim."""
    path = [Ball((0.0, 1.2 * t - 0.6, 0.0)) for t in TIMES]
    camera = cameras(1)[0]
    one = filmed(lambda t: [path[TIMES.index(t)]], TIMES, 1, noise)[0]
    for i, ball in enumerate(path):
        truth = (drawn(camera, [ball]) != drawn(camera, [])).any(-1).numpy()
        both = (truth & one.changed[i]).sum() / (truth | one.changed[i]).sum()
        assert both > 0.85
    assert np.abs(one.median / 255 - drawn(camera, []).numpy()).mean() < 0.02


def test_a_shadow_is_none_of_it() -> None:
    """All channels darker alike; but a coloured or a brighter patch is a thing, and so is a black
    one."""
    assert not changes(with_patch((0.6, 0.62, 0.65))).any()
    for factor in ((0.9, 0.4, 0.4), (1.4, 1.4, 1.4), (0.05, 0.05, 0.05)):
        found = changes(with_patch(factor, 3))
        assert found[3, 21:39, 21:39].all()
        assert found.sum() < 1.2 * 20 * 20


def test_large_images_are_shrunk_and_masks_kept() -> None:
    width = 2 * LONGEST_SIDE
    camera = cameras(1)[0]
    large = type(camera)(camera.cam_from_world, camera.intrinsics, width, 10)
    mask = torch.ones(10, width)
    mask[:, :20] = 0
    images = [
        Image("view", large, torch.full((10, width, 3), 0.1 * i), None, mask, i / 2)
        for i in range(3)
    ]
    one = fixed_camera_clip(images, BLACK)
    assert one.images.shape == (3, 5, LONGEST_SIDE, 3)
    assert not one.counted[:, :, :10].any()
    assert one.counted[:, :, 10:].all()
    assert not one.changed[:, :, :10].any()
    assert one.times == (0.0, 0.5, 1.0)
    assert fixed_camera_clip(images, BLACK, total=8000).images.shape[2] == LONGEST_SIDE // 2


# --- hulls

LOW = np.full(3, -3.0)
HIGH = np.full(3, 3.0)
MOMENTS = tuple(i / 4 for i in range(5))


def hulls(*balls: Ball, count: int = 8, blind: int = 0) -> list[np.ndarray]:
    """Cubes of those of the last of some moments; before, the balls were not there."""
    clips = filmed(lambda t: balls if t == 1.0 else [], MOMENTS, count)
    for one in clips[:blind]:
        one.changed[:] = False
    found = [hull.cubes for hull in hulls_in(views_at(clips, 1.0), LOW, HIGH)]
    return sorted(found, key=lambda cubes: -len(cubes))


# of four, three suffice: their hull has corners
@pytest.mark.parametrize(("count", "fraction"), [(4, 0.3), (8, 0.15)])
def test_a_hull_has_the_centre_and_the_radius_of_its_ball(count: int, fraction: float) -> None:
    ball = Ball((0.31, -0.22, 0.13))
    (found,) = hulls(ball, count=count)
    assert np.linalg.norm(found.mean(0) - ball.center) < fraction * ball.radius
    distances = np.linalg.norm(found - np.array(ball.center), axis=1)
    # of a ball: 0.79 of its radius
    assert np.median(distances) == pytest.approx(0.79 * ball.radius, rel=0.25)


def test_two_balls_are_two() -> None:
    found = hulls(Ball((-0.4, 0.0, 0.1)), Ball((0.5, 0.2, -0.1), 0.15, (0.1, 0.2, 0.9)))
    places = np.array([points.mean(0) for points in found[:2]])
    assert np.abs(places - np.array([[-0.4, 0.0, 0.1], [0.5, 0.2, -0.1]])).max() < 0.05


@pytest.mark.parametrize(("count", "number"), [(8, 1), (3, 0)])
def test_what_one_of_eight_cameras_does_not_see_is_found(count: int, number: int) -> None:
    """Something still hides it there; but of three cameras all must see it."""
    found = hulls(Ball((0.1, 0.0, 0.0)), count=count, blind=1)
    assert len(found) == number
    assert all(np.linalg.norm(points.mean(0) - [0.1, 0.0, 0.0]) < 0.05 for points in found)


# --- Gaussians on them


def ball_at(time: float) -> Ball:
    """It travels along z, and is of another red in the second half of the clip."""
    colour = (0.9, 0.2, 0.1) if time < 0.5 else (0.7, 0.4, 0.2)
    return Ball((0.1, 0.2, 1.8 * time - 0.9), 0.3, colour)


def test_gaussians_cover_a_ball_at_each_time_and_pay() -> None:
    """On its surface, in its colour of that time; at another place or time they would not pay."""
    clips = filmed(lambda t: [ball_at(t)], TIMES, 7)
    hulls = [hulls_in(views_at(clips, time), LOW, HIGH) for time in TIMES]
    (track,) = linked(TIMES, hulls)
    assert [time for time, _ in track] == list(TIMES)
    assert travels(track)
    shape = surface([hull for _, hull in track])
    for time, hull in track:
        now = hull_gaussians(views_at(clips, time), hull.center, *shape, 4)
        assert pays(now, time, clips)
        ball = ball_at(time)
        apart = (now.means - torch.tensor(ball.center)).norm(dim=1)
        # a hull has corners
        assert ((apart - ball.radius).abs() < 0.5 * ball.radius).float().mean() > 0.8
        assert (now.base_rgb.mean(0) - torch.tensor(ball.color)).abs().max() < 0.1
        assert now.sh.shape == (len(now), 4, 3)
        beside = now.replace(means=now.means + torch.tensor([0.0, 0.9, 0.0]))
        assert not pays(beside, time, clips)
        assert not pays(now, TIMES[0] if time > 0.5 else TIMES[-1], clips)


def test_what_jumps_to_and_fro_does_not_travel() -> None:
    cubes = np.argwhere(np.ones((3, 3, 3))) - 1.0
    places = [(0.0, 0, 0), (4.0, 0, 0)] * 4
    assert not travels([(i / 7, Hull(cubes + place, 1.0)) for i, place in enumerate(places)])


def test_two_that_cross_are_told_apart_and_may_be_lost_for_a_while() -> None:
    cubes = np.argwhere(np.ones((3, 3, 3))) - 1.0
    hulls = [
        [
            Hull(cubes + np.array(place), 1.0)
            for place in ((4 * i, 2 * i, 0), (4 * i, 20 - 2 * i, 0))
        ]
        for i in range(11)
    ]
    hulls[3] = hulls[3][1:]
    first, second = linked([i / 10 for i in range(11)], hulls)
    assert (len(first), len(second)) == (10, 11)
    assert first[-1][1].center[1] == 20
    assert second[-1][1].center[1] == 0


def started(balls: Balls, count: int = 6, limit: int = 600) -> list[TimedGaussians]:
    return first_motion(filmed(balls, TIMES, count), cloud(50), 1.0, limit, RenderOptions())


def crossing(time: float) -> tuple[float, float, float]:
    return (1.6 * time - 0.8, 0.3, 0.1)


def test_one_ball_begins_at_each_time() -> None:
    found = started(lambda t: [Ball(crossing(t))])
    for time in TIMES:
        now = [one for one in found if one.time == time]
        center = torch.cat([one.gaussians.means for one in now]).median(0).values
        assert (center - torch.tensor(crossing(time))).norm() < 0.1


@pytest.mark.parametrize(("count", "limit"), [(6, 600), (1, 600), (6, 0)])
def test_where_nothing_changes_nothing_begins(count: int, limit: int) -> None:
    """A ball that stands still; one camera, which sees no depth; no Gaussians allowed."""
    at = (lambda _: (0.0, 0.0, 0.0)) if count == 6 and limit else crossing
    assert started(lambda t: [Ball(at(t))], count, limit) == []


# --- surfaces that look different at a time

SHADES = tuple(i / 5 for i in range(6))
CENTER = torch.tensor([0.0, 0.1, 0.1])
RADIUS = 0.4
RED = (0.9, 0.2, 0.1)
INSIDE = 0.35  # Radius of the Gaussians, which are blurred: none shows what is beside the ball


def shell(count: int = 400) -> Gaussians:
    """Flat red Gaussians all over a ball."""
    i = torch.arange(count)
    z = 1 - (2 * i + 1) / count
    turn = 2.39996 * i
    flat = (1 - z**2).sqrt()
    out = torch.stack([flat * turn.cos(), flat * turn.sin(), z], 1)
    # z to the outward normal
    quats = torch.cat([1 + out[:, 2:], -out[:, 1:2], out[:, :1], torch.zeros(count, 1)], 1)
    scales = torch.tensor([0.04, 0.04, 0.004]).log().expand(count, 3)
    sh = ((torch.tensor(RED) - 0.5) / 0.28209479).expand(count, 1, 3)
    return Gaussians(
        CENTER + INSIDE * out, quats, scales.clone(), torch.full((count,), 4.0), sh.clone()
    )


def test_a_ball_that_is_blue_at_a_time_gets_blue_gaussians_then_just_before_its_own() -> None:
    clips = filmed(
        lambda t: [Ball((0.0, 0.1, 0.1), RADIUS, (0.1, 0.2, 0.9) if t == SHADES[2] else RED)],
        SHADES,
        noise=0.0,
    )
    (found,) = surface_changes(clips, shell(), RenderOptions(), 1000)
    assert found.time == SHADES[2]
    assert len(found.gaussians) > 300
    close = (found.gaussians.base_rgb - torch.tensor([0.1, 0.2, 0.9])).abs().amax(1) < 0.15
    assert close.float().mean() > 0.9
    apart = (found.gaussians.means - CENTER).norm(dim=1)
    assert ((apart - INSIDE).abs() < 0.03).all()
    fewer = surface_changes(clips, shell(), RenderOptions(), 50)
    assert sum(len(one.gaussians) for one in fewer) <= 50
