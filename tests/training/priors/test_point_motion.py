from __future__ import annotations

from dataclasses import replace

import torch
from moving_scene import camera, row_of_balls

from dyngs.data.loader import Image
from dyngs.gaussians.rendering import RenderOptions
from dyngs.training.priors.point_motion import displacements, flow_error, track_error

OPTIONS = RenderOptions()


def test_what_is_drawn_is_the_displacement_of_the_gaussian_that_shows() -> None:
    """One ball moves along x at the depth of its centre: focal length times motion over depth."""
    here = camera(32, 24)
    start = row_of_balls(1)
    moved = start.replace(means=start.means + torch.tensor([0.1, 0.0, 0.0]))
    drawn = displacements(start, moved, here, here, OPTIONS)
    pose = here.cam_from_world[0]
    before, after = (x.means[0] @ pose[:3, :3].T + pose[:3, 3] for x in (start, moved))
    focal = here.intrinsics[0].diagonal()[:2]
    wanted = focal * (after[:2] / after[2] - before[:2] / before[2])
    shown = drawn[..., 2] > 0.5
    assert bool(shown.any())
    torch.testing.assert_close(drawn[shown][:, :2], wanted.expand(int(shown.sum()), 2), rtol=0, atol=1e-3)


def test_gradients_move_the_gaussians_to_where_flow_says() -> None:
    here = camera(32, 24)
    start = row_of_balls(1)
    end = (start.means.clone()).requires_grad_()
    drawn = displacements(start, start.replace(means=end), here, here, OPTIONS)
    flow = torch.full((24, 32, 2), torch.nan)
    flow[drawn[..., 2].detach() > 0.5] = torch.tensor([3.0, 0.0])
    image = Image("a", here, torch.zeros(24, 32, 3), None, None, 0.0, flow=flow)
    error = flow_error(drawn, image)
    assert error is not None
    (slope,) = torch.autograd.grad(error, end)
    along = here.cam_from_world[0, :3, :3] @ slope[0]
    assert float(along[0]) < 0  # the loss falls where the point goes to the right in the image
    assert flow_error(drawn.detach(), replace(image, flow=torch.full((24, 32, 2), torch.nan))) is None
    assert flow_error(drawn.detach(), replace(image, mask=torch.zeros(24, 32))) is None


def test_tracks_are_right_where_the_points_go() -> None:
    drawn = torch.zeros(24, 32, 3)
    drawn[..., 2] = 1
    drawn[:, 16:, 0] = 4
    start = torch.tensor([[20.0, 5.0], [4.0, 7.0]])
    exact = track_error(drawn, start, torch.tensor([[24.0, 5.0], [4.0, 7.0]]))
    wrong = track_error(drawn, start, start)
    assert exact is not None
    assert wrong is not None
    assert float(exact) == 0
    assert float(wrong) > 0.04
    assert track_error(torch.zeros(24, 32, 3), start, start) is None
