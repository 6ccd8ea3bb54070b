"""NeRF (Mildenhall et al. 2020): a coarse and a fine network of positions and directions, the slow
reference.

R rays, K samples of each, M = R K.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from dyngs.baselines.fields.field import PUBLISHED_HALF, TIME, Field, Seen, encoded, with_time
from dyngs.baselines.fields.keys import NerfModel
from dyngs.core.initialisation import glorot
from dyngs.core.state import Role, State, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.models.checkpoint import Checkpoint
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.rays import Composited, Rays, Samples, Space, composite

LAST = 1e10  # Length of the last sample of a ray: whatever is dense there hides the background
_LEAST = 1e-5  # Weight of an interval that nothing was seen in
DEPTH, SKIP = 8, 5  # Hidden layers of the trunk; the layer that sees the position again
POSITION_OCTAVES, DIRECTION_OCTAVES = 10, 4
POSITION = 3 * (1 + 2 * POSITION_OCTAVES)
DIRECTION = 3 * (1 + 2 * DIRECTION_OCTAVES)


@dataclass(frozen=True)
class NerfSizes:
    """Sizes of the networks, and of a step of their training."""

    width: int  # features of the hidden layers
    coarse: int  # samples of a ray for the coarse network
    fine: int  # more of them for the fine network
    rays: int  # of a step
    lr: float  # learning rate of Adam at first


SIZES = {
    "tiny": NerfSizes(32, 12, 12, 64, 2e-3),
    "cpu": NerfSizes(128, 32, 32, 256, 1e-3),
    "published": NerfSizes(256, 64, 128, 1024, 5e-4),
}


@dataclass(frozen=True)
class NerfNetwork:
    """Weights and biases of the trunk, whose outputs are density and bottleneck, and of the
    colours' layers."""

    trunk: tuple[Layer, ...]
    head: tuple[Layer, ...]

    @staticmethod
    def shapes(model: NerfModel) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
        """Return (in, out) of the layers of trunk and head."""
        width = SIZES[model.sizes].width
        first = POSITION + (TIME if model.time else 0)
        trunk = [first, *[width] * DEPTH, width + 1]
        pairs = [(i + (first if n == SKIP else 0), o) for n, (i, o) in enumerate(pairwise(trunk))]
        return pairs, [(width + DIRECTION, width // 2), (width // 2, 3)]

    @staticmethod
    def new(model: NerfModel, generator: torch.Generator) -> NerfNetwork:
        def layer(inputs: int, outputs: int) -> Layer:
            bias = torch.zeros(outputs, device="cpu").requires_grad_()
            return Layer(glorot(inputs, outputs, generator).requires_grad_(), bias)

        trunk, head = (
            tuple(layer(*shape) for shape in shapes) for shapes in NerfNetwork.shapes(model)
        )
        return NerfNetwork(trunk, head)

    @staticmethod
    def restored(model: NerfModel, stored: Mapping[str, Tensor], name: str) -> NerfNetwork:
        """Return the network ``name`` of a state. Raises KeyError or ValueError."""

        def tensor(key: str, *shape: int) -> Tensor:
            return require_tensor(key, stored[key], shape).clone()

        trunk, head = (
            tuple(
                Layer(
                    tensor(f"{name}.{part}.{n}.weight", o, i), tensor(f"{name}.{part}.{n}.bias", o)
                )
                for n, (i, o) in enumerate(shapes)
            )
            for part, shapes in zip(("trunk", "head"), NerfNetwork.shapes(model), strict=True)
        )
        return NerfNetwork(trunk, head)

    @property
    def parameters(self) -> dict[str, Tensor]:
        parts = {"trunk": self.trunk, "head": self.head}
        layers = {
            f"{name}.{n}": layer for name, part in parts.items() for n, layer in enumerate(part)
        }
        return {
            f"{name}.{kind}": getattr(x, kind)
            for name, x in layers.items()
            for kind in ("weight", "bias")
        }

    def outputs(self, places: Tensor) -> Tensor:
        """Return (M, 1 + width) raw densities and bottlenecks of encoded places."""
        return perceptron(places, self.trunk, skip=SKIP)

    def colours(self, outputs: Tensor, directions: Tensor) -> Tensor:
        """Return (M, 3) colours, seen along encoded directions."""
        return perceptron(torch.cat([outputs[:, 1:], directions], 1), self.head).sigmoid()


@dataclass(frozen=True)
class NerfField(Field):
    """Two networks: the coarse one says where the fine one looks closer."""

    space: Space
    coarse: NerfNetwork
    fine: NerfNetwork
    num_coarse: int  # samples of a ray
    num_fine: int  # more of them for the fine network
    sees_time: bool = False

    @staticmethod
    def new(model: NerfModel, space: Space, generator: torch.Generator) -> NerfField:
        coarse, fine = (NerfNetwork.new(model, generator) for _ in range(2))
        sizes = SIZES[model.sizes]
        return NerfField(space, coarse, fine, sizes.coarse, sizes.fine, model.time)

    @staticmethod
    def restored(model: NerfModel, space: Space, checkpoint: Checkpoint) -> NerfField:
        """Return the field of a checkpoint. Raises KeyError or ValueError where its tensors do not
        fit."""
        stored = checkpoint.part("field")
        coarse, fine = (NerfNetwork.restored(model, stored, name) for name in ("coarse", "fine"))
        sizes = SIZES[model.sizes]
        return NerfField(space, coarse, fine, sizes.coarse, sizes.fine, model.time)

    @property
    def num_shifts(self) -> int:
        return self.num_coarse + self.num_fine

    @property
    def parameters(self) -> Mapping[str, Tensor]:
        networks = {"coarse": self.coarse, "fine": self.fine}
        return {
            f"{name}.{key}": x
            for name, network in networks.items()
            for key, x in network.parameters.items()
        }

    def state(self) -> State:
        return with_role({name: x.detach() for name, x in self.parameters.items()}, Role.SHARED)

    def seen(self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None) -> Seen:
        if shifts is None:
            shifts = rays.origins.new_full((len(rays), self.num_shifts), 0.5)
        distances = evenly(rays, self.space, near, shifts[:, : self.num_coarse])
        coarse, weights = self._through(self.coarse, rays, distances, time)
        distances = by_weights(distances, weights, shifts[:, self.num_coarse :])
        fine, _ = self._through(self.fine, rays, distances, time)
        return replace(fine, num_samples=fine.num_samples + coarse.num_samples, coarse=coarse)

    def densities(self, points: Tensor, time: float) -> Tensor:
        return self._densities(self.fine.outputs(self._places(self.space.unit(points), time)))

    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        outputs = self.fine.outputs(self._places(self.space.unit(points), time))
        return self.fine.colours(outputs, encoded(directions, DIRECTION_OCTAVES))

    def _through(
        self, network: NerfNetwork, rays: Rays, distances: Tensor, time: float
    ) -> tuple[Seen, Tensor]:
        """Return what rays see at distances (R, K), ascending, and the weights (R, K) of these."""
        samples = along(rays, self.space, distances)
        outputs = network.outputs(self._places(samples.coords, time))
        directions = encoded(rays.directions, DIRECTION_OCTAVES)[samples.rays]
        seen: Composited = composite(
            self._densities(outputs), network.colours(outputs, directions), samples, 0.0
        )
        weights = seen.weights.view(distances.shape)
        # at the sample, as published; the last one has no middle
        depth = (weights * distances).sum(1)
        return Seen(seen.colour, seen.transmittance, depth, len(samples)), weights

    def _places(self, coords: Tensor, time: float) -> Tensor:
        """Return encoded positions, in the unit of the published scenes, and time."""
        places = encoded((coords - 0.5) * (2 * PUBLISHED_HALF), POSITION_OCTAVES)
        return with_time(places, time) if self.sees_time else places

    def _densities(self, outputs: Tensor) -> Tensor:
        return outputs[:, 0].relu() * (PUBLISHED_HALF / self.space.half)


@torch.no_grad()
def crossed(rays: Rays, space: Space, near: float) -> tuple[Tensor, Tensor]:
    """Return distances (R,) at which rays enter and leave the outermost cube, from ``near`` on;
    equal if they miss."""
    offsets = rays.origins - rays.origins.new_tensor(space.centre)
    walls = torch.stack([-space.outermost - offsets, space.outermost - offsets]) / rays.directions
    walls = walls.nan_to_num(0.0)  # along a wall, within it
    begin = walls.amin(0).amax(1).clamp_min(near)
    return begin, torch.maximum(walls.amax(0).amin(1), begin)


@torch.no_grad()
def evenly(rays: Rays, space: Space, near: float, shifts: Tensor) -> Tensor:
    """Return distances (R, K) of samples, one in each of K equal parts of the way through the
    space, ascending.

    ``shifts`` (R, K) in [0, 1): where in its part each lies. Parts are equal in the distance; with
    surroundings in its inverse, so that what is far away gets few.
    """
    begin, end = (x[:, None] for x in crossed(rays, space, near))
    at = (torch.arange(shifts.shape[1], device=shifts.device) + shifts) / shifts.shape[1]
    if space.cascades == 1:
        return begin + (end - begin) * at
    return 1 / ((1 - at) / begin + at / end)


@torch.no_grad()
def by_weights(distances: Tensor, weights: Tensor, shifts: Tensor) -> Tensor:
    """Return (R, K + N) distances, ascending: those given (R, K), and N more where their weights
    (R, K) are.

    The inverse of the distribution that is even between the middles of samples and has the weights
    of the inner ones. ``shifts`` (R, N) in [0, 1): where in its N-th of the distribution each lies.
    """
    edges = (distances[:, 1:] + distances[:, :-1]) / 2
    mass = weights[:, 1:-1] + _LEAST
    below = torch.cat([torch.zeros_like(mass[:, :1]), mass.cumsum(1)], 1)
    below = below / below[:, -1:]
    wanted = (torch.arange(shifts.shape[1], device=shifts.device) + shifts) / shifts.shape[1]
    right = torch.searchsorted(below, wanted.contiguous(), right=True).clamp(1, below.shape[1] - 1)
    low = below.gather(1, right - 1)
    high = below.gather(1, right)
    first = edges.gather(1, right - 1)
    last = edges.gather(1, right)
    fraction = (wanted - low) / (high - low).clamp_min(_LEAST * _LEAST)
    return torch.cat([distances, first + (last - first) * fraction], 1).sort(1).values


@torch.no_grad()
def along(rays: Rays, space: Space, distances: Tensor) -> Samples:
    """Return samples from each of the distances (R, K) to the next; coordinates are of their
    starts."""
    count, each = distances.shape
    points = rays.origins[:, None] + rays.directions[:, None] * distances[..., None]
    ends = torch.cat([distances[:, 1:], distances[:, -1:] + LAST], 1)
    which = torch.arange(count, device=distances.device)
    return Samples(
        offsets=torch.arange(count + 1, device=distances.device) * each,
        rays=which.repeat_interleave(each),
        starts=distances.flatten(),
        ends=ends.flatten(),
        coords=space.unit(points).view(-1, 3),
    )
