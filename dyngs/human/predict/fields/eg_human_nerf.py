"""EG-HumanNeRF (Wang, Kanamori and Endo 2024), as far as published: few samples guided by a body.

Rays are sampled between a dilated and an eroded body mesh. A first network predicts the signed ray
distance at these samples: the distance along the ray to the surface, positive in front of it. A
few guided samples around its zero crossing get refined distances, from which opacities follow, and
blending weights for the colours of the images; images in which the body hides a sample are
excluded. A small U-Net refines the image. Network sizes and losses are our own.

Symbols: V images, R rays, K samples per ray, C features.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.predict.fields.network import (
    FINE,
    NEAR,
    EncodedPerson,
    FieldNetwork,
    FieldPicture,
    Perceptron,
    PointFeatures,
    initialize_network,
    mean_and_variance,
    mean_over_views,
    sample_offsets,
    view_weights,
)
from dyngs.human.predict.kind import FieldKeys
from dyngs.human.predict.people import DILATION, sample_maps
from dyngs.models.volume import camera_rays
from dyngs.ops.rays import Rays


@dataclass(frozen=True)
class EgHumanNerfParams:
    """Sizes and weights, which the paper does not give; lengths in m."""

    features: int = 32  # coarse image features per pixel
    width: int = 64  # hidden layers
    samples: int = 16  # coarse samples per ray
    # guided samples, relative to the expected surface
    offsets: tuple[float, ...] = (-0.02, -0.01, -0.005, 0.0, 0.005, 0.01)
    srdf_weight: float = 0.2  # of the signed ray distance loss, relative to ``limit``
    limit: float = 0.05  # truncation of signed ray distances
    clear: float = 0.01  # margin of the loss for rays that miss the surface
    hidden_by: float = 0.03  # depth behind the body from which a sample is occluded
    sharpness: float = 200.0  # initial sharpness of surfaces, per m
    geometry: int = 16  # geometry features of a sample


PARAMS = EgHumanNerfParams()
HINTS = 8  # input features of a sample from the body and the silhouettes
_SMALL_AT_FIRST = ("guide.layers.2.weight", "surface.layers.2.weight", "refine.last.weight")
_FAR = 1e3  # depth of the background, m
_EDGE = 0.05  # alpha of rays that miss the person; those above 1 - _EDGE hit it


class EgHumanNerf(FieldNetwork):
    """EG-HumanNeRF network, see the module."""

    needs_depth = True

    def __init__(self, generator: torch.Generator, keys: FieldKeys) -> None:
        super().__init__(PARAMS.features, keys)
        width = PARAMS.width
        pixel = PARAMS.features + FINE
        self.guide = Perceptron(2 * pixel + HINTS, width, width, 1)
        self.attention = Perceptron(pixel + 5, width, 1)
        self.surface = Perceptron(2 * pixel + HINTS, width, width, 1 + PARAMS.geometry)
        colours = 3 + FINE
        self.blend = Perceptron(3 * colours + PARAMS.geometry + 5, width, width // 2, 1)
        self.sharpness = nn.Parameter(torch.tensor(math.log(PARAMS.sharpness), device="cpu"))
        self.refine = Refinement()
        initialize_network(self, generator)
        with torch.no_grad():  # start with the body surface and unchanged colours
            for name, weight in self.named_parameters():
                if name in _SMALL_AT_FIRST:
                    weight.mul_(0.1)

    def prepare(self, person: EncodedPerson) -> Tensor:
        """Return the depth maps (V, 1, H, W) of the body in the images, m."""
        depths = [person.body.depth(camera)[None] for camera in person.sources.cameras]
        return torch.stack(depths).clamp(max=_FAR)

    def limits(self, person: EncodedPerson, camera: Cameras, z: Tensor) -> tuple[Tensor, Tensor]:
        """Values are start and end of the sampled interval, and the distance of the body, m."""
        limits = (person.body.interval(camera).flatten(1) / z).clamp(NEAR, _FAR)
        near, far, _ = limits
        return (far > near).nonzero()[:, 0], limits.T  # not where all are _FAR

    def render(
        self, person: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        picture = super().render(person, camera, generator)
        middle = float((person.body.key_points.mean(0) - camera.centers[0]).norm())
        colour = self.refine(picture.colour, picture.transmittance, picture.depth, middle)
        return replace(picture, colour=colour)

    def march(
        self, person: EncodedPerson, rays: Rays, limits: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Sequence[Any]]:
        """Intermediate results are distances and signed ray distances (R, K) of both stages, m."""
        first, last, body = limits.split(1, 1)

        def look_up(at: Tensor) -> tuple[Tensor, PointFeatures, Tensor]:
            """Return points (R K, 3), their image features, and heights (R, K) above the body."""
            points = rays.origins[:, None] + rays.directions[:, None] * at[..., None]
            points = points.flatten(0, 1)
            height = person.body.height(points).clamp(-PARAMS.limit, PARAMS.limit)
            return points, person.sample(points), height.view(at.shape)

        def inputs(
            seen: PointFeatures, height: Tensor, at: Tensor, weights: Tensor | None = None
        ) -> Tensor:
            """Return image features and HINTS other features of ray samples (R K, ...).

            The latter are the distances to the body (signed, absolute, along the ray), the position
            in the interval, the closest approach of the ray to the body, and alpha of the ray and
            of the sample.
            """
            along = (body - at).clamp(-DILATION, DILATION) / DILATION
            place = (at - first) / (last - first)
            height = height / PARAMS.limit
            parts = [height, height.abs(), along, place, closest / PARAMS.limit, max_alpha]
            hints = torch.stack([x.expand_as(at) for x in parts], -1).flatten(0, 1)
            return torch.cat([mean_and_variance(seen.features, weights), hints, seen.coverage], -1)

        count = PARAMS.samples
        shifts = sample_offsets(len(rays), count, generator=generator)
        places = (torch.arange(count, device="cpu") + shifts).to(first) / count
        at = torch.lerp(first, last, places)
        _, seen, height = look_up(at)
        closest = height.amin(1, keepdim=True)
        max_alpha = seen.alpha.amin(0).view(at.shape).amax(1, keepdim=True)
        signed = height + PARAMS.limit * self.guide(inputs(seen, height, at)).view(at.shape)

        surface = expected_surface(at.detach(), signed.detach())
        near = surface + at.new_tensor(PARAMS.offsets)
        points, seen, height = look_up(near)
        front = sample_maps(person.extra, seen.grid, "nearest")[..., 0]
        hidden = seen.depth - front.where(seen.alpha > 0, _FAR) > PARAMS.hidden_by
        # Images in which the sample is hidden, unless it is hidden in all.
        excluded = 1e4 * (hidden & ~hidden.all(0))
        directions = rays.directions.repeat_interleave(near.shape[1], 0)
        relative = person.relative_directions(directions, points)
        facts = torch.cat([hidden[..., None].to(relative), relative], -1)
        weights = view_weights(self.attention, [seen.features, facts], excluded)
        output = self.surface(inputs(seen, height, near, weights))
        change = PARAMS.limit * output[:, 0].view(near.shape)
        closer = interpolate_along_rays(at, signed, near) + change
        shared = torch.cat([mean_and_variance(seen.colours, weights), output[:, 1:]], -1)
        shared = shared.expand(len(facts), -1, -1)
        weights = view_weights(self.blend, [seen.colours, shared, facts], excluded)
        colours = mean_over_views(seen.rgb, weights).view(*near.shape, 3)

        opacity = opacities(near, closer, self.sharpness.exp())
        through = pad((1 - opacity).cumprod(1), (1, 0), value=1.0)
        weights = -through.diff(dim=1)
        colour = (weights[..., None] * colours).sum(1)
        distance = (weights * near).sum(1, keepdim=True)
        return torch.cat([colour, through[:, -1:], distance], 1), [(at, signed), (near, closer)]

    def penalty(self, picture: FieldPicture, image: Image, scale: float) -> Tensor:
        """Return the mean signed ray distance error of rays that hit or miss the person for sure.

        Pixels on outlines show both; the image error alone decides about them.
        """
        total = picture.colour.new_zeros(())
        assert image.depth is not None
        assert image.alpha is not None
        _, z = camera_rays(image.cameras.scaled(self.keys.supersampling))
        maps = torch.stack([image.depth, image.alpha])[None]
        finer = interpolate(maps, scale_factor=self.keys.supersampling)
        depth, alpha = finer.flatten()[:, None].chunk(2)
        surface = depth / (scale * z[:, None])
        misses = alpha < _EDGE
        is_known = misses | ((alpha > 1 - _EDGE) & (surface > 0))
        limit = PARAMS.limit
        for rays, at, signed in picture.samples:
            deviation = (signed - (surface[rays] - at).clamp(-limit, limit)).abs()
            # Rays that miss have no true distance; only values below a small margin are penalised.
            error = torch.where(misses[rays], (PARAMS.clear - signed).relu(), deviation)
            known = is_known[rays]
            total = total + (known * error).sum() / (limit * at.shape[1] * known.sum().clamp_min(1))
        return PARAMS.srdf_weight * total


def expected_surface(at: Tensor, signed: Tensor) -> Tensor:
    """Return the distances (R, 1) of the first zero crossing of signed ray distances (R, K) at (R,
    K).

    Without a crossing: the sample with the smallest value, or the first one if that is behind.
    """
    crosses = (signed[:, :-1] > 0) & (signed[:, 1:] <= 0)
    index = crosses.int().argmax(1, keepdim=True)
    before, after = _neighbours(signed, index)
    low, high = _neighbours(at, index)
    fraction = before / (before - after).clamp_min(1e-9)
    smallest = at.gather(1, signed.relu().argmin(1, keepdim=True))
    return torch.where(crosses.any(1, keepdim=True), low + fraction * (high - low), smallest)


def interpolate_along_rays(at: Tensor, values: Tensor, queries: Tensor) -> Tensor:
    """Interpolate values (R, K) at ascending distances (R, K) linearly at ``queries`` (R, N)."""
    index = torch.searchsorted(at, queries).clamp(1, at.shape[1] - 1) - 1
    low, high = _neighbours(at, index)
    fraction = ((queries - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
    return torch.lerp(*_neighbours(values, index), fraction)


def _neighbours(values: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return values (R, K) at ``index`` (R, N) and behind it."""
    return values.gather(1, index), values.gather(1, index + 1)


