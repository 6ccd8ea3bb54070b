"""Common parts of networks that predict radiance fields of people.

Symbols: V images, M points, P rays of a camera, C features, D values per point.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.predict.kind import FieldKeys
from dyngs.human.predict.people import PosedBody, Sources, sample_maps
from dyngs.models.prediction import Encoder, initialize_weights, upsample
from dyngs.models.volume import camera_rays
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.rays import Rays

FINE = 8
"""Features per pixel at half resolution, next to the coarse ones at a quarter."""
_MIN_DEPTH = 1e-3  # points nearer to a camera are not visible, m
_MIN_ALPHA = 1e-2  # limits the division that undoes premultiplied alpha


class Perceptron(nn.Module):
    """MLP with layers of ``widths`` features and ReLU between them, applied to rows."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(i, o) for i, o in pairwise(widths))

    def forward(self, x: Tensor) -> Tensor:
        layers = [Layer(layer.weight, layer.bias) for layer in self.layers]  # pyright: ignore[reportArgumentType]
        return perceptron(x.flatten(0, -2), layers).unflatten(0, x.shape[:-1])


class ImageEncoder(nn.Module):
    """Encodes images (V, 4, H, W) to coarse (V, C, H/4, W/4) and fine (V, FINE, H/2, W/2)
    features."""

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
    """Pixel-aligned features of M points in V images."""

    features: Tensor  # (V, M, C + FINE)
    rgb: Tensor  # (V, M, 3) straight colours
    alpha: Tensor  # (V, M), 0 outside the image
    grid: Tensor  # (V, M, 2) and depth (V, M), see ``SourceFeatures.project``
    depth: Tensor

    @property
    def colours(self) -> Tensor:
        """Colours and fine features (V, M, 3 + FINE)."""
        return torch.cat([self.rgb, self.features[..., -FINE:]], -1)

    @property
    def coverage(self) -> Tensor:
        """Smallest and mean alpha over the images (M, 2)."""
        return torch.stack([self.alpha.amin(0), self.alpha.mean(0)], -1)


@dataclass(frozen=True)
class SourceFeatures:
    """Input images with their feature maps."""

    sources: Sources
    coarse: Tensor  # (V, C, H/4, W/4)
    fine: Tensor  # (V, FINE, H/2, W/2)

    def sample(self, points: Tensor) -> PointFeatures:
        """Sample images and features at points (M, 3); differentiable in the features."""
        grid, depth = self.project(points)
        rgba = sample_maps(self.sources.rgba, grid)
        # Convolutions with stride s centre feature i on pixel s i: half of s - 1 px before the
        # middle of the pixels that a map of 1/s of the resolution is sampled as.
        pixel = 1 / grid.new_tensor(self.sources.rgba.shape[:1:-1])
        features = [
            sample_maps(self.coarse, grid + 3 * pixel),
            sample_maps(self.fine, grid + pixel),
        ]
        return PointFeatures(
            torch.cat(features, -1),
            rgba[..., :3] / rgba[..., 3:].clamp_min(_MIN_ALPHA),
            rgba[..., 3],
            grid,
            depth,
        )

    def alpha(self, points: Tensor) -> Tensor:
        """Return the alpha (V, M) of points (M, 3) in the images, 0 outside."""
        return sample_maps(self.sources.rgba[:, 3:], self.project(points)[0])[..., 0]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project points (M, 3); return positions (V, M, 2) in [-1, 1] within the image, and
        depths (V, M)."""
        sources = self.sources
        pose = sources.cam_from_world
        local = points @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
        depth = local[..., 2]
        pixels = (local @ sources.intrinsics.mT)[..., :2] / depth.clamp_min(_MIN_DEPTH)[..., None]
        grid = 2 * pixels / pixels.new_tensor(sources.rgba.shape[:1:-1]) - 1
        return torch.where(depth[..., None] > _MIN_DEPTH, grid, 2.0).clamp(-2, 2), depth

    def relative_directions(self, directions: Tensor, points: Tensor) -> Tensor:
        """Return ray directions relative to those of the images (V, M, 4).

        The normalised difference and the dot product of ray directions (M, 3) and directions from
        the cameras to ``points`` (M, 3).
        """
        from_images = normalize(points - self.sources.cameras.centers[:, None], dim=-1)
        difference = normalize(directions - from_images, dim=-1)
        return torch.cat([difference, (directions * from_images).sum(-1, keepdim=True)], -1)


def initialize_network(network: nn.Module, generator: torch.Generator) -> None:
    """Initialise all weights from ``generator`` on the CPU (linear layers: Glorot and Bengio 2010);
    biases are 0."""
    initialize_weights(network, generator)
    for layer in network.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)


def mean_over_views(values: Tensor, weights: Tensor) -> Tensor:
    """Return the mean (M, D) over views of values (V, M, D), with weights (V, M) that sum to 1."""
    return (weights[..., None] * values).sum(0)


def mean_and_variance(values: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return mean and variance (M, 2 D) over views; None: all weights are equal."""
    if weights is None:
        variance, mean = torch.var_mean(values, 0, correction=0)
    else:
        mean = mean_over_views(values, weights)
        variance = mean_over_views((values - mean).square(), weights)
    return torch.cat([mean, variance], -1)


