"""EG-HumanNeRF (Wang, Kanamori and Endo 2024) as far as it is published: few samples, guided by a
body.

Rays are looked at between a dilated and an eroded body. A first network says at samples in between
how far it is along the ray to the surface (the signed ray distance: positive before it). Few
samples around its zero are then looked at closely: an attention over images, that knows from the
body which of them cannot see a sample, gives the distance again, from which opacities follow, and
the weights of the images' colours. A small network mends the picture. Sizes and losses are not
published; these are ours.

Local letters: V images, R rays, K samples of each, C features.
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
    at_pixels,
    begin,
    between,
    blended,
    mean_and_variance,
    sample_offsets,
    split_rays,
)
from dyngs.human.predict.people import DILATION, BodyBoundaries, PosedBody
from dyngs.models.volume import camera_rays
from dyngs.ops.rays import Rays


@dataclass(frozen=True)
class EgHumanNerfParams:
    """Sizes and weights that are not published; lengths in m."""

    features: int = 32  # of a pixel of the images
    width: int = 64  # features of hidden layers
    samples: int = 16  # of a ray, that say where the surface is
    # of guided samples from where the surface is expected
    offsets: tuple[float, ...] = (-0.02, -0.01, -0.005, 0.0, 0.005, 0.01)
    srdf_weight: float = 0.2  # of the error of signed ray distances, over ``limit``
    limit: float = 0.05  # signed ray distances are learned up to here
    clear: float = 0.01  # signed ray distances from which a ray that misses is learned no more
    hidden_by: float = 0.03  # what lies so far behind the body is hidden by it
    sharpness: float = 200.0  # of the first surfaces, per m
    geometry: int = 16  # features of what is known about the surface at a sample


PARAMS = EgHumanNerfParams()
HINTS = 8  # What is known of a sample and its ray from the body and the silhouettes
_FAR = 1e3  # Stands for no depth, m


class EgHumanNerf(FieldNetwork):
    """See the module."""

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
        begin(self, generator)
        with torch.no_grad():  # begin with the distance to the body, and with colours as they are
            for layer in (self.guide.layers[-1], self.surface.layers[-1], self.refine.last):
                layer.weight.mul_(0.1)  # pyright: ignore[reportCallIssue, reportAttributeAccessIssue]

    needs_depth = True

    def prepared(self, seen: SourceFeatures, body: PosedBody) -> tuple[BodyBoundaries, Tensor]:
        """Return the boundaries of the body, and its depths (V, 1, H, W) in the images, m."""
        boundaries = BodyBoundaries(body)
        sources = seen.sources
        depths = torch.stack([boundaries.depth(sources.camera(i)) for i in range(len(sources))])
        return boundaries, depths[:, None].clamp(max=_FAR).to(sources.rgba)

    def picture(
        self, known: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        rays, z = camera_rays(camera)
        boundaries, _ = known.own
        first, last, body = (
            (x.flatten() / z).clamp(max=_FAR)[:, None] for x in boundaries.interval(camera)
        )
        last = torch.where(first < _FAR, last, 0.0)
        first = first.clamp_min(NEAR)
        which = (last > first).nonzero()[:, 0]
        found = []
        for some in split_rays(which):
            limits = first[some], last[some], body[some]
            found.append(self._along(known, rays[some], limits, generator))
        canvas = [
            rays.origins.new_full((len(rays), size), own) for size, own in ((3, 0), (1, 1), (1, 0))
        ]
        colour, through, depth = (
            whole.index_copy(0, which, torch.cat(parts)).view(camera.height, camera.width, -1)
            for whole, *parts in zip(canvas, *(piece[:3] for piece in found), strict=True)
        )
        through = through[..., 0]
        depth = depth[..., 0]
        samples = [(which, *pair) for pair in found[0][3]] if torch.is_grad_enabled() else []
        middle = float((known.body.key_points.mean(0) - rays.origins[0]).norm())
        return FieldPicture(self.refine(colour, through, depth, middle), through, depth, samples)

    def _along(
        self,
        known: EncodedPerson,
        rays: Rays,
        limits: tuple[Tensor, Tensor, Tensor],
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
        """Return colours before black (R, 3), transmittance (R, 1), sums of weight times distance
        (R, 1), and the samples of both stages: distances (R, K) along the rays, and signed ray
        distances (R, K), m.

        ``limits`` (R, 1) are where rays are looked at from, to where, and where they meet the body.
        """
        seen = known.seen
        boundaries, depths = known.own
        first, last, body = limits

        def look(at: Tensor) -> tuple[Tensor, PointFeatures, Tensor]:
            """Return samples (R K, 3), what images show of them, and the signed ray distances
            (R, K) that learning begins with: their heights above the body."""
            points = rays.origins[:, None] + rays.directions[:, None] * at[..., None]
            points = points.flatten(0, 1)
            height = boundaries.height(points).view(at.shape)
            return points, seen.look(points), height.clamp(-PARAMS.limit, PARAMS.limit)

        def hints(looked: PointFeatures, prior: Tensor, at: Tensor) -> Tensor:
            """Return (R K, HINTS): the distance to the body in any direction and along the ray,
            where in its interval a sample is, how near the ray comes to the body, which says
            whether clothes are met beside it, and if silhouettes hold the sample, and any of the
            ray."""
            along = (body - at).clamp(-DILATION, DILATION) / DILATION
            place = (at - first) / (last - first)
            limit = PARAMS.limit
            parts = [prior / limit, prior.abs() / limit, along, place, closest / limit, held]
            rows = torch.stack([x.expand_as(at) for x in parts], -1).flatten(0, 1)
            alpha = torch.stack([looked.alpha.amin(0), looked.alpha.mean(0)], -1)
            return torch.cat([rows, alpha], -1)

        count = PARAMS.samples
        shifts = sample_offsets(len(rays), count, generator=generator)
        at = first + (last - first) * (torch.arange(count, device="cpu") + shifts).to(first) / count
        _, looked, prior = look(at)
        closest = prior.amin(1, keepdim=True)
        held = looked.alpha.amin(0).view(at.shape).amax(1, keepdim=True)
        facts = torch.cat([mean_and_variance(looked.features), hints(looked, prior, at)], -1)
        signed = prior + PARAMS.limit * self.guide(facts).view(at.shape)

        near = expected_surface(at.detach(), signed.detach())[:, None]
        near = near + at.new_tensor(PARAMS.offsets)
        points, looked, prior = look(near)
        grid, depth = seen.projected(points)
        surface = at_pixels(depths, grid, "nearest")[..., 0].where(looked.alpha > 0, _FAR)
        hidden = depth > surface + PARAMS.hidden_by
        # images that do not count where another does
        excluded = 1e4 * (hidden & ~hidden.all(0))
        directions = rays.directions.repeat_interleave(near.shape[1], 0)
        apart = between(directions, points, seen.sources.centers)
        facts = torch.cat([hidden[..., None].to(apart), apart], -1)
        logits = self.attention(torch.cat([looked.features, facts], -1))[..., 0]
        weights = (logits - excluded).softmax(0)
        known_here = [mean_and_variance(looked.features, weights), hints(looked, prior, near)]
        found = self.surface(torch.cat(known_here, -1))
        closer = interpolated(at, signed, near) + PARAMS.limit * found[:, 0].view(near.shape)
        own = torch.cat([looked.rgb, looked.features[..., -FINE:]], -1)
        both = torch.cat([mean_and_variance(own, weights), found[:, 1:]], -1)
        both = both.expand(len(own), -1, -1)
        logits = self.blend(torch.cat([own, both, facts], -1))[..., 0]
        colours = blended(logits - excluded, looked.rgb).view(*near.shape, 3)

        opacity = opacities(near, closer, self.sharpness.exp())
        through = torch.cumprod(torch.cat([torch.ones_like(opacity[:, :1]), 1 - opacity], 1), 1)
        weights = opacity * through[:, :-1]
        colour = (weights[..., None] * colours).sum(1)
        distance = (weights * near).sum(1, keepdim=True)
        return colour, through[:, -1:], distance, [(at, signed), (near, closer)]

    def penalty(self, picture: FieldPicture, image: Image, scale: float) -> Tensor:
        """Return the mean error of signed ray distances; rays meet the person where alpha is above
        a half."""
        total = picture.colour.new_zeros(())
        assert image.depth is not None
        assert image.alpha is not None
        _, z = camera_rays(image.cameras)
        limit = PARAMS.limit
        for rays, at, signed in picture.samples:
            truth, alpha = (x.flatten()[rays][:, None] for x in (image.depth, image.alpha))
            surface = truth / (scale * z[rays][:, None])
            meets = alpha > 0.5
            off = (signed - (surface - at).clamp(-limit, limit)).abs()
            # a ray that misses has no distance: one that is large would outweigh those of rays that
            # just meet a limb
            error = torch.where(meets, off, (PARAMS.clear - signed).relu())
            counts = ~meets | (truth > 0)
            error = torch.where(counts, error, 0.0)
            total = total + error.sum() / (limit * at.shape[1] * counts.sum().clamp_min(1))
        return PARAMS.srdf_weight * total


def expected_surface(at: Tensor, signed: Tensor) -> Tensor:
    """Return distances (R,) at which signed ray distances (R, K) of samples at distances (R, K)
    first cross zero.

    Where none does: that of the least.
    """
    crosses = (signed[:, :-1] > 0) & (signed[:, 1:] <= 0)
    place = crosses.to(torch.uint8).argmax(1, keepdim=True)
    before = signed.gather(1, place)
    after = signed.gather(1, place + 1)
    low = at.gather(1, place)
    high = at.gather(1, place + 1)
    fraction = before / (before - after).clamp_min(1e-9)
    nearest = at.gather(1, signed.argmin(1, keepdim=True))
    nearest = torch.where(signed[:, :1] <= 0, at[:, :1], nearest)
    return torch.where(crosses.any(1, keepdim=True), low + fraction * (high - low), nearest)[:, 0]


def interpolated(at: Tensor, values: Tensor, wanted: Tensor) -> Tensor:
    """Return values (R, N) at distances ``wanted`` (R, N), linear between those (R, K) at ascending
    ``at`` (R, K)."""
    after = torch.searchsorted(at.contiguous(), wanted.contiguous()).clamp(1, at.shape[1] - 1)
    low = at.gather(1, after - 1)
    high = at.gather(1, after)
    fraction = ((wanted - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
    return torch.lerp(values.gather(1, after - 1), values.gather(1, after), fraction)


def opacities(at: Tensor, signed: Tensor, sharpness: Tensor) -> Tensor:
    """Return opacities (R, K) of samples at distances (R, K) with signed ray distances (R, K): NeuS
    (Wang et al. 2021), with a cosine of -1 as rays meet their own surface at right angles.

    Half of the mean of the neighbouring intervals lies before and behind each sample.
    """
    gaps = at.diff(dim=1)
    half = (torch.cat([gaps[:, :1], gaps], 1) + torch.cat([gaps, gaps[:, -1:]], 1)) / 4
    before = (sharpness * (signed + half)).sigmoid()
    behind = (sharpness * (signed - half)).sigmoid()
    return ((before - behind + 1e-5) / (before + 1e-5)).clamp(0, 1)


class Refinement(nn.Module):
    """A U-Net of 16, 32 and 64 channels that mends a picture from its colours, opacities and
    depths."""

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
        """Return colours before black (H, W, 3) of colours before black, transmittance and depths
        (H, W).

        ``middle``: distance of the person, m.
        """
        height, width = through.shape
        alpha = 1 - through
        planes = torch.cat(
            [colour, alpha[..., None], (depth - alpha * middle)[..., None]], -1
        ).permute(2, 0, 1)[None]
        levels = [self.first(pad(planes, (0, -width % 4, 0, -height % 4))).relu()]
        for layer in self.down:
            levels.append(layer(levels[-1]).relu())
        found = levels.pop()
        for layer in self.up:
            larger = levels.pop()
            found = layer(
                torch.cat([interpolate(found, larger.shape[2:], mode="nearest"), larger], 1)
            ).relu()
        change = self.last(found)[0, :, :height, :width].permute(1, 2, 0)
        return (colour + alpha[..., None] * change).clamp_min(0)
