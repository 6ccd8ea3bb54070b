"""What networks that predict fields of people have in common: they draw a person that they have
seen in images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.predict.fields.features import ImageEncoder, SourceFeatures
from dyngs.human.predict.fields.people import PosedBody, Sources

NEAR = 0.1  # Nearest distance that is drawn, m
CHUNK = 1 << 12  # Rays drawn together where nothing is learned


@dataclass(frozen=True)
class FieldPicture:
    """What a camera sees, (H, W, ...), before black."""

    colour: Tensor  # (H, W, 3)
    transmittance: Tensor  # (H, W)
    depth: Tensor  # (H, W) sum of weight times the distance along the ray, m
    samples: Sequence[Any] = ()  # what ``penalty`` needs


@dataclass(frozen=True)
class EncodedPerson:
    """A person, as a network knows it."""

    seen: SourceFeatures
    body: PosedBody
    own: Any  # what else the network has found out


class FieldNetwork(nn.Module, ABC):
    """A network that predicts a field of a person from images and a body."""

    needs_depth: ClassVar[bool] = False  # whether it is trained on depth maps

    def __init__(self, features: int) -> None:
        super().__init__()
        self.encoder = ImageEncoder(features)

    def look(self, sources: Sources, body: PosedBody) -> EncodedPerson:
        """Return what is known of a person; differentiable."""
        seen = SourceFeatures(sources, *self.encoder(sources.rgba))
        return EncodedPerson(seen, body, self.prepared(seen, body))

    @abstractmethod
    def prepared(self, seen: SourceFeatures, body: PosedBody) -> Any:
        """Return ``EncodedPerson.own``."""

    @abstractmethod
    def picture(
        self, known: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        """Return what one camera sees, in a world of metres; differentiable where gradients are
        enabled.

        ``generator`` places samples at random, as in training; None: evenly.
        """

    def penalty(self, picture: FieldPicture, image: Image, scale: float) -> Tensor:
        """Return what the loss has besides the error of the picture of ``image``.

        ``scale``: units of its depth map in a metre.
        """
        return picture.colour.new_zeros(())
