"""What can be drawn: anything trained, of whatever kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from torch import Tensor

from dyngs.camera import Cameras
from dyngs.colour.network import ColourNetwork
from dyngs.gaussians import Gaussians
from dyngs.rendering import Rendering, RenderOptions, Shader, render


class Scene(Protocol):
    """Gaussians at any time, as ``TrainedScene`` and ``AvatarScene``."""

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
        """How many numbers are stored beside the Gaussians and their colours."""
        ...

    @property
    def colour(self) -> ColourNetwork | None:
        """What colours them; None: their harmonics."""
        ...

    def __len__(self) -> int: ...

    def at(self, time: float | None) -> Gaussians:
        """The N Gaussians at ``time``, clamped; None is the first moment."""
        ...

    def shader_at(self, time: float | None) -> Shader | None:
        """What colours the Gaussians of ``at(time)``; None: their harmonics."""
        ...

    def part(self, which: Literal["moving", "still"]) -> Scene:
        """Only the Gaussians that move, or only those that do not."""
        ...


def num_colour_values(scene: Scene) -> int:
    """How many numbers the colours take: base, network, and harmonics but for Gaussians that have none but zeros."""
    sh = scene.gaussians.sh
    with_rest = int((sh[:, 1:] != 0).flatten(1).any(1).sum())
    network = 0 if scene.colour is None else scene.colour.num_values
    return 3 * len(sh) + 3 * (sh.shape[1] - 1) * with_rest + network


@dataclass(frozen=True)
class Moment:
    """A scene at one time: what cameras see."""

    gaussians: Gaussians
    shader: Shader | None = None

    def seen_by(self, cameras: Cameras, options: RenderOptions, background: Tensor | None = None) -> Rendering:
        """Pictures of it, as ``render`` makes them."""
        return render(self.gaussians, cameras, options, background=background, shader=self.shader)


def moment_of(scene: Scene, time: float | None) -> Moment:
    """``scene`` at ``time``, clamped; None is the first moment."""
    return Moment(scene.at(time), scene.shader_at(time))
