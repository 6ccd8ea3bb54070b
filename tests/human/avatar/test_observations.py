"""Colours of points against what the images were painted with."""

from __future__ import annotations

import torch

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.avatar.observations import observed_colours
from dyngs.human.avatar.posing import BodyPose, Skeleton

STILL = BodyPose(torch.eye(3)[None], torch.zeros(3), torch.tensor(1.0))
SKELETON = Skeleton(torch.zeros(1, 3), (-1,))


def image(
    rgb: tuple[float, float, float], half: float, with_alpha: bool = True, turned: bool = False
) -> Image:
    """A disc of colour ``rgb`` and radius ``half`` m around the origin, seen from z = -2 or,
    ``turned``, from 2."""
    pose = torch.eye(4)
    pose[2, 3] = 2.0
    if turned:
        pose[0, 0] = pose[2, 2] = -1.0
    cameras = Cameras(pose[None], torch.tensor([[[40.0, 0, 20], [0, 40.0, 20], [0, 0, 1]]]), 40, 40)
    grid = (torch.arange(40) + 0.5 - 20) / 20
    alpha = ((grid[:, None] ** 2 + grid**2).sqrt() < half).float()
    return Image(
        "disc",
        cameras,
        alpha[..., None] * torch.tensor(rgb),
        alpha if with_alpha else None,
        None,
        0.0,
        0,
    )


def colours(
    points: list[list[float]],
    *shown: tuple[Image, BodyPose],
    normal: tuple[float, float, float] = (0.0, 0.0, -1.0),
) -> torch.Tensor:
    """Observed colours of points on a body of one joint that all face one way."""
    count = len(points)
    at_rest = torch.tensor(points)
    normals = torch.tensor([normal]).repeat(count, 1)
    weights = torch.ones(count, 1)
    return observed_colours(
        normals, weights, SKELETON, ((image, pose, at_rest) for image, pose in shown)
    )[0]


def test_positions_are_looked_up_in_the_pose_of_the_image() -> None:
    moved = BodyPose(torch.eye(3)[None], torch.tensor([-0.6, 0.0, 0.0]), torch.tensor(2.0))
    found = colours([[0.3, 0, 0], [0.0, 0, 0]], (image((1, 0, 0), 0.3), moved))
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.5, 0.5]]))


def test_colours_are_those_of_the_cameras_in_front() -> None:
    shown = [
        (image((1.0, 0.2, 0.0), 0.5), STILL),
        (image((0.0, 0.0, 1.0), 0.5, turned=True), STILL),
    ]
    torch.testing.assert_close(colours([[0.0, 0, 0]], *shown)[0], torch.tensor([1.0, 0.2, 0.0]))
    back = colours([[0.0, 0, 0]], *shown, normal=(0.0, 0.0, 1.0))
    torch.testing.assert_close(back[0], torch.tensor([0.0, 0.0, 1.0]))
