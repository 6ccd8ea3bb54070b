"""Squares around the person: the same person, seen by cameras that fit the squares."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.gaussians.rendering import render
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import posed_vertices
from dyngs.human.body.body_reader import default_template, read_body
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.fit.silhouettes import _OPTIONS as OPTIONS
from dyngs.human.fit.silhouettes import (
    Surface,
    drawn_silhouettes,
    longest_box_side,
    observed_frame,
    surface_of,
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
    frame = observed_frame([shown], side, 10)
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


def test_what_lies_outside_of_the_image_is_not_known() -> None:
    frame = observed_frame([image(slice(0, 20), slice(0, 5))], 20, 25)
    assert frame is not None
    assert frame.known[0, :, 12:].mean() > 0.8
    assert not frame.known[0, :, 0].any(), "left of the image"
    assert not frame.known[0, 0].any(), "above it"


def test_half_the_size_shows_the_same() -> None:
    frame = observed_frame([image(slice(10, 30), slice(20, 28))], 20, 24)
    assert frame is not None
    small = frame.shrunk(2)
    assert small.alpha.shape == (1, 12, 12)
    assert float(small.alpha.mean()) == pytest.approx(float(frame.alpha.mean()), rel=1e-5)
    assert small.cameras.intrinsics[0, 0, 0] * 2 == frame.cameras.intrinsics[0, 0, 0]


def test_images_without_anybody_are_left_out() -> None:
    nobody = image(slice(0, 0), slice(0, 0))
    assert longest_box_side([nobody]) == 0
    assert observed_frame([nobody], 20, 10) is None
    found = observed_frame([nobody, image(slice(10, 30), slice(20, 28))], 20, 10)
    assert found is not None
    assert len(found) == 1


def test_turns_show_each_view_as_often_and_views_that_are_far_apart() -> None:
    shown = [image(slice(10, 30), slice(20, 21 + i)) for i in range(7)]
    frame = observed_frame(shown, 20, 10)
    assert frame is not None
    parts = [frame.part(turn, 3) for turn in range(7)]
    areas = frame.alpha.sum((1, 2)).tolist()
    rows = [[areas.index(x) for x in part.alpha.sum((1, 2)).tolist()] for part in parts]
    assert sorted(x for part in rows for x in part) == sorted(3 * list(range(7)))
    assert all(
        min(abs(a - b) % 7, 7 - abs(a - b) % 7) >= 2
        for part in rows
        for a in part
        for b in part
        if a != b
    )
    for part, own in zip(parts, rows, strict=True):
        torch.testing.assert_close(part.cameras.intrinsics, frame.cameras.intrinsics[own])
        torch.testing.assert_close(part.known, frame.known[own])
    assert frame.part(3, 7) is frame


def test_the_coverage_is_that_of_a_render_and_needs_no_colours() -> None:
    surface = surface_of(default_template(), 16)
    pose = torch.eye(4)[None].clone()
    # 3 m in front of a standing person
    pose[0, :3] = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 3]])
    camera = Cameras(pose, torch.tensor([[[40.0, 0, 24], [0, 40, 24], [0, 0, 1]]]), 48, 48)
    found = drawn_silhouettes(surface.discs, camera)
    coloured = render(surface.discs, camera, OPTIONS).alpha
    assert found.sum() > 50
    torch.testing.assert_close(found, coloured, rtol=0, atol=1e-6)


def test_pose_blend_shapes_move_the_surface_as_they_move_the_mesh(
    smpl_files: tuple[Path, Path],
) -> None:
    body = read_body(*smpl_files)
    surface = surface_of(body, 24)
    texels = atlas_texels(body, 24, body.vertices)
    poses = 0.5 * torch.randn(24, 3, generator=torch.Generator().manual_seed(1))
    poses[0] = 0.0
    place = torch.tensor([0.1, 0.2, 0.3])
    pose = BodyPose(axis_angle_to_matrix(poses), place, torch.tensor(1.0))
    shape = torch.zeros(10)
    skin = surface.discs.replace(means=texels.points)

    def away(drawn: Surface) -> torch.Tensor:
        """Distances of points of the skin from where the mesh has them, m."""
        posed = (
            replace(drawn, discs=skin).in_shape(shape, torch.zeros(len(drawn))).in_pose(pose).means
        )
        mesh = posed_vertices(body, poses[None], place[None])[0]
        return (
            posed - (texels.barycentric[..., None] * mesh[body.faces[texels.faces]]).sum(1)
        ).norm(dim=1)

    # What remains: points between vertices are skinned, not placed between skinned vertices.
    assert away(surface).mean() < 2e-4
    assert away(replace(surface, pose_dirs=None)).mean() > 2e-3
