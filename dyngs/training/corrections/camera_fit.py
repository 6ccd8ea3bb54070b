"""The pose from which a scene looks most like an image, found from one nearby (iNeRF, Yen-Chen et al. 2021)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianScene
from dyngs.ops.adam import adam_step_
from dyngs.ops.loss import l1_ssim_loss
from dyngs.training.corrections.camera_refinement import corrected, slopes, watched

UPDATES = 60
FIRST_RATE, LAST_RATE = 2e-3, 1e-4  # Learning rates, rad, and as a fraction of the scene's size; log-linear between
SSIM_WEIGHT = 0.2


def fitted_to_image(
    scene: GaussianScene,
    image: Image,
    background: Tensor,
    size: float,
    *,
    options: RenderOptions | None = None,
    weights: Tensor | None = None,
) -> Image:
    """Return ``image`` with its camera moved to where the scene looks most like it; the lens stays."""
    options, truth = options or scene.options, image.composite(background)
    counts = image.mask if weights is None or image.mask is None else weights * image.mask
    counts = weights if counts is None else counts
    correction = torch.zeros(1, 6, device=image.cameras.cam_from_world.device)
    first, second = torch.zeros_like(correction), torch.zeros_like(correction)
    best, least = correction.clone(), float("inf")
    for update in range(1, UPDATES + 1):
        camera = watched(corrected(image.cameras, correction[0], None, size))
        with torch.enable_grad():
            rendered = scene.render(camera, image.time, options=options, background=background).rgb[0]
            loss = l1_ssim_loss(rendered, truth, SSIM_WEIGHT, counts)
            by_pose, by_intrinsics = torch.autograd.grad(loss, [camera.cam_from_world, camera.intrinsics])
        if float(loss.detach()) < least:
            best, least = correction.clone(), float(loss.detach())
        rate = FIRST_RATE * (LAST_RATE / FIRST_RATE) ** (update / UPDATES)
        adam_step_(
            correction, slopes(camera, by_pose, by_intrinsics, size)[0][None], first, second, lr=rate, step=update
        )
    return replace(image, cameras=corrected(image.cameras, best[0], None, size))