def opacities(at: Tensor, signed: Tensor, sharpness: Tensor) -> Tensor:
    """Return opacities (R, K) of signed ray distances (R, K) at (R, K).

    Each sample covers half of the neighbouring intervals. Opacities are differences of a sigmoid
    (NeuS, Wang et al. 2021) with cosine -1, since distances are along the ray.
    """
    gaps = at.diff(dim=1)
    gaps = torch.cat([gaps[:, :1], gaps, gaps[:, -1:]], 1)
    half = (gaps[:, :-1] + gaps[:, 1:]) / 4
    before = (sharpness * (signed + half)).sigmoid()
    behind = (sharpness * (signed - half)).sigmoid()
    return ((before - behind + 1e-5) / (before + 1e-5)).clamp(0, 1)


class Refinement(nn.Module):
    """U-Net of 16, 32 and 64 channels that corrects a rendered image."""

    def __init__(self) -> None:
        super().__init__()
        widths = (16, 32, 64)
        # A patch of a training step goes on beyond its sides, as the image does.
        conv = partial(nn.Conv2d, kernel_size=3, padding=1, padding_mode="replicate")
        self.first = conv(5, widths[0])
        self.down = nn.ModuleList(conv(i, o, stride=2) for i, o in pairwise(widths))
        self.up = nn.ModuleList(conv(i + o, o) for i, o in pairwise(widths[::-1]))
        self.last = conv(widths[0], 3)

    def forward(self, colour: Tensor, through: Tensor, depth: Tensor, middle: float) -> Tensor:
        """Return corrected premultiplied colours (H, W, 3).

        Inputs are premultiplied colours (H, W, 3), transmittance and weighted depth (H, W);
        ``middle`` is the distance of the person, m.
        """
        height, width = through.shape
        alpha = 1 - through
        planes = torch.stack([*colour.unbind(2), alpha, depth - alpha * middle])[None]
        levels = [self.first(pad(planes, (0, -width % 4, 0, -height % 4))).relu()]
        for layer in self.down:
            levels.append(layer(levels[-1]).relu())
        output = levels.pop()
        for layer in self.up:
            larger = levels.pop()
            output = layer(torch.cat([interpolate(output, larger.shape[2:]), larger], 1)).relu()
        change = self.last(output)[0, :, :height, :width].permute(1, 2, 0)
        return (colour + alpha[..., None] * change).clamp_min(0)
