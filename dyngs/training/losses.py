"""Terms of the loss of a training image: its colours, its silhouette, and what the model itself asks for."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from dyngs.models.model import Look, Loss
from dyngs.ops.loss import l1_ssim_loss


class ImageLoss(Loss):
    """L1 and D-SSIM of the image (3DGS)."""

    def __init__(self, ssim_weight: float) -> None:
        self._ssim_weight = ssim_weight

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        return {"image": l1_ssim_loss(look.rendered, look.truth, self._ssim_weight, look.image.mask)}


class SilhouetteLoss(Loss):
    """Mean error of alpha, where the images have any.

    Args:
        masked: only pixels that count in the image do so here.
    """

    def __init__(self, weight: float, *, masked: bool) -> None:
        self.weight, self._masked = weight, masked

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        if self.weight == 0 or look.image.alpha is None:
            return {}
        error = (look.drawn.rendering.alpha[0] - look.image.alpha).abs()
        if self._masked and look.image.mask is not None:
            error = error * look.image.mask
        return {"alpha": self.weight * error.mean()}


class PenaltyLoss(Loss):
    """Regularizers of what was drawn."""

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        return look.drawn.penalties


class RegularizerLoss(Loss):
    """Regularizers of the model, whatever is drawn."""

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        return look.model.regularizers()
