"""Shifts of pixels become shifts of nodes: known ones come back, and the unseen stays."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_fields import TIMES, cloud

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.deform.node_shifts import LONGEST_SIDE, SeenShift, matching_factor, seen_shift, spline_changes
from dyngs.deform.nodes import nodes_at
from dyngs.deform.spline_fit import spline_basis
from dyngs.gaussians.rendering import render

PIECES = 3


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1))
def test_a_shift_that_all_images_see_moves_the_splines_by_it(x: float, y: float, z: float) -> None:
    """What follows no seen Gaussian does not move."""
    positions = torch.tensor([[0.0, 0, 0], [1, 0, 0], [100, 0, 0], [101, 0, 0], [102, 0, 0], [103, 0, 0]])
    means = torch.tensor([[0.1, 0, 0], [0.4, 0, 0], [0.9, 0, 0]])
    nodes = nodes_at(positions[:2], means)
    shift, weights = torch.tensor([x, y, z]), torch.tensor([300.0, 500, 400])
    seen = [SeenShift(i / 20, shift * weights[:, None], weights) for i in range(21)]
    change = spline_changes(nodes, nodes.weights(means), seen, PIECES)
    at = torch.einsum("kp,spd->skd", spline_basis(torch.linspace(0, 1, 9), PIECES).float(), change)
    torch.testing.assert_close(at, shift.expand_as(at), rtol=0.1, atol=0.03)


def test_what_is_not_seen_does_not_move() -> None:
    means = torch.tensor([[0.1, 0, 0], [0.9, 0, 0]])
    nodes = nodes_at(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), means)
    seen = [SeenShift(time, torch.zeros(2, 3), torch.tensor([50.0, 0])) for time in TIMES]
    assert not spline_changes(nodes, nodes.weights(means), seen, PIECES).any()


def test_shifts_in_the_image_are_shifts_in_the_world() -> None:
    """Gaussians that belong one pixel to the right and two down are told so, at their depth, in a turned camera."""
    gaussians = cloud(60).replace(logit_opacities=torch.full((60,), 3.0))
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2))).Q
    turn = turn * torch.linalg.det(turn)
    pose = torch.eye(4)
    pose[:3, :3], pose[2, 3] = turn, 8.0
    lens = torch.tensor([[60.0, 0, 24], [0, 60, 24], [0, 0, 1]])
    cameras = Cameras(pose[None], lens[None], 48, 48)
    drawn = render(gaussians, cameras).rgb[0].detach()
    truth = drawn.roll((2, 1), (0, 1))
    image = Image("a", cameras, truth, None, None, 0.5)
    found = seen_shift(gaussians, torch.arange(60), image, drawn, truth)
    covers = found.weights > 3
    assert int(covers.sum()) >= 8
    depths = gaussians.means @ turn[2] + 8.0
    wanted = (depths / 60)[:, None] * (turn[0] + 2 * turn[1])
    mean = found.shifts[covers] / found.weights[covers, None]
    error = (mean - wanted[covers]).norm(dim=1) / wanted[covers].norm(dim=1)
    assert float(error.median()) < 0.25


def test_images_are_made_small() -> None:
    assert matching_factor(LONGEST_SIDE, 10) == 1
    assert matching_factor(854, 480) == 7
    assert matching_factor(400, 401) == 4
