"""What networks that predict fields of people have in common: they draw a person that they have
seen in images."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from dyngs.core.camera import Cameras
from dyngs.core.initialisation import glorot
from dyngs.data.loader import Image
from dyngs.human.predict.people import PosedBody, Sources
from dyngs.models.prediction import Encoder, initialize_weights, upsample
from dyngs.ops.perceptron import Layer, perceptron

FINE = 8
"""Features of a pixel at half the resolution, next to those at a quarter."""
_BEHIND = 1e-3  # Least depth of a point, m: what is nearer is not seen
_CLEAR = 1e-2  # Alpha below which a pixel has no colour


class Perceptron(nn.Module):
    """Layers of ``widths`` features with a ReLU between them, over rows."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise(widths))

    def forward(self, x: Tensor) -> Tensor:
        layers = [Layer(layer.weight, layer.bias) for layer in self.layers]  # pyright: ignore[reportArgumentType]
        rows = perceptron(x.flatten(0, -2), layers)
        return rows.view(*x.shape[:-1], rows.shape[-1])


class ImageEncoder(nn.Module):
    """Features of images (V, 4, H, W): ``features`` (V, C, H/4, W/4) that know their surroundings,
    and fine ones."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.levels = Encoder(4, (16, 32, 48))
        self.fuse = nn.Sequential(
            nn.Conv2d(80, features, 3, padding=1), nn.SiLU(), nn.Conv2d(features, features, 1)
        )
        self.fine = nn.Conv2d(16, FINE, 3, padding=1)

    def forward(self, rgba: Tensor) -> tuple[Tensor, Tensor]:
        half, quarter, eighth = self.levels(rgba)
        return self.fuse(torch.cat([quarter, upsample(eighth)], 1)), self.fine(half)


@dataclass(frozen=True)
class PointFeatures:
    """What V images show at M points."""

    features: Tensor  # (V, M, C + FINE)
    rgb: Tensor  # (V, M, 3) straight colours
    alpha: Tensor  # (V, M), 0 beside the image


@dataclass(frozen=True)
class SourceFeatures:
    """Images with their features."""

    sources: Sources
    coarse: Tensor  # (V, C, H/4, W/4)
    fine: Tensor  # (V, FINE, H/2, W/2)

    def look(self, points: Tensor) -> PointFeatures:
        """Return what the images show at points (M, 3); differentiable in the features."""
        grid, _ = self.projected(points)
        rgba = at_pixels(self.sources.rgba, grid)
        features = torch.cat([at_pixels(self.coarse, grid), at_pixels(self.fine, grid)], -1)
        return PointFeatures(
            features, rgba[..., :3] / rgba[..., 3:].clamp_min(_CLEAR), rgba[..., 3]
        )

    def alpha(self, points: Tensor) -> Tensor:
        """Return the opacities (V, M) of points (M, 3) in the images, 0 beside them."""
        return at_pixels(self.sources.rgba[:, 3:], self.projected(points)[0])[..., 0]

    def projected(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return where the images show points (M, 3), (V, M, 2) in [-1, 1] within the image, and their
        depth (V, M)."""
        sources = self.sources
        pose = sources.cam_from_world
        local = points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
        depth = local[..., 2]
        pixels = (local @ sources.intrinsics.mT)[..., :2] / depth.clamp_min(_BEHIND)[..., None]
        height, width = sources.rgba.shape[2:]
        grid = 2 * pixels / pixels.new_tensor([width, height]) - 1
        return torch.where(depth[..., None] > _BEHIND, grid, 2.0).clamp(-2, 2), depth


def at_pixels(maps: Tensor, grid: Tensor, mode: str = "bilinear") -> Tensor:
    """Return (V, M, D) values of maps (V, D, h, w) at places (V, M, 2) in [-1, 1], 0 beside
    them."""
    found = grid_sample(maps, grid[:, None], mode=mode, padding_mode="zeros", align_corners=False)
    return found[:, :, 0].mT


def begin(network: nn.Module, generator: torch.Generator) -> None:
    """Draw all weights from ``generator``, on the CPU; biases are 0."""
    initialize_weights(network, generator)
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            with torch.no_grad():
                layer.weight.copy_(glorot(layer.in_features, layer.out_features, generator))
                layer.bias.zero_()


def mean_and_variance(values: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return (M, 2 D): mean and variance over views of values (V, M, D) with weights (V, M) that
    sum to 1."""
    if weights is None:
        weights = values.new_full((len(values), 1), 1 / len(values))
    share = weights[..., None]
    mean = (share * values).sum(0)
    return torch.cat([mean, (share * (values - mean).square()).sum(0)], -1)


def between(directions: Tensor, points: Tensor, centers: Tensor) -> Tensor:
    """Return (V, M, 4): how the directions (M, 3) of rays differ from those of the images to points
    (M, 3).

    The difference of the two unit vectors, and their product. ``centers`` (V, 3) of the cameras.
    """
    theirs = torch.nn.functional.normalize(points - centers[:, None], dim=-1)
    apart = torch.nn.functional.normalize(directions - theirs, dim=-1)
    return torch.cat([apart, (directions * theirs).sum(-1, keepdim=True)], -1)


def blended(logits: Tensor, colours: Tensor) -> Tensor:
    """Return (M, 3) colours of V images (V, M, 3), weighted by the softmax of ``logits`` (V, M)."""
    return (logits.softmax(0)[..., None] * colours).sum(0)


def split_rays(rays: Tensor) -> Sequence[Tensor]:
    """Return the indices of rays that are drawn together: all where something is learned."""
    return [rays] if torch.is_grad_enabled() else rays.split(CHUNK)


def sample_offsets(*shape: int, generator: torch.Generator | None) -> Tensor:
    """Return where samples lie in their part of a ray, in [0, 1): at random, or in the middle."""
    if generator is None:
        return torch.full(shape, 0.5, device="cpu")
    return torch.rand(shape, generator=generator, device="cpu")


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
