"""NeRF (Mildenhall et al. 2020): a coarse and a fine MLP on encoded positions and directions.

Local letters: R rays, K samples per ray, M = R K.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from dyngs.baselines.fields.kind import NerfModel
from dyngs.baselines.fields.scene import (
    PUBLISHED_HALF,
    PUBLISHED_PIXELS,
    TIME,
    RadianceField,
    RenderedRays,
    encode_frequencies,
    restore_parameters,
)
from dyngs.baselines.fields.training import FieldTraining
from dyngs.core.initialisation import glorot
from dyngs.models.kind import StartContext
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.rays import Rays, Samples, Space, composite

LAST_LENGTH = 1e10  # length of the last sample of a ray, so that its density blocks the background
_MIN_WEIGHT = 1e-5  # smallest weight of an interval
DEPTH, SKIP = 8, 5  # hidden layers of the trunk; the layer that gets the position again
POSITION_OCTAVES, DIRECTION_OCTAVES = 10, 4
POSITION = 3 * (1 + 2 * POSITION_OCTAVES)
DIRECTION = 3 * (1 + 2 * DIRECTION_OCTAVES)
LAST_RATE = 0.1  # ratio of the last to the first learning rate


@dataclass(frozen=True)
class NerfSizes:
    """Sizes of the networks and of a training step."""

    width: int  # features of the hidden layers
    coarse: int  # samples per ray of the coarse network
    fine: int  # additional samples of the fine network
    rays: int  # rays per step
    lr: float  # initial learning rate of Adam


SIZES = {
    "tiny": NerfSizes(32, 12, 12, 64, 2e-3),
    "cpu": NerfSizes(128, 32, 32, 256, 1e-3),
    "published": NerfSizes(256, 64, 128, 1024, 5e-4),
}


def parameter_shapes(model: NerfModel) -> dict[str, tuple[int, ...]]:
    """Return the parameter shapes of both networks.

    Each network has a trunk (density and bottleneck) and a head (colours).
    """
    width = SIZES[model.sizes].width
    first = POSITION + (TIME if model.time else 0)
    trunk = [first, *[width] * DEPTH, width + 1]
    layers = {f"trunk.{n}": (out, before) for n, (before, out) in enumerate(pairwise(trunk))}
    layers[f"trunk.{SKIP}"] = (width, width + first)
    layers |= {"head.0": (width // 2, width + DIRECTION), "head.1": (3, width // 2)}
    shapes_by_name: dict[str, tuple[int, ...]] = {}
    for network in ("coarse", "fine"):
        for name, (out, before) in layers.items():
            shapes_by_name[f"{network}.{name}.weight"] = (out, before)
            shapes_by_name[f"{network}.{name}.bias"] = (out,)
    return shapes_by_name


@dataclass(frozen=True)
class NerfField(RadianceField):
    """Two networks: the coarse one places the samples of the fine one."""

    @classmethod
    def new(
        cls,
        model: NerfModel,
        space: Space,
        generator: torch.Generator,
        pixels: int = PUBLISHED_PIXELS,
    ) -> NerfField:
        parameters = {
            name: glorot(shape[1], shape[0], generator)
            if len(shape) == 2
            else torch.zeros(shape, device="cpu")
            for name, shape in parameter_shapes(model).items()
        }
        return cls(model, space, parameters)

    @classmethod
    def from_state(cls, model: NerfModel, space: Space, stored: Mapping[str, Tensor]) -> NerfField:
        return cls(model, space, restore_parameters(stored, parameter_shapes(model)))

    @property
    def num_random_values(self) -> int:
        sizes = SIZES[self.model.sizes]
        return sizes.coarse + sizes.fine

    def render_rays(
        self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None
    ) -> RenderedRays:
        if shifts is None:
            shifts = rays.origins.new_full((len(rays), self.num_random_values), 0.5)
        num_coarse = SIZES[self.model.sizes].coarse
        distances = sample_evenly(rays, self.space, near, shifts[:, :num_coarse])
        coarse, weights = self._render_samples("coarse", rays, distances, time)
        distances = sample_by_weights(distances, weights, shifts[:, num_coarse:])
        fine, _ = self._render_samples("fine", rays, distances, time)
        return replace(fine, num_samples=fine.num_samples + coarse.num_samples, coarse=coarse)

    def densities(self, points: Tensor, time: float) -> Tensor:
        return self._densities(self._outputs("fine", self.space.unit(points), time))

    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        outputs = self._outputs("fine", self.space.unit(points), time)
        return self._colours("fine", outputs, encode_frequencies(directions, DIRECTION_OCTAVES))

    def _render_samples(
        self, network: str, rays: Rays, distances: Tensor, time: float
    ) -> tuple[RenderedRays, Tensor]:
        """Render rays from samples at ``distances`` (R, K), ascending; also return their weights
        (R, K)."""
        samples = build_samples(rays, self.space, distances)
        outputs = self._outputs(network, samples.coords, time)
        directions = encode_frequencies(rays.directions, DIRECTION_OCTAVES)[samples.rays]
        colours = self._colours(network, outputs, directions)
        seen = composite(self._densities(outputs), colours, samples, 0.0)
        weights = seen.weights.view(distances.shape)
        # at the sample, as published; the last interval has no middle
        depth = (weights * distances).sum(1)
        return RenderedRays(seen.colour, seen.transmittance, depth, len(samples)), weights

    def _layers(self, name: str, count: int) -> list[Layer]:
        own = self.parameters
        return [Layer(own[f"{name}.{n}.weight"], own[f"{name}.{n}.bias"]) for n in range(count)]

    def _outputs(self, network: str, coords: Tensor, time: float) -> Tensor:
        """Return raw densities and bottlenecks (M, 1 + width) at ``coords`` in the unit cube."""
        # in the unit of the published scenes
        places = encode_frequencies((coords - 0.5) * (2 * PUBLISHED_HALF), POSITION_OCTAVES)
        trunk = self._layers(f"{network}.trunk", DEPTH + 1)
        return perceptron(self.with_time(places, time), trunk, skip=SKIP)

    def _colours(self, network: str, outputs: Tensor, directions: Tensor) -> Tensor:
        """Return colours (M, 3) for encoded view directions."""
        head = self._layers(f"{network}.head", 2)
        return perceptron(torch.cat([outputs[:, 1:], directions], 1), head).sigmoid()

    def _densities(self, outputs: Tensor) -> Tensor:
        return outputs[:, 0].relu() * (PUBLISHED_HALF / self.space.half)


@torch.no_grad()
def intersect_space(rays: Rays, space: Space, near: float) -> tuple[Tensor, Tensor]:
    """Return the distances (R,) at which rays enter and leave the outermost cube; equal for
    misses."""
    offsets = rays.origins - rays.origins.new_tensor(space.centre)
    walls = torch.stack([-space.outermost - offsets, space.outermost - offsets]) / rays.directions
    walls = walls.nan_to_num(0.0)  # rays inside a wall
    begin = walls.amin(0).amax(1).clamp_min(near)
    return begin, torch.maximum(walls.amax(0).amin(1), begin)


@torch.no_grad()
def sample_evenly(rays: Rays, space: Space, near: float, shifts: Tensor) -> Tensor:
    """Sample one distance in each of K equal intervals through the space; return (R, K),
    ascending.

    ``shifts`` (R, K) in [0, 1): position in the interval. With surroundings the intervals are
    equal in inverse distance, so that distant space gets few samples.
    """
    begin, end = (x[:, None] for x in intersect_space(rays, space, near))
    at = (torch.arange(shifts.shape[1], device=shifts.device) + shifts) / shifts.shape[1]
    if space.cascades == 1:
        return begin + (end - begin) * at
    return 1 / ((1 - at) / begin + at / end)


@torch.no_grad()
def sample_by_weights(distances: Tensor, weights: Tensor, shifts: Tensor) -> Tensor:
    """Add N samples distributed by the weights (R, K) of the coarse samples; return (R, K + N),
    ascending.

    Inverse transform sampling of the piecewise constant density between the middles of samples.
    ``shifts`` (R, N) in [0, 1): position within each N-th of the distribution.
    """
    edges = (distances[:, 1:] + distances[:, :-1]) / 2
    mass = weights[:, 1:-1] + _MIN_WEIGHT
    below = torch.cat([torch.zeros_like(mass[:, :1]), mass.cumsum(1)], 1)
    below = below / below[:, -1:]
    wanted = (torch.arange(shifts.shape[1], device=shifts.device) + shifts) / shifts.shape[1]
    right = torch.searchsorted(below, wanted.contiguous(), right=True).clamp(1, below.shape[1] - 1)
    low = below.gather(1, right - 1)
    high = below.gather(1, right)
    first = edges.gather(1, right - 1)
    last = edges.gather(1, right)
    fraction = (wanted - low) / (high - low).clamp_min(_MIN_WEIGHT * _MIN_WEIGHT)
    return torch.cat([distances, first + (last - first) * fraction], 1).sort(1).values


@torch.no_grad()
def build_samples(rays: Rays, space: Space, distances: Tensor) -> Samples:
    """Build samples that extend from each distance (R, K) to the next; coordinates are at their
    starts."""
    count, each = distances.shape
    points = rays.origins[:, None] + rays.directions[:, None] * distances[..., None]
    ends = torch.cat([distances[:, 1:], distances[:, -1:] + LAST_LENGTH], 1)
    which = torch.arange(count, device=distances.device)
    return Samples(
        offsets=torch.arange(count + 1, device=distances.device) * each,
        rays=which.repeat_interleave(each),
        starts=distances.flatten(),
        ends=ends.flatten(),
        coords=space.unit(points).view(-1, 3),
    )


class NerfTraining(FieldTraining):
    """Training of NeRF: a fixed number of rays and an exponentially decaying learning rate."""

    def __init__(self, run: StartContext) -> None:
        super().__init__(run, NerfField, 1, 0)
        self._sizes = SIZES[self._model.sizes]

    @property
    def num_rays(self) -> int:
        return max(1, self._sizes.rays // self._batch)

    def learning_rate(self, step: int) -> float:
        highest = self._model.lr or self._sizes.lr
        return highest * LAST_RATE ** (step / self._run.config.train.steps)
