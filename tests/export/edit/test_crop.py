"""What lies in boxes, spheres and meshes, and regions that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from moving_scene import moving_scene, sliding_nodes, still_scene

from dyngs.core.errors import DyngsError
from dyngs.export.edit.crop import Box, Sphere, held_by, mesh_path, region_of
from dyngs.io.formats.similarity import Similarity

POINTS = np.random.default_rng(0).uniform(-1.5, 1.5, (3000, 3))


def torus(path: Path) -> trimesh.Trimesh:
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    mesh.export(path)
    return mesh


def test_boxes_and_spheres() -> None:
    box = region_of(["1,-1,0", "-0.5,1,1"])
    x, y, z = POINTS.T
    np.testing.assert_array_equal(
        box.holds(POINTS), (abs(y) <= 1) & (z >= 0) & (z <= 1) & (x >= -0.5) & (x <= 1)
    )
    ball = region_of(["1,0,0 1.2m"])  # also as one word
    np.testing.assert_array_equal(ball.holds(POINTS), (x - 1) ** 2 + y**2 + z**2 <= 1.44)
    assert isinstance(box, Box)
    assert isinstance(ball, Sphere)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off", ".glb"])
def test_the_inside_of_a_mesh(suffix: str, tmp_path: Path) -> None:
    """A torus, whose hole is outside, however its triangles are turned."""
    path = tmp_path / f"my torus{suffix}"
    torus(path)
    assert mesh_path([str(path)]) == path
    ring = np.hypot(np.hypot(POINTS[:, 0], POINTS[:, 1]) - 1, POINTS[:, 2])
    sure = abs(ring - 0.4) > 0.03  # it is made of flat triangles
    np.testing.assert_array_equal(region_of([str(path)]).holds(POINTS)[sure], (ring < 0.4)[sure])


def test_meshes_that_are_not_closed(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere()
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "a.ply")
    with pytest.raises(DyngsError, match=r"is not closed .*; fill its holes"):
        region_of([str(tmp_path / "a.ply")])
    trimesh.PointCloud(POINTS).export(tmp_path / "b.ply")
    with pytest.raises(DyngsError, match=r"is not closed|must be a mesh of triangles"):
        region_of([str(tmp_path / "b.ply")])
    torus(tmp_path / "c.stl")
    (tmp_path / "c.stl").write_bytes((tmp_path / "c.stl").read_bytes()[:2000])
    with pytest.raises(DyngsError, match=r"c\.stl: .*(cannot be read|is not closed)"):
        region_of([str(tmp_path / "c.stl")])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["1,2,3"], "give two corners x,y,z x,y,z, a centre and a radius"),
        (["1,2,3", "1,2"], "'1,2' is no point"),
        (["1,2,3", "1,5,9"], "the box is flat"),
        (["1,2,3", "-1"], "a radius of -1"),
        (["1,2,3", "nan"], "is no number"),
        (["box.xyz"], "a closed mesh is one of .obj"),
        (["none.obj"], "no such file"),
        ([""], "a closed mesh is one of"),
    ],
)
def test_regions_that_are_none(words: list[str], said: str) -> None:
    with pytest.raises(DyngsError, match=said) as caught:
        region_of(words)
    assert "\n" not in str(caught.value)


def test_what_moves_is_held_if_it_ever_is() -> None:
    """Balls 1 and 3 slide along x."""
    for scene in (still_scene(), moving_scene(sliding_nodes())):
        at = [scene.at(t).means for t in (0.0, 0.25, 0.5, 0.75, 1.0)]
        region = Sphere(tuple(at[2][1].tolist()), 1e-3)  # type: ignore[arg-type]
        inside = torch.stack([(x - at[2][1]).norm(dim=1) < 1e-3 for x in at]).any(0)
        assert torch.equal(held_by(region, scene, Similarity()), inside)
        assert not held_by(region, scene, Similarity(shift=(9.0, 0.0, 0.0))).any()
