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
    CHUNK,
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
)
from dyngs.human.predict.people import OUTWARDS, Boundaries, PosedBody
from dyngs.models.volume import rays_of
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


@dataclass(frozen=True)
class GuidedSamples:
    """Samples of R rays with their signed ray distances, of both stages."""

    rays: Tensor  # (R,) index of the pixel
    at: Tensor  # (R, K) distances along the ray, m
    signed: Tensor  # (R, K) m


@dataclass(frozen=True)
class RayContext:
    """What is known of R rays, (R, 1) each, lengths in m."""

    begin: Tensor  # where they are looked at from
    end: Tensor  # to where
    body: Tensor  # where they meet the body
    closest: Tensor  # least height above the body, which says whether clothes are met beside it
    # largest alpha that all images show of a sample: how far they are within the visual hull
    held: Tensor


@dataclass(frozen=True)
class BodyDepths:
    """A body, and its depths (V, 1, H, W) in the images, m."""

    boundaries: Boundaries
    depths: Tensor


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

    def prepared(self, seen: SourceFeatures, body: PosedBody) -> BodyDepths:
        boundaries = Boundaries(body)
        sources = seen.sources
        depths = torch.stack([boundaries.depth(sources.camera(i)) for i in range(len(sources))])
        return BodyDepths(boundaries, depths[:, None].clamp(max=_FAR).to(sources.rgba))

    def picture(
        self, known: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        rays, z = rays_of(camera)
        begin_at, end, body = self._limits(known, camera, rays, z)
        which = (end > begin_at).nonzero()[:, 0]
        found = []
        for some in [which] if torch.is_grad_enabled() else which.split(CHUNK):
            found.append(
                self._along(known, rays[some], (begin_at[some], end[some], body[some]), generator)
            )
        shape = (camera.height, camera.width)
        like = rays.origins
        colour = like.new_zeros(*shape, 3)
        depth = like.new_zeros(shape)
        through = like.new_ones(shape)
        if not len(which):
            return FieldPicture(colour, through, depth)
        parts = [torch.cat(x) for x in zip(*(part[:3] for part in found), strict=True)]
        colour, through, depth = (
            whole.flatten(0, 1).index_copy(0, which, own).view(whole.shape)
            for whole, own in zip((colour, through, depth), parts, strict=True)
        )
        guided = (
            [GuidedSamples(which, at, signed) for at, signed in found[0][3]]
            if torch.is_grad_enabled()
            else []
        )
        middle = float((known.body.key_points.mean(0) - rays.origins[0]).norm())
        return FieldPicture(self.refine(colour, through, depth, middle), through, depth, guided)

    def _limits(
        self, known: EncodedPerson, camera: Cameras, rays: Rays, z: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return where rays are looked at from (R,), to (R,), and where they meet the body (R,),
        distances in m."""
        interval = known.own.boundaries.interval(camera)
        begin_at, end, body = (
            (x.flatten() / z).clamp(max=_FAR) for x in (interval.begin, interval.end, interval.body)
        )
        return begin_at.clamp_min(NEAR), torch.where(begin_at < _FAR, end, 0.0), body

    def _along(
        self,
        known: EncodedPerson,
        rays: Rays,
        limits: tuple[Tensor, Tensor, Tensor],
        generator: torch.Generator | None,
    ) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
        """Return colours before black (R, 3), transmittance (R,), sums of weight times distance
        (R,), and samples."""
        first, last, body = (x[:, None] for x in limits)
        count = PARAMS.samples
        shifts = torch.full((len(rays), count), 0.5, device="cpu")
        if generator is not None:
            shifts = torch.rand(shifts.shape, generator=generator, device="cpu")
        at = first + (last - first) * (torch.arange(count, device="cpu") + shifts).to(first) / count
        points = (rays.origins[:, None] + rays.directions[:, None] * at[..., None]).flatten(0, 1)
        looked = known.seen.look(points)
        prior = _heights(known, points, at)
        closest = prior.amin(1, keepdim=True)
        held = looked.alpha.amin(0).view(at.shape).amax(1, keepdim=True)
        whole = RayContext(first, last, body, closest, held)
        hints = self._hints(looked, prior, at, whole)
        guide = self.guide(torch.cat([mean_and_variance(looked.features), hints], -1))
        signed = prior + PARAMS.limit * guide.view(at.shape)
        near = expected_surface(at.detach(), signed.detach())[:, None] + at.new_tensor(
            PARAMS.offsets
        )
        closer, colours = self._surface(known, rays, near, (at, signed), whole)
        opacity = opacities(near, closer, self.sharpness.exp())
        through = torch.cumprod(torch.cat([torch.ones_like(opacity[:, :1]), 1 - opacity], 1), 1)
        weights = opacity * through[:, :-1]
        colour = (weights[..., None] * colours).sum(1)
        return colour, through[:, -1], (weights * near).sum(1), [(at, signed), (near, closer)]

    def _surface(
        self,
        known: EncodedPerson,
        rays: Rays,
        at: Tensor,
        guide: tuple[Tensor, Tensor],
        whole: RayContext,
    ) -> tuple[Tensor, Tensor]:
        """Return signed ray distances (R, K), m, and colours (R, K, 3) of samples at distances (R,
        K)."""
        seen = known.seen
        centers = known.seen.sources.centers
        points = (rays.origins[:, None] + rays.directions[:, None] * at[..., None]).flatten(0, 1)
        looked = seen.look(points)
        grid, depth = seen.projected(points)
        hidden = (
            depth
            > at_pixels(known.own.depths, grid, "nearest")[..., 0].where(looked.alpha > 0, _FAR)
            + PARAMS.hidden_by
        )
        apart = between(rays.directions.repeat_interleave(at.shape[1], 0), points, centers)
        facts = torch.cat([hidden[..., None].to(apart), apart], -1)
        logits = self.attention(torch.cat([looked.features, facts], -1))[..., 0]
        weights = (logits - 1e4 * (hidden & ~hidden.all(0))).softmax(0)
        hints = self._hints(looked, _heights(known, points, at), at, whole)
        found = self.surface(torch.cat([mean_and_variance(looked.features, weights), hints], -1))
        signed = interpolated(*guide, at) + PARAMS.limit * found[:, 0].view(at.shape)
        own = torch.cat([looked.rgb, looked.features[..., -FINE:]], -1)
        both = torch.cat([mean_and_variance(own, weights), found[:, 1:]], -1).expand(
            len(own), -1, -1
        )
        colours = blended(self.blend(torch.cat([own, both, facts], -1))[..., 0], looked.rgb, hidden)
        return signed, colours.view(*at.shape, 3)

    def _hints(self, looked: PointFeatures, prior: Tensor, at: Tensor, ray: RayContext) -> Tensor:
        """Return (R K, HINTS): the distance to the body in any direction and along the ray, where
        in its interval a sample is, how near the ray comes to the body, and if silhouettes hold the
        sample, and any of the ray."""
        along = (ray.body - at).clamp(-OUTWARDS, OUTWARDS) / OUTWARDS
        place = (at - ray.begin) / (ray.end - ray.begin)
        parts = [
            prior / PARAMS.limit,
            prior.abs() / PARAMS.limit,
            along,
            place,
            ray.closest / PARAMS.limit,
            ray.held,
        ]
        known = torch.stack([x.expand_as(at) for x in parts], -1).flatten(0, 1)
        return torch.cat([known, looked.alpha.amin(0)[:, None], looked.alpha.mean(0)[:, None]], -1)

    def penalty(self, picture: FieldPicture, image: Image, scale: float) -> Tensor:
        """Return the mean error of signed ray distances; rays meet the person where alpha is above
        a half."""
        if not picture.samples:
            return picture.colour.new_zeros(())
        assert image.depth is not None
        assert image.alpha is not None
        _, z = rays_of(image.cameras)
        total = picture.colour.new_zeros(())
        for samples in picture.samples:
            truth, alpha = (x.flatten()[samples.rays][:, None] for x in (image.depth, image.alpha))
            surface = truth / (scale * z[samples.rays][:, None])
            meets = alpha > 0.5
            off = (samples.signed - (surface - samples.at).clamp(-PARAMS.limit, PARAMS.limit)).abs()
            # a ray that misses has no distance: one that is large would outweigh those of rays that
            # just meet a limb
            error = torch.where(meets, off, (PARAMS.clear - samples.signed).relu())
            counts = ~meets | (truth > 0)
            error = torch.where(counts, error, 0.0)
            total = total + error.sum() / (
                PARAMS.limit * samples.at.shape[1] * counts.sum().clamp_min(1)
            )
        return PARAMS.srdf_weight * total


def _heights(known: EncodedPerson, points: Tensor, at: Tensor) -> Tensor:
    """Return the signed ray distances (R, K) that learning begins with, of points (R K, 3) at
    distances (R, K).

    Their heights above the body, which also say something where a ray passes beside it.
    """
    height = known.own.boundaries.height(points).view(at.shape)
    return height.clamp(-PARAMS.limit, PARAMS.limit)


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
