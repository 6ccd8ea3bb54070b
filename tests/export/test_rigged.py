"""Rigged people in files of other programs: other readers open them, skinning matches dyngs, and
textures and surfaces cover the clothes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from bare_person import (
    RESOLUTION,
    atlas,
    bands,
    bare_run,
    bare_scene,
    random_clip,
    template,
    with_motion,
)
from gltf_skins import SkinnedGlb
from moving_scene import write_moving_run
from synthetic_bodies import model, write_npz

from dyngs.core.errors import DyngsError
from dyngs.export.rigged.people import (
    AnimationInfo,
    add_animation,
    anchor_normals,
    body_mesh,
    build_rig,
    mesh_document,
    rest_vertices,
    surface_normals,
    write_mesh,
)
from dyngs.export.rigged.surface import MARGINS, FittedSurface, fit_surface
from dyngs.export.rigged.texture import (
    BakedTexels,
    bake_texels,
    fill_unseen,
    texture_image,
)
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.posing import PoseBlendShapes, Skeleton, texel_gaussians
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.atlas import Texels, atlas_texels
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
from dyngs.human.motion.placement import rotate_clip_to_y_up
from dyngs.runs.checkpoint import load_run


def test_another_reader_finds_mesh_and_texture(tmp_path: Path) -> None:
    """Each vertex has the colour of its place."""
    run = bare_run()
    notes = write_mesh(run, tmp_path / "ann.glb")
    assert notes[0].startswith("texture 256 x 256; ")
    assert "silhouette IoU" in notes[1]
    loaded = trimesh.load(tmp_path / "ann.glb", process=False)
    (mesh,) = loaded.geometry.values()  # pyright: ignore[reportAttributeAccessIssue]
    body = template()
    _, _, source = body_mesh(body)
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
    run = with_motion(bare_run(scene), random_clip(4, seed=5))
    notes = write_mesh(run, tmp_path / "ann.glb", AnimationInfo("dance", 10.0))
    assert notes[-1] == "pose-dependent offsets are not exported: glTF skins have none"
    found = SkinnedGlb(tmp_path / "ann.glb")
    animation = found.json["animations"][0]
    assert animation["name"] == "dance"
    np.testing.assert_allclose(
        found.numbers(animation["samplers"][0]["input"])[:, 0], [0, 0.1, 0.2, 0.3], atol=1e-6
    )
    assert abs(min(found.posed(frame)[:, 1].min() for frame in range(4))) < 1e-5
    assert found.image().shape == (96, 96, 3)
    assert found.json["extensionsUsed"] == ["KHR_materials_unlit"]
    write_mesh(run, tmp_path / "again.glb", AnimationInfo("dance", 10.0))
    assert (tmp_path / "again.glb").read_bytes() == (tmp_path / "ann.glb").read_bytes()


GREY = np.full((4, 4, 3), 128, np.uint8)


def scene_of(scale: float = 1.0) -> HumanScene:
    scene = with_motion(bare_run(), random_clip(4, scale, seed=3)).scene
    assert isinstance(scene, HumanScene)
    return scene


def written(path: Path, scene: HumanScene) -> SkinnedGlb:
    body = template()
    with torch.no_grad():
        rig = build_rig(scene, body.vertices)
        document = mesh_document(body, rig, body.vertices, GREY)
        add_animation(
            document, scene, rig, body.vertices, body.weights, AnimationInfo("dance", 10.0)
        )
        document.write(path)
    return SkinnedGlb(path)


@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_the_skin_moves_vertices_as_our_own_skinning_does(tmp_path: Path, scale: float) -> None:
    """At every key, up to a shift along the floor; the lowest vertex of the clip is at y = 0."""
    scene = scene_of(scale)
    body = template()
    found = written(tmp_path / "x.glb", scene)
    _, _, source = body_mesh(body)
    skeleton = scene.learned_skeleton
    clip = rotate_clip_to_y_up(scene.played_clip, scene.clip, skeleton.joints)
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


def test_our_reader_of_motions_finds_the_same_motion(tmp_path: Path) -> None:
    scene = scene_of()
    written(tmp_path / "x.glb", scene)
    found = read_gltf(tmp_path / "x.glb", fps=10.0)
    assert found.names == JOINT_NAMES
    clip = rotate_clip_to_y_up(scene.played_clip, scene.clip, scene.learned_skeleton.joints)
    skeleton = scene.learned_skeleton
    for frame in range(4):
        world = joint_transforms(
            skeleton.joints, skeleton.parents, axis_angle_to_matrix(clip.poses[frame])
        )
        np.testing.assert_allclose(found.rotations[frame], world[:, :, :3].numpy(), atol=1e-5)


def test_vertices_are_doubled_at_seams_only() -> None:
    """Each corner keeps its place and its texture coordinate."""
    body = template()
    uv, faces, source = body_mesh(body)
    assert body.uv is not None
    assert body.uv_faces is not None
    corners = torch.stack([body.faces, body.uv_faces], -1).reshape(-1, 2)
    assert len(source) == len(torch.unique(corners, dim=0))
    assert torch.equal(source[faces], body.faces)
    assert torch.equal(uv[faces], body.uv[body.uv_faces])
    normals = surface_normals(body.vertices, body.faces)
    outward = ((body.vertices - torch.tensor([0.0, 0.2, 0.0])) * normals).sum(1)
    trunk = body.weights[:, [3, 6, 9]].sum(1) > 0.9
    assert float((outward[trunk] > 0).float().mean()) > 0.95
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(len(normals)), atol=1e-5, rtol=0)


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
    with pytest.raises(DyngsError, match="is not the one this person was trained on"):
        rest_vertices(scene, replace(body, faces=body.faces[:100], uv_faces=None, uv=None))
    with pytest.raises(DyngsError, match=r"has no UV coordinates; train with model\.uv=FILE\.obj"):
        body_mesh(replace(body, uv=None, uv_faces=None))


def test_other_scenes_are_refused(tmp_path: Path) -> None:
    run = load_run(write_moving_run(tmp_path / "run"))
    with pytest.raises(DyngsError, match=r"needs a run of a person \(model\.kind=human\)"):
        write_mesh(run, tmp_path / "x.glb")
    assert not list(tmp_path.glob("x*"))


BODY = template()
NORMALS = anchor_normals(bare_scene().anchors, BODY, BODY.vertices)


@torch.no_grad()
def fitted(gaussians: Gaussians) -> FittedSurface:
    scene = bare_scene().with_gaussians(gaussians)
    samples = atlas(2 * RESOLUTION)
    return fit_surface(
        gaussians, BODY, BODY.vertices, samples, bake_texels(scene, samples, NORMALS)
    )


def test_trousers_move_the_thighs_and_nothing_else() -> None:
    """Gaussians 3 cm above the thighs: there the surface rises by about as much, and silhouettes
    agree better."""
    gaussians = bare_scene().gaussians
    thighs = atlas().weights[:, [1, 2]].sum(1).clamp(0, 1)
    found = fitted(gaussians.replace(means=gaussians.means + 0.03 * thighs[:, None] * NORMALS))
    assert found.margin in MARGINS
    assert found.agreement > found.plain + 0.01
    moved = (found.vertices - BODY.vertices).norm(dim=1)
    margin = found.margin or 0.0
    inside = BODY.weights[:, [1, 2]].sum(1) > 0.95
    assert abs(float(moved[inside].median()) - 0.03 - margin) < 0.006
    shins = BODY.weights[:, [4, 5]].sum(1) > 0.95
    assert abs(float(moved[shins].median()) - margin) < 0.006
    assert float(moved.max()) < 0.06 + 1e-6


def baked(scene: HumanScene, texels: Texels) -> BakedTexels:
    with torch.no_grad():
        return bake_texels(
            scene, texels, anchor_normals(scene.anchors, template(), template().vertices)
        )


def test_the_image_is_upside_up_and_not_mirrored() -> None:
    """Read as renderers do, row = (1 - v) H: at each vertex of the head and hands its own
    colour."""
    body = template()
    texels = atlas_texels(template(), 128)
    assert body.uv is not None
    assert body.uv_faces is not None
    image = texture_image(bands(texels.points), texels)
    uv = body.uv[body.uv_faces.flatten()]
    at = body.vertices[body.faces.flatten()]
    column = (uv[:, 0] * 128).long().clamp(0, 127)
    row = ((1 - uv[:, 1]) * 128).long().clamp(0, 127)
    found = torch.from_numpy(image[row, column]).float() / 255
    error = (found - bands(at)).abs().amax(1)
    assert float(error.quantile(0.99)) < 0.06


def test_gaps_are_filled_from_around_and_large_holes_from_the_mirror_side() -> None:
    """The whole left forearm is missing: it gets the right one's colours, at the same heights."""
    texels = atlas(192)
    left = texels.weights[:, [18, 20]].sum(1) > 0.5
    make = torch.Generator().manual_seed(0)
    alone = (torch.rand(len(texels), generator=make) < 0.02) & (
        texels.weights[:, [3, 6, 9]].sum(1) > 0.9
    )
    colours = (
        torch.stack(
            [texels.points[:, 0].abs(), texels.points[:, 1] + 1, texels.points[:, 2] + 0.5], dim=1
        )
        / 2
    )
    alpha = torch.where(left | alone, 0.0, 1.0)
    given = torch.where((alpha > 0)[:, None], colours, 0.0)
    filled = fill_unseen(BakedTexels(given, alpha, torch.zeros(len(texels))), texels)
    assert float((filled - colours)[left].abs().quantile(0.95)) < 0.02
    assert float((filled - colours)[alone].abs().max()) < 0.03
    assert torch.equal(filled[alpha > 0], colours[alpha > 0])
