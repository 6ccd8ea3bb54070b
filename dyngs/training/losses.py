"""Loss terms of a training image: colours, silhouette, losses of the user; and their finiteness
check."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.errors import DyngsError
from dyngs.data.loader import Image
from dyngs.models.model import Loss, LossInput
from dyngs.ops.device import AsyncReadback, copy_async
from dyngs.ops.loss import l1_ssim_loss


class ImageLoss(Loss):
    """L1 and D-SSIM loss of the image, as in 3DGS."""

    def __init__(self, ssim_weight: float) -> None:
        self._ssim_weight = ssim_weight

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        return {
            "image": l1_ssim_loss(look.rendered, look.truth, self._ssim_weight, look.image.mask)
        }


class SilhouetteLoss(Loss):
    """Mean absolute error of alpha over unmasked pixels, for images with alpha.

    Args:
        weight: weight of the term from step ``full_from`` on.
        early: fraction of ``weight`` before that step.
    """

    def __init__(self, weight: float, early: float = 1.0, full_from: float = 0.0) -> None:
        self.weight = weight
        self.early = early
        self._full_from = full_from

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        if self.weight == 0 or look.image.alpha is None:
            return {}
        error = (look.drawn.rendering.alpha[0] - look.image.alpha).abs()
        if look.image.mask is not None:
            error = error * look.image.mask
        fraction = self.early if look.step < self._full_from else 1.0
        return {"alpha": fraction * self.weight * error.mean()}


LossFunction = Callable[[LossInput], Tensor]
"""A loss of the user: a differentiable scalar, weighted, of a training image and its rendering."""


class AddedLoss(Loss):
    """A loss of the user, which is added to those of dyngs.

    Attributes:
        name: in the config of the run and in messages: its number and the name of the function.
    """

    def __init__(self, number: int, function: LossFunction) -> None:
        self._function = function
        self.name = f"{number} {getattr(function, '__name__', type(function).__name__)}"

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        value = self._function(look)
        if not isinstance(value, Tensor) or value.ndim:
            shape = getattr(value, "shape", type(value).__name__)
            raise DyngsError(f"loss {self.name}: must return a scalar tensor, got {shape}")
        return {f"loss {self.name}": value}


def require_losses(config: Config, losses: Sequence[AddedLoss]) -> None:
    """Raise DyngsError unless ``losses`` are those that the run was started with."""
    given = tuple(loss.name for loss in losses)
    if given != config.train.losses:
        raise DyngsError(
            f"train.losses: the run has {list(config.train.losses)}, given were {list(given)}; "
            "pass the same again from Python: dyngs.train(resume=RUN, losses=[...])"
        )


class StepCheck:
    """Loss value of a step, with a check that all terms and deformed tensors are finite."""

    def __init__(
        self, terms: Mapping[str, Tensor], moved: Mapping[str, Tensor], device: torch.device
    ) -> None:
        self._terms = tuple(terms)
        self._moved = {name: x.detach() for name, x in moved.items() if x.numel()}
        numbers = [copy_async(x.detach(), device).double().reshape(1) for x in terms.values()]
        # A sum shows NaN and infinity and takes a thirtieth of the time of isfinite.
        numbers += [x.sum().double().reshape(1) for x in self._moved.values()]
        self._read = AsyncReadback(torch.cat(numbers))

    def loss(self, step: int, image: Image, deformation_name: tuple[str, str]) -> float:
        """Return the sum of the terms. Blocks until they are computed.

        Raises:
            DyngsError: a term or a deformed tensor is not finite.
        """
        numbers = self._read.numbers().tolist()
        values = numbers[: len(self._terms)]
        where = f"step {step}, view {image.name!r}"
        sums = numbers[len(self._terms) :]
        for (name, x), total in zip(self._moved.items(), sums, strict=True):
            # The sum of finite numbers may overflow.
            if not math.isfinite(total) and not bool(x.isfinite().all()):
                what, section = deformation_name
                raise DyngsError(
                    f"{where}: the {what} produced non-finite {name} at time {image.time or 0:g}; "
                    f"lower the learning rates in {section}"
                )
        for name, value in zip(self._terms, values, strict=True):
            if not math.isfinite(value):
                of_image = "check that image, or lower the learning rates in optim"
                what = of_image if name == "image" else "lower its weight or learning rate"
                raise DyngsError(f"{where}: loss term {name!r} is {value}; {what}")
        return sum(values)
