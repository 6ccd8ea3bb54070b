"""The strategy of a set of Gaussians that is final: nothing is added or removed."""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.gaussians import EditResult, Gaussians


class FixedDensifier:
    """A ``Densifier`` that changes nothing."""

    touches_all = False

    def wants_signal(self, step: int) -> bool:
        return False

    def after_backward(self, step: int, probe_grad: Tensor, radii: Tensor, size: tuple[int, int]) -> None:
        return None

    def tallies(self, step: int, count: int) -> list[Tensor]:
        return []

    def edit(self, step: int, parameters: Gaussians, generator: torch.Generator) -> EditResult | None:
        return None

    def regularizers(self, parameters: Gaussians) -> dict[str, Tensor]:
        return {}

    def perturb(self, parameters: Gaussians, lr_means: float, generator: torch.Generator) -> None:
        return None

    def place(self, device: torch.device) -> None:
        return None

    def limit(self, max_gaussians: int) -> None:
        return None

    def state(self) -> dict[str, Tensor]:
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:
        return None
