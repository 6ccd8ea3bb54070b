"""Gaussians with joints: other readers open them, ours sees plain Gaussians, and the skin moves
them as we do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from bare_person import bare_run, playing, random_clip
from gltf_skins import SkinnedGlb
from plyfile import PlyData

from dyngs.core.errors import DyngsError
from dyngs.export.rigged.mesh_file import Played
from dyngs.export.rigged.splat_files import write_rigged_splats
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.skinning import axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.placement import upright
from dyngs.io.formats.formats import read_splats


def test_the_columns_and_comments_suffice_to_pose_the_person(tmp_path: Path) -> None:
    """With nothing but the file, read by plyfile, and linear blend skinning."""
    run = bare_run()
    scene = run.scene
    assert isinstance(scene, HumanScene)
    path = write_rigged_splats(run, tmp_path / "ann.ply").path
    data = PlyData.read(str(path))
    rows = data["vertex"]
    joints = np.stack([rows[f"joint_{k}"] for k in range(8)], axis=1).astype(int)
    weights = np.stack([rows[f"weight_{k}"] for k in range(8)], axis=1)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    lines = [line.split() for line in data.comments if line.startswith("joint ")]
    assert [int(line[1]) for line in lines] == list(range(55))
    assert lines[1][2:4] == ["left_hip", "0"]
    parents = tuple(int(line[3]) for line in lines)
    places = torch.tensor([[float(x) for x in line[4:]] for line in lines])
    pose = axis_angle_to_matrix(
        0.4 * torch.randn(55, 3, generator=torch.Generator().manual_seed(1))
    )
    moves = joint_transforms(places, parents, pose).numpy()[joints]
    means = np.stack([rows[axis] for axis in "xyz"], axis=1)
    blend = (weights[..., None, None] * moves).sum(axis=1)
    found = np.einsum("nab,nb->na", blend[..., :3], means) + blend[..., 3]
    skeleton = scene.learned_skeleton
    own = torch.einsum(
        "nj,jab->nab", scene.weights, joint_transforms(skeleton.joints, skeleton.parents, pose)
    )
    wanted = float(np.exp(0.1)) * (
        (own[..., :3] @ scene.gaussians.means[..., None])[..., 0] + own[..., 3]
    )
    rise = (found - wanted.numpy()).mean(axis=0)
    np.testing.assert_allclose(found, wanted.numpy() + rise, atol=2e-5)
    np.testing.assert_allclose(rise[[0, 2]], 0, atol=1e-5)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_other_readers_see_the_rest_pose(tmp_path: Path, suffix: str) -> None:
    run = bare_run()
    splat = read_splats(write_rigged_splats(run, tmp_path / f"ann{suffix}").path)
    assert len(splat.gaussians) == len(run.scene)
    assert splat.gaussians.means[:, 1].amin() > -0.01
    torch.testing.assert_close(splat.gaussians.sh, run.scene.gaussians.sh, atol=1e-6, rtol=0)
    ratio = splat.gaussians.scales / run.scene.gaussians.scales
    torch.testing.assert_close(ratio, torch.full_like(ratio, float(np.exp(0.1))), atol=1e-4, rtol=0)


def test_the_skin_moves_gaussians_as_the_avatar_does(tmp_path: Path) -> None:
    run = playing(bare_run(), random_clip(3, 0.7, seed=2))
    scene = run.scene
    assert isinstance(scene, HumanScene)
    written = write_rigged_splats(run, tmp_path / "ann.glb", Played("walk", 25.0))
    assert written.notes == (
        "KHR_gaussian_splatting does not say whether skins turn Gaussians: viewers may show the rest pose",
    )
    found = SkinnedGlb(tmp_path / "ann.glb")
    assert found.primitive["mode"] == 0
    turned = upright(scene.moves_as, scene.clip, scene.learned_skeleton.joints)
    torch.testing.assert_close(turned.poses, scene.moves_as.poses, atol=1e-5, rtol=0)
    for frame, time in enumerate((0.0, 0.5, 1.0)):
        difference = found.posed(frame) - scene.at(time).means.numpy()
        np.testing.assert_allclose(difference, np.tile(difference[0], (len(scene), 1)), atol=1e-5)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"x\.spz: joints are written as \.ply or \.glb"):
        write_rigged_splats(bare_run(), tmp_path / "x.spz")
    with pytest.raises(DyngsError, match=r"--motion does not go with --joints in a \.ply"):
        write_rigged_splats(bare_run(), tmp_path / "x.ply", Played("walk", 25.0))
