"""Training of a static scene: on every image, with its 3D filter kept up to date."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.scene import Moment, Scene
from dyngs.state import State
from dyngs.static.filters import filter_std
from dyngs.static.scene import StaticScene


class FilterUpdate:
    """Recomputation of Mip-Splatting's 3D filter at given steps.

    Args:
        cameras: the training cameras; none: there is no filter.
        steps: steps after which it is, besides those that change the set of Gaussians.
    """

    def __init__(self, cameras: Sequence[Cameras] = (), steps: range = range(0)) -> None:
        self.cameras, self.steps = cameras, steps

    def of(self, gaussians: Gaussians) -> Tensor | None:
        """Return the filter (N,) of the Gaussians; None where there is none."""
        return filter_std(gaussians.means, self.cameras) if self.cameras else None

    def is_due(self, step: int, edited: bool) -> bool:
        return bool(self.cameras) and (edited or step in self.steps)


class StaticTraining:
    """See ``SceneTraining``; nothing is learned beside the Gaussians and their colours."""

    moves_by = ("", "")

    def __init__(self, update: FilterUpdate) -> None:
        self._update = update

    def first_scene(self, gaussians: Gaussians) -> StaticScene:
        """Return the scene of the first Gaussians."""
        return StaticScene(gaussians=gaussians, filter_std=self._update.of(gaussians))

    def trains_on(self, time: float | None, step: int) -> bool:
        """Return true: every image, always."""
        return True

    def window(self, step: int) -> tuple[float, float]:
        """Return [0, 1]: all times, always."""
        return 0.0, 1.0

    def extend(self, scene: Scene, seen: tuple[float, float], step: int) -> None:
        """Do nothing: all times are trained on."""

    def moment(self, scene: Scene, image: Image, step: int) -> Moment:
        return scene.moment(image.time)

    def optimize(self, scene: Scene, step: int) -> int:
        """Return 0: the scene learns nothing beside its Gaussians."""
        return 0

    def learned(self, scene: Scene) -> None:
        """Return None, as ``optimize`` says."""

    def after_step(self, scene: StaticScene, step: int, edited: bool) -> StaticScene:
        if self._update.is_due(step, edited):
            return replace(scene, filter_std=self._update.of(scene.gaussians))
        return scene

    def revised(self, scene: Scene, step: int) -> tuple[Scene, EditResult] | None:
        """Return None: the set of Gaussians is left to the strategy."""
        return None

    def all_moving(self, scene: StaticScene, extent: float) -> StaticScene:
        """Return ``scene``: nothing moves."""
        return scene

    def follow(self, edit: TopologyEdit) -> None:
        """Do nothing: nothing is kept per Gaussian."""

    def restored(self, gaussians: Gaussians, tensors: Mapping[str, Tensor], like: Scene) -> StaticScene:
        scene = StaticScene.restored(gaussians, tensors)
        return replace(scene, colour=like.colour, options=like.options, background=like.background)

    def state(self) -> State:
        return {}
