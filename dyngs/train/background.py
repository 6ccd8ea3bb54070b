"""Which colour lies behind the pictures."""

from __future__ import annotations

import torch
from torch import Tensor

_BACKGROUNDS = {"white": 1.0, "black": 0.0}


def evaluation_background(choice: str, has_alpha: bool) -> tuple[str, Tensor]:
    """Name and (3,) colour of the background to evaluate on: that of training, black where that was random.

    Args:
        choice: ``data.background`` of the config.
        has_alpha: of the capture; decides what "auto" means.
    """
    resolved = {"auto": "white" if has_alpha else "black", "random": "black"}.get(choice, choice)
    return resolved, torch.full((3,), _BACKGROUNDS[resolved])
