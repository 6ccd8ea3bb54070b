"""The static model as the trainer sees it: parameters in, Gaussians to draw out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from torch import Tensor

from dyngs.camera import Cameras
from dyngs.colour.network import Frame
from dyngs.gaussians import Gaussians
from dyngs.static.densify import EditResult
from dyngs.static.filters import filter_std, fuse_filter


@dataclass(frozen=True)
class Drawn:
    """What a model draws for a picture.

    Attributes:
        gaussians: differentiable in the parameters.
        penalties: differentiable regularizers, weighted, by name.
        frame: where they are at rest, if colours should follow a body.
    """

    gaussians: Gaussians
    penalties: dict[str, Tensor] = field(default_factory=dict)
    frame: Frame | None = None


class StaticScene:
    """The same Gaussians at every time, filtered in 3D if cameras to filter for are given.

    Attributes:
        refresh_steps: steps after which the filter is recomputed, besides those that change the set.
    """

    def __init__(self, filter_cameras: Sequence[Cameras] = (), refresh_steps: range = range(0)) -> None:
        self.refresh_steps = refresh_steps
        self._cameras = filter_cameras
        self._filter_std: Tensor | None = None

    def trains_on(self, time: float | None, step: int) -> bool:
        """Every picture, always."""
        return True

    def gaussians_at(self, parameters: Gaussians, batch: object, step: int) -> Drawn:
        """What is drawn; ``batch`` and ``step`` are of no matter here."""
        if self._cameras and (self._filter_std is None or len(self._filter_std) != len(parameters)):
            self._filter_std = filter_std(parameters.means, self._cameras)
        return Drawn(self.filtered(parameters))

    def filtered(self, gaussians: Gaussians, rows: Tensor | None = None) -> Gaussians:
        """What is drawn of the Gaussians, or, where ``rows`` (A,) are given, of those A; the filter as it was last."""
        if self._filter_std is None:
            return gaussians
        return fuse_filter(gaussians, self._filter_std if rows is None else self._filter_std[rows])

    def after_step(self, parameters: Gaussians, step: int, result: EditResult | None) -> int:
        """Bring what depends on the parameters up to date; nothing of its own is optimized, so 0 is returned."""
        if self._cameras and (result is not None or step in self.refresh_steps):
            self._filter_std = filter_std(parameters.means, self._cameras)
        return 0

    def edit(self, parameters: Gaussians, step: int) -> EditResult | None:
        """The set of Gaussians is left to the strategy."""
        return None

    def num_moving(self, num_gaussians: int) -> int:
        """None of them moves."""
        return 0

    def state(self) -> dict[str, Tensor]:
        return {} if self._filter_std is None else {"filter_std": self._filter_std}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._filter_std = state.get("filter_std")
