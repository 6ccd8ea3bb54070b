"""KeypointNeRF (Mihajlovic et al. 2022): a field whose points are placed by their depth relative to
key points.

Samples lie where all images show the person. Per image, the network knows a sample by how much
nearer or farther it is to that camera than each key point nearby, and by the features of the pixel;
mean and variance over images give the density, and weights by which the colours of the images are
blended.

Local letters: V images, M samples, J key points, R rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d, softplus

from dyngs.core.camera import Cameras
from dyngs.human.body.joints import JOINT_PARENTS
from dyngs.human.predict.fields.network import (
    FINE,
    NEAR,
    EncodedPerson,
    FieldNetwork,
    FieldPicture,
    Perceptron,
    SourceFeatures,
    begin,
    between,
    blended,
    mean_and_variance,
    sample_offsets,
    split_rays,
)
from dyngs.human.predict.people import NUM_KEY_POINTS, PosedBody, Sources
from dyngs.models.volume import camera_rays, reached_samples, select_samples, thin_samples
from dyngs.ops.rays import MarchSteps, Rays, Samples, Space, composite, march


@dataclass(frozen=True)
class KeypointNerfParams:
    """Sizes and lengths (m)."""

    features: int = 32  # of a pixel of the images
    width: int = 64  # features of hidden layers
    step: float = 0.015  # length of a sample of a ray
    octaves: int = 3  # of sines and cosines of relative depths
    reach: float = 0.1  # standard deviation of how far a key point counts
    cells: int = 32  # of the cube around a person, along an axis
    visible: float = 0.1  # alpha from which an image shows the person
    densest: float = 100.0  # density, per m, that the network's output is a multiple of
    thick: float = 0.065  # distance of the surface from the bones at first
    steep: float = 60.0  # by how much raw densities fall at first, per m from the bones
    pooled: int = 32  # features of a sample per image
    geometry: int = 24  # features of what is known about the surface at a sample


PARAMS = KeypointNerfParams()
AROUND = 0.3  # m around the bones that a person fills
CODE = NUM_KEY_POINTS * (1 + 2 * PARAMS.octaves)
HINTS = 4  # What is known of a sample from the bones and the silhouettes


class KeypointNerf(FieldNetwork):
    """See the module."""

    def __init__(self, generator: torch.Generator) -> None:
        super().__init__(PARAMS.features)
        width = PARAMS.width
        colours = 3 + FINE + PARAMS.geometry
        self.per_image = Perceptron(CODE + PARAMS.features + FINE, width, width, PARAMS.pooled)
        self.geometry = Perceptron(2 * PARAMS.pooled + HINTS, width, width, 1 + PARAMS.geometry)
        self.blend = Perceptron(3 * colours + 4, width, width // 2, 1)
        begin(self, generator)

    def prepared(self, seen: SourceFeatures, body: PosedBody) -> tuple[Space, Tensor]:
        return visual_hull(seen, body.key_points)

    def picture(
        self, known: EncodedPerson, camera: Cameras, generator: torch.Generator | None = None
    ) -> FieldPicture:
        rays, _ = camera_rays(camera)
        shifts = sample_offsets(len(rays), generator=generator).to(rays.origins)
        pieces = split_rays(torch.arange(len(rays), device=shifts.device))
        found = [self._along(known, rays[some], shifts[some]) for some in pieces]
        colour, through, depth = (torch.cat(x) for x in zip(*found, strict=True))
        shape = camera.height, camera.width
        return FieldPicture(colour.view(*shape, 3), through.view(shape), depth.view(shape))

    def _along(
        self, known: EncodedPerson, rays: Rays, shifts: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return colours before black (R, 3), transmittance (R,), and sums of weight times distance
        (R,)."""
        seen = known.seen
        space, occupied = known.own
        samples = march(rays, shifts, space, occupied, MarchSteps(NEAR, PARAMS.step))
        learns = torch.is_grad_enabled()
        with torch.no_grad():  # which samples are worth it takes their densities alone
            shown = seen.alpha(places(samples, space)) > PARAMS.visible
            samples = select_samples(samples, shown.all(0))[0]
            points = places(samples, space)
            code = spatial_code(points, known.body.key_points, seen.sources)
            geometry = self._geometry(known, points, code)
            if learns:
                samples, which = thin_samples(density(geometry), samples, shifts)
            else:
                samples, which = reached_samples(density(geometry), samples)
            points = points[which]
            geometry = geometry[which]
        if learns:
            geometry = self._geometry(known, points, code[:, which])
        densities = density(geometry)
        colours = self._colours(seen, geometry, points, rays.directions[samples.rays.long()])
        drawn = composite(densities, colours, samples)
        return drawn.colour, drawn.transmittance, drawn.depth

    def _geometry(self, known: EncodedPerson, points: Tensor, code: Tensor) -> Tensor:
        """Return (M, 1 + PARAMS.geometry): raw densities, and what is known of the surface at points (M,
        3).

        Densities begin with those of limbs of one thickness.
        """
        looked = known.seen.look(points)
        bone = distance_to_bones(points, known.body.key_points)[:, None]
        per_image = self.per_image(torch.cat([code, looked.features], -1))
        held = torch.stack([looked.alpha.amin(0), looked.alpha.mean(0)], -1)
        hints = torch.cat([bone / PARAMS.reach, (bone / PARAMS.reach).square(), held], -1)
        found = self.geometry(torch.cat([mean_and_variance(per_image), hints], -1))
        return torch.cat([found[:, :1] + PARAMS.steep * (PARAMS.thick - bone), found[:, 1:]], -1)

    def _colours(
        self, seen: SourceFeatures, geometry: Tensor, points: Tensor, directions: Tensor
    ) -> Tensor:
        """Return (M, 3) colours: of the images, blended."""
        looked = seen.look(points)
        count = len(seen.sources)
        own = torch.cat(
            [looked.rgb, looked.features[..., -FINE:], geometry[:, 1:].expand(count, -1, -1)], -1
        )
        both = mean_and_variance(own).expand(count, -1, -1)
        apart = between(directions, points, seen.sources.centers)
        logits = self.blend(torch.cat([own, both, apart], -1))[..., 0]
        return blended(logits, looked.rgb)


