"""Interface of what a trainer learns of single images: exposures, cameras, masks of what disagrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.models.renderable import Rendering
from dyngs.ops.adam import Count


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
    """What is learned of single images next to the scene.

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
