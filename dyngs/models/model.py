"""Models that a trainer steps, their loss terms, and corrections of single images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import RasterizeMode
from dyngs.core.state import State
from dyngs.data.loader import Image
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.renderable import Renderable, Rendering
from dyngs.ops.adam import Count

S_co = TypeVar("S_co", bound=Renderable, covariant=True)


def do_nothing() -> None:
    """Do nothing."""


@dataclass(frozen=True)
class RenderOutput:
    """A training image as a model draws it."""

    rendering: Rendering  # of the image's camera
    # differentiable regularizers of what was drawn, weighted, by name
    penalties: Mapping[str, Tensor] = field(default_factory=dict)
    # tensors that something learned has moved, by name: one that is not finite would not be drawn,
    # so that a diverging field could go unseen; empty: nothing was
    moved: Mapping[str, Tensor] = field(default_factory=dict)
    after_backward: Callable[[], None] = do_nothing  # takes in gradients once they are there
    # what the rendering is compared with where that is only some pixels of the image; None: the
    # whole image
    image: Image | None = None


@dataclass(frozen=True)
class UpdateResult:
    """Result of an update."""

    bad: Count = 0  # number of rows left out because their gradient was not finite
    finding: str | None = None  # lines about what was found out, or None
    # there are other rows now: several processes must have come to the same
    topology_changed: bool = False


class Model(ABC, Generic[S_co]):
    """A model in training: its scene and everything that training it keeps.

    Attributes:
        moves_by: name of what moves the scene, and the configuration section of its learning rates,
            for messages.
    """

    deformation_name: tuple[str, str] = ("", "")

    @property
    @abstractmethod
    def scene(self) -> S_co:
        """The scene in its current state."""

    @abstractmethod
    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        """Return how ``image`` is drawn in ``step`` before ``background`` (3,), differentiable."""

    @abstractmethod
    def update(self, step: int) -> UpdateResult:
        """Update the parameters by their gradients, then clear the gradients."""

    @property
    @abstractmethod
    def leaves(self) -> Sequence[Tensor]:
        """Tensors that receive gradients, in a fixed order."""

    @abstractmethod
    def state(self) -> State:
        """Return all tensors that resuming needs, by name, with their roles."""

    @abstractmethod
    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to where ``checkpoint`` was taken."""

    @abstractmethod
    def place(self, device: torch.device) -> None:
        """Move the model to ``device``."""

    @property
    def colour_loss(self) -> Loss | None:
        """How its colours are compared with true ones; None: by L1 and D-SSIM."""
        return None

    def regularizers(self) -> Mapping[str, Tensor]:
        return {}

    def tallies(self, step: int) -> Sequence[Tensor]:
        """Return what ``step`` has counted; processes that share it sum it in place."""
        return ()

    def trains_on(self, time: float | None, step: int) -> bool:
        """Return whether an image of ``time`` may be trained on in ``step``; at each step some
        may."""
        return True

    def is_held_out(self, index: int, step: int) -> bool:
        """Return whether training view ``index`` must not be trained on in ``step``."""
        return False

    def window(self, step: int) -> tuple[float, float]:
        """Return the first and last time that are trained on at ``step``."""
        return 0.0, 1.0

    def extend(self, seen: tuple[float, float], step: int) -> None:
        """Continue what was learned for the times in ``seen`` to those that are trained on at
        ``step``."""

    @property
    def rasterize_mode(self) -> RasterizeMode:
        """How other programs are to draw it."""
        return RasterizeMode.CLASSIC

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians; 0 where it is made of something else."""
        return 0

    @property
    def num_moving(self) -> int:
        return 0


@dataclass(frozen=True)
class LossInput:
    """A training image next to its rendering, for terms of the loss.

    Example:

        import dyngs

        def dark(look: dyngs.LossInput):
            return 0.01 * look.rendered.mean()

    Attributes:
        index: of the training view.
        step: from 1.
        image: what was trained on: ``dyngs.data.loader.Image`` with camera, alpha, and a mask of
            the pixels that count.
        drawn: the rendering with alpha and depth, and its regularizers.
        rendered, truth: (H, W, 3) that are compared, on the same background.
        model: the model in training; ``model.scene`` is its scene.
        generator: random numbers of the run.
    """

    index: int
    step: int
    image: Image
    drawn: RenderOutput
    rendered: Tensor
    truth: Tensor
    model: Model[Any]
    generator: torch.Generator


class Loss:
    """Terms of the loss."""

    def needs_depth(self, image: Image) -> bool:
        """Return whether ``image`` must be drawn with its depth."""
        return False

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        """Return differentiable scalars, weighted, by name."""
        raise NotImplementedError


@dataclass(frozen=True)
class RenderedView:
    """A training image next to its rendering, before the loss.

    Attributes:
        index: of the training view.
        rendered: (H, W, 3) that is compared with the image.
        draw: renders the scene from cameras at a time, with expected depth.
        trains_on: returns whether a training view is trained on in this step.
    """

    index: int
    step: int
    image: Image
    rendering: Rendering
    rendered: Tensor
    background: Tensor
    draw: Callable[[Cameras, float | None], Rendering]
    trains_on: Callable[[int], bool]


class Correction:
    """Parameters of single images, learned beside the scene (exposure, cameras, robust masks).

    Attributes:
        name: of its part in a checkpoint.
    """

    name: str

    def before_render(self, image: Image) -> Image:
        """Return the image whose camera the scene is rendered from."""
        return image

    def after_render(self, view: RenderedView) -> RenderedView:
        """Return the view with the image and the rendering that the loss compares."""
        return view

    def after_backward(self, index: int, step: int, image: Image) -> Count:
        """Update what is learned of an image; return the number of rows with bad gradients."""
        return 0

    def state(self) -> dict[str, Tensor]:
        """Return what a checkpoint stores."""
        raise NotImplementedError

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what ``state`` returned. Raises KeyError, or ValueError for other images."""
        raise NotImplementedError
