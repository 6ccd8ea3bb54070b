"""The background colour of training and evaluation, and silhouettes where it hides things of its own colour."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.data.loader import Picture

_BACKGROUNDS = {"white": 1.0, "black": 0.0}
OPAQUE = 0.99
"""Alpha from which a pixel shows no background."""
ALIKE = 0.1
"""Largest difference of a channel up to which a colour counts as that of the background."""
MANY_ALIKE = 0.05
"""Share of the opaque pixels of the background's colour from which silhouettes are trained on: with 0.12 (orbits) the
whole picture gains 0.8 dB, with 0 (flag) nothing; in between nothing was measured."""
WEIGHT = 0.1
"""Weight of the mean error of alpha there."""
PICTURES = 12
"""Number of pictures in which colours are compared with the background."""


@dataclass(frozen=True)
class AlphaWeight:
    """Weight of the mean error of alpha in the loss.

    Attributes:
        weight: 0 or more.
        finding: a line about why, if that was measured.
    """

    weight: float = 0.0
    finding: str | None = None


def measured_alpha_weight(pictures: Iterable[Picture], background: Tensor) -> AlphaWeight:
    """Return the weight of the mean error of alpha that suits ``pictures`` on the colour ``background`` (3,)."""
    share = share_alike(pictures, background)
    if share is None:
        return AlphaWeight()
    uses = share >= MANY_ALIKE
    text = f"{share:.1%} of the opaque pixels have nearly the background's colour: " + (
        f"silhouettes count, too (train.alpha_weight={WEIGHT:g})" if uses else "silhouettes are not needed"
    )
    return AlphaWeight(WEIGHT if uses else 0.0, text)


def share_alike(pictures: Iterable[Picture], background: Tensor) -> float | None:
    """Return the share of the opaque pixels whose channels all differ from ``background`` (3,) by ``ALIKE`` or less.

    None where there are no opaque pixels beside a background. Masked pixels do not count.
    """
    opaque, alike, shows_background = 0, 0, False
    for picture in pictures:
        if picture.alpha is None:
            continue
        shows_background |= bool((picture.alpha < OPAQUE).any())
        counts = picture.alpha >= OPAQUE
        if picture.mask is not None:
            counts &= picture.mask > 0
        colours = picture.rgb_premultiplied[counts] / picture.alpha[counts][:, None]
        opaque += len(colours)
        alike += int(((colours - background).abs() <= ALIKE).all(1).sum())
    return alike / opaque if opaque and shows_background else None


def evaluation_background(choice: str, has_alpha: bool) -> tuple[str, Tensor]:
    """Return the name and (3,) colour of the background to evaluate on: that of training, black where that was random.

    Args:
        choice: ``data.background`` of the config.
        has_alpha: of the capture; decides what "auto" means.
    """
    resolved = {"auto": "white" if has_alpha else "black", "random": "black"}.get(choice, choice)
    return resolved, torch.full((3,), _BACKGROUNDS[resolved], device="cpu")


def background_colour(name: str, generator: torch.Generator | None = None) -> Tensor:
    """Return the (3,) colour of a "white", "black" or "random" background; a random one without generator is black."""
    if name == "random" and generator is not None:
        return torch.rand(3, generator=generator, device="cpu")
    return torch.full((3,), _BACKGROUNDS["black" if name == "random" else name], device="cpu")
