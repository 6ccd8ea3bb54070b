"""The ray tracer against closed forms: disks, projected points, faces, the surface of a waving
sheet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.data.synthetic.captures import hemisphere_cameras, orbit_cameras
from dyngs.data.synthetic.raytrace import (
    CAMERA_ANGLE_X,
    Box,
    Scene,
    Sheet,
    Sphere,
    Wave,
    render_scene,
)

SHEET = Sheet(
    (0.1, -0.2, 0.3),
    (0.8, 0.6),
    (Wave(0.12, (5.0, 1.5), 0.4), Wave(0.05, (-2.0, 6.0), 1.0)),
    lambda local: np.abs(local).astype(np.float32),
)


def _grey(local: np.ndarray) -> np.ndarray:
    return np.full((len(local), 3), 0.5, np.float32)


def test_sphere_covers_the_disk_that_perspective_predicts() -> None:
    size, distance, radius = 96, 4.0, 0.8
    pose = orbit_cameras(1, distance, elevation_deg=30.0, start_deg=20.0)[0]
    alpha = (
        render_scene(Scene((Sphere((0, 0, 0), radius, _grey),)), pose, size, samples=4)[..., 3]
        / 255.0
    )
    focal_px = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    disk_px = np.pi * (focal_px * radius / np.sqrt(distance**2 - radius**2)) ** 2
    assert abs(alpha.sum() / disk_px - 1) < 0.005
    rows, columns = np.mgrid[:size, :size] + 0.5
    assert abs((alpha * columns).sum() / alpha.sum() - size / 2) < 0.05
    assert abs((alpha * rows).sum() / alpha.sum() - size / 2) < 0.05
    assert 0 < ((alpha > 0) & (alpha < 1)).mean() < 0.1, "edges must be antialiased, and only edges"


def test_a_point_is_drawn_where_its_camera_sees_it() -> None:
    size = 128
    point = np.array([0.5, -0.3, 0.4])
    pose = hemisphere_cameras(5, 4.0, seed=3)[2]
    alpha = render_scene(Scene((Sphere(tuple(point), 0.05, _grey),)), pose, size)[..., 3].astype(
        float
    )
    local = np.linalg.inv(pose) @ [*point, 1.0]
    focal_px = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    expected = 0.5 * size + focal_px * np.array([local[0], -local[1]]) / -local[2]
    rows, columns = np.mgrid[:size, :size] + 0.5
    found = np.array([(alpha * columns).sum(), (alpha * rows).sum()]) / alpha.sum()
    np.testing.assert_allclose(found, expected, atol=0.1)


def test_box_faces_are_hit_with_their_normals() -> None:
    box = Box((1.0, 2.0, 3.0), (0.5, 1.0, 1.5), _grey, yaw=0.7)
    rng = np.random.default_rng(0)
    origins = (np.array([1.0, 2.0, 3.0]) + 5 * _unit(rng.normal(size=(200, 3)))).astype(np.float32)
    directions = _unit(np.array([1.0, 2.0, 3.0]) - origins).astype(np.float32)
    distance = box.intersect(origins, directions)
    points = origins + distance[:, None] * directions
    np.testing.assert_allclose(np.abs(box.local(points)).max(axis=1), 1.0, atol=1e-5)
    assert (np.einsum("ri,ri->r", box.normals(points), directions) < 0).all()
    assert np.isinf(box.intersect(origins, -directions)).all()


def test_paint_turns_with_the_ball() -> None:
    """The paint of a turned ball at a turned point is the paint of the ball as it was at the point
    as it was."""
    angle = 0.8
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    still = Sphere((1.0, -2.0, 0.5), 0.7, _grey)
    turned = replace(still, turn=turn)
    directions = _unit(np.random.default_rng(1).normal(size=(50, 3)))
    center = np.array(still.center)
    before = still.local((center + 0.7 * directions).astype(np.float32))
    after = turned.local((center + 0.7 * directions @ turn.T).astype(np.float32))
    np.testing.assert_allclose(before, directions, atol=1e-6)
    np.testing.assert_allclose(after, before, atol=2e-6)
    np.testing.assert_array_equal(turned.normals(center[None]), still.normals(center[None]))


def test_lamp_side_is_brighter_and_shadow_is_darker() -> None:
    pose = orbit_cameras(1, 4.0, elevation_deg=60.0, start_deg=0.0)[0]
    plate = Box((0, 0, -0.5), (1.0, 1.0, 0.05), _grey)
    ball = Sphere((0, 0, 0), 0.4, _grey)
    alone = render_scene(Scene((plate,)), pose, 64)
    with_ball = render_scene(Scene((plate, ball)), pose, 64)
    both_plate = (alone[..., 3] == 255) & (np.abs(with_ball.astype(int) - alone).max(axis=2) > 0)
    assert (
        with_ball[both_plate].astype(int)[:, :3].sum() < alone[both_plate].astype(int)[:, :3].sum()
    )


def test_a_faint_neighbour_changes_nothing_far_from_it() -> None:
    """With ``faint`` a ball darkens its surroundings, of which the form factor is above it, and
    nothing else."""
    plate = Box((0, 0, -0.5), (3.0, 3.0, 0.05), _grey, gloss=0.0)
    ball = Sphere((0.0, 0.0, -0.25), 0.2, _grey)
    above = orbit_cameras(1, 8.0, elevation_deg=90.0, start_deg=0.0)[0]
    lamp = (0.0, 0.0, 50.0)  # so high that the shadow stays below the ball
    alone, soft, sharp = (
        render_scene(Scene(things, lamp=lamp, faint=faint), above, 64, 2).astype(int)
        for things, faint in (((plate,), 0.0), ((plate, ball), 0.0), ((plate, ball), 0.1))
    )
    rows, columns = (np.mgrid[:64, :64] + 0.5 - 32) * np.tan(0.5 * CAMERA_ANGLE_X) / 32 * 8.45
    # cos * (r / d)^2 = h r^2 / d^3 falls below 0.1 beyond this distance d from the ball
    reach = (0.2 * 0.2**2 / 0.1) ** (1 / 3) + 0.1
    far = rows**2 + columns**2 > reach**2
    assert far.mean() > 0.5
    np.testing.assert_array_equal(sharp[far], alone[far])
    assert (soft[far] != alone[far]).any()
    assert (sharp[~far] < alone[~far]).any()


def test_rays_through_a_sheet_end_on_its_surface() -> None:
    """``z = height(u, v)`` inside the rectangle; and no point before it lies on the other side
    (dense, float64)."""
    rng = np.random.default_rng(2)
    center = np.array(SHEET.center)
    origins = (center + 3 * _unit(rng.normal(size=(300, 3)))).astype(np.float32)
    aims = center + rng.uniform(-1, 1, (300, 3)) * [0.9, 0.7, 0.2]
    directions = _unit(aims - origins).astype(np.float32)
    distance = SHEET.intersect(origins, directions)
    hit = np.isfinite(distance)
    assert 0.3 < hit.mean() < 0.99
    u, v, z = (origins[hit] + distance[hit, None] * directions[hit] - SHEET.center).T
    np.testing.assert_allclose(z, SHEET.height(u, v), atol=3e-6)
    assert (np.abs(u) <= 0.8 + 1e-5).all()
    assert (np.abs(v) <= 0.6 + 1e-5).all()
    first = _first_crossing(origins.astype(float) - center, directions.astype(float))
    agree = np.isclose(distance, first, atol=4e-3) | (np.isinf(distance) & np.isinf(first))
    assert agree.mean() > 0.98, "a ray that grazes a crest may miss it"


def _first_crossing(start: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(R,) by trying 4000 places on each ray."""
    distance = np.linspace(1.5, 5.0, 4000)
    x, y, z = np.moveaxis(start[:, None] + distance[:, None] * directions[:, None], -1, 0)
    side = z > 0.12 * np.sin(5.0 * x + 1.5 * y + 0.4) + 0.05 * np.sin(-2.0 * x + 6.0 * y + 1.0)
    inside = (np.abs(x) < 0.8) & (np.abs(y) < 0.6)
    crossing = (side[:, 1:] != side[:, :-1]) & inside[:, 1:] & inside[:, :-1]
    return np.where(crossing.any(axis=1), distance[crossing.argmax(axis=1)], np.inf)


