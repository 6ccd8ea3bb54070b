"""An avatar by itself: equal poses give equal images, and corrections that were learned are applied
once."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.state import select_prefix, strip_roles
from dyngs.data.capture import BodyFrames, Capture, Split, View
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import render
from dyngs.human.avatar.posing import (
    SharedCorrection,
    Skeleton,
    corrected_clip,
    corrected_pose,
    texel_gaussians,
)
from dyngs.human.avatar.scene import HumanScene, initial_human_scene
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.motion.motion import MotionClip


def random_clip(frames: int, seed: int = 0) -> MotionClip:
    generator = torch.Generator().manual_seed(seed)
    times = torch.linspace(0, 1, frames, dtype=torch.float64)
    trans = torch.randn(frames, 3, generator=generator)
    return MotionClip(
        times,
        0.3 * torch.randn(frames, 55, 3, generator=generator),
        0.1 * trans,
        torch.ones(frames),
    )


def stirred() -> HumanScene:
    """A person whose corrections are not zero."""
    body = default_template()
    gaussians, anchors = texel_gaussians(atlas_texels(body, 24), (0.0,), 0)
    gaussians = gaussians.replace(
        sh=torch.randn(gaussians.sh.shape, generator=torch.Generator().manual_seed(1))
    )
    skeleton = Skeleton(body.joints, body.parents)
    scene = initial_human_scene(gaussians, anchors, skeleton, random_clip(4))
    generator = torch.Generator().manual_seed(2)
    for x in scene.learned.values().values():
        x += 0.05 * torch.randn(x.shape, generator=generator)
    return scene


def reloaded(scene: HumanScene) -> HumanScene:
    """The scene of what is stored of it."""
    return HumanScene.from_state(
        scene.gaussians, select_prefix(strip_roles(scene.state()), "model")
    )


def seen(gaussians: Gaussians) -> Tensor:
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[2, 3] = 3.0
    cameras = Cameras(pose[None], torch.tensor([[[40.0, 0, 20], [0, 40.0, 20], [0, 0, 1]]]), 40, 40)
    return render(gaussians, cameras).rgb[0]


def test_two_clips_of_the_same_pose_give_the_same_image() -> None:
    scene = reloaded(stirred())
    one = random_clip(3, seed=5)
    other = random_clip(6, seed=6)
    for name in ("poses", "trans", "scale"):
        getattr(other, name)[4] = getattr(one, name)[1]
    first, second = (seen(scene.with_motion(c).at(t)) for c, t in ((one, 0.5), (other, 0.8)))
    assert torch.equal(first, second)
    assert float((first - seen(scene.with_motion(one).at(0.0))).abs().max()) > 0.05
    assert float(first.max()) > 0.2


def test_baked_corrections_are_those_of_training() -> None:
    trained = stirred()
    played = reloaded(trained).played_clip
    for row in range(len(trained.clip)):
        posing = corrected_pose(trained.learned, trained.clip, row)
        torch.testing.assert_close(
            axis_angle_to_matrix(played.poses[row]), posing.rotations, rtol=0, atol=1e-5
        )
        torch.testing.assert_close(played.trans[row], posing.trans)
        torch.testing.assert_close(played.scale[row], posing.scale)


def test_other_clips_get_what_holds_for_all_poses() -> None:
    turns = torch.zeros(2, 3)
    turns[1, 0] = 0.5
    clip = MotionClip(
        torch.zeros(1, dtype=torch.float64), torch.zeros(1, 2, 3), torch.ones(1, 3), torch.ones(1)
    )
    clip.poses[0, 1, 1] = math.pi / 2
    found = corrected_clip(SharedCorrection(turns, math.log(2)), clip)
    wanted = (
        Rotation.from_rotvec([0, math.pi / 2, 0]) * Rotation.from_rotvec([0.5, 0, 0])
    ).as_rotvec()
    assert found.poses[0, 1].tolist() == pytest.approx(wanted.tolist(), abs=1e-6)
    assert float(found.scale[0]) == pytest.approx(2)
    assert torch.equal(found.trans, clip.trans)


def test_held_out_frames_have_their_own_poses_with_corrections_of_their_neighbours() -> None:
    """Frames 0, 2, 4 and 6 of a clip are trained on, frames 3 and 4 are in the test split."""
    whole = random_clip(7)
    trained = stirred()
    clip = whole.select(torch.tensor([0, 2, 4, 6]))
    trained = replace(trained, clip=clip)
    frames = BodyFrames(
        frames=tuple(range(7)),
        poses=whole.poses.double().numpy(),
        trans=whole.trans.double().numpy(),
        betas=np.zeros(10),
        scale=np.ones(7),
    )
    views = tuple(
        View(
            name=str(frame),
            image_path=Path(f"{frame}.png"),
            cam_from_world=np.eye(4),
            intrinsics=np.eye(3),
            width=4,
            height=4,
            time=float(whole.times[frame]),
            frame=frame,
        )
        for frame in (3, 4)
    )
    body: dict[Split, BodyFrames] = {"train": frames, "test": frames}
    capture = Capture(Path(), "body_json", {"test": views}, body=body)
    played = trained.for_split(capture, "test").played_clip
    torch.testing.assert_close(played.poses[1], trained.played_clip.poses[2])
    torch.testing.assert_close(played.trans[1], trained.played_clip.trans[2])
    between = {name: trained.learned[name][1:3].detach().mean(0) for name in ("poses", "trans")}
    wanted = corrected_clip(
        trained.fit, whole.select(torch.tensor([3])), *(x[None] for x in between.values())
    )
    torch.testing.assert_close(
        axis_angle_to_matrix(played.poses[0]),
        axis_angle_to_matrix(wanted.poses[0]),
        rtol=0,
        atol=1e-5,
    )
    torch.testing.assert_close(played.trans[0], wanted.trans[0])
