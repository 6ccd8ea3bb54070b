"""The nearest neighbours of points."""

from __future__ import annotations

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions
from dyngs.human.avatar.observations import (
    effective_view_counts,
    fill_unseen,
    find_mirror_gaussians,
    rigidity_errors,
    same_part_neighbours,
    smooth_over_neighbours,
)
from dyngs.human.avatar.posing import Anchors
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body_reader import load_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.keys import HumanModel


@pytest.mark.parametrize("num_points", [1, 3, 40])
def test_neighbours_are_the_nearest_others_and_missing_ones_the_point_itself(
    num_points: int,
) -> None:
    points = torch.rand(num_points, 3, generator=torch.Generator().manual_seed(0))
    found = same_part_neighbours(points, torch.ones(num_points, 1))
    nearest = torch.cdist(points, points).argsort(dim=1)[:, 1:6]
    for i, row in enumerate(found.tolist()):
        assert row == [*nearest[i].tolist(), *[i] * (5 - nearest.shape[1])]


def test_no_gaussian_of_an_arm_is_linked_to_the_trunk_or_of_a_finger_to_another() -> None:
    body = load_template(HumanModel())
    texels = atlas_texels(body, 96)
    near = same_part_neighbours(texels.points, texels.weights)
    first = texels.weights.argmax(1)
    names = JOINT_NAMES[: len(body.parents)]
    part = {
        "left_elbow": 1,
        "left_wrist": 1,
        "spine1": 2,
        "spine2": 2,
        "left_knee": 3,
        "right_knee": 4,
    }
    fingers = ("index", "middle", "pinky", "ring", "thumb")
    part |= {f"left_{name}{i}": 5 + k for k, name in enumerate(fingers) for i in (2, 3)}
    parts = torch.tensor([part.get(name, 0) for name in names])[first]
    parts[texels.weights.amax(1) < 0.9] = 0  # between joints
    known = parts > 0
    linked = parts[near[known]]
    assert bool(((linked == parts[known, None]) | (linked == 0)).all())
    assert float((near == torch.arange(len(near))[:, None]).float().mean()) < 0.02, (
        "few lack neighbours"
    )


def sheet(width: int = 12, height: int = 10) -> tuple[Gaussians, Anchors]:
    """A flat sheet in the x-y plane, symmetric about x = 0, with texels of 1 cm."""
    x = (torch.arange(width) - (width - 1) / 2) * 0.01
    points = torch.cartesian_prod(x, torch.arange(height) * 0.01, torch.zeros(1))
    count = len(points)
    size = torch.full((count,), 0.01)
    joints = torch.zeros(count, 1, dtype=torch.long)
    anchors = Anchors(
        points=points,
        size=size,
        joints=joints,
        weights=torch.ones(count, 1),
        face=joints[:, 0],
        barycentric=torch.ones(count, 3) / 3,
        uv=points[:, :2],
        height=torch.zeros(count),
    )
    gaussians = Gaussians(
        means=points.clone(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), 0.005).log(),
        logit_opacities=torch.full((count,), 2.0),
        sh=torch.zeros(count, 1, 3),
    )
    return gaussians, anchors


def camera(distance: float = 1.0, size: int = 60, focal: float = 300.0) -> Cameras:
    pose = torch.eye(4)
    pose[2, 3] = distance
    half = size / 2
    return Cameras(
        pose[None], torch.tensor([[[focal, 0, half], [0, focal, half], [0, 0, 1]]]), size, size
    )


def test_a_view_counts_as_about_one_whatever_its_size_and_what_is_behind_counts_nothing() -> None:
    gaussians, anchors = sheet()
    behind = gaussians.replace(means=gaussians.means + torch.tensor([0.0, 0.0, 0.05]))
    rows = torch.arange(len(anchors)).repeat(2)
    opaque = gaussians.select(rows).replace(
        means=torch.cat([gaussians.means, behind.means]),
        logit_opacities=torch.full((len(rows),), 5.0),
    )
    sizes = anchors.size.repeat(2)
    count = len(anchors)
    inner = (
        (anchors.points[:, 0].abs() < 0.04)
        & (anchors.points[:, 1] > 0.02)
        & (anchors.points[:, 1] < 0.07)
    )
    for size, focal in ((60, 300.0), (240, 1200.0)):
        seen = effective_view_counts(
            [(opaque, camera(1.0, size, focal))], sizes, 1.0, RenderOptions()
        )
        assert 0.3 < float(seen[:count][inner].mean()) < 2.5
        assert float(seen[count:][inner].max()) < 0.02
    twice = effective_view_counts([(opaque, camera())] * 2, sizes, 1.0, RenderOptions())
    torch.testing.assert_close(
        twice, 2 * effective_view_counts([(opaque, camera())], sizes, 1.0, RenderOptions())
    )


