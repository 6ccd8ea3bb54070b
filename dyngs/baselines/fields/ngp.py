"""Instant-NGP (Müller et al. 2022): a multiresolution hash grid, a density and a colour network,
occupied cells.

Trained by the protocol of nerfacc's occupancy grid (Li et al. 2023).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from dyngs.baselines.fields.field import (
    PUBLISHED_HALF,
    TIME,
    Field,
    Seen,
    network,
    truncated_exp,
    with_time,
)
from dyngs.baselines.fields.keys import NgpModel
from dyngs.core.initialisation import glorot
from dyngs.core.state import Role, State, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.volume import reached_samples, thinned_samples
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.hash_grid import HashLevels, hash_features, known_features
from dyngs.ops.rays import Rays, Space, Steps, composite, march

# Features of hidden layers, and of the density network's output, whose first is the density
WIDTH, GEOMETRY = 64, 16
# Of the harmonics of directions; Instant-NGP counts degrees from 1
DIRECTION_DEGREE, DIRECTION_TERMS = 3, 16
# Least length of a sample where there are several cubes, in its distance over `across`: 1/256 as
# published
CONE = 4.0
LOG2_SAMPLES = 14  # Samples of a step, for a CPU
PUBLISHED_PIXELS = 800  # Along a side of the images of published figures
ACROSS = 1024 / PUBLISHED_PIXELS
FINEST = 2.56
"""For a CPU, per pixel of an image's longest side: samples along the diagonal of the innermost
cube, as published, and cells of the finest level along an axis, half as published; twice as many
where the innermost cube is half of all."""
FIRST = 1e-4  # Rows of the grid begin within this of 0


@dataclass(frozen=True)
class NgpSizes:
    """Sizes of a field and of a step of its training."""

    levels: HashLevels
    features: int
    num_samples: int  # of a step
    across: int  # samples along the diagonal of the innermost cube

    @staticmethod
    def of(model: NgpModel, pixels: int = PUBLISHED_PIXELS, cascades: int = 1) -> NgpSizes:
        """Return what ``model`` asks for; the rest is for a CPU and images of ``pixels``, or as
        published."""
        published = model.sizes == "published"
        levels = model.levels or (16 if published else 8)
        features = model.features or (2 if published else 4)
        log2_rows = model.log2_rows or (19 if published else 16)
        finest = model.finest or (
            4096 if published else min(max(64, round(FINEST * pixels * min(cascades, 2))), 4096)
        )
        across = 1024 if published else min(max(128, round(ACROSS * pixels)), 1024)
        grid = HashLevels.geometric(levels, 16, finest, 1 << log2_rows)
        return NgpSizes(
            grid, features, 1 << (model.log2_samples or (18 if published else LOG2_SAMPLES)), across
        )


@dataclass(frozen=True)
class NgpField(Field):
    """A hash grid with its two networks, and the cells in which anything is.

    Attributes:
        table: (rows, F) of all levels.
        density, colour: weights of the networks, (out, in) each.
        occupied: bool of ``space.shape``.
        pixels: of the longest side of the images that it was made for.
        across: samples along the diagonal of the innermost cube.
    """

    space: Space
    pixels: int
    levels: HashLevels
    table: Tensor
    density: tuple[Tensor, ...]
    colour: tuple[Tensor, ...]
    occupied: Tensor
    across: int
    sees_time: bool = False

    @staticmethod
    def new(
        model: NgpModel, space: Space, generator: torch.Generator, pixels: int = PUBLISHED_PIXELS
    ) -> NgpField:
        """Return a field before the first step: nearly grey, hardly dense, occupied everywhere.

        ``pixels``: of the longest side of the images.
        """
        sizes = NgpSizes.of(model, pixels, space.cascades)
        rows = torch.rand(
            (sizes.levels.num_rows, sizes.features), generator=generator, device="cpu"
        )
        weights = [
            tuple(glorot(i, o, generator).requires_grad_() for i, o in pairwise(widths))
            for widths in _widths(sizes, model.time).values()
        ]
        occupied = torch.ones(space.shape, dtype=torch.bool, device="cpu")
        table = (FIRST * (2 * rows - 1)).requires_grad_()
        return NgpField(
            space,
            pixels,
            sizes.levels,
            table,
            weights[0],
            weights[1],
            occupied,
            sizes.across,
            model.time,
        )

    @staticmethod
    def restored(model: NgpModel, space: Space, checkpoint: Checkpoint) -> NgpField:
        """Return the field of a checkpoint. Raises KeyError or ValueError where its tensors do not
        fit."""
        stored = checkpoint.part("field")
        pixels = int(require_tensor("pixels", stored["pixels"], (1,), torch.int64))
        sizes = NgpSizes.of(model, pixels, space.cascades)
        table = require_tensor(
            "table", stored["table"], (sizes.levels.num_rows, sizes.features)
        ).clone()
        networks = {
            name: tuple(
                require_tensor(f"{name}.{i}", stored[f"{name}.{i}"], (out, before)).clone()
                for i, (before, out) in enumerate(pairwise(w))
            )
            for name, w in _widths(sizes, model.time).items()
        }
        count = math.prod(space.shape)
        bits = require_tensor("occupied", stored["occupied"], (-(-count // 8),), torch.uint8)
        occupied = _unpacked(bits, space)
        return NgpField(
            space,
            pixels,
            sizes.levels,
            table,
            networks["density"],
            networks["colour"],
            occupied,
            sizes.across,
            model.time,
        )

    @property
    def num_shifts(self) -> int:
        return 2  # where the samples of a ray lie, and which of those that hardly show are taken

    @property
    def parameters(self) -> Mapping[str, Tensor]:
        networks = {"density": self.density, "colour": self.colour}
        weights = {
            f"{name}.{i}": x for name, network in networks.items() for i, x in enumerate(network)
        }
        return {"table": self.table, **weights}

    def state(self) -> State:
        tensors = {name: x.detach() for name, x in self.parameters.items()}
        own = {
            "occupied": _packed(self.occupied),
            "pixels": torch.tensor([self.pixels], device="cpu"),
        }
        return with_role(tensors | own, Role.SHARED)

    @cached_property
    def step(self) -> float:
        """Length of a sample, world units."""
        return 2 * self.space.half * math.sqrt(3) / self.across

    def seen(self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None) -> Seen:
        steps = Steps(near, self.step, CONE / self.across if self.space.cascades > 1 else 0.0)
        shift = (
            rays.origins.new_full((len(rays),), 0.5)
            if shifts is None
            else shifts[:, 0].contiguous()
        )
        marched = march(rays, shift, self.space, self.occupied, steps)
        with torch.no_grad():  # which samples are worth it takes their densities alone
            features = hash_features(marched.coords, self.table, self.levels)
            densities = self._density(self._geometry(features, time), marched.coords)
            if shifts is None:
                samples, which = reached_samples(densities, marched)
            else:
                samples, which = thinned_samples(densities, marched, shifts[:, 1])
        geometry = self._geometry(
            known_features(features, which, samples.coords, self.table, self.levels), time
        )
        basis = harmonics_basis(rays.directions, DIRECTION_DEGREE)
        colours = self._colours(geometry, basis[samples.rays])
        drawn = composite(self._density(geometry, samples.coords), colours, samples)
        return Seen(drawn.colour, drawn.transmittance, drawn.depth, len(samples))

    def densities(self, points: Tensor, time: float) -> Tensor:
        coords = self.space.unit(points)
        return self._density(
            self._geometry(hash_features(coords, self.table, self.levels), time), coords
        )

    def may_hold(self, points: Tensor) -> Tensor:
        """See ``Field``: what lies in occupied cells, or beyond the innermost cube."""
        n = self.space.cells
        middle = points.new_tensor(self.space.centre)
        place = ((points - middle) / self.space.half + 1) * (n / 2)
        x, y, z = place.long().clamp(0, n - 1).unbind(1)
        return self.occupied[0, z, y, x] | ((place < 0) | (place > n)).any(1)

    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        geometry = self._geometry(
            hash_features(self.space.unit(points), self.table, self.levels), time
        )
        return self._colours(geometry, harmonics_basis(directions, DIRECTION_DEGREE))

    def _geometry(self, features: Tensor, time: float) -> Tensor:
        return network(with_time(features, time) if self.sees_time else features, self.density)

    def _density(self, geometry: Tensor, coords: Tensor) -> Tensor:
        """Return (M,) densities, per world unit; the published ones are per unit of a cube of half
        side 1.5.

        Outside of the innermost cube it is per unit of a cube on whose side the point lies, so that
        a field which has learned nothing is as dense a mist in each.
        """
        found = truncated_exp(geometry[:, 0] - 1) * (PUBLISHED_HALF / self.space.half)
        if self.space.cascades == 1:
            return found
        return found * (2 - 4 * (coords - 0.5).abs().amax(1)).clamp(max=1)  # 1 over the max-norm

    def _colours(self, geometry: Tensor, basis: Tensor) -> Tensor:
        return network(torch.cat([geometry, basis], 1), self.colour).sigmoid()


def _widths(sizes: NgpSizes, sees_time: bool) -> dict[str, tuple[int, ...]]:
    """Return how many features go into each layer of the networks, and come out of the last."""
    inputs = len(sizes.levels.rows) * sizes.features + (TIME if sees_time else 0)
    return {
        "density": (inputs, WIDTH, GEOMETRY),
        "colour": (GEOMETRY + DIRECTION_TERMS, WIDTH, WIDTH, 3),
    }


def _packed(occupied: Tensor) -> Tensor:
    """Return (cells / 8,) uint8, rounded up: bit i % 8 of byte i / 8 is cell i."""
    flat = occupied.flatten()
    flat = torch.cat([flat, flat.new_zeros(-len(flat) % 8)]).view(-1, 8)
    return (flat.to(torch.uint8) << torch.arange(8, dtype=torch.uint8, device=flat.device)).sum(
        1, dtype=torch.uint8
    )


def _unpacked(bits: Tensor, space: Space) -> Tensor:
    flat = bits[:, None] >> torch.arange(8, dtype=torch.uint8, device=bits.device) & 1
    return flat.bool().flatten()[: math.prod(space.shape)].reshape(space.shape)
