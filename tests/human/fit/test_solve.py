"""Errors and stages of the fit: known values, and key points that lead a pose."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.gaussians.optimizer import Parameters
from dyngs.human.avatar.posing import posed_joints
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.fit import capture_fit
from dyngs.human.fit.capture_fit import (
    KEYPOINT,
    LIMIT_WEIGHT,
    MISTAKEN,
    Fitting,
    ObservedFrame,
    PosePrior,
    Surface,
    drawn_frame,
    frame_pose_of,
    keypoint_error,
    near_given,
    new_fit,
    prior,
    surface_of,
    usual,
)
from dyngs.human.motion.motion import MotionClip

SIZE = 32


@pytest.fixture(scope="module")
def surface() -> Surface:
    return surface_of(default_template(), 24)


def camera() -> Cameras:
    """In front of a person at the origin, y up."""
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    pose[2, 3] = 4.0
    intrinsics = torch.tensor([[1.6 * SIZE, 0, SIZE / 2], [0, 1.6 * SIZE, SIZE / 2], [0, 0, 1]])
    return Cameras(pose[None], intrinsics[None], SIZE, SIZE)


def clip(elbow: float = 0.0) -> MotionClip:
    """The rest pose, with the left elbow bent."""
    poses = torch.zeros(1, 55, 3)
    poses[0, JOINT_NAMES.index("left_elbow"), 2] = elbow
    return MotionClip(torch.zeros(1, dtype=torch.float64), poses, torch.zeros(1, 3), torch.ones(1))


def joints_at(learned: Parameters, clip: MotionClip, surface: Surface) -> torch.Tensor:
    """The joints (J, 3) of the first frame of a fit."""
    return posed_joints(surface.skeleton(learned["betas"]), frame_pose_of(learned, clip, 0))


def test_key_points_in_place_cost_nothing_and_others_their_distance() -> None:
    joints = torch.zeros(55, 3)
    positions = torch.zeros(1, 55, 3)
    joints[1] = torch.tensor([0.5, 1.0, 0.0])
    positions[0, :2] = torch.tensor([[0.5, 0.5, 1.0], [0.5 + 1.6 * 0.125, 0.5 - 1.6 * 0.25, 1.0]])
    assert float(keypoint_error(joints, positions, camera())) == pytest.approx(0, abs=1e-6)
    moved = positions.clone()
    moved[0, 0, 0] += 3 * KEYPOINT
    assert float(keypoint_error(joints, moved, camera())) == pytest.approx(
        (math.sqrt(10) - 1) / 2, rel=1e-4
    )
    moved[0, 0, 2] = 0
    assert float(keypoint_error(joints, moved, camera())) == pytest.approx(0, abs=1e-6)


def test_a_wrong_mask_among_right_ones_moves_the_person_less(
    surface: Surface, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three views are right, the fourth one shows what is beside the person."""
    given = clip()
    view = camera()
    with torch.no_grad():
        alpha = drawn_frame(new_fit(given, surface), given, surface, 0, view)
    views = Cameras(
        view.cam_from_world.expand(4, 4, 4), view.intrinsics.expand(4, 3, 3), SIZE, SIZE
    )
    masks = torch.cat([alpha, alpha, alpha, alpha.roll(3, dims=2)])
    seen = ObservedFrame(views, masks, torch.ones_like(masks))
    fitting = Fitting(given, surface, near_given(given))
    moved = []
    for scale in (MISTAKEN, 1e9 * MISTAKEN):
        monkeypatch.setattr(capture_fit, "MISTAKEN", scale)
        found = fitting.run(new_fit(given, surface), ("trans",), 80, lambda _: seen)
        moved.append(abs(float(found["trans"][0, 0].detach())))
    assert moved[0] < 0.5 * moved[1]


def test_key_points_lead_an_arm_where_silhouettes_do_not(surface: Surface) -> None:
    """The given arm is bent by 2 rad; the image shows it straight."""
    given = clip(2.0)
    straight = clip()
    view = camera()
    with torch.no_grad():
        truth = joints_at(new_fit(straight, surface), straight, surface)
        alpha = drawn_frame(new_fit(straight, surface), straight, surface, 0, view)
    marked = torch.zeros(1, 55, 3)
    wrist = JOINT_NAMES.index("left_wrist")
    for name in ("left_shoulder", "left_elbow", "left_wrist"):
        row = JOINT_NAMES.index(name)
        marked[0, row] = torch.tensor(
            [0.5 + 1.6 * truth[row, 0] / 4, 0.5 - 1.6 * truth[row, 1] / 4, 1.0]
        )
    errors = []
    for joints in (None, marked):
        seen = ObservedFrame(view, alpha, torch.ones_like(alpha), joints)
        fitting = Fitting(given, surface, near_given(given))
        found = fitting.run(new_fit(given, surface), ("poses",), 120, lambda _, seen=seen: seen)
        errors.append(float((joints_at(found, given, surface) - truth)[wrist].detach().norm()))
    assert errors[1] < 0.2, "the prior of given poses still pulls"
    assert errors[1] < 0.5 * errors[0]


def test_only_what_a_stage_names_is_learned(surface: Surface) -> None:
    given = clip()
    view = camera()
    alpha = torch.ones(1, SIZE, SIZE)
    seen = ObservedFrame(view, alpha, alpha)
    start = new_fit(given, surface)
    found = Fitting(given, surface, near_given(given)).run(start, ("betas",), 2, lambda _: seen)
    assert not any(value.any() for value in start.values().values()), (
        "what was learned before stays as it is"
    )
    changed = {name for name, value in found.values().items() if value.any()}
    assert changed == {"betas"}


def test_joints_beyond_what_anybody_does_cost_much_more(surface: Surface) -> None:
    clip = MotionClip(
        torch.zeros(1, dtype=torch.float64), torch.zeros(1, 55, 3), torch.zeros(1, 3), torch.ones(1)
    )
    expected = usual(clip)
    row = JOINT_NAMES.index("left_collar")

    def cost(deviations: float, prior_of_poses: PosePrior) -> float:
        learned = new_fit(clip, surface).values()
        learned["poses"] = expected.centre.clone()
        learned["poses"][0, row, 1] += deviations * expected.spread[row, 1]
        return float(prior(Parameters(learned, {}, 1.0), prior_of_poses).detach())

    fraction = 1 / (21 * 3)
    unlimited = replace(expected, limit=math.inf)
    assert cost(2.9, expected) == pytest.approx(cost(2.9, unlimited), abs=1e-8)
    assert cost(5.0, expected) - cost(5.0, unlimited) == pytest.approx(
        LIMIT_WEIGHT * 2.0**2 * fraction, rel=1e-4
    )
    assert near_given(clip).limit == math.inf, "given poses may be as they like"


SIZE, FRAMES, STEPS, DISTANCE = 32, 4, 12, 2.2