@given(
    u=st.floats(-0.7, 0.7),
    v=st.floats(-0.5, 0.5),
    phase=st.floats(0, 6.3),
    amplitude=st.floats(0.0, 0.2),
)
@settings(max_examples=40, deadline=None)
def test_a_ray_from_above_meets_the_material_point_below_it(
    u: float, v: float, phase: float, amplitude: float
) -> None:
    """However the sheet waves, (u, v) stays what it is, its height is the sine, its normal that of
    the gradient."""
    sheet = replace(SHEET, center=(0.0, 0.0, 0.0), waves=(Wave(amplitude, (4.0, 3.0), phase),))
    origin = np.array([[u, v, 2.0]], np.float32)
    down = np.array([[0.0, 0.0, -1.0]], np.float32)
    point = origin + sheet.intersect(origin, down)[:, None] * down
    angle = 4.0 * u + 3.0 * v + phase
    np.testing.assert_allclose(point[0], [u, v, amplitude * np.sin(angle)], atol=3e-6)
    np.testing.assert_allclose(sheet.local(point)[0], [u / 0.8, v / 0.6, 0.0], atol=1e-6)
    gradient = amplitude * np.cos(angle) * np.array([4.0, 3.0])
    np.testing.assert_allclose(
        sheet.normals(point)[0], _unit(np.array([*-gradient, 1.0])), atol=3e-6
    )


def test_a_sheet_is_seen_from_both_sides_and_throws_a_shadow() -> None:
    sheet = replace(SHEET, center=(0.0, 0.0, 0.0), paint=_grey)
    above = orbit_cameras(1, 4.0, elevation_deg=80.0, start_deg=0.0)[0]
    below = orbit_cameras(1, 4.0, elevation_deg=-80.0, start_deg=0.0)[0]
    top, bottom = (render_scene(Scene((sheet,)), pose, 48, 2) for pose in (above, below))
    sizes = [int((image[..., 3] == 255).sum()) for image in (top, bottom)]
    assert abs(sizes[0] / sizes[1] - 1) < 0.1
    lit, dark = (image[image[..., 3] == 255][:, :3].mean() for image in (top, bottom))
    assert lit > dark + 40, "the lamp is above"
    plate = Box((0.0, 0.0, -0.9), (1.5, 1.5, 0.1), _grey)
    free, under = (
        render_scene(Scene(things), above, 48, 2)[..., :3] for things in ((plate,), (plate, sheet))
    )
    assert (under.astype(int) - free).min() < -40


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a, axis=-1, keepdims=True)
