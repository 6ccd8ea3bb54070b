"""What of an image a pose is fitted to: all of it, or its silhouette alone.

Render and image are both shrunk: drawn at a smaller size the same Gaussians look larger, because of the low-pass that
every Gaussian gets in pixels, and the fit ends elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from dyngs.data.images.images import area_downscale
from dyngs.data.loader import Image
from dyngs.human.avatar.corrections import POSE_CM, POSE_WEIGHT
from dyngs.models.renderable import Rendering
from dyngs.ops.loss import l1_ssim_loss

SSIM_WEIGHT, ALPHA_WEIGHT = 0.2, 0.1
"""Of SSIM and of the mean error of alpha in the loss of whole images, as in training."""


@dataclass(frozen=True)
class Comparison:
    """How renders of a person are compared with images, and what keeps the pose near that given.

    Attributes:
        difference: the loss () between a rendering and an image on a background (3,), with sides divided by a factor.
        turn_weight: of the mean squared rotation that is added to the joints, 1 / rad^2.
        shift_weight: of the mean squared translation that is added, 1 / m^2.
        views_to_turn: fewest images of one moment from which rotations are fitted; from fewer the translation is.
    """

    difference: Callable[[Rendering, Image, Tensor, int], Tensor]
    turn_weight: float
    shift_weight: float = 0.0
    views_to_turn: int = 1


def difference_of_images(drawn: Rendering, image: Image, background: Tensor, shrink: int) -> Tensor:
    """Return 0.8 L1 + 0.2 (1 - SSIM) + 0.1 of the mean error of alpha ()."""
    rendered, truth, mask = drawn.rgb[0], image.composite(background), image.mask
    error = None if image.alpha is None else (drawn.alpha[0] - image.alpha)[..., None]
    if mask is not None:
        rendered, truth = rendered * mask[..., None], truth * mask[..., None]
        error = None if error is None else error * mask[..., None]
        mask = shrunk(mask[..., None], shrink)[..., 0]
    loss = l1_ssim_loss(shrunk(rendered, shrink), shrunk(truth, shrink), SSIM_WEIGHT, mask)
    return loss if error is None else loss + ALPHA_WEIGHT * shrunk(error, shrink).abs().mean()


def difference_of_silhouettes(drawn: Rendering, image: Image, background: Tensor, shrink: int) -> Tensor:
    """Return the squared error of alpha, over the area of the silhouette (); nothing else of the image is looked at.

    Raises:
        ValueError: an image without alpha.
    """
    if image.alpha is None:
        raise ValueError(f"{image.name}: has no silhouette")
    error, truth = drawn.alpha[0] - image.alpha, image.alpha
    if image.mask is not None:
        error, truth = error * image.mask, truth * image.mask
    return shrunk(error[..., None], shrink).square().sum() / shrunk(truth[..., None], shrink).sum().clamp_min(1)


IMAGES = Comparison(difference_of_images, turn_weight=POSE_WEIGHT / POSE_CM**2)
SILHOUETTES = Comparison(difference_of_silhouettes, turn_weight=1.0, shift_weight=10.0, views_to_turn=2)
"""One view hides how far limbs reach towards the camera: rotations fitted to it look wrong from elsewhere."""


def shrunk(image: Tensor, factor: int) -> Tensor:
    """Return the (H, W, C) image with its sides divided by ``factor``, averaged over pixel areas."""
    if factor == 1:
        return image
    height, width = (max(1, round(side / factor)) for side in image.shape[:2])
    return area_downscale(image, width, height)
