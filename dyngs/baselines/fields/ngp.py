"""Instant-NGP (Müller et al. 2022): a multiresolution hash grid, a density and a colour network,
occupied cells.

Trained by the protocol of nerfacc's occupancy grid (Li et al. 2023).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
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
from dyngs.data.capture import View
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.volume import reached_samples, thinned_samples
from dyngs.ops.device import sent
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
PUBLISHED_PIXELS = 800  # Along a side of the images of published figures
ACROSS = 1024 / PUBLISHED_PIXELS
FINEST = 2.56
"""For a CPU, per pixel of an image's longest side: samples along the diagonal of the innermost
cube, as published, and cells of the finest level along an axis, half as published; twice as many
where the innermost cube is half of all."""
FIRST = 1e-4  # Rows of the grid begin within this of 0
# Steps between updates; up to which step all cells are looked at where it is a power of two
EVERY, WARM_UP = 16, 256
DECAY = 0.95
THRESHOLD = 1e-2
"""Opacity above which a cell counts as occupied, or the mean of its cube if that is less: of a
sample as long as published, a 1,024th of the cube's diagonal."""
CHUNK = 1 << 17  # Cells looked at together


@dataclass(frozen=True)
class NgpSizes:
    """Sizes of a field and of a step of its training."""

    num_levels: int
    features: int
    log2_rows: int  # most rows of a level
    log2_samples: int  # of a step
    # cells of the occupancy grid along an axis; None: as suits the number of cubes
    cells: int | None
    # cells of the finest level along an axis; None: by the images, see ``FINEST``
    finest: int | None

    @staticmethod
    def of(model: NgpModel) -> NgpSizes:
        return SIZES[model.sizes]

    def levels(self, pixels: int, cascades: int) -> HashLevels:
        """Return the levels of the hash grid for images with a longest side of ``pixels`` px."""
        finest = self.finest or min(max(64, round(FINEST * pixels * min(cascades, 2))), 4096)
        return HashLevels.geometric(self.num_levels, 16, finest, 1 << self.log2_rows)

    def across(self, pixels: int) -> int:
        """Return the number of samples along the diagonal of the innermost cube."""
        if self.finest == 4096:
            return 1024
        return min(max(128, round(ACROSS * pixels)), 1024)


SIZES = {
    "tiny": NgpSizes(6, 4, 12, 12, 32, 128),
    "cpu": NgpSizes(8, 4, 16, 14, None, None),
    "published": NgpSizes(16, 2, 19, 18, None, 4096),
}


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
        sizes = NgpSizes.of(model)
        levels = sizes.levels(pixels, space.cascades)
        rows = torch.rand((levels.num_rows, sizes.features), generator=generator, device="cpu")
        weights = [
            tuple(glorot(i, o, generator).requires_grad_() for i, o in pairwise(widths))
            for widths in _widths(sizes, model.time).values()
        ]
        occupied = torch.ones(space.shape, dtype=torch.bool, device="cpu")
        table = (FIRST * (2 * rows - 1)).requires_grad_()
        return NgpField(
            space,
            pixels,
            levels,
            table,
            weights[0],
            weights[1],
            occupied,
            sizes.across(pixels),
            model.time,
        )

    @staticmethod
    def restored(model: NgpModel, space: Space, checkpoint: Checkpoint) -> NgpField:
        """Return the field of a checkpoint. Raises KeyError or ValueError where its tensors do not
        fit."""
        stored = checkpoint.part("field")
        pixels = int(require_tensor("pixels", stored["pixels"], (1,), torch.int64))
        sizes = NgpSizes.of(model)
        levels = sizes.levels(pixels, space.cascades)
        table = require_tensor("table", stored["table"], (levels.num_rows, sizes.features)).clone()
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
            levels,
            table,
            networks["density"],
            networks["colour"],
            occupied,
            sizes.across(pixels),
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
    inputs = sizes.num_levels * sizes.features + (TIME if sees_time else 0)
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


