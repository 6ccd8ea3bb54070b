"""What networks that predict fields of people have in common: they draw a person that they have
seen in images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.predict.fields.features import ImageEncoder, Seen
from dyngs.human.predict.fields.people import Body, Sources

NEAR = 0.1  # Nearest distance that is drawn, m
CHUNK = 1 << 12  # Rays drawn together where nothing is learned


@dataclass(frozen=True)
class Picture:
    """What a camera sees, (H, W, ...), before black."""

    colour: Tensor  # (H, W, 3)
    transmittance: Tensor  # (H, W)
    depth: Tensor  # (H, W) sum of weight times the distance along the ray, m
    samples: Sequence[Any] = ()  # what ``penalty`` needs


@dataclass(frozen=True)
class Known:
    """A person, as a network knows it."""

    seen: Seen
    body: Body
    own: Any  # what else the network has found out


class FieldNetwork(nn.Module, ABC):
    """A network that predicts a field of a person from images and a body."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.encoder = ImageEncoder(features)

    @property
    def needs_depth(self) -> bool:
        """Whether it is trained on depth maps."""
        return False

    def look(self, sources: Sources, body: Body) -> Known:
        """Return what is known of a person; differentiable."""
        seen = Seen(sources, *self.encoder(sources.rgba))
        return Known(seen, body, self.prepared(seen, body))

    @abstractmethod
    def prepared(self, seen: Seen, body: Body) -> Any:
        """Return ``Known.own``."""

    @abstractmethod
    def picture(
        self, known: Known, camera: Cameras, generator: torch.Generator | None = None
    ) -> Picture:
        """Return what one camera sees, in a world of metres; differentiable where gradients are
        enabled.

        ``generator`` places samples at random, as in training; None: evenly.
        """

    def penalty(self, picture: Picture, image: Image, scale: float) -> Tensor:
        """Return what the loss has besides the error of the picture of ``image``.

        ``scale``: units of its depth map in a metre.
        """
        return picture.colour.new_zeros(())
