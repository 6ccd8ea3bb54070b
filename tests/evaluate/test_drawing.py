"""Images drawn smaller come out at full size and show the same."""

from __future__ import annotations

import pytest
import torch
from moving_scene import camera, still_scene

from dyngs.evaluate.drawing import Drawing
from dyngs.gaussians.rendering import RenderOptions

pytestmark = pytest.mark.usefixtures("one_thread")


def test_a_shrunk_camera_sees_the_same() -> None:
    small = camera(20, 14).scaled(0.5)
    assert (small.width, small.height) == (10, 7)
    corner = torch.tensor([20.0, 14.0, 1.0])
    ray, same = (torch.linalg.inv(c.intrinsics[0]) @ p for c, p in ((camera(20, 14), corner), (small, corner / 2)))
    assert torch.allclose(ray[:2], (ray / same * same)[:2])
    assert torch.allclose(small.intrinsics[0] @ ray / ray[2], torch.tensor([10.0, 7.0, 1.0]))
    assert camera().scaled(1.0).width == 20


def test_a_small_drawing_comes_out_at_full_size_and_in_its_place() -> None:
    drawings = [Drawing(still_scene(1), RenderOptions(), torch.ones(3), scale) for scale in (1.0, 0.5)]
    images = [1 - drawing.image(camera(40, 28), None).mean(2) for drawing in drawings]
    assert [tuple(x.shape) for x in images] == [(28, 40), (28, 40)]
    assert not torch.equal(*images)
    across = [float((x.sum(0) * torch.arange(40)).sum() / x.sum()) for x in images]
    assert across[0] == pytest.approx(across[1], abs=0.3)  # px; half a pixel's shift would be seen
