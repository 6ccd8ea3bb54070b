"""Meshes of people: other readers open them, and what does not go in is said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from bare_person import bands, bare_run, bare_scene, playing, random_clip, template
from gltf_skins import SkinnedGlb
from moving_scene import write_moving_run

from dyngs.core.errors import DyngsError
from dyngs.export.rigged.mesh_file import Played, write_mesh
from dyngs.export.rigged.skeleton import body_mesh
from dyngs.human.avatar.posing import PoseBlendShapes
from dyngs.runs.checkpoint import load_run


def test_another_reader_finds_mesh_and_texture(tmp_path: Path) -> None:
    """Each vertex has the colour of its place."""
    run = bare_run()
    written = write_mesh(run, tmp_path / "ann.glb")
    assert written.notes[0].startswith("texture of 256 x 256; ")
    assert (
        "silhouettes agree" in written.notes[1]
        or "the template, whose silhouettes agree best" in written.notes[1]
    )
    loaded = trimesh.load(tmp_path / "ann.glb", process=False)
    (mesh,) = loaded.geometry.values()  # pyright: ignore[reportAttributeAccessIssue]
    body = template()
    source = body_mesh(run.scene, body, body.vertices).source  # pyright: ignore[reportArgumentType]
    assert len(mesh.faces) == len(body.faces)
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert image.shape == (256, 256, 3)
    u, v = mesh.visual.uv.T  # v upwards, as trimesh has it
    colours = (
        image[((1 - v) * 256).astype(int).clip(0, 255), (u * 256).astype(int).clip(0, 255)] / 255
    )
    error = np.abs(colours - bands(body.vertices)[source].numpy()).max(axis=1)
    assert np.quantile(error, 0.9) < 0.08
    assert np.median(error) < 0.02


def test_a_motion_becomes_an_animation(tmp_path: Path) -> None:
    """The same bytes on every run; a skin has no offsets that depend on the pose."""
    shapes = PoseBlendShapes(torch.zeros(486, 3 * len(template().vertices)), template().faces)
    scene = replace(bare_scene(resolution=24), shapes=shapes)
    run = playing(bare_run(scene), random_clip(4, seed=5))
    notes = write_mesh(run, tmp_path / "ann.glb", Played("dance", 10.0)).notes
    assert notes[-1] == "offsets that depend on the pose are left out: glTF's skins have none"
    found = SkinnedGlb(tmp_path / "ann.glb")
    animation = found.json["animations"][0]
    assert animation["name"] == "dance"
    np.testing.assert_allclose(
        found.numbers(animation["samplers"][0]["input"])[:, 0], [0, 0.1, 0.2, 0.3], atol=1e-6
    )
    assert abs(min(found.posed(frame)[:, 1].min() for frame in range(4))) < 1e-5
    assert found.image().shape == (96, 96, 3)
    assert found.json["extensionsUsed"] == ["KHR_materials_unlit"]
    write_mesh(run, tmp_path / "again.glb", Played("dance", 10.0))
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "ann.glb").read_bytes()


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"x\.ply: a mesh is written as \.glb; give --out x\.glb"):
        write_mesh(bare_run(), tmp_path / "x.ply")
    run = load_run(write_moving_run(tmp_path / "run"))
    with pytest.raises(
        DyngsError, match=r"--format mesh needs the run of a person \(model\.kind=human\)"
    ):
        write_mesh(run, tmp_path / "x.glb")
    assert not list(tmp_path.glob("x*"))
