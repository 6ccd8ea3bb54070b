"""Polyhedra with faces of one colour, and their true edges."""

from __future__ import annotations

import numpy as np

from dyngs.data.synthetic.captures import orbit_cameras
from dyngs.data.synthetic.polyhedra import Solid, face_ids, polyhedra, solid, true_edges
from dyngs.data.synthetic.raytrace import Box, Scene

CUBE = np.concatenate([np.eye(3), -np.eye(3)])
COLOURS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def cube() -> Solid:
    return solid((0.1, 0.2, 0.0), 0.5, CUBE, COLOURS)


def test_a_solid_cube_is_a_box() -> None:
    random = np.random.default_rng(0)
    origins = random.normal(size=(300, 3)) * 3
    towards = np.array([0.1, 0.2, 0.0]) + 0.4 * random.normal(size=(300, 3)) - origins
    directions = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    box = Box((0.1, 0.2, 0.0), (0.5, 0.5, 0.5), lambda local: local)
    found, expected = (x.intersect(origins.astype(np.float32), directions) for x in (cube(), box))
    assert np.isfinite(expected).sum() > 50
    np.testing.assert_allclose(found, expected, atol=1e-4)
    hit = np.isfinite(expected)
    points = (origins + np.where(hit, expected, 0)[:, None] * directions)[hit].astype(np.float32)
    np.testing.assert_allclose(cube().normals(points), box.normals(points))


def test_faces_have_their_colours() -> None:
    ahead = np.array(
        [[0.6, 0.2, 0.0], [0.1, 0.7, 0.0], [0.1, 0.2, 0.5], [-0.4, 0.2, 0.0]], np.float32
    )
    assert cube().face(ahead).tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(cube().paint(cube().local(ahead)), [*COLOURS, COLOURS[0]])


def test_edges_of_a_cube_from_ahead_are_a_square() -> None:
    scene = Scene((solid((0.0, 0.0, 0.0), 0.5, CUBE, COLOURS),))
    pose = orbit_cameras(1, 4.0, 0.0, 0.0)[0]
    edges = true_edges(scene, pose, 40, 2)
    seen = face_ids(scene, pose, 40, 1)[0] >= 0
    rows = np.flatnonzero(seen.any(axis=1))
    assert 12 < len(rows) < 20
    middle = edges[20] > 0
    assert middle.sum() in (4, 6)
    assert not middle[rows[0] + 3 : rows[-1] - 2].any()


def test_every_shape_is_seen() -> None:
    scene = polyhedra()
    ids = np.concatenate(
        [face_ids(scene, pose, 64, 1).ravel() for pose in orbit_cameras(4, 4.0, 35.0, 20.0)]
    )
    assert set(np.unique(ids[ids >= 0] // 64)) == set(range(len(scene.primitives)))
