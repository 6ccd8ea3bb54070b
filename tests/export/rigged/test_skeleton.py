"""The skeleton in glTF: its names, its rest pose, and a motion that stands on the floor."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bare_person import bare_run, bare_scene, playing, random_clip, template
from gltf_skins import SkinnedGlb
from synthetic_bodies import model, write_npz

from dyngs.core.errors import DyngsError
from dyngs.export.rigged.mesh_file import mesh_document
from dyngs.export.rigged.skeleton import (
    Rig,
    add_weights,
    anchor_normals,
    animation_of,
    body_mesh,
    rest_vertices,
    rig_of,
)
from dyngs.human.avatar.posing import Skeleton, texel_gaussians
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import apply_shape
from dyngs.human.body.body_reader import read_body
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import (
    apply_transforms,
    axis_angle_to_matrix,
    blend_transforms,
    joint_transforms,
)
from dyngs.human.motion.gltf import read_gltf
from dyngs.human.motion.placement import upright
from dyngs.io.gltf import GlbDocument

GREY = np.full((4, 4, 3), 128, np.uint8)


def scene_of(scale: float = 1.0) -> HumanScene:
    scene = playing(bare_run(), random_clip(4, scale, seed=3)).scene
    assert isinstance(scene, HumanScene)
    return scene


def written(path: Path, scene: HumanScene) -> SkinnedGlb:
    body = template()
    with torch.no_grad():
        rig = rig_of(scene, body.vertices)
        animation = animation_of(scene, rig, body.vertices, body.weights, 10.0, "dance")
        mesh_document(body_mesh(scene, body, body.vertices), rig, GREY, animation).write(path)
    return SkinnedGlb(path)


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_the_skin_moves_vertices_as_our_own_skinning_does(tmp_path: Path, scale: float) -> None:
    """At every key, up to a shift along the floor; the lowest vertex of the clip is at y = 0."""
    scene = scene_of(scale)
    body = template()
    found = written(tmp_path / "x.glb", scene)
    source = body_mesh(scene, body, body.vertices).source
    skeleton = scene.learned_skeleton
    clip = upright(scene.moves_as, scene.clip, skeleton.joints)
    lowest = []
    shifts = []
    for frame in range(4):
        joints = joint_transforms(
            skeleton.joints, skeleton.parents, axis_angle_to_matrix(clip.poses[frame])
        )
        ours = clip.scale[frame] * apply_transforms(
            blend_transforms(body.weights, joints), body.vertices
        )
        theirs = found.posed(frame)
        shift = theirs - (ours + clip.trans[frame])[source].double().numpy()
        np.testing.assert_allclose(shift, shift[:1].repeat(len(shift), 0), atol=5e-6)
        shifts.append(shift[0])
        lowest.append(theirs[:, 1].min())
    np.testing.assert_allclose(shifts, shifts[:1] * 4, atol=5e-6)
    assert min(lowest) == pytest.approx(0, abs=1e-5)


def test_at_rest_the_vertices_stay_where_they_are(tmp_path: Path) -> None:
    """Upright, feet on the floor, as large as in the capture."""
    found = written(tmp_path / "x.glb", scene_of())
    points = found.attribute("POSITION")
    np.testing.assert_allclose(found.posed(None), points, atol=1e-6)
    assert points[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert np.ptp(points[:, 1]) == pytest.approx(1.761 * np.exp(0.1), abs=2e-3)


def test_our_reader_of_motions_finds_the_same_motion(tmp_path: Path) -> None:
    scene = scene_of()
    written(tmp_path / "x.glb", scene)
    found = read_gltf(tmp_path / "x.glb", fps=10.0)
    assert found.names == JOINT_NAMES
    clip = upright(scene.moves_as, scene.clip, scene.learned_skeleton.joints)
    skeleton = scene.learned_skeleton
    for frame in range(4):
        world = joint_transforms(
            skeleton.joints, skeleton.parents, axis_angle_to_matrix(clip.poses[frame])
        )
        np.testing.assert_allclose(found.rotations[frame], world[:, :, :3].numpy(), atol=1e-5)


@pytest.mark.parametrize("count", [24, 52, 55])
def test_joints_have_names(count: int) -> None:
    parents = tuple(range(-1, count - 1))
    names = Rig(Skeleton(torch.zeros(count, 3), parents), 1.0, 0.0).names
    assert len(set(names)) == count
    assert names[:3] == ("pelvis", "left_hip", "right_hip")
    assert names[-1] == {24: "right_hand", 52: "right_thumb3", 55: "right_thumb3"}[count]


def test_weights_are_complete_and_unused_joints_are_the_first(tmp_path: Path) -> None:
    """As validators ask; the heaviest four come first, since some programs know no more."""
    given = torch.zeros(3, 9)
    given[0, 7] = 1
    given[1, 2:7] = torch.tensor([0.1, 0.2, 0.3, 0.15, 0.25])
    given[2, :2] = 0.5
    document = GlbDocument()
    names = add_weights(document, given)
    document.json |= {"meshes": [{"primitives": [{"attributes": names}]}]}
    document.write(tmp_path / "x.glb")
    joints, weights = SkinnedGlb(tmp_path / "x.glb").weights()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert (joints[weights == 0] == 0).all()
    dense = np.zeros((3, 9))
    np.add.at(dense, (np.arange(3)[:, None], joints), weights)
    np.testing.assert_allclose(dense, given.numpy(), atol=1e-6)
    assert (np.diff(weights, axis=1) <= 0).all()
    assert list(add_weights(GlbDocument(), given[[0, 2]])) == ["JOINTS_0", "WEIGHTS_0"]


def test_vertices_are_doubled_at_seams_only() -> None:
    """Each corner keeps its place and its texture coordinate; copies share weights and normals."""
    body = template()
    scene = bare_scene()
    mesh = body_mesh(scene, body, body.vertices)
    assert body.uv is not None
    assert body.uv_faces is not None
    assert len(mesh.vertices) == len(
        torch.unique(torch.stack([body.faces, body.uv_faces], -1).reshape(-1, 2), dim=0)
    )
    assert torch.equal(mesh.vertices[mesh.faces], body.vertices[body.faces])
    assert torch.equal(mesh.uv[mesh.faces], body.uv[body.uv_faces])
    assert torch.equal(mesh.weights, body.weights[mesh.source])
    outward = ((mesh.vertices - torch.tensor([0.0, 0.2, 0.0])) * mesh.normals).sum(1)
    trunk = mesh.weights[:, [3, 6, 9]].sum(1) > 0.9
    assert float((outward[trunk] > 0).float().mean()) > 0.95
    torch.testing.assert_close(
        mesh.normals.norm(dim=1), torch.ones(len(mesh.normals)), atol=1e-5, rtol=0
    )


def test_the_shape_follows_from_what_a_run_holds(tmp_path: Path) -> None:
    """Ten shape parameters from joints and anchors, to a tenth of a millimetre."""
    body = read_body(write_npz(tmp_path / "body.npz", model("smplx")))
    betas = torch.linspace(-2, 2, 10)
    vertices, joints = apply_shape(body, betas)
    texels = atlas_texels(body, 32, vertices)
    gaussians, anchors = texel_gaussians(texels, [0.0, 0.02], 0)
    scene = replace(
        bare_scene(), gaussians=gaussians, anchors=anchors, skeleton=Skeleton(joints, body.parents)
    )
    torch.testing.assert_close(rest_vertices(scene, body), vertices, atol=1e-4, rtol=0)
    np.testing.assert_allclose(
        anchor_normals(anchors, body, vertices).norm(dim=1).numpy(), 1, atol=1e-5
    )


def test_templates_that_do_not_fit() -> None:
    scene = bare_scene()
    body = template()
    torch.testing.assert_close(rest_vertices(scene, body), body.vertices, atol=1e-4, rtol=0)
    with pytest.raises(DyngsError, match="is not the one that this person was trained on"):
        rest_vertices(scene, replace(body, faces=body.faces[:100], uv_faces=None, uv=None))
    with pytest.raises(
        DyngsError, match=r"has no texture coordinates; train with model\.uv=FILE\.obj"
    ):
        body_mesh(scene, replace(body, uv=None, uv_faces=None), body.vertices)
