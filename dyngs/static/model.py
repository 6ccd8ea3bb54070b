"""The static model as the trainer sees it: parameters in, Gaussians to draw out."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from dyngs.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.static.filters import filter_std, fuse_filter


class StaticScene:
    """The same Gaussians at every time, filtered in 3D if cameras to filter for are given.

    Attributes:
        refresh_steps: steps after which the filter is recomputed, besides those that change the set.
    """

    def __init__(self, filter_cameras: Sequence[Cameras] = (), refresh_steps: range = range(0)) -> None:
        self.refresh_steps = refresh_steps
        self._cameras = filter_cameras
        self._filter_std: Tensor | None = None

    def gaussians_at(self, parameters: Gaussians, batch: object) -> Gaussians:
        """What is drawn for ``batch``, which is of no matter here; differentiable in ``parameters``."""
        if not self._cameras:
            return parameters
        if self._filter_std is None or len(self._filter_std) != len(parameters):
            self._filter_std = filter_std(parameters.means, self._cameras)
        return fuse_filter(parameters, self._filter_std)

    def after_step(self, parameters: Gaussians, step: int, *, edited: bool) -> None:
        """Bring what depends on the parameters up to date."""
        if self._cameras and (edited or step in self.refresh_steps):
            self._filter_std = filter_std(parameters.means, self._cameras)

    def state(self) -> dict[str, Tensor]:
        return {} if self._filter_std is None else {"filter_std": self._filter_std}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._filter_std = state.get("filter_std")
