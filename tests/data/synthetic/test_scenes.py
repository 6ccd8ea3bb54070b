"""The embedded scenes: what moves is where its formula says, what is still is still, paint sticks
to its surface."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import hemisphere_cameras, orbit_cameras
from dyngs.data.synthetic.raytrace import (
    CAMERA_ANGLE_X,
    Box,
    Paint,
    Scene,
    Sheet,
    Sphere,
    render_scene,
)
from dyngs.data.synthetic.scenes import SceneName, scene_at, still_life

NAMES: tuple[SceneName, ...] = get_args(SceneName)
NUM_STILL: dict[SceneName, int] = dict(zip(NAMES, (2, 4, 7, 1), strict=True))
ROLLING = [("spin", 3), ("roll", 1)]
FOCAL = 0.5 / np.tan(0.5 * CAMERA_ANGLE_X)
"""Of an image of one pixel."""

times = st.floats(0.0, 1.0)


def test_the_still_life_is_on_white_and_fills_the_image() -> None:
    for pose in hemisphere_cameras(6, 4.0, 0):
        alpha = render_scene(still_life(), pose, 32, samples=2)[..., 3]
        assert alpha[0].max() == 0
        assert 0.15 < (alpha > 0).mean() < 0.75


@pytest.mark.parametrize("name", [name for name in NAMES if name != "room"])
def test_moving_things_stay_inside_the_image(name: SceneName) -> None:
    poses = hemisphere_cameras(7, 4.0, seed=1)
    for time, pose in zip(np.linspace(0, 1, 7), poses, strict=True):
        alpha = render_scene(scene_at(name, float(time)), pose, 32, samples=2)[..., 3]
        border = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
        assert (border > 0).mean() < 0.05, "at most a corner of the plate"
        assert 0.1 < (alpha > 0).mean() < 0.75


def test_the_room_is_opaque_in_all_directions() -> None:
    for azimuth_deg in (-79.0, -45.0, -11.0):
        for elevation_deg in (16.0, 34.0):
            pose = orbit_cameras(1, 4.0, elevation_deg, azimuth_deg)[0]
            assert render_scene(scene_at("room", 0.4), pose, 24, 1)[..., 3].min() == 255


def test_unknown_scene_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(
        DyngsError, match="no moving scene 'nosuch'; choose one of spin, wave, room, roll"
    ):
        scene_at("nosuch", 0.0)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", NAMES)
def test_still_primitives_come_first_and_stay(name: SceneName) -> None:
    """Where they are and how they are painted; of the others each changes."""
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
    first = scene_at(name, 0.35).primitives
    second = scene_at(name, 0.72).primitives
    still = NUM_STILL[name]
    for a, b in zip(first[:still], second[:still], strict=True):
        assert repr(a).split("paint")[0] == repr(b).split("paint")[0]
        np.testing.assert_array_equal(a.paint(a.local(points)), b.paint(b.local(points)))
    assert len(first) == len(second) > still
    assert scene_at(name, 0.35).movers == range(still, len(first))
    for a, b in zip(first[still:], second[still:], strict=True):
        assert (a.local(points) != b.local(points)).any() or isinstance(a, Sheet)


@pytest.mark.parametrize("name", ["spin", "room"])
def test_far_from_the_mover_nothing_changes(name: SceneName) -> None:
    """From a fixed camera, exactly: neither light nor sky of what is far from the moving thing
    depends on it."""
    pose = orbit_cameras(1, 4.0, elevation_deg=28.0, start_deg=-45.0)[0]
    first, second = (render_scene(scene_at(name, time), pose, 64, 2) for time in (0.0, 1.0))
    same = (first == second).all(axis=-1)
    if name == "spin":
        drawn = first[..., 3] > 0
        assert (~same & drawn).mean() > 0.05
        assert same[drawn].mean() > 0.3
    else:
        assert 0.02 < (~same).mean() < 0.25
        assert same[:15].all(), "the walls"


@given(time=times, azimuth_deg=st.floats(0, 360), elevation_deg=st.floats(5, 80))
@settings(max_examples=12, deadline=None)
def test_the_rolling_ball_is_seen_where_its_path_says(
    time: float, azimuth_deg: float, elevation_deg: float
) -> None:
    """A ball's outline is an ellipse whose middle lies between the projections of its two tangent
    rays."""
    size = 96
    angle = np.radians(-130.0 + 130.0 * time)
    center = np.array([0.70 * np.cos(angle), 0.70 * np.sin(angle), -0.10])
    radius = 0.24
    ball = scene_at("spin", time).primitives[-1]
    pose = orbit_cameras(1, 4.0, elevation_deg, azimuth_deg)[0]
    alpha = render_scene(Scene((ball,)), pose, size, samples=4)[..., 3].astype(float)
    rows, columns = np.mgrid[:size, :size] + 0.5
    found = np.array([(alpha * columns).sum(), (alpha * rows).sum()]) / alpha.sum()
    local = np.linalg.inv(pose) @ [*center, 1.0]
    off_axis = np.array([local[0], -local[1]]) / -local[2]
    tilt = np.arctan(np.linalg.norm(off_axis))
    half = np.arcsin(radius / np.linalg.norm(local[:3]))
    middle = 0.5 * (np.tan(tilt + half) + np.tan(tilt - half))
    expected = 0.5 * size + FOCAL * size * middle * off_axis / np.linalg.norm(off_axis)
    np.testing.assert_allclose(found, expected, atol=0.12)  # 1/4 pixel samples


@pytest.mark.parametrize(("name", "index"), ROLLING)
@given(time=st.floats(0.01, 0.99))
@settings(max_examples=10, deadline=None)
def test_balls_roll_without_slipping(name: SceneName, index: int, time: float) -> None:
    """The material point that touches the plate is at rest, while the centre is not."""
    before, now, after = (
        scene_at(name, time + step).primitives[index] for step in (-1e-4, 0.0, 1e-4)
    )
    assert isinstance(before, Sphere)
    assert isinstance(now, Sphere)
    assert isinstance(after, Sphere)
    material = now.turn.T @ [0.0, 0.0, -now.radius]
    speed = (np.array(after.center) - before.center) / 2e-4
    contact = speed + (after.turn - before.turn) @ material / 2e-4
    assert now.center[2] - now.radius == pytest.approx(-0.34)
    assert np.linalg.norm(speed) > 0.3
    np.testing.assert_allclose(contact, 0.0, atol=1e-4)
    np.testing.assert_allclose(now.turn @ now.turn.T, np.eye(3), atol=1e-12)


@given(time=times)
def test_spinning_things_never_touch(time: float) -> None:
    _, other, die, ball = scene_at("spin", time).primitives
    assert isinstance(die, Box)
    assert isinstance(ball, Sphere)
    assert isinstance(other, Sphere)
    assert die.center[2] - die.half_extents[2] == pytest.approx(-0.34)
    c = np.cos(die.yaw)
    s = np.sin(die.yaw)
    across = np.abs(np.array([[c, s], [-s, c]]) @ ball.center[:2])
    gap = np.maximum(across - die.half_extents[:2], 0.0)
    assert np.linalg.norm(gap) > ball.radius
    assert np.linalg.norm(np.subtract(ball.center, other.center)) > ball.radius + other.radius


def test_faces_of_the_die_hold_one_to_six_pips_and_opposite_ones_seven() -> None:
    paint = scene_at("spin", 0.0).primitives[2].paint
    a, b = (g.ravel() for g in np.meshgrid(*[(np.arange(200) + 0.5) / 100 - 1] * 2))
    counts = np.zeros((3, 2))
    for axis in range(3):
        for side in range(2):
            local = np.empty((len(a), 3), np.float32)
            local[:, axis] = 2 * side - 1
            local[:, axis - 1] = a
            local[:, axis - 2] = b
            is_pip = (paint(local) == np.array([0.96, 0.94, 0.88], np.float32)).all(axis=1)
            counts[axis, side] = is_pip.mean() * 4 / (np.pi * 0.19**2)
    np.testing.assert_allclose(counts, counts.round(), atol=0.1)
    assert sorted(counts.round().ravel()) == [1, 2, 3, 4, 5, 6]
    np.testing.assert_array_equal(counts.round().sum(axis=1), 7)


def test_the_cloth_closes_its_cycle_and_bends_in_between() -> None:
    u, v = np.random.default_rng(3).uniform(-0.5, 0.5, (2, 100)).astype(np.float32)
    start, middle, end = (_cloth(time).height(u, v) for time in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(end, start, atol=1e-6)
    assert np.abs(middle - start).max() > 0.15
    cloth = _cloth(0.0)
    lowest = cloth.center[2] - sum(wave.amplitude for wave in cloth.waves)
    assert lowest > -0.34, "it never meets the plate"


@pytest.mark.parametrize("time", [0.0, 0.2, 0.55, 0.9])
def test_a_mark_on_the_cloth_is_seen_where_its_material_point_is(time: float) -> None:
    """Texture moves with the cloth: a painted spot is drawn at the projection of (u, v, height(u,
    v))."""
    size = 128
    u = 0.31
    v = -0.22
    sheet = replace(_cloth(time), paint=_spot(u / 0.74, v / 0.56))
    pose = orbit_cameras(1, 4.0, elevation_deg=50.0, start_deg=-60.0)[0]
    image = render_scene(Scene((sheet,)), pose, size, samples=3).astype(float)
    red = ((image[..., 3] == 255) & (image[..., 0] > 2 * image[..., 1])).astype(float)
    rows, columns = np.mgrid[:size, :size] + 0.5
    found = np.array([(red * columns).sum(), (red * rows).sum()]) / red.sum()
    height = 0.16 + 0.115 * np.sin(5.2 * u + 1.6 * v - 2 * np.pi * time)
    height += 0.045 * np.sin(-2.4 * u + 6.0 * v - 2 * np.pi * time + 1.0)
    local = np.linalg.inv(pose) @ [u, v, height, 1.0]
    expected = 0.5 * size + FOCAL * size * np.array([local[0], -local[1]]) / -local[2]
    np.testing.assert_allclose(found, expected, atol=0.4)  # the spot is 7 pixels wide and bends


def test_every_point_of_the_cloth_keeps_its_color() -> None:
    u, v = np.random.default_rng(4).uniform(-0.5, 0.5, (2, 300)).astype(np.float32)
    down = np.tile(np.array([0, 0, -1], np.float32), (300, 1))
    colors = []
    for time in (0.0, 0.3, 0.8):
        sheet = _cloth(time)
        origins = np.stack([u, v, np.full_like(u, 2.0)], axis=1)
        points = origins + sheet.intersect(origins, down)[:, None] * down
        colors.append(sheet.paint(sheet.local(points)))
    np.testing.assert_array_equal(colors[1], colors[0])
    np.testing.assert_array_equal(colors[2], colors[0])
    assert len(np.unique(colors[0], axis=0)) >= 5, "a texture by which motion can be seen"


@given(time=times)
def test_the_hopping_ball_keeps_its_distance(time: float) -> None:
    *_, framed, tiled, top, still, ball = scene_at("room", time).primitives
    assert isinstance(ball, Sphere)
    assert ball.center[2] - ball.radius >= -0.5 - 1e-9
    for other in (still, top):
        assert isinstance(other, Sphere)
        assert np.linalg.norm(np.subtract(ball.center, other.center)) > ball.radius + other.radius
    for box in (framed, tiled):
        assert isinstance(box, Box)
        corner = np.linalg.norm(box.half_extents[:2])
        assert np.linalg.norm(np.subtract(ball.center, box.center)[:2]) > ball.radius + corner


def test_the_rolling_ball_turns_by_its_path_over_its_radius() -> None:
    """The point on top at time 0 goes up and down by the cosine of path over radius, 2.5 times."""
    balls = [scene_at("roll", time).primitives[1] for time in np.linspace(0, 1, 2001).tolist()]
    centers = np.array([ball.center for ball in balls])
    path = np.concatenate([[0.0], np.linalg.norm(np.diff(centers, axis=0), axis=1).cumsum()])
    assert path[-1] == pytest.approx(2.5 * 2 * np.pi * 0.28, rel=1e-5)
    top = _ball(balls[0]).turn.T @ [0.0, 0.0, 1.0]
    heights = np.array([(_ball(ball).turn @ top)[2] for ball in balls])
    np.testing.assert_allclose(heights, np.cos(path / 0.28), atol=1e-4)
    np.testing.assert_allclose(centers[[0, -1], 2], -0.34 + 0.28)
    np.testing.assert_allclose(np.hypot(*centers[:, :2].T), 0.60)


def _ball(thing: object) -> Sphere:
    assert isinstance(thing, Sphere)
    return thing


def _box(thing: object) -> Box:
    assert isinstance(thing, Box)
    return thing


def _cloth(time: float) -> Sheet:
    sheet = scene_at("wave", time).primitives[-1]
    assert isinstance(sheet, Sheet)
    return sheet


def _spot(u: float, v: float) -> Paint:
    def paint(local: np.ndarray) -> np.ndarray:
        is_spot = np.hypot((local[:, 0] - u) * 0.74, (local[:, 1] - v) * 0.56) < 0.08
        return np.where(is_spot[:, None], np.array([0.9, 0.0, 0.0]), np.array([0.5, 0.5, 0.5]))

    return paint
