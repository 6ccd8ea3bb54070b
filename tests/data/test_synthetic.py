"""The demo scene: geometry against closed forms, files against their layout."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from dyngs.data.synthetic import (
    CAMERA_ANGLE_X,
    Box,
    Scene,
    Sphere,
    StillOptions,
    hemisphere_cameras,
    orbit_cameras,
    render_scene,
    still_life,
    write_still_capture,
)


def _grey(local: np.ndarray) -> np.ndarray:
    return np.full((len(local), 3), 0.5, np.float32)


def test_sphere_covers_the_disk_that_perspective_predicts() -> None:
    size, distance, radius = 96, 4.0, 0.8
    pose = orbit_cameras(1, distance, elevation_deg=30.0, start_deg=20.0)[0]
    alpha = render_scene(Scene((Sphere((0, 0, 0), radius, _grey),)), pose, size, samples=4)[..., 3] / 255.0
    focal_px = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    disk_px = np.pi * (focal_px * radius / np.sqrt(distance**2 - radius**2)) ** 2
    assert abs(alpha.sum() / disk_px - 1) < 0.005
    rows, columns = np.mgrid[:size, :size] + 0.5
    assert abs((alpha * columns).sum() / alpha.sum() - size / 2) < 0.05
    assert abs((alpha * rows).sum() / alpha.sum() - size / 2) < 0.05
    assert 0 < ((alpha > 0) & (alpha < 1)).mean() < 0.1, "edges must be antialiased, and only edges"


def test_a_point_is_drawn_where_its_camera_sees_it() -> None:
    size, point = 128, np.array([0.5, -0.3, 0.4])
    pose = hemisphere_cameras(5, 4.0, seed=3)[2]
    alpha = render_scene(Scene((Sphere(tuple(point), 0.05, _grey),)), pose, size)[..., 3].astype(float)
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


def test_lamp_side_is_brighter_and_shadow_is_darker() -> None:
    pose = orbit_cameras(1, 4.0, elevation_deg=60.0, start_deg=0.0)[0]
    plate = Box((0, 0, -0.5), (1.0, 1.0, 0.05), _grey)
    ball = Sphere((0, 0, 0), 0.4, _grey)
    alone = render_scene(Scene((plate,)), pose, 64)
    with_ball = render_scene(Scene((plate, ball)), pose, 64)
    both_plate = (alone[..., 3] == 255) & (np.abs(with_ball.astype(int) - alone).max(axis=2) > 0)
    assert with_ball[both_plate].astype(int)[:, :3].sum() < alone[both_plate].astype(int)[:, :3].sum()
    assert still_life().primitives, "the demo scene is not empty"


def test_capture_has_blender_layout_and_repeats_bytewise(tmp_path: Path) -> None:
    options = StillOptions(size=24, num_train=3, num_val=1, num_test=2, samples=2)
    first, second = (write_still_capture(tmp_path / name, options) for name in ("a", "b"))
    files = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
    assert len(files) == 3 + 1 + 2 + 3
    for file in files:
        assert (first / file).read_bytes() == (second / file).read_bytes(), file
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        document = json.loads((first / f"transforms_{split}.json").read_text())
        assert document["camera_angle_x"] == CAMERA_ANGLE_X
        assert len(document["frames"]) == count
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
            np.testing.assert_allclose(
                pose[:3, 3], 4.0 * pose[:3, 2], atol=1e-12
            )  # OpenGL: z points away from the scene
            spec = oiio.ImageBuf(str(first / (frame["file_path"] + ".png"))).spec()
            assert (spec.width, spec.height, spec.nchannels) == (24, 24, 4)


def test_background_is_transparent_and_the_scene_fills_the_picture() -> None:
    alphas = [
        render_scene(still_life(), pose, 32, samples=2)[..., 3] for pose in hemisphere_cameras(6, 4.0, 0)
    ]  # fmt: skip
    for alpha in alphas:
        assert alpha[0].max() == 0
        assert 0.15 < (alpha > 0).mean() < 0.75


def test_cameras_differ_by_seed_only_in_azimuth() -> None:
    a, b = hemisphere_cameras(7, 4.0, 0), hemisphere_cameras(7, 4.0, 1)
    assert not np.allclose(a, b)
    np.testing.assert_allclose(a[:, 2, 3], b[:, 2, 3])
    assert (a[:, 2, 3] > 0).all()


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a, axis=-1, keepdims=True)