def density(geometry: Tensor) -> Tensor:
    """Return (M,) densities, per m, of raw ones in the first column."""
    return PARAMS.densest * softplus(geometry[:, 0])


@torch.no_grad()
def spatial_code(points: Tensor, key_points: Tensor, sources: Sources) -> Tensor:
    """Return the code (V, M, CODE) of points (M, 3): their depths relative to each key point (J,
    3), in each camera.

    dz, then sine and cosine of pi 2^l dz of each octave l, all times exp(-d^2 / (2 PARAMS.reach^2)) with
    the distance d in m.
    """
    apart = points[:, None] - key_points
    weight = (-apart.square().sum(-1) / (2 * PARAMS.reach**2)).exp()[None]
    axes = sources.cam_from_world[:, 2, :3]
    dz = (axes @ apart.view(-1, 3).T).view(len(axes), *apart.shape[:2])
    sine = (math.pi * dz).sin()
    cosine = (math.pi * dz).cos()
    parts = [dz]
    for octave in range(PARAMS.octaves):
        if octave:
            sine, cosine = 2 * sine * cosine, 1 - 2 * sine.square()
        parts += [sine, cosine]
    return torch.cat([part * weight for part in parts], -1)


@torch.no_grad()
def visual_hull(seen: SourceFeatures, key_points: Tensor) -> tuple[Space, Tensor]:
    """Return a cube, and which of its cells hold a place that all images show as the person.

    They are no further than ``AROUND`` from the bones between the key points (J, 3).
    """
    low = key_points.amin(0)
    high = key_points.amax(0)
    half = float((high - low).max()) / 2 + AROUND
    x, y, z = ((low + high) / 2).tolist()
    space = Space((x, y, z), half, 1, PARAMS.cells)
    axis = (torch.arange(PARAMS.cells, device=low.device) + 0.5) * (2 * half / PARAMS.cells) - half
    z, y, x = torch.meshgrid(*(axis + middle for middle in reversed(space.centre)), indexing="ij")
    middles = torch.stack([x, y, z], -1).view(-1, 3)
    grid, depth = seen.projected(middles)
    sources = seen.sources
    reach = half / PARAMS.cells * math.sqrt(3)
    occupied = torch.ones(len(middles), dtype=torch.bool, device=low.device)
    for i in range(len(sources)):
        nearest = max(float(depth[i].min()), NEAR)
        # that a cell may reach over
        pixels = math.ceil(reach * float(sources.intrinsics[i, 0, 0]) / nearest) + 1
        alpha = max_pool2d(sources.rgba[i : i + 1, 3:], (2 * pixels + 1, 1), 1, (pixels, 0))
        alpha = max_pool2d(alpha, (1, 2 * pixels + 1), 1, (0, pixels))
        places_in = grid[i][None, None]
        found = grid_sample(alpha, places_in, mode="nearest", align_corners=False)[0, 0, 0]
        occupied &= found > PARAMS.visible
    where = occupied.nonzero()[:, 0]
    occupied[where] = distance_to_bones(middles[where], key_points) < AROUND
    return space, occupied.view(space.shape)


def distance_to_bones(points: Tensor, key_points: Tensor) -> Tensor:
    """Return the distance (M,) of points (M, 3) to the nearest bone, m; ``key_points`` (J, 3)."""
    nearest = (points - key_points[0]).norm(dim=1)
    for joint, parent in enumerate(JOINT_PARENTS[1 : len(key_points)], start=1):
        start = key_points[parent]
        along = key_points[joint] - key_points[parent]
        at = ((points - start) @ along / along.square().sum().clamp_min(1e-12)).clamp(0, 1)
        nearest = torch.minimum(nearest, (points - start - at[:, None] * along).norm(dim=1))
    return nearest


def places(samples: Samples, space: Space) -> Tensor:
    """Return (M, 3) the middles of samples."""
    return (samples.coords - 0.5) * (2 * space.half) + samples.coords.new_tensor(space.centre)
