"""What can be drawn: anything trained, of whatever kind."""

from __future__ import annotations

from typing import Literal, Protocol

from torch import Tensor

from dyngs.gaussians import Gaussians


class Scene(Protocol):
    """Gaussians at any time, as ``dyngs.deform.trained.TrainedScene`` and ``dyngs.human.trained.AvatarScene``."""

    @property
    def gaussians(self) -> Gaussians:
        """The N Gaussians that are stored."""
        ...

    @property
    def rows(self) -> Tensor:
        """(M,) indices of those that move, ascending."""
        ...

    @property
    def times(self) -> tuple[float, ...]:
        """Distinct moments of training, or of the clip that is played, in [0, 1], ascending."""
        ...

    @property
    def is_still(self) -> bool:
        """``at`` returns the same at every time."""
        ...

    @property
    def moving_share(self) -> float:
        """M / N, 0 where nothing moves."""
        ...

    @property
    def num_field_values(self) -> int:
        """How many numbers are stored beside the Gaussians."""
        ...

    def __len__(self) -> int: ...

    def at(self, time: float | None) -> Gaussians:
        """The N Gaussians at ``time``, clamped; None is the first moment."""
        ...

    def part(self, which: Literal["moving", "still"]) -> Scene:
        """Only the Gaussians that move, or only those that do not."""
        ...
