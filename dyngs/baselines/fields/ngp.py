"""Instant-NGP (Müller et al. 2022): multiresolution hash grid, two small MLPs and occupied cells.

Training follows nerfacc's occupancy grid (Li et al. 2023).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.scene import (
    PUBLISHED_HALF,
    PUBLISHED_PIXELS,
    TIME,
    RadianceField,
    RenderedRays,
    mlp,
    restore_parameters,
    truncated_exp,
)
from dyngs.baselines.fields.training import FieldTraining
from dyngs.core.errors import DyngsError
from dyngs.core.initialisation import glorot
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.capture import View
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import UpdateResult
from dyngs.models.volume import visible_samples
from dyngs.ops.device import copy_async
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.hash_grid import HashLevels, hash_features, select_features
from dyngs.ops.rays import MarchSteps, Rays, Space, composite, march

# Width of hidden layers, and outputs of the density network (the first is the density).
WIDTH, GEOMETRY = 64, 16
# Spherical harmonics of directions; Instant-NGP counts degrees from 1.
DIRECTION_DEGREE, DIRECTION_TERMS = 3, 16
# With several cubes, samples are at least this fraction of their distance over ``across`` long.
CONE = 4.0
ACROSS = 1024 / PUBLISHED_PIXELS
FINEST = 2.56
"""Per pixel of the longest image side, for a CPU: samples along the diagonal of the innermost
cube, and cells of the finest level (half as published; twice as many if there are surroundings)."""
FIRST = 1e-4  # initial features are uniform within this
# Steps between updates of the occupancy grid; warm-up steps in which all cells are evaluated.
EVERY, WARM_UP = 16, 256
DECAY = 0.95
THRESHOLD = 1e-2
"""Opacity above which a cell is occupied, or the mean of its cube if lower.

