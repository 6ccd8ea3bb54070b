"""Ray marching through occupied cells, and volume rendering (Max 1995), differentiable.

R rays, M samples. The samples of ray r are ``offsets[r]`` to ``offsets[r + 1] - 1``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.ops.registration import Backward, empty_like, launch, register

TRANSMITTANCE_MIN = 1e-4  # A ray ends when less than this is left (Müller et al. 2022)


@dataclass(frozen=True)
class Space:
    """Nested cubes around a centre, each twice as large as the next inner one, with equal numbers
    of cells.

    Example:

        Space((0.0, 0.0, 0.0), half=1.5, cascades=1, cells=128)  # one cube: nothing lies outside of
        it
    """

    centre: tuple[float, float, float]  # world
    half: float  # half the side of the innermost cube, world units
    cascades: int  # number of cubes
    cells: int  # along an axis of each

    @property
    def outermost(self) -> float:
        """Half the side of the outermost cube, world units."""
        return self.half * 2 ** (self.cascades - 1)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(cubes, cells along z, y, x)."""
        return self.cascades, self.cells, self.cells, self.cells

    def unit(self, points: Tensor) -> Tensor:
        """Map world points (..., 3) into the unit cube.

        With several cubes, points outside the innermost are contracted: y to (2 - 1/|y|) y/|y| in
        the max-norm (Barron et al. 2022). The innermost cube becomes [1/4, 3/4]^3.
        """
        y = (points - points.new_tensor(self.centre)) / self.half
        if self.cascades == 1:
            return y / 2 + 0.5
        norm = y.abs().amax(-1, keepdim=True).clamp_min(1)
        return y * ((2 - 1 / norm) / norm) / 4 + 0.5


@dataclass(frozen=True)
class Rays:
    """R rays in the world, float32 or float64."""

    origins: Tensor  # (R, 3)
    directions: Tensor  # (R, 3) unit

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, which: slice | Tensor) -> Rays:
        return Rays(self.origins[which], self.directions[which])


@dataclass(frozen=True)
class Samples:
    """M samples of R rays."""

    offsets: Tensor  # (R + 1,) int64
    rays: Tensor  # (M,) int32 or int64 index of the ray
    starts: Tensor  # (M,) distance along the ray
    ends: Tensor  # (M,)
    coords: Tensor  # (M, 3) of the middle in the unit cube, see ``Space.unit``

    def __len__(self) -> int:
        return len(self.rays)

    @property
    def num_rays(self) -> int:
        return len(self.offsets) - 1


@dataclass(frozen=True)
class MarchSteps:
    """Sample lengths in world units: at least ``length``, and at least ``cone`` times the
    distance.
    """

    near: float
    length: float
    cone: float = 0.0
    most: int = 1 << 16  # of a ray


def _march_arguments(
    rays: list[Tensor], occupied: Tensor, space: list[float], steps: list[float]
) -> tuple[Any, ...]:
    """Return the arguments of both kernels: ray arrays, sizes, cells and options."""
    x, y, z, half, cascades, cells = space
    near, length, cone, most = steps
    return (
        *rays,
        ((x, y, z), half, int(cascades), int(cells)),
        occupied,
        (near, length, cone, int(most)),
    )


def _march_counts(
    rays: list[Tensor], occupied: Tensor, space: list[float], steps: list[float]
) -> Tensor:
    counts = rays[2].new_empty(rays[2].shape, dtype=torch.int64)
    given = _march_arguments(rays, occupied, space, steps)
    launch(rays[2], "march_count", *given, counts)
    return counts


march_counts_op = register("march_counts", _march_counts)
"""The number (R,) of samples of each ray; ``rays``: origins, directions, shifts."""


