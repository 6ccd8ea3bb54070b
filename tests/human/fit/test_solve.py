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
    LIMIT_WEIGHT,
    OUTLIER_ERROR,
    BodyDiscs,
    BodyFit,
    ObservedFrame,
    body_discs,
    pose_prior,
    skeleton_targets,
)
from dyngs.human.fit.skeleton_fit import PARAMS
from dyngs.human.motion.motion import MotionClip

SIZE = 32


@pytest.fixture(scope="module")
def body() -> BodyDiscs:
    return body_discs(default_template(), 24)


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


def fitting_of(clip: MotionClip, body: BodyDiscs, *, is_given: bool = True) -> BodyFit:
    return BodyFit(clip, body, pose_prior(clip, is_given=is_given))


def joints_at(learned: Parameters, fitting: BodyFit) -> torch.Tensor:
    """The joints (J, 3) of the first frame of a fit."""
    return posed_joints(fitting.shaped(learned).skeleton, fitting.pose(learned, 0))


def test_key_points_in_place_cost_nothing_and_others_their_distance() -> None:
    joints = torch.zeros(55, 3)
    positions = torch.zeros(1, 55, 3)
    joints[1] = torch.tensor([0.5, 1.0, 0.0])
    positions[0, :2] = torch.tensor([[0.5, 0.5, 1.0], [0.5 + 1.6 * 0.125, 0.5 - 1.6 * 0.25, 1.0]])

    def error(keypoints: torch.Tensor) -> float:
        alpha = torch.zeros(1, SIZE, SIZE)
        frame = ObservedFrame(camera(), alpha, alpha, keypoints)
        return float(skeleton_targets({0: frame}, 1, 55).error(joints[None], 1.0))

    assert error(positions) == pytest.approx(0, abs=1e-6)
    moved = positions.clone()
    moved[0, 0, 0] += 3 * PARAMS.keypoint_std
    assert error(moved) == pytest.approx((math.sqrt(10) - 1) / 2, rel=1e-4)
    moved[0, 0, 2] = 0
    assert error(moved) == pytest.approx(0, abs=1e-6)


def test_a_wrong_mask_among_right_ones_moves_the_person_less(
    body: BodyDiscs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three views are right, the fourth one shows what is beside the person."""
    fitting = fitting_of(clip(), body)
    view = camera()
    with torch.no_grad():
        alpha = fitting.silhouettes(fitting.initial_parameters(), 0, view)
    views = Cameras(
        view.cam_from_world.expand(4, 4, 4), view.intrinsics.expand(4, 3, 3), SIZE, SIZE
    )
    masks = torch.cat([alpha, alpha, alpha, alpha.roll(3, dims=2)])
    seen = ObservedFrame(views, masks, torch.ones_like(masks))
    moved = []
    for scale in (OUTLIER_ERROR, 1e9 * OUTLIER_ERROR):
        monkeypatch.setattr(capture_fit, "OUTLIER_ERROR", scale)
        found = fitting.optimize(fitting.initial_parameters(), ("trans",), 80, lambda _: seen)
        moved.append(abs(float(found["trans"][0, 0].detach())))
    assert moved[0] < 0.5 * moved[1]


def test_key_points_lead_an_arm_where_silhouettes_do_not(body: BodyDiscs) -> None:
    """The given arm is bent by 2 rad; the image shows it straight."""
    fitting = fitting_of(clip(2.0), body)
    straight = fitting_of(clip(), body)
    view = camera()
    with torch.no_grad():
        truth = joints_at(straight.initial_parameters(), straight)
        alpha = straight.silhouettes(straight.initial_parameters(), 0, view)
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
        found = fitting.optimize(
            fitting.initial_parameters(), ("poses",), 120, lambda _, seen=seen: seen
        )
        errors.append(float((joints_at(found, fitting) - truth)[wrist].detach().norm()))
    assert errors[1] < 0.2, "the prior of given poses still pulls"
    assert errors[1] < 0.5 * errors[0]


def test_only_what_a_stage_names_is_learned(body: BodyDiscs) -> None:
    alpha = torch.ones(1, SIZE, SIZE)
    seen = ObservedFrame(camera(), alpha, alpha)
    fitting = fitting_of(clip(), body)
    start = fitting.initial_parameters()
    found = fitting.optimize(start, ("betas",), 2, lambda _: seen)
    assert not any(value.any() for value in start.values().values()), (
        "what was learned before stays as it is"
    )
    changed = {name for name, value in found.values().items() if value.any()}
    assert changed == {"betas"}


def test_joints_beyond_what_anybody_does_cost_much_more(body: BodyDiscs) -> None:
    limited = fitting_of(clip(), body, is_given=False)
    expected = limited.prior
    row = JOINT_NAMES.index("left_collar")

    def cost(deviations: float, fitting: BodyFit) -> float:
        learned = fitting.initial_parameters().values()
        learned["poses"] = expected.mean.clone()
        learned["poses"][0, row, 1] += deviations * expected.std[row, 1]
        return float(fitting.penalty(Parameters(learned, {}, 1.0)).detach())

    fraction = 1 / (21 * 3)
    unlimited = replace(limited, prior=replace(expected, limit=math.inf))
    assert cost(2.9, limited) == pytest.approx(cost(2.9, unlimited), abs=1e-8)
    assert cost(5.0, limited) - cost(5.0, unlimited) == pytest.approx(
        LIMIT_WEIGHT * 2.0**2 * fraction, rel=1e-4
    )
    assert fitting_of(clip(), body).prior.limit == math.inf, "given poses may be as they like"
