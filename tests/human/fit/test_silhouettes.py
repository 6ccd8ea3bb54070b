"""Squares around the person: the same person, seen by cameras that fit the squares."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import posed_vertices
from dyngs.human.body.body_reader import read_body
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.fit.capture_fit import (
    BodyDiscs,
    body_discs,
    crop_frame,
    longest_box_side,
)


def image(rows: slice, columns: slice, height: int = 40, width: int = 60) -> Image:
    alpha = torch.zeros(height, width)
    alpha[rows, columns] = 1.0
    camera = Cameras(
        torch.eye(4)[None], torch.tensor([[[50.0, 0, 30], [0, 50, 20], [0, 0, 1]]]), width, height
    )
    return Image("p", camera, alpha[..., None].expand(-1, -1, 3), alpha, None, None, 0)


def test_a_point_of_the_world_falls_on_the_same_part_of_the_person() -> None:
    shown = image(slice(10, 30), slice(20, 28))
    side = longest_box_side([shown])
    assert side == 20
    frame = crop_frame([shown], side, 10)
    assert frame is not None
    corner = torch.tensor([[20.0, 10.0, 1.0], [28.0, 30.0, 1.0]])  # of the box, in the image
    directions = torch.linalg.solve(shown.cameras.intrinsics[0], corner.T)
    inside = (frame.cameras.intrinsics[0] @ directions).T[:, :2]
    covered = frame.alpha[0] > 0.5
    rows = covered.any(1).nonzero()[:, 0]
    columns = covered.any(0).nonzero()[:, 0]
    assert inside[0].round().tolist() == [float(columns[0]), float(rows[0])]
    assert inside[1].round().tolist() == [float(columns[-1]) + 1, float(rows[-1]) + 1]
    assert float(frame.alpha.sum()) * (25 / 10) ** 2 == pytest.approx(160, rel=0.01)


def test_pixels_outside_the_image_are_unknown() -> None:
    frame = crop_frame([image(slice(0, 20), slice(0, 5))], 20, 25)
    assert frame is not None
    assert frame.known[0, :, 12:].mean() > 0.8
    assert not frame.known[0, :, 0].any(), "left of the image"
    assert not frame.known[0, 0].any(), "above it"


def test_pose_blend_shapes_move_the_surface_as_they_move_the_mesh(
    smpl_files: tuple[Path, Path],
) -> None:
    body = read_body(*smpl_files)
    surface = body_discs(body, 24)
    texels = atlas_texels(body, 24, body.vertices)
    poses = 0.5 * torch.randn(24, 3, generator=torch.Generator().manual_seed(1))
    poses[0] = 0.0
    place = torch.tensor([0.1, 0.2, 0.3])
    pose = BodyPose(axis_angle_to_matrix(poses), place, torch.tensor(1.0))
    shape = torch.zeros(10)
    skin = surface.discs.replace(means=texels.points)

    def away(drawn: BodyDiscs) -> torch.Tensor:
        """Distances of points of the skin from where the mesh has them, m."""
        posed = (
            replace(drawn, discs=skin)
            .with_shape(shape, torch.zeros(len(texels)))
            .in_pose(pose)
            .means
        )
        mesh = posed_vertices(body, poses[None], place[None])[0]
        return (
            posed - (texels.barycentric[..., None] * mesh[body.faces[texels.faces]]).sum(1)
        ).norm(dim=1)

    # What remains: points between vertices are skinned, not placed between skinned vertices.
    assert away(surface).mean() < 2e-4
    assert away(replace(surface, pose_dirs=None)).mean() > 2e-3
