"""A scene's own render, looked at from a pose nearby, is found again."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import random_scene
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.metrics import psnr
from dyngs.static.scene import StaticScene
from dyngs.training.corrections.camera_fit import fitted_to_image
from dyngs.training.corrections.camera_refinement import corrected

BLACK, WRONG = torch.zeros(3), torch.tensor([0.01, -0.012, 0.008, 0.01, 0.008, -0.01])


def scene_and_image() -> tuple[StaticScene, Image]:
    """Return a scene and its render, with the camera that is right."""
    drawn = random_scene(n=60, views=1, size=(48, 40), seed=2).to(torch.float32)
    scene = StaticScene(gaussians=drawn.gaussians)
    rgb = scene.render(drawn.cameras, None, background=BLACK).rgb[0]
    return scene, Image("own", drawn.cameras, rgb, None, None, None)


def shown(scene: StaticScene, image: Image) -> Tensor:
    return scene.render(image.cameras, None, background=BLACK).rgb[0]


@pytest.mark.parametrize("left_only", [False, True])
def test_the_pose_of_a_render_is_found_again(left_only: bool) -> None:
    scene, right = scene_and_image()
    wrong = replace(right, cameras=corrected(right.cameras, WRONG, None, 3.0))
    weights = torch.zeros(40, 48) if left_only else None
    if weights is not None:
        weights[:, :24] = 1
    found = fitted_to_image(scene, wrong, BLACK, 3.0, weights=weights)
    before, after = (psnr(shown(scene, x), right.rgb_premultiplied) for x in (wrong, found))
    assert after > before + 10
    assert torch.equal(found.cameras.intrinsics, right.cameras.intrinsics)


def test_a_pose_that_is_right_stays_and_the_scene_collects_no_gradients() -> None:
    scene, right = scene_and_image()
    for tensor in scene.gaussians.tensors().values():
        tensor.requires_grad_()
    found = fitted_to_image(scene, right, BLACK, 3.0)
    assert torch.equal(found.cameras.cam_from_world, right.cameras.cam_from_world)
    assert all(tensor.grad is None for tensor in scene.gaussians.tensors().values())