def view_weights(
    network: Perceptron, inputs: list[Tensor], excluded: Tensor | float = 0.0
) -> Tensor:
    """Return weights (V, M) of the views that sum to 1.

    ``network`` predicts their logits from ``inputs`` (V, M, D); ``excluded`` (V, M) is subtracted.
    """
    return (network(torch.cat(inputs, -1))[..., 0] - excluded).softmax(0)


def sample_offsets(*shape: int, generator: torch.Generator | None) -> Tensor:
    """Return sample positions within ray segments, in [0, 1): random with a generator, else 0.5."""
    if generator is None:
        return torch.full(shape, 0.5, device="cpu")
    return torch.rand(shape, generator=generator, device="cpu")


NEAR = 0.1  # near plane, m
CHUNK = 1 << 10  # rays rendered together without gradients


@dataclass(frozen=True)
class FieldPicture:
    """Rendered image before the background is added."""

    colour: Tensor  # (H, W, 3)
    transmittance: Tensor  # (H, W)
    depth: Tensor  # (H, W) expected distance along the ray times alpha, m
    samples: Sequence[Any] = ()  # intermediate results for ``penalty``


@dataclass(frozen=True)
class EncodedPerson(SourceFeatures):
    """Person encoded by a network: image features, body, and data of the network's own."""

    body: PosedBody
    extra: Any = None  # see ``FieldNetwork.prepare``


class FieldNetwork(nn.Module, ABC):
    """Network that predicts a radiance field of a person from images and a posed body."""

    needs_depth: ClassVar[bool] = False  # whether training needs depth maps

    def __init__(self, features: int, keys: FieldKeys) -> None:
        super().__init__()
        self.keys = keys
        self.encoder = ImageEncoder(features)

    def encode(self, sources: Sources, body: PosedBody) -> EncodedPerson:
        """Encode a person from images and a body; differentiable."""
        coarse, fine = self.encoder(sources.rgba)
        person = EncodedPerson(sources, coarse, fine, body)
        return replace(person, extra=self.prepare(person))

    @abstractmethod
    def prepare(self, person: EncodedPerson) -> Any:
        """Return ``EncodedPerson.extra``."""

    def limits(self, person: EncodedPerson, camera: Cameras, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the indices (R,) of rays that may hit the person, and values (P, D) of all rays.

        ``z`` (P,) is the depth at distance 1 along each ray of the camera.
        """
        return torch.arange(len(z), device=z.device), z[:, None]

    @abstractmethod
    def march(
        self, person: EncodedPerson, rays: Rays, limits: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Sequence[Any]]:
        """Render R rays with their ``limits`` (R, D).

        Returns premultiplied colours, transmittance and weighted distances (R, 5), and
        intermediate results for ``penalty``.
        """

    def render(
        self, person: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        """Render one camera, in metres; differentiable where gradients are enabled.

        ``generator`` places samples at random, as in training; None: evenly.
        """
        count = self.keys.supersampling
        finer = camera.scaled(count)
        rays, z = camera_rays(finer)
        rows, limits = self.limits(person, finer, z)
        pieces = [rows] if torch.is_grad_enabled() else rows.split(CHUNK)
        found = [self.march(person, rays[piece], limits[piece], generator) for piece in pieces]
        canvas = z.new_tensor([0.0, 0.0, 0.0, 1.0, 0.0]).repeat(len(z), 1)
        canvas = canvas.index_copy(0, rows, torch.cat([values for values, _ in found]))
        canvas = canvas.view(camera.height, count, camera.width, count, 5).mean((1, 3))
        samples = [(rows, *pair) for pair in found[0][1]] if torch.is_grad_enabled() else []
        return FieldPicture(canvas[..., :3], canvas[..., 3], canvas[..., 4], samples)

    def penalty(self, picture: FieldPicture, image: Image, scale: float) -> Tensor:
        """Return loss terms besides the image error; ``scale``: depth map units per metre."""
        return picture.colour.new_zeros(())