def _march_samples(
    rays: list[Tensor],
    occupied: Tensor,
    space: list[float],
    steps: list[float],
    offsets: Tensor,
    count: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    like = rays[2]
    which = like.new_empty(count, dtype=torch.int32)
    samples = which, like.new_empty(count), like.new_empty(count), like.new_empty(count, 3)
    given = _march_arguments(rays, occupied, space, steps)
    launch(like, "march_samples", *given, offsets, samples)
    return samples


march_samples_op = register("march_samples", _march_samples)
"""Ray, start, end (M,) and coordinates (M, 3) of the M = ``count`` samples whose ``offsets`` (R +
1,) are given."""


@torch.no_grad()
def march(rays: Rays, shifts: Tensor, space: Space, occupied: Tensor, steps: MarchSteps) -> Samples:
    """Return the samples of rays whose midpoints lie in occupied cells.

    Empty cells are skipped by whole steps. ``shifts`` (R,) in [0, 1) offset the samples of each
    ray by a fraction of a step. ``occupied`` is bool of ``space.shape``. Results do not depend on
    the number of threads. The host waits for the number of samples.
    """
    given = (
        [rays.origins.contiguous(), rays.directions.contiguous(), shifts.contiguous()],
        occupied,
        [*map(float, space.centre), float(space.half), float(space.cascades), float(space.cells)],
        [float(steps.near), float(steps.length), float(steps.cone), float(steps.most)],
    )
    offsets = offsets_of(march_counts_op(*given))
    return Samples(offsets, *march_samples_op(*given, offsets, int(offsets[-1])))


def _reached(
    densities: Tensor, starts: Tensor, ends: Tensor, offsets: Tensor, transmittance_min: float
) -> tuple[Tensor, Tensor]:
    which = densities.new_empty(densities.shape, dtype=torch.bool)
    counts = offsets.new_empty(offsets.shape[0] - 1)
    given = densities, starts, ends, offsets, transmittance_min
    launch(densities, "reached_samples", *given, which, counts)
    return which, counts


reached_op = register("reached", _reached)
"""Which samples (M,) are reached, and how many of each ray (R,)."""


@torch.no_grad()
def reached(
    densities: Tensor, samples: Samples, transmittance_min: float = TRANSMITTANCE_MIN
) -> tuple[Tensor, Tensor]:
    """Return an (M,) mask of samples that are not hidden by samples before them, and their (R +
    1,) offsets.
    """
    given = (
        densities.contiguous(),
        samples.starts,
        samples.ends,
        samples.offsets,
        transmittance_min,
    )
    which, counts = reached_op(*given)
    return which, offsets_of(counts)


def offsets_of(counts: Tensor) -> Tensor:
    """Return (R + 1,) exclusive prefix sums of ``counts`` (R,), ending with the total."""
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def _composite(
    densities: Tensor,
    colours: Tensor,
    starts: Tensor,
    ends: Tensor,
    offsets: Tensor,
    transmittance_min: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rays = offsets.shape[0] - 1
    out = (
        densities.new_empty(rays, 3),
        densities.new_empty(rays),
        densities.new_empty(rays),
        empty_like(densities),
    )
    given = densities, colours, starts, ends, offsets, transmittance_min
    launch(densities, "composite_forward", *given, out)
    return out


def _composite_backward(x: Backward) -> Sequence[Tensor]:
    *samples, transmittance_min = x.inputs
    densities, colours, *_ = samples
    results = empty_like(densities), empty_like(colours)
    given = *samples, transmittance_min, tuple(x.grads)
    launch(densities, "composite_backward", *given, *results)
    return results


composite_op = register(
    "composite", _composite, _composite_backward, "densities colours", constant=[3]
)
"""Colour (R, 3), transmittance (R,), sum of weight times distance (R,), and weights (M,)."""


@dataclass(frozen=True)
class Composited:
    """Rendered values of R rays."""

    colour: Tensor  # (R, 3) before black
    transmittance: Tensor  # (R,) that is left
    depth: Tensor  # (R,) sum of weight times the distance along the ray
    weights: Tensor  # (M,) of the samples, without gradient


def composite(
    densities: Tensor,
    colours: Tensor,
    samples: Samples,
    transmittance_min: float = TRANSMITTANCE_MIN,
) -> Composited:
    """Volume-render samples with densities (M,) per world unit and colours (M, 3), differentiable
    once.

    alpha = 1 - exp(-density length), weight = alpha times the transmittance before it. A ray ends
    when its transmittance falls below ``transmittance_min``. Results do not depend on the number
    of threads. Raises DyngsError: shapes or dtypes that do not fit.
    """
    given = (
        densities.contiguous(),
        colours.contiguous(),
        samples.starts,
        samples.ends,
        samples.offsets,
    )
    return Composited(*composite_op(*given, transmittance_min))
