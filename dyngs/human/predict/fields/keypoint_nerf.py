"""KeypointNeRF (Mihajlovic et al. 2022): a radiance field conditioned on relative depths of key
points.

Samples lie in the visual hull. Per image, a sample is encoded by its depth relative to nearby key
points and by pixel-aligned features. Mean and variance over images give the density and the
weights that blend the colours of the images.

Symbols: V images, M samples, J key points, R rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, softplus

from dyngs.human.body.joints import JOINT_PARENTS
from dyngs.human.predict.fields.network import (
    FINE,
    NEAR,
    EncodedPerson,
    FieldNetwork,
    Perceptron,
    PointFeatures,
    SourceFeatures,
    initialize_network,
    mean_and_variance,
    mean_over_views,
    sample_offsets,
    view_weights,
)
from dyngs.human.predict.kind import FieldKeys
from dyngs.human.predict.people import NUM_KEY_POINTS, Sources, sample_maps
from dyngs.models.volume import select_samples, visible_samples
from dyngs.ops.rays import MarchSteps, Rays, Space, composite, march


@dataclass(frozen=True)
class KeypointNerfParams:
    """Sizes and lengths (m)."""

    features: int = 32  # coarse image features per pixel
    width: int = 64  # hidden layers
    step: float = 0.015  # distance of samples on a ray
    octaves: int = 3  # of the positional encoding of relative depths
    reach: float = 0.1  # standard deviation of the weight of a key point
    cells: int = 32  # of the occupancy grid, per axis
    visible: float = 0.1  # alpha from which a pixel shows the person
    densest: float = 100.0  # scale of the density, per m
    thick: float = 0.065  # distance of the initial surface from the bones
    steep: float = 60.0  # slope of the initial raw density, per m from the bones
    pooled: int = 32  # features of a sample per image
    geometry: int = 24  # geometry features of a sample


PARAMS = KeypointNerfParams()
AROUND = 0.3  # largest distance of the surface from the bones, m
CODE = NUM_KEY_POINTS * (1 + 2 * PARAMS.octaves)
HINTS = 4  # input features of a sample from bones and silhouettes


class KeypointNerf(FieldNetwork):
    """KeypointNeRF network, see the module."""

    def __init__(self, generator: torch.Generator, keys: FieldKeys) -> None:
        super().__init__(PARAMS.features, keys)
        width = PARAMS.width
        colours = 3 + FINE + PARAMS.geometry
        self.per_image = Perceptron(CODE + PARAMS.features + FINE, width, width, PARAMS.pooled)
        self.geometry = Perceptron(2 * PARAMS.pooled + HINTS, width, width, 1 + PARAMS.geometry)
        self.blend = Perceptron(3 * colours + 4, width, width // 2, 1)
        initialize_network(self, generator)

    def prepare(self, person: EncodedPerson) -> tuple[Space, Tensor]:
        return visual_hull(person, person.body.key_points)

    def march(
        self, person: EncodedPerson, rays: Rays, limits: Tensor, generator: torch.Generator | None
    ) -> tuple[Tensor, Sequence[Any]]:
        space, occupied = person.extra
        shifts = sample_offsets(len(rays), generator=generator).to(rays.origins)
        samples = march(rays, shifts, space, occupied, MarchSteps(NEAR, PARAMS.step))
        is_training = torch.is_grad_enabled()
        with torch.no_grad():  # densities alone decide which samples are rendered
            alpha = person.alpha(to_world(samples.coords, space)) > PARAMS.visible
            samples = select_samples(samples, alpha.all(0))[0]
            points = to_world(samples.coords, space)
            geometry = self._geometry(person, points, person.sample(points))
            samples, which = visible_samples(
                density(geometry), samples, shifts if is_training else None
            )
            points = points[which]
        seen = person.sample(points)
        geometry = self._geometry(person, points, seen) if is_training else geometry[which]
        count = len(seen.rgb)
        per_view = torch.cat([seen.colours, geometry[:, 1:].expand(count, -1, -1)], -1)
        pooled = mean_and_variance(per_view).expand(count, -1, -1)
        directions = rays.directions[samples.rays.long()]
        relative = person.relative_directions(directions, points)
        weights = view_weights(self.blend, [per_view, pooled, relative])
        image = composite(density(geometry), mean_over_views(seen.rgb, weights), samples)
        return torch.cat([image.colour, image.transmittance[:, None], image.depth[:, None]], 1), []

    def _geometry(self, person: EncodedPerson, points: Tensor, seen: PointFeatures) -> Tensor:
        """Return raw density and geometry features (M, 1 + PARAMS.geometry) of points (M, 3).

        The initial density is that of limbs of constant thickness.
        """
        bone = distance_to_bones(points, person.body.key_points)[:, None]
        code = spatial_code(points, person.body.key_points, person.sources)
        per_image = self.per_image(torch.cat([code, seen.features], -1))
        distance = bone / PARAMS.reach
        hints = torch.cat([distance, distance.square(), seen.coverage], -1)
        output = self.geometry(torch.cat([mean_and_variance(per_image), hints], -1))
        return torch.cat([output[:, :1] + PARAMS.steep * (PARAMS.thick - bone), output[:, 1:]], -1)


def density(geometry: Tensor) -> Tensor:
    """Return densities (M,), per m, of the raw densities in the first column."""
    return PARAMS.densest * softplus(geometry[:, 0])


@torch.no_grad()
def spatial_code(points: Tensor, key_points: Tensor, sources: Sources) -> Tensor:
    """Return the relative spatial encoding (V, M, CODE) of points (M, 3) to key points (J, 3) per
    camera.

    dz, then sine and cosine of pi 2^l dz of each octave l, all times exp(-d^2 / (2
    PARAMS.reach^2)); dz is the depth difference and d the distance, m.
    """
    apart = points[:, None] - key_points
    weight = (-apart.square().sum(-1) / (2 * PARAMS.reach**2)).exp()
    dz = torch.einsum("vc,mjc->vmj", sources.cam_from_world[:, 2, :3], apart)
    parts = [dz]
    for octave in range(PARAMS.octaves):
        angle = math.pi * 2**octave * dz
        parts += [angle.sin(), angle.cos()]
    return torch.cat([part * weight for part in parts], -1)


@torch.no_grad()
def visual_hull(features: SourceFeatures, key_points: Tensor) -> tuple[Space, Tensor]:
    """Return an occupancy grid of the visual hull within ``AROUND`` of the bones of key points (J,
    3)."""
    low = key_points.amin(0)
    high = key_points.amax(0)
    half = float((high - low).max()) / 2 + AROUND
    x, y, z = ((low + high) / 2).tolist()
    space = Space((x, y, z), half, 1, PARAMS.cells)
    axis = (torch.arange(PARAMS.cells, device=low.device) + 0.5) / PARAMS.cells
    # The first axis of the grid is z.
    middles = to_world(torch.cartesian_prod(axis, axis, axis).flip(1), space)
    grid, depth = features.project(middles)
    sources = features.sources
    reach = half / PARAMS.cells * math.sqrt(3)
    nearest = depth.amin(1).clamp_min(NEAR)
    # largest size of a cell in an image
    pixels = math.ceil(reach * float((sources.intrinsics[:, 0, 0] / nearest).max())) + 1
    alpha = max_pool2d(sources.rgba[:, 3:], (2 * pixels + 1, 1), 1, (pixels, 0))
    alpha = max_pool2d(alpha, (1, 2 * pixels + 1), 1, (0, pixels))
    occupied = (sample_maps(alpha, grid, "nearest")[..., 0] > PARAMS.visible).all(0)
    where = occupied.nonzero()[:, 0]
    occupied[where] = distance_to_bones(middles[where], key_points) < AROUND
    return space, occupied.view(space.shape)


def distance_to_bones(points: Tensor, key_points: Tensor) -> Tensor:
    """Return the distances (M,) of points (M, 3) to the nearest bone of key points (J, 3), m."""
    starts = key_points[list(JOINT_PARENTS[1 : len(key_points)])]
    bones = key_points[1:] - starts
    offsets = points[:, None] - starts
    at = (offsets * bones).sum(-1) / bones.square().sum(-1).clamp_min(1e-12)
    return (offsets - at.clamp(0, 1)[..., None] * bones).norm(dim=-1).amin(1)


def to_world(coords: Tensor, space: Space) -> Tensor:
    """Return positions (M, 3) of coordinates (M, 3) in the unit cube."""
    return (coords - 0.5) * (2 * space.half) + coords.new_tensor(space.centre)
