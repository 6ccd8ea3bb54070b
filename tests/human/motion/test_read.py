"""Motion files, read by suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from motion_files import (
    VRM,
    Clip,
    as_local,
    glb_of,
    pelvis_path,
    random_motion,
    skeleton,
    tiny_body,
    vrma_of,
    write_bvh,
)
from scipy.spatial.transform import Rotation

from dyngs.errors import DyngsError
from dyngs.human.motion.motion import (
    Motion,
)
from dyngs.human.motion.read import read_motion
from dyngs.human.template.body import posed_vertices
from dyngs.human.template.body_reader import default_template
from dyngs.human.template.joints import JOINT_NAMES

BODY = tiny_body()


def matrices(motion: Motion) -> np.ndarray:
    return Rotation.from_rotvec(motion.poses.double().numpy().reshape(-1, 3)).as_matrix()


def test_the_suffix_says_what_a_file_is(tmp_path: Path) -> None:
    """The same motion from BVH, GLB and VRM animation, in upper case too."""
    motion, own = random_motion(), skeleton()
    local, root = as_local(motion, own), pelvis_path(BODY, motion)
    files = [write_bvh(tmp_path / "x.BVH", own, local, root), glb_of(own, Clip(local, root)).write(tmp_path / "x.glb")]
    for path in files:
        found = read_motion(path, BODY)
        np.testing.assert_allclose(matrices(found), matrices(motion), atol=1e-5)
        assert found.fps == pytest.approx(30, rel=1e-6)
        assert found.poses.dtype == torch.float32
    halved = read_motion(files[0], BODY, fps=15.0)
    np.testing.assert_allclose(
        matrices(halved), matrices(motion).reshape(4, 55, 3, 3)[::2].reshape(-1, 3, 3), atol=1e-5
    )
    assert len(read_motion(files[1], BODY, fps=60.0, clip="Walk")) == 7
    bones = skeleton(tuple(VRM))
    waving = vrma_of(bones, Clip(as_local(motion, bones), root, bind_matrices=False)).write(tmp_path / "x.vrma")
    found = read_motion(waving, BODY, fps=60.0, clip="Walk")
    rows = [i for i, name in enumerate(JOINT_NAMES) if name in VRM]
    np.testing.assert_allclose(found.poses[::2, rows].numpy(), motion.poses[:, rows].numpy(), atol=1e-5)


def test_the_body_that_comes_with_dyngs_is_the_default(tmp_path: Path) -> None:
    """Its feet come to the floor, its pelvis to the height of its legs."""
    own = skeleton()
    motion = read_motion(write_bvh(tmp_path / "x.bvh", own, np.tile(np.eye(3), (1, 55, 1, 1)), own.rest[:1]))
    body = default_template()
    lowest = posed_vertices(body, motion.poses, motion.trans)[..., 1].min()
    assert float(lowest) == pytest.approx(0, abs=1e-5)
    assert 0.8 < float(body.joints[0, 1] + motion.trans[0, 1]) < 1.1


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("x.fbx", {}, r"x\.fbx: unknown kind of motion; give an AMASS or SMPL-X \.npz"),
        ("x.bvh", {"up": "z"}, "the up axis can only be chosen for an .npz"),
        ("x.npz", {"clip": "Walk"}, "holds one motion without a name"),
        ("x.bvh", {}, "cannot be read"),
        ("x.glb", {}, "cannot be read"),
        ("x.npz", {}, "no such file"),
    ],
)
def test_what_cannot_be_read(tmp_path: Path, name: str, options: dict[str, str], problem: str) -> None:
    with pytest.raises(DyngsError, match=problem) as caught:
        read_motion(tmp_path / name, BODY, **options)  # pyright: ignore[reportArgumentType]
    assert str(tmp_path / name) in str(caught.value)