Of a sample of published length, 1/1024 of the diagonal of the cube.
"""
CHUNK = 1 << 17  # cells evaluated at once
RANDOM_CELLS_PER_SAMPLE = 2  # random cells per update and sample of a step
RATE = 1e-2
WEIGHT_DECAY = 1e-6  # L2 penalty of the MLP weights
FIRST_SAMPLES = 256  # assumed samples per ray before any were counted
MOST_RAYS = 1 << 15  # per image and step
RATE_RISES, FIRST_RATE = 100, 0.01  # warm-up steps of the learning rate, and its initial fraction
DROPS = (0.5, 0.75, 0.9)
DROP = 0.33  # factor on the learning rate after each of ``DROPS``


@dataclass(frozen=True)
class NgpSizes:
    """Sizes of the field and of a training step."""

    num_levels: int
    features: int
    log2_rows: int  # maximum rows per level
    log2_samples: int  # samples per step
    # Cells of the occupancy grid along an axis; None: by the number of cubes.
    cells: int | None
    # Cells of the finest level along an axis; None: by the image size, see ``FINEST``.
    finest: int | None
    # Samples along the diagonal of the innermost cube; None: by the image size, see ``ACROSS``.
    across: int | None


SIZES = {
    "tiny": NgpSizes(6, 4, 12, 12, 32, 128, None),
    "cpu": NgpSizes(8, 4, 16, 14, None, None, None),
    "published": NgpSizes(16, 2, 19, 18, None, 4096, 1024),
}


@dataclass(frozen=True)
class NgpField(RadianceField):
    """A hash grid with its two networks, and the cells in which anything is.

    Attributes:
        pixels: of the longest side of the images that it was made for.
        occupied: bool of ``space.shape``.
    """

    pixels: int
    occupied: Tensor

    @classmethod
    def new(
        cls,
        model: NgpModel,
        space: Space,
        generator: torch.Generator,
        pixels: int = PUBLISHED_PIXELS,
    ) -> NgpField:
        """Create a field that is nearly grey, of low density, and occupied everywhere."""
        own = parameter_shapes(model, space, pixels)
        rows = torch.rand(own["table"], generator=generator, device="cpu")
        parameters = {"table": FIRST * (2 * rows - 1)}
        for name, (out, before) in own.items():
            if name != "table":
                parameters[name] = glorot(before, out, generator)
        occupied = torch.ones(space.shape, dtype=torch.bool, device="cpu")
        return cls(model, space, parameters, pixels, occupied)

    @classmethod
    def from_state(cls, model: NgpModel, space: Space, stored: Mapping[str, Tensor]) -> NgpField:
        pixels = int(require_tensor("pixels", stored["pixels"], (1,), torch.int64))
        parameters = restore_parameters(stored, parameter_shapes(model, space, pixels))
        count = math.prod(space.shape)
        bits = require_tensor("occupied", stored["occupied"], (-(-count // 8),), torch.uint8)
        flat = np.unpackbits(bits.numpy(), count=count, bitorder="little").astype(bool)
        occupied = torch.from_numpy(flat).reshape(space.shape)
        return cls(model, space, parameters, pixels, occupied)

    @property
    def num_random_values(self) -> int:
        return 2  # offset of the samples, and selection of samples with low weight

    def state(self) -> State:
        bits = np.packbits(self.occupied.cpu().numpy().ravel(), bitorder="little")
        own = {
            "occupied": torch.from_numpy(bits),
            "pixels": torch.tensor([self.pixels], device="cpu"),
        }
        return super().state() | with_role(own, Role.SHARED)

    @cached_property
    def levels(self) -> HashLevels:
        return hash_levels(self.model, self.space, self.pixels)

    @cached_property
    def across(self) -> int:
        """Samples along the diagonal of the innermost cube."""
        own = SIZES[self.model.sizes].across
        return own or min(max(128, round(ACROSS * self.pixels)), 1024)

    @cached_property
    def step(self) -> float:
        """Sample length, world units."""
        return 2 * self.space.half * math.sqrt(3) / self.across

    def render_rays(
        self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None
    ) -> RenderedRays:
        steps = MarchSteps(near, self.step, CONE / self.across if self.space.cascades > 1 else 0.0)
        places = rays.origins.new_full((len(rays), 2), 0.5) if shifts is None else shifts
        marched = march(rays, places[:, 0].contiguous(), self.space, self.occupied, steps)
        table = self.parameters["table"]
        with torch.no_grad():  # selection of samples needs densities only
            features = hash_features(marched.coords, table, self.levels)
            densities = self._density(self._geometry(features, time), marched.coords)
            thinned = None if shifts is None else shifts[:, 1]
            samples, which = visible_samples(densities, marched, thinned)
        features = select_features(features, which, samples.coords, table, self.levels)
        geometry = self._geometry(features, time)
        basis = harmonics_basis(rays.directions, DIRECTION_DEGREE)
        colours = self._colours(geometry, basis[samples.rays])
        drawn = composite(self._density(geometry, samples.coords), colours, samples)
        return RenderedRays(drawn.colour, drawn.transmittance, drawn.depth, len(samples))

    def densities(self, points: Tensor, time: float) -> Tensor:
        coords = self.space.unit(points)
        return self._density(self._geometry(self._features(coords), time), coords)

    def may_be_occupied(self, points: Tensor) -> Tensor:
        """Return true in occupied cells and beyond the innermost cube, see ``RadianceField``."""
        n = self.space.cells
        middle = points.new_tensor(self.space.centre)
        place = ((points - middle) / self.space.half + 1) * (n / 2)
        x, y, z = place.long().clamp(0, n - 1).unbind(1)
        return self.occupied[0, z, y, x] | ((place < 0) | (place > n)).any(1)

    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        geometry = self._geometry(self._features(self.space.unit(points)), time)
        return self._colours(geometry, harmonics_basis(directions, DIRECTION_DEGREE))

    def _features(self, coords: Tensor) -> Tensor:
        return hash_features(coords, self.parameters["table"], self.levels)

    def _network(self, x: Tensor, name: str) -> Tensor:
        return mlp(x, [w for key, w in self.parameters.items() if key.startswith(name)])

    def _geometry(self, features: Tensor, time: float) -> Tensor:
        return self._network(self.with_time(features, time), "density")

    def _density(self, geometry: Tensor, coords: Tensor) -> Tensor:
        """Return densities (M,) per world unit; the published ones are per unit of a cube of half
        side 1.5.

        Outside the innermost cube, densities are relative to the cube through the point, so that
        an untrained field is equally dense in each cube.
        """
        found = truncated_exp(geometry[:, 0] - 1) * (PUBLISHED_HALF / self.space.half)
        if self.space.cascades == 1:
            return found
        return found * (2 - 4 * (coords - 0.5).abs().amax(1)).clamp(max=1)  # 1 / max-norm

    def _colours(self, geometry: Tensor, basis: Tensor) -> Tensor:
        return self._network(torch.cat([geometry, basis], 1), "colour").sigmoid()


def hash_levels(model: NgpModel, space: Space, pixels: int) -> HashLevels:
    """Return the levels of the hash grid for images with a longest side of ``pixels``."""
    sizes = SIZES[model.sizes]
    finest = min(max(64, round(FINEST * pixels * min(space.cascades, 2))), 4096)
    return HashLevels.geometric(sizes.num_levels, 16, sizes.finest or finest, 1 << sizes.log2_rows)


def parameter_shapes(model: NgpModel, space: Space, pixels: int) -> dict[str, tuple[int, int]]:
    """Return the parameter shapes: hash table and MLP weights (out, in)."""
    sizes = SIZES[model.sizes]
    inputs = sizes.num_levels * sizes.features + (TIME if model.time else 0)
    widths = {
        "density": (inputs, WIDTH, GEOMETRY),
        "colour": (GEOMETRY + DIRECTION_TERMS, WIDTH, WIDTH, 3),
    }
    found = {"table": (hash_levels(model, space, pixels).num_rows, sizes.features)}
    for name, layers in widths.items():
        found |= {f"{name}.{i}": (out, n) for i, (n, out) in enumerate(pairwise(layers))}
    return found


def cells_in_view(space: Space, views: Sequence[View]) -> Tensor:
    """Return a mask of ``space.shape``: cells that a view sees, outside the next smaller cube."""
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
        for view in views:  # visible cells are not tested again
            hidden = ~_may_see(
                view,
                middles[unseen] * np.float32(half) + np.array(space.centre, np.float32),
                radius,
            )
            seen[cascade].reshape(-1)[unseen[~hidden]] = True
            unseen = unseen[hidden]
    return torch.from_numpy(seen)


def _may_see(view: View, points: np.ndarray, radius: float) -> np.ndarray:
    """Return a mask (P,) of spheres around ``points`` that may be visible; conservative."""
    pose = view.cam_from_world.astype(np.float32)
    k = view.intrinsics
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    found = z > -radius
    for across, middle, focal, size in (
        (x, k[0, 2], k[0, 0], view.width),
        (y, k[1, 2], k[1, 1], view.height),
    ):
        for side, edge in ((1, (size - middle) / focal), (-1, middle / focal)):
            # side plane of the frustum
            found &= side * across - edge * z < radius * (1 + edge * edge) ** 0.5
    return found


class NgpTraining(FieldTraining):
    """Training of Instant-NGP: rays per step adapt to the number of samples; updates occupied
    cells.

    The largest opacity found in each cell decays until it is found again.
    """

    betas = (0.9, 0.99)

    def __init__(self, run: StartContext) -> None:
        model: Any = run.config.model
        sizes = SIZES[model.sizes]
        camera = run.images[0].cameras
        super().__init__(run, NgpField, sizes.cells, max(camera.width, camera.height))
        num_samples = 1 << sizes.log2_samples
        self._wanted = max(1, num_samples // self._batch)
        # Rays and samples of this step.
        self._counted = torch.zeros(2, dtype=torch.float64, device="cpu")
        self._rays = max(1, self._wanted // FIRST_SAMPLES)
        self._most_random = RANDOM_CELLS_PER_SAMPLE * num_samples
        self._find_cells_in_view()
        self._field.occupied.copy_(self._cells_of_views)

    @property
    def _field(self) -> NgpField:
        field = self._scene.field
        assert isinstance(field, NgpField)
        return field

    def _find_cells_in_view(self) -> None:
        """Find the cells in view, which may be occupied; reset their opacities."""
        space = self._field.space
        seen = cells_in_view(space, self._run.capture.splits["train"])
        if not bool(seen.any()):
            raise DyngsError(
                f"{self._run.config.data.root}: no training camera sees the cube of the field; "
                "set model.half_extent or model.surroundings=always"
            )
        self._cells_of_views = seen
        self._cells = seen.flatten().nonzero()[:, 0]
        self._opacities = torch.zeros(seen.numel(), device="cpu")

    def error(self, one: Tensor, other: Tensor) -> Tensor:
        return torch.nn.functional.smooth_l1_loss(one, other, reduction="none")

    @property
    def num_rays(self) -> int:
        return self._rays

    def record_samples(self, num_rays: int, num_samples: int) -> None:
        self._counted += torch.tensor([num_rays, num_samples], dtype=torch.float64, device="cpu")

    def tallies(self, step: int) -> Sequence[Tensor]:
        return [self._counted]

    def learning_rate(self, step: int) -> float:
        rising = min(1.0, FIRST_RATE + (1 - FIRST_RATE) * (step - 1) / RATE_RISES)
        fallen = sum(step > fraction * self._run.config.train.steps for fraction in DROPS)
        return (self._model.lr or RATE) * rising * DROP**fallen

    def update(self, step: int) -> UpdateResult:
        for name, x in self._field.parameters.items():
            if name != "table" and x.grad is not None:
                x.grad.add_(x.detach(), alpha=WEIGHT_DECAY)
        updated = super().update(step)
        if step > EVERY and step % EVERY == 0:
            self._update_occupancy(step)
        rays, samples = self._counted.tolist()
        self._rays = max(1, min(MOST_RAYS, int(rays * self._wanted / max(samples, 1.0))))
        self._counted.zero_()
        return updated

    @torch.no_grad()
    def _update_occupancy(self, step: int) -> None:
        """Evaluate densities at random points of cells and update the occupied cells."""
        cells = self._select_cells(step)
        found = torch.cat([self._opacities_of(x) for x in cells.split(CHUNK)])
        self._opacities[cells] = torch.maximum(self._opacities[cells] * DECAY, found)
        seen = self._cells_of_views.flatten(1)
        cubes = self._opacities.view(seen.shape)
        means = cubes.double().sum(1) / seen.sum(1).clamp_min(1)
        occupied = cubes > means.clamp(max=THRESHOLD)[:, None]
        self._field.occupied.copy_(occupied.view(self._field.space.shape))

    def _select_cells(self, step: int) -> Tensor:
        """Return cell indices to evaluate: all in powers of two during warm-up, else random and
        occupied ones.

        At most a quarter of all cells each.
        """
        if step <= WARM_UP and step & (step - 1) == 0:
            return self._cells
        max_count = -(-len(self._cells) // 4)
        drawn = self._cells[
            self._random_indices(len(self._cells), min(self._most_random, max_count))
        ]
        full = self._field.occupied.flatten().nonzero()[:, 0]
        if len(full) > max_count:
            full = full[self._random_indices(len(full), max_count)]
        return torch.cat([drawn, full]).unique()

    def _random_indices(self, below: int, count: int) -> Tensor:
        drawn = torch.randint(below, (count,), generator=self._run.generator, device="cpu")
        return copy_async(drawn, self._cells.device)

    def _opacities_of(self, cells: Tensor) -> Tensor:
        generator = self._run.generator
        space = self._field.space
        n = space.cells
        x = cells % n
        y = torch.div(cells, n, rounding_mode="floor") % n
        z = torch.div(cells, n * n, rounding_mode="floor")
        half = space.half * 2.0 ** torch.div(z, n, rounding_mode="floor")
        within = copy_async(
            torch.rand((len(cells), 3), generator=generator, device="cpu"), cells.device
        )
        places = torch.stack([x, y, z % n], 1) + within
        points = (places * (2 / n) - 1) * half[:, None] + within.new_tensor(space.centre)
        times = self._scene.training_times or (0.0,)
        which = 0
        if self._scene.training_times:
            which = int(torch.randint(len(times), (1,), generator=generator, device="cpu"))
        return self._field.densities(points, times[which]) * (half * (2 * math.sqrt(3) / 1024))

    def state(self) -> State:
        own = {"values": self._opacities, "rays": torch.tensor([self._rays], device="cpu")}
        return super().state() | add_prefix("occupancy", with_role(own, Role.TRAINING))

    def restore(self, checkpoint: Checkpoint) -> None:
        before = self._field.space
        super().restore(checkpoint)
        stored = checkpoint.part("occupancy")
        if self._field.space != before:  # finding visible cells takes seconds
            self._find_cells_in_view()
        shape = tuple(self._opacities.shape)
        self._opacities = require_tensor("values", stored["values"], shape).clone()
        rays = int(require_tensor("rays", stored["rays"], (1,), torch.int64))
        self._rays = min(MOST_RAYS, max(1, rays))

    def place(self, device: torch.device) -> None:
        super().place(device)
        self._cells_of_views, self._cells, self._opacities = (
            x.to(device) for x in (self._cells_of_views, self._cells, self._opacities)
        )
