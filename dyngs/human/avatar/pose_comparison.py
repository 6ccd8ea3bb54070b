"""What of a picture a pose is fitted to: all of it, or its silhouette alone.

Render and picture are both shrunk: drawn at a smaller size the same Gaussians look larger, because of the low-pass that
every Gaussian gets in pixels, and the fit ends elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from dyngs.data.loader import Picture
from dyngs.data.pictures.images import area_downscale
from dyngs.human.avatar.corrections import POSE_CM, POSE_WEIGHT
from dyngs.ops.loss import l1_ssim_loss
from dyngs.rendering import Rendering

SSIM_WEIGHT, ALPHA_WEIGHT = 0.2, 0.1
"""Of SSIM and of the mean error of alpha in the loss of whole pictures, as in training."""


@dataclass(frozen=True)
class Comparison:
    """How renders of a person are compared with pictures, and what keeps the pose near that given.

    Attributes:
        difference: the loss () between a rendering and a picture on a background (3,), with sides divided by a factor.
        turn_weight: of the mean squared rotation that is added to the joints, 1 / rad^2.
        shift_weight: of the mean squared translation that is added, 1 / m^2.
        views_to_turn: fewest pictures of one moment from which rotations are fitted; from fewer the translation is.
    """

    difference: Callable[[Rendering, Picture, Tensor, int], Tensor]
    turn_weight: float
    shift_weight: float = 0.0
    views_to_turn: int = 1


def difference_of_pictures(drawn: Rendering, picture: Picture, background: Tensor, shrink: int) -> Tensor:
    """Return 0.8 L1 + 0.2 (1 - SSIM) + 0.1 of the mean error of alpha ()."""
    rendered, truth, mask = drawn.rgb[0], picture.composite(background), picture.mask
    error = None if picture.alpha is None else (drawn.alpha[0] - picture.alpha)[..., None]
    if mask is not None:
        rendered, truth = rendered * mask[..., None], truth * mask[..., None]
        error = None if error is None else error * mask[..., None]
        mask = shrunk(mask[..., None], shrink)[..., 0]
    loss = l1_ssim_loss(shrunk(rendered, shrink), shrunk(truth, shrink), SSIM_WEIGHT, mask)
    return loss if error is None else loss + ALPHA_WEIGHT * shrunk(error, shrink).abs().mean()


def difference_of_silhouettes(drawn: Rendering, picture: Picture, background: Tensor, shrink: int) -> Tensor:
    """Return the squared error of alpha, over the area of the silhouette (); nothing else of the picture is looked at.

    Raises:
        ValueError: a picture without alpha.
    """
    if picture.alpha is None:
        raise ValueError(f"{picture.name}: has no silhouette")
    error, truth = drawn.alpha[0] - picture.alpha, picture.alpha
    if picture.mask is not None:
        error, truth = error * picture.mask, truth * picture.mask
    return shrunk(error[..., None], shrink).square().sum() / shrunk(truth[..., None], shrink).sum().clamp_min(1)


PICTURES = Comparison(difference_of_pictures, turn_weight=POSE_WEIGHT / POSE_CM**2)
SILHOUETTES = Comparison(difference_of_silhouettes, turn_weight=1.0, shift_weight=10.0, views_to_turn=2)
"""One view hides how far limbs reach towards the camera: rotations fitted to it look wrong from elsewhere."""


def shrunk(picture: Tensor, factor: int) -> Tensor:
    """Return the (H, W, C) picture with its sides divided by ``factor``, averaged over pixel areas."""
    if factor == 1:
        return picture
    height, width = (max(1, round(side / factor)) for side in picture.shape[:2])
    return area_downscale(picture, width, height)
