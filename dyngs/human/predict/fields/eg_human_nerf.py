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
from dataclasses import dataclass
from itertools import pairwise

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
    SourceFeatures,
    blend_colours,
    initialize_network,
    mean_and_variance,
    relative_directions,
    sample_maps,
    sample_offsets,
    split_rays,
)
from dyngs.human.predict.people import DILATION, BodyBoundaries, PosedBody
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
_FAR = 1e3  # depth of the background, m


class EgHumanNerf(FieldNetwork):
    """EG-HumanNeRF network, see the module."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__(PARAMS.features)
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
            for layer in (self.guide.layers[-1], self.surface.layers[-1], self.refine.last):
                layer.weight.mul_(0.1)  # pyright: ignore[reportCallIssue, reportAttributeAccessIssue]

    needs_depth = True

    def prepare(self, features: SourceFeatures, body: PosedBody) -> tuple[BodyBoundaries, Tensor]:
        """Return the boundaries of the body, and its depth maps (V, 1, H, W) in the images, m."""
        boundaries = BodyBoundaries(body)
        sources = features.sources
        depths = torch.stack([boundaries.depth(sources.camera(i)) for i in range(len(sources))])
        return boundaries, depths[:, None].clamp(max=_FAR).to(sources.rgba)

    def render(
        self, person: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        rays, z = camera_rays(camera)
        boundaries, _ = person.extra
        near, far, body_depth = (
            (x.flatten() / z).clamp(max=_FAR)[:, None] for x in boundaries.interval(camera)
        )
        far = torch.where(near < _FAR, far, 0.0)
        near = near.clamp_min(NEAR)
        rows = (far > near).nonzero()[:, 0]
        pieces = []
        for piece in split_rays(rows):
            limits = near[piece], far[piece], body_depth[piece]
            pieces.append(self._along(person, rays[piece], limits, generator))
        canvas = [
            rays.origins.new_full((len(rays), size), fill)
            for size, fill in ((3, 0), (1, 1), (1, 0))
        ]
        colour, through, depth = (
            whole.index_copy(0, rows, torch.cat(parts)).view(camera.height, camera.width, -1)
            for whole, *parts in zip(canvas, *(piece[:3] for piece in pieces), strict=True)
        )
        through = through[..., 0]
        depth = depth[..., 0]
        samples = [(rows, *pair) for pair in pieces[0][3]] if torch.is_grad_enabled() else []
        middle = float((person.body.key_points.mean(0) - rays.origins[0]).norm())
        return FieldPicture(self.refine(colour, through, depth, middle), through, depth, samples)

    def _along(
        self,
        person: EncodedPerson,
        rays: Rays,
        limits: tuple[Tensor, Tensor, Tensor],
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
        """Render rays.

        Args:
            person: the encoded person.
            rays: R of them.
            limits: (R, 1) each: start and end of the sampled interval, and depth of the body.
            generator: for random sample positions.

        Returns:
            Premultiplied colours (R, 3), transmittance (R, 1), weighted depths (R, 1), and
            distances and signed ray distances (R, K) of the samples of both stages, m.
        """
        features = person.features
        boundaries, depths = person.extra
        first, last, body = limits

        def sample_at(at: Tensor) -> tuple[Tensor, PointFeatures, Tensor]:
            """Return points (R K, 3), their image features, and heights (R, K) above the body."""
            points = rays.origins[:, None] + rays.directions[:, None] * at[..., None]
            points = points.flatten(0, 1)
            height = boundaries.height(points).view(at.shape)
            return points, features.sample(points), height.clamp(-PARAMS.limit, PARAMS.limit)

        def hints(pixel_features: PointFeatures, prior: Tensor, at: Tensor) -> Tensor:
            """Return input features (R K, HINTS) of ray samples.

            They are the distances to the body (signed, absolute, along the ray), the position in
            the interval, the closest approach of the ray to the body, and alpha of the ray and of
            the sample.
            """
            along = (body - at).clamp(-DILATION, DILATION) / DILATION
            place = (at - first) / (last - first)
            limit = PARAMS.limit
            parts = [prior / limit, prior.abs() / limit, along, place, closest / limit, max_alpha]
            rows = torch.stack([x.expand_as(at) for x in parts], -1).flatten(0, 1)
            alpha = torch.stack([pixel_features.alpha.amin(0), pixel_features.alpha.mean(0)], -1)
            return torch.cat([rows, alpha], -1)

        count = PARAMS.samples
        shifts = sample_offsets(len(rays), count, generator=generator)
        at = first + (last - first) * (torch.arange(count, device="cpu") + shifts).to(first) / count
        _, pixel_features, prior = sample_at(at)
        closest = prior.amin(1, keepdim=True)
        max_alpha = pixel_features.alpha.amin(0).view(at.shape).amax(1, keepdim=True)
        facts = torch.cat(
            [mean_and_variance(pixel_features.features), hints(pixel_features, prior, at)], -1
        )
        signed = prior + PARAMS.limit * self.guide(facts).view(at.shape)

        near = expected_surface(at.detach(), signed.detach())[:, None]
        near = near + at.new_tensor(PARAMS.offsets)
        points, pixel_features, prior = sample_at(near)
        grid, depth = features.project(points)
        surface = sample_maps(depths, grid, "nearest")[..., 0].where(pixel_features.alpha > 0, _FAR)
        hidden = depth > surface + PARAMS.hidden_by
        # Images in which the sample is occluded, unless it is occluded in all.
        excluded = 1e4 * (hidden & ~hidden.all(0))
        directions = rays.directions.repeat_interleave(near.shape[1], 0)
        relative = relative_directions(directions, points, features.sources.centers)
        facts = torch.cat([hidden[..., None].to(relative), relative], -1)
        logits = self.attention(torch.cat([pixel_features.features, facts], -1))[..., 0]
        weights = (logits - excluded).softmax(0)
        known_here = [
            mean_and_variance(pixel_features.features, weights),
            hints(pixel_features, prior, near),
        ]
        output = self.surface(torch.cat(known_here, -1))
        closer = interpolate_along_rays(at, signed, near) + PARAMS.limit * output[:, 0].view(
            near.shape
        )
        per_view = torch.cat([pixel_features.rgb, pixel_features.features[..., -FINE:]], -1)
        both = torch.cat([mean_and_variance(per_view, weights), output[:, 1:]], -1)
        both = both.expand(len(per_view), -1, -1)
        logits = self.blend(torch.cat([per_view, both, facts], -1))[..., 0]
        colours = blend_colours(logits - excluded, pixel_features.rgb).view(*near.shape, 3)

        opacity = opacities(near, closer, self.sharpness.exp())
        through = torch.cumprod(torch.cat([torch.ones_like(opacity[:, :1]), 1 - opacity], 1), 1)
        weights = opacity * through[:, :-1]
        colour = (weights[..., None] * colours).sum(1)
        distance = (weights * near).sum(1, keepdim=True)
        return colour, through[:, -1:], distance, [(at, signed), (near, closer)]

    def penalty(self, picture: FieldPicture, image: Image, scale: float) -> Tensor:
        """Return the mean signed ray distance error; rays hit the person if alpha exceeds 0.5."""
        total = picture.colour.new_zeros(())
        assert image.depth is not None
        assert image.alpha is not None
        _, z = camera_rays(image.cameras)
        limit = PARAMS.limit
        for rays, at, signed in picture.samples:
            truth, alpha = (x.flatten()[rays][:, None] for x in (image.depth, image.alpha))
            surface = truth / (scale * z[rays][:, None])
            hits = alpha > 0.5
            deviation = (signed - (surface - at).clamp(-limit, limit)).abs()
            # Rays that miss have no true distance; only values below a small margin are penalised.
            error = torch.where(hits, deviation, (PARAMS.clear - signed).relu())
            is_known = ~hits | (truth > 0)
            error = torch.where(is_known, error, 0.0)
            total = total + error.sum() / (limit * at.shape[1] * is_known.sum().clamp_min(1))
        return PARAMS.srdf_weight * total


def expected_surface(at: Tensor, signed: Tensor) -> Tensor:
    """Return the distances (R,) of the first zero crossing of signed ray distances (R, K) at (R,
    K).

    Without a crossing: the sample with the smallest value.
    """
    crosses = (signed[:, :-1] > 0) & (signed[:, 1:] <= 0)
    index = crosses.to(torch.uint8).argmax(1, keepdim=True)
    before = signed.gather(1, index)
    after = signed.gather(1, index + 1)
    low = at.gather(1, index)
    high = at.gather(1, index + 1)
    fraction = before / (before - after).clamp_min(1e-9)
    smallest = at.gather(1, signed.argmin(1, keepdim=True))
    smallest = torch.where(signed[:, :1] <= 0, at[:, :1], smallest)
    return torch.where(crosses.any(1, keepdim=True), low + fraction * (high - low), smallest)[:, 0]


def interpolate_along_rays(at: Tensor, values: Tensor, queries: Tensor) -> Tensor:
    """Interpolate values (R, K) at ascending distances (R, K) linearly at ``queries`` (R, N)."""
    after = torch.searchsorted(at.contiguous(), queries.contiguous()).clamp(1, at.shape[1] - 1)
    low = at.gather(1, after - 1)
    high = at.gather(1, after)
    fraction = ((queries - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
    return torch.lerp(values.gather(1, after - 1), values.gather(1, after), fraction)


def opacities(at: Tensor, signed: Tensor, sharpness: Tensor) -> Tensor:
    """Return NeuS opacities (R, K) (Wang et al. 2021) of signed ray distances (R, K) at (R, K).

    The cosine is -1, since signed ray distances are along the ray. Each sample covers half of the
    neighbouring intervals.
    """
    gaps = at.diff(dim=1)
    half = (torch.cat([gaps[:, :1], gaps], 1) + torch.cat([gaps, gaps[:, -1:]], 1)) / 4
    before = (sharpness * (signed + half)).sigmoid()
    behind = (sharpness * (signed - half)).sigmoid()
    return ((before - behind + 1e-5) / (before + 1e-5)).clamp(0, 1)


class Refinement(nn.Module):
    """U-Net of 16, 32 and 64 channels that corrects a rendered image."""

    def __init__(self) -> None:
        super().__init__()
        widths = (16, 32, 64)
        self.first = nn.Conv2d(5, widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(i, o, 3, 2, 1) for i, o in pairwise(widths))
        self.up = nn.ModuleList(
            nn.Conv2d(i + o, o, 3, padding=1) for i, o in pairwise(widths[::-1])
        )
        self.last = nn.Conv2d(widths[0], 3, 3, padding=1)

    def forward(self, colour: Tensor, through: Tensor, depth: Tensor, middle: float) -> Tensor:
        """Return corrected premultiplied colours (H, W, 3).

        Inputs are premultiplied colours (H, W, 3), transmittance and weighted depth (H, W);
        ``middle`` is the distance of the person, m.
        """
        height, width = through.shape
        alpha = 1 - through
        planes = torch.cat(
            [colour, alpha[..., None], (depth - alpha * middle)[..., None]], -1
        ).permute(2, 0, 1)[None]
        levels = [self.first(pad(planes, (0, -width % 4, 0, -height % 4))).relu()]
        for layer in self.down:
            levels.append(layer(levels[-1]).relu())
        output = levels.pop()
        for layer in self.up:
            larger = levels.pop()
            output = layer(
                torch.cat([interpolate(output, larger.shape[2:], mode="nearest"), larger], 1)
            ).relu()
        change = self.last(output)[0, :, :height, :width].permute(1, 2, 0)
        return (colour + alpha[..., None] * change).clamp_min(0)