class Occupancy:
    """The largest opacity of a sample found in each cell, which fades until it is found again.

    Args:
        seen: bool of ``space.shape``: cells that may be occupied at all, see ``seen_cells``.
        num_random: random cells of each look after the warm-up; a quarter of all at most.
    """

    def __init__(self, space: Space, seen: Tensor, num_random: int) -> None:
        self._space = space
        self.seen = seen
        self._cells = seen.flatten().nonzero()[:, 0]
        self._count = seen.flatten(1).sum(1).clamp_min(1)
        self._num_random = min(num_random, -(-len(self._cells) // 4))
        self._values = torch.zeros(math.prod(space.shape), device="cpu")

    def place(self, device: torch.device) -> None:
        """Go on on ``device``; random numbers stay those of the CPU."""
        self.seen, self._cells, self._count, self._values = (
            x.to(device) for x in (self.seen, self._cells, self._count, self._values)
        )

    def is_due(self, step: int) -> bool:
        return step > EVERY and step % EVERY == 0

    @torch.no_grad()
    def updated(
        self, field: NgpField, step: int, times: tuple[float, ...], generator: torch.Generator
    ) -> Tensor:
        """Look at densities at random places of cells, at one of ``times``; return bool of
        ``space.shape``."""
        cells = self._chosen(field.occupied, step, generator)
        found = torch.cat([self._opacities(field, x, times, generator) for x in cells.split(CHUNK)])
        self._values[cells] = torch.maximum(self._values[cells] * DECAY, found)
        cubes = self._values.view(len(self._count), -1)
        levels = (cubes.double().sum(1) / self._count).clamp(max=THRESHOLD)
        return (cubes > levels[:, None]).view(self._space.shape)

    def state(self) -> dict[str, Tensor]:
        return {"values": self._values}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._values = require_tensor("values", state["values"], tuple(self._values.shape)).clone()

    def _chosen(self, occupied: Tensor, step: int, generator: torch.Generator) -> Tensor:
        """Return indices of cells: of all ever less often as it warms up, else random and occupied
        ones.

        At most a quarter of all each.
        """
        if step <= WARM_UP and step & (step - 1) == 0:
            return self._cells
        drawn = self._cells[self._drawn(len(self._cells), self._num_random, generator)]
        full = occupied.flatten().nonzero()[:, 0]
        most = -(-len(self._cells) // 4)
        if len(full) > most:
            full = full[self._drawn(len(full), most, generator)]
        return torch.cat([drawn, full]).unique()

    def _drawn(self, below: int, count: int, generator: torch.Generator) -> Tensor:
        return sent(
            torch.randint(below, (count,), generator=generator, device="cpu"), self._values.device
        )

    def _opacities(
        self, field: NgpField, cells: Tensor, times: tuple[float, ...], generator: torch.Generator
    ) -> Tensor:
        space = self._space
        n = self._space.cells
        x = cells % n
        y = torch.div(cells, n, rounding_mode="floor") % n
        z = torch.div(cells, n * n, rounding_mode="floor")
        cascade = torch.div(z, n, rounding_mode="floor")
        z = z % n
        half = space.half * 2.0**cascade
        within = sent(torch.rand((len(cells), 3), generator=generator, device="cpu"), cells.device)
        places = torch.stack([x, y, z], 1) + within
        points = (places * (2 / n) - 1) * half[:, None] + within.new_tensor(space.centre)
        time = (
            times[int(torch.randint(len(times), (1,), generator=generator, device="cpu"))]
            if times
            else 0.0
        )
        return field.densities(points, time) * (half * (2 * math.sqrt(3) / 1024))


def seen_cells(space: Space, views: Sequence[View]) -> Tensor:
    """Return bool of ``space.shape``: cells of which a view sees a part, outside of the next
    smaller cube."""
    seen = np.zeros(space.shape, dtype=bool)
    axis = (np.arange(space.cells) + 0.5) * (2 / space.cells) - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    middles = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    for cascade in range(space.cascades):
        half = space.half * 2.0**cascade
        radius = half * 3**0.5 / space.cells
        outside = (
            np.abs(middles).max(1) > 0.5 - 1 / space.cells + 1e-6
            if cascade
            else np.ones(len(middles), bool)
        )
        unseen = np.flatnonzero(outside)
        for view in views:  # those seen once are not looked at again
            hidden = ~_sees(
                view,
                middles[unseen] * np.float32(half) + np.array(space.centre, np.float32),
                radius,
            )
            seen[cascade].reshape(-1)[unseen[~hidden]] = True
            unseen = unseen[hidden]
    return torch.from_numpy(seen)


def _sees(view: View, points: np.ndarray, radius: float) -> np.ndarray:
    """Return (P,) bool: whether the view sees anything of the balls of a radius around points (P,
    3); errs on yes."""
    pose = view.cam_from_world.astype(np.float32)
    k = view.intrinsics
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    found = z > -radius
    for across, middle, focal, size in (
        (x, k[0, 2], k[0, 0], view.width),
        (y, k[1, 2], k[1, 1], view.height),
    ):
        for side, edge in ((1, (size - middle) / focal), (-1, middle / focal)):
            # the side of the frustum, a plane
            found &= side * across - edge * z < radius * (1 + edge * edge) ** 0.5
    return found