def test_the_unseen_half_of_a_symmetric_body_is_that_of_the_other_side() -> None:
    gaussians, anchors = sheet()
    torch.manual_seed(0)
    right = anchors.points[:, 0] < 0
    smooth = torch.stack(
        [anchors.points[:, 1] * 5, anchors.points[:, 0].abs() * 8, 0 * right], dim=1
    )[:, None]
    bulge = torch.stack(
        [torch.sign(anchors.points[:, 0]), torch.ones_like(right), 2.0 * torch.ones_like(right)],
        dim=1,
    )
    true = gaussians.replace(sh=smooth, means=anchors.points + 0.004 * bulge)
    spoilt = true.replace(
        sh=torch.where(right[:, None, None], torch.randn(len(anchors), 1, 3), true.sh),
        means=torch.where(
            right[:, None], anchors.points + 0.02 * torch.randn(len(anchors), 3), true.means
        ),
        logit_opacities=torch.where(right, -3.0, true.logit_opacities),
    )
    weights = torch.stack([right, ~right], dim=1).float()
    new = fill_unseen(spoilt, anchors, weights, 0.0, (~right).float())
    torch.testing.assert_close(new["means"], true.means)
    torch.testing.assert_close(new["logit_opacities"], true.logit_opacities)
    assert float((new["sh"] - true.sh).abs().max()) < 0.06, (
        "colours are mixed a little with those around"
    )
    torch.testing.assert_close(new["sh"][~right], true.sh[~right], rtol=0, atol=2e-3)


def test_without_a_seen_mirror_image_a_gap_is_filled_smoothly_and_from_its_own_part_only() -> None:
    gaussians, anchors = sheet()
    torch.manual_seed(0)
    left = anchors.points[:, 0] > 0
    x = anchors.points[:, 0]
    gap = (x.abs() < 0.03) & (anchors.points[:, 1] > 0.02) & (anchors.points[:, 1] < 0.07)
    colours = torch.where(left[:, None], torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 0, 1]))
    noisy = torch.where(gap[:, None], torch.randn(len(anchors), 3), colours)
    weights = torch.stack([~left, left], dim=1).float()
    found = smooth_over_neighbours(noisy, (~gap).float(), anchors, weights)
    torch.testing.assert_close(found, colours, atol=1e-3, rtol=0)
    _, is_image = find_mirror_gaussians(anchors, 0.5)
    assert not bool(is_image.any())
    new = fill_unseen(gaussians.replace(sh=noisy[:, None]), anchors, weights, 0.5, (~gap).float())
    torch.testing.assert_close(new["sh"][:, 0], colours, atol=1e-3, rtol=0)
    torch.testing.assert_close(new["means"], gaussians.means)


def test_strains_are_those_of_a_loop_and_so_are_their_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    means, moved, points = torch.randn(3, 7, 3, generator=generator, dtype=torch.float64).unbind(0)
    near = torch.tensor([1, 2, 0, 0, 5, 4, 6])
    scale = torch.tensor(1.5, dtype=torch.float64)  # the last is alone
    found = rigidity_errors(means, moved, points, near, scale)
    changes = []
    unlike = []
    for i, j in enumerate(near.tolist()):
        changes.append(
            float((moved[i] - moved[j]).norm() / 1.5 - (means[i] - means[j]).norm()) ** 2
        )
        unlike.append(float(((means - points)[i] - (means - points)[j]).square().sum()))
    torch.testing.assert_close(found[0].item(), sum(changes) / 7, rtol=1e-6, atol=0)
    torch.testing.assert_close(found[1].item(), sum(unlike) / 7)
    leaves = means.requires_grad_(), moved.requires_grad_()
    assert torch.autograd.gradcheck(lambda a, b: rigidity_errors(a, b, points, near, scale), leaves)
