"""The background colour of training and evaluation."""

from __future__ import annotations

import torch
from torch import Tensor

_BACKGROUNDS = {"white": 1.0, "black": 0.0}


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
