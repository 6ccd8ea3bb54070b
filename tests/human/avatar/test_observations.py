"""Silhouettes and colours of positions against what the images were painted with."""

from __future__ import annotations

import torch

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.avatar.observations import SurfacePoints, observed_colours
from dyngs.human.avatar.posing import BodyPose, Skeleton

STILL = BodyPose(torch.eye(3)[None], torch.zeros(3), torch.tensor(1.0))
SKELETON = Skeleton(torch.zeros(1, 3), (-1,))


def image(rgb: tuple[float, float, float], half: float, with_alpha: bool = True, turned: bool = False) -> Image:
    """A disc of colour ``rgb`` and radius ``half`` m around the origin, seen from z = -2 or, ``turned``, from 2."""
    pose = torch.eye(4)
    pose[2, 3] = 2.0
    if turned:
        pose[0, 0] = pose[2, 2] = -1.0
    cameras = Cameras(pose[None], torch.tensor([[[40.0, 0, 20], [0, 40.0, 20], [0, 0, 1]]]), 40, 40)
    grid = (torch.arange(40) + 0.5 - 20) / 20
    alpha = ((grid[:, None] ** 2 + grid**2).sqrt() < half).float()
    return Image("disc", cameras, alpha[..., None] * torch.tensor(rgb), alpha if with_alpha else None, None, 0.0, 0)


def positions(points: list[list[float]], normal: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> SurfacePoints:
    count = len(points)
    return SurfacePoints(torch.tensor(points), torch.tensor([normal]).repeat(count, 1), torch.ones(count, 1))


def test_places_are_looked_up_in_the_pose_of_the_image() -> None:
    moved = BodyPose(torch.eye(3)[None], torch.tensor([-0.6, 0.0, 0.0]), torch.tensor(2.0))
    found = observed_colours(positions([[0.3, 0, 0], [0.0, 0, 0]]), SKELETON, [(image((1, 0, 0), 0.3), moved)])
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.0, 0.0], [0.5, 0.5, 0.5]]))


def test_colours_are_those_of_the_cameras_in_front() -> None:
    shown = [(image((1.0, 0.2, 0.0), 0.5), STILL), (image((0.0, 0.0, 1.0), 0.5, turned=True), STILL)]
    front = observed_colours(positions([[0.0, 0, 0]]), SKELETON, shown)[0]
    back = observed_colours(positions([[0.0, 0, 0]], (0.0, 0.0, 1.0)), SKELETON, shown)[0]
    torch.testing.assert_close(front, torch.tensor([1.0, 0.2, 0.0]))
    torch.testing.assert_close(back, torch.tensor([0.0, 0.0, 1.0]))


def test_what_nobody_faces_is_grey_and_without_alpha_the_full_image_counts() -> None:
    aside = observed_colours(positions([[0.0, 0, 0]], (1.0, 0.0, 0.0)), SKELETON, [(image((1, 0, 0), 0.5), STILL)])
    torch.testing.assert_close(aside[0], torch.full((3,), 0.5))
    opaque, cut = image((1, 0, 0), 0.5, with_alpha=False), image((1, 0, 0), 0.5)
    beside = positions([[0.8, 0, 0]])
    torch.testing.assert_close(observed_colours(beside, SKELETON, [(opaque, STILL)])[0], torch.zeros(3))
    torch.testing.assert_close(observed_colours(beside, SKELETON, [(cut, STILL)])[0], torch.full((3,), 0.5))
