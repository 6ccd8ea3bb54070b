"""The value of the loss, and whether it and what was drawn are finite: read at once, while a GPU goes on."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.errors import DyngsError
from dyngs.ops.device import ReadBack, sent


class StepCheck:
    """The loss of a step, term by term, and whether what was drawn is finite."""

    def __init__(self, terms: Mapping[str, Tensor], moved: Mapping[str, Tensor], device: torch.device) -> None:
        self._terms, self._parts = tuple(terms), tuple(moved)
        numbers = [sent(x.detach(), device).double() for x in terms.values()]
        numbers += [x.detach().isfinite().all().double() for x in moved.values()]
        self._read = ReadBack(torch.stack(numbers))

    def loss(self, step: int, image: Image, moves_by: tuple[str, str]) -> float:
        """Return the sum of the terms; waits for them."""
        numbers = self._read.numbers().tolist()
        values, finite = numbers[: len(self._terms)], numbers[len(self._terms) :]
        broken = [name for name, is_finite in zip(self._parts, finite, strict=True) if not is_finite]
        where = f"step {step}, view {image.name!r}"
        if broken:
            what, section = moves_by
            raise DyngsError(
                f"{where}: the {what} makes {', '.join(broken)} at {image.time or 0:g} not finite; lower the rates "
                f"in {section}"
            )
        for name, value in zip(self._terms, values, strict=True):
            if not math.isfinite(value):
                of_image = "look at that image; lower the rates in optim"
                what = of_image if name == "image" else "lower its weight or rate"
                raise DyngsError(f"{where}: the loss term {name!r} is {value}; {what}")
        return sum(values)
