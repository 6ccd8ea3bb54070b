"""Radiance fields: the interface of a field, how it is drawn, where it lies in a capture, and its
surface."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor

from dyngs.baselines.fields.kind import FieldModel
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.core.tensor_checks import require_tensor, require_times
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import focus_point, fraction_in_front, invert_rigid
from dyngs.data.scene_space import camera_extent
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.renderable import (
    DrawOptions,
    Renderable,
    Rendering,
    Surface,
    SurfaceOptions,
    TimeStep,
    composite_background,
    fixed_cameras,
)
from dyngs.models.views import evaluation_background
from dyngs.models.volume import camera_rays
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.rays import Rays, Space

NEAR = 0.05  # Nearest distance that is drawn, in units of half the side of the innermost cube
CHUNK = 1 << 13  # Rays drawn together
MOST_CASCADES = 7  # Cubes of surroundings: the outermost is 64 times the innermost
# Along an axis of a single cube, and of each of several: looking at all takes a while
GRID, FAR_GRID = 128, 64
BESIDE = 1.25
"""Half the side of an innermost cube that holds the cameras, in the farthest distances of one from
its middle."""
SEEN_FAR = 0.02  # Fraction of the sparse points that may lie outside of the outermost cube
CELLS = 192  # Along an axis of the innermost cube, unless asked otherwise
LEVEL = 25.0
"""Density at the surface, unless asked otherwise, per unit of a world whose innermost cube has half
side 1.5: half of the light is lost in a 36th of a unit."""
POINTS = 1 << 17  # Points looked at together
LARGEST_EXPONENT = 15.0
TIME_OCTAVES = 4
TIME = 1 + 2 * TIME_OCTAVES
"""Numbers that a time in [0, 1] is encoded in."""
PUBLISHED_HALF = 1.5
"""Half the side of the cube of published figures: densities are per unit of a world in which the
cube is as large."""
PUBLISHED_PIXELS = 800  # Along a side of the images of published figures

F = TypeVar("F", bound="Field")


@dataclass(frozen=True)
class RenderedRays:
    """What R rays see, before black."""

    colour: Tensor  # (R, 3)
    transmittance: Tensor  # (R,)
    depth: Tensor  # (R,) sum of weight times the distance along the ray
    num_samples: int  # that were taken
    coarse: RenderedRays | None = None  # by the coarse network, where there is one


@dataclass(frozen=True)
class Field(ABC):
    """A radiance field.

    Attributes:
        space: where it has a density.
        parameters: all that is learned, by name; leaves while it is trained.
    """

    model: Any
    space: Space
    parameters: dict[str, Tensor]

    @classmethod
    @abstractmethod
    def new(
        cls: type[F],
        model: Any,
        space: Space,
        generator: torch.Generator,
        pixels: int = PUBLISHED_PIXELS,
    ) -> F:
        """Return a field before the first step; ``pixels``: of the longest side of the images."""

    @classmethod
    @abstractmethod
    def from_state(cls: type[F], model: Any, space: Space, stored: Mapping[str, Tensor]) -> F:
        """Return the field in a state. Raises KeyError or ValueError where its tensors do not
        fit."""

    @property
    @abstractmethod
    def num_random_values(self) -> int:
        """K: random numbers that a ray needs in training."""

    @abstractmethod
    def seen(
        self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None
    ) -> RenderedRays:
        """Return what rays see at ``time``; differentiable in the parameters.

        Args:
            near: what is nearer is not drawn, world units.
            shifts: (R, K) random numbers in [0, 1) that place the samples, see ``num_shifts``;
                None: evenly.
        """

    @abstractmethod
    def densities(self, points: Tensor, time: float) -> Tensor:
        """Return (M,) densities, per world unit, at points (M, 3) of the world."""

    @abstractmethod
    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        """Return (M, 3) colours of points (M, 3) of the world, seen along unit directions (M,
        3)."""

    def may_be_occupied(self, points: Tensor) -> Tensor:
        """Return (M,) bool: whether there may be anything at points (M, 3) of the world, before
        looking."""
        return torch.ones(len(points), dtype=torch.bool, device=points.device)

    def state(self) -> State:
        """Return its tensors by name, with their role."""
        return with_role({name: x.detach() for name, x in self.parameters.items()}, Role.SHARED)

    def with_time(self, x: Tensor, time: float) -> Tensor:
        """Return the inputs (M, K) of a network, followed by the encoded ``time`` where the field
        moves (T-NeRF)."""
        if not self.model.time:
            return x
        when = encode_frequencies(x.new_full((1, 1), time), TIME_OCTAVES)
        return torch.cat([x, when.expand(len(x), -1)], 1)


def restored_parameters(
    stored: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, Tensor]:
    """Return the parameters in a state. Raises KeyError or ValueError where they do not fit."""
    return {
        name: require_tensor(name, stored[name], shape).clone() for name, shape in shapes.items()
    }


class _TruncatedExp(torch.autograd.Function):
    """exp, whose gradient is that of ``LARGEST_EXPONENT`` beyond it (Instant-NGP)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (x,) = ctx.saved_tensors
        return grad * x.clamp(max=LARGEST_EXPONENT).exp()


def truncated_exp(x: Tensor) -> Tensor:
    """Return exp(x), whose gradient does not grow beyond exp(15)."""
    result: Tensor = _TruncatedExp.apply(x)  # pyright: ignore[reportAssignmentType]
    return result


def encode_frequencies(x: Tensor, octaves: int) -> Tensor:
    """Return (M, D (1 + 2 octaves)): x, then the sines and cosines of 2^k x of each octave k,
    without pi (NeRF)."""
    parts = [x]
    for k in range(octaves):
        parts += [(2.0**k * x).sin(), (2.0**k * x).cos()]
    return torch.cat(parts, 1)


def mlp(x: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Return (M, out) outputs of a perceptron without biases."""
    return perceptron(x, [Layer(weight, weight.new_zeros(len(weight))) for weight in weights])


@dataclass(frozen=True)
class FieldScene(Renderable):
    """A field; ``seen_at``: distinct training times in [0, 1], ascending, where it moves."""

    field: Field
    training_times: tuple[float, ...] = ()
    options: DrawOptions = dataclasses.field(default_factory=DrawOptions)
    background: Tensor | None = None
    surface_options: ClassVar[frozenset[str]] = frozenset({"level", "cells"})

    def own_surface(self, time: float, options: SurfaceOptions) -> Surface:
        return extract_surface(self, time, options.level, options.cells)

    @property
    def times(self) -> tuple[float, ...]:
        return self.training_times

    @property
    def is_static(self) -> bool:
        return not self.field.model.time

    @property
    def bounds(self) -> Tensor:
        space = self.field.space
        centre = torch.tensor(space.centre, device=self.device)
        return torch.stack([centre - space.half, centre + space.half])

    @property
    def device(self) -> torch.device:
        return next(iter(self.field.parameters.values())).device

    def state(self) -> State:
        space = self.field.space
        numbers = [*space.centre, space.half, space.cascades, space.cells]
        own = {"space": torch.tensor(numbers, dtype=torch.float64, device="cpu")}
        if self.training_times:
            own["times"] = torch.tensor(self.training_times, dtype=torch.float64, device="cpu")
        return add_prefix("field", with_role(own, Role.SHARED) | self.field.state())

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: Any = None,
        background: Tensor | None = None,
    ) -> Rendering:
        options = self.options if options is None else options
        behind = self.background if background is None else background
        now = time if isinstance(time, TimeStep) else self.time_step(time)
        cameras = fixed_cameras(cameras, behind, next(iter(self.field.parameters.values())))
        views = [
            self._view(cameras.select(i), now.time or 0.0, options) for i in range(len(cameras))
        ]
        rgb, through, depth = (torch.stack(x) for x in zip(*views, strict=True))
        return composite_background(rgb, through, depth, options, behind)

    def _view(
        self, camera: Cameras, time: float, options: DrawOptions
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return colours before black (H, W, 3), transmittance (H, W) and the sum of weight times z
        (H, W)."""
        rays, z = camera_rays(camera)
        parts = []
        for begin in range(0, len(rays), CHUNK):
            chosen = slice(begin, begin + CHUNK)
            seen = self.field.seen(rays[chosen], time, near=options.near)
            parts.append((seen.colour, seen.transmittance, seen.depth * z[chosen]))
        colour, through, depth = (torch.cat(x) for x in zip(*parts, strict=True))
        shape = camera.height, camera.width
        return colour.view(*shape, 3), through.view(shape), depth.view(shape)


def restore_scene(
    field_class: type[Field], model: FieldModel, checkpoint: Checkpoint
) -> FieldScene:
    """Return the scene of a checkpoint. Raises KeyError or ValueError where its tensors do not
    fit."""
    stored = checkpoint.part("field")
    numbers = require_tensor("space", stored["space"], (6,), torch.float64).tolist()
    x, y, z, half, cascades, cells = numbers
    if not (half > 0 and cascades in range(1, 17) and cells in range(1, 1025)):
        raise ValueError(f"'space' is no space: {numbers}")
    space = Space((x, y, z), half, int(cascades), int(cells))
    field = field_class.from_state(model, space, stored)
    times = require_times("times", stored["times"]).tolist() if "times" in stored else ()
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return FieldScene(field, tuple(times), DrawOptions(near=NEAR * half), behind)


def space_of(model: FieldModel, cells: int | None, capture: Capture) -> Space:
    """Return the space of the field of ``capture``.

    An object before a background lies in a cube around the point that the cameras look at, as large
    as what all of them frame. So does the innermost cube of other captures, with others around it
    for what is far away; where the cameras do not look at one point it holds the cameras.

    Args:
        cells: of each cube along an axis; None: as suits their number.

    Raises:
        DyngsError: nothing tells depth, or much lies too far away.
    """
    views = capture.splits["train"]
    requested = None if model.half_extent is None else model.half_extent / capture.world_scale
    poses = np.stack([invert_rigid(view.cam_from_world) for view in views])
    centres = poses[:, :3, 3]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if not camera_extent(centres):
        raise DyngsError(
            "the capture has a single camera position, from which a field cannot tell depth: give more images, or a "
            "capture whose camera moves"
        )
    focus = focus_point(poses)
    looked_at = focus if focus is not None and fraction_in_front(poses, focus) > 0.5 else None
    far = model.surroundings == "always" or (model.surroundings == "auto" and not capture.has_alpha)
    if not far:
        middle = centres.mean(axis=0) if looked_at is None else looked_at
        return _space(middle, requested or _framed(views, middle), 1, cells)
    middle = centres.mean(axis=0)
    if looked_at is not None and np.linalg.norm(looked_at - middle) < 2 * spread:
        middle = looked_at
    beside = BESIDE * float(np.abs(centres - middle).max())
    framed = beside if middle is not looked_at else min(beside, _framed(views, middle))
    half = requested or framed
    return _space(middle, half, _cascades(capture, middle, half), cells)


def _space(middle: np.ndarray, half: float, cascades: int, cells: int | None) -> Space:
    x, y, z = (float(value) for value in middle)
    return Space((x, y, z), float(half), cascades, cells or (GRID if cascades == 1 else FAR_GRID))


def _framed(views: Sequence[View], middle: np.ndarray) -> float:
    """Return half the side of the cube around ``middle`` that images frame, the median over
    views."""
    halves = []
    for view in views:
        x, y, z = view.cam_from_world[:3, :3] @ middle + view.cam_from_world[:3, 3]
        focal = min(view.intrinsics[0, 0] / view.width, view.intrinsics[1, 1] / view.height)
        halves.append(float(np.linalg.norm([x, y, z])) * 0.5 / float(focal))
    return float(np.median(halves))


def _cascades(capture: Capture, middle: np.ndarray, half: float) -> int:
    """Return the number of cubes that hold the sparse points; all where there are none."""
    if capture.points is None or not len(capture.points.xyz):
        return MOST_CASCADES
    norms = np.abs(capture.points.xyz - middle).max(axis=1) / half
    needed = 1 + math.ceil(math.log2(max(float(np.quantile(norms, 1 - SEEN_FAR)), 1.0)))
    return min(max(needed + 1, 2), MOST_CASCADES)  # what is behind the points, too


@torch.no_grad()
def extract_surface(
    scene: FieldScene, time: float = 0.0, level: float | None = None, cells: int | None = None
) -> Surface:
    """Return the surface in the innermost cube at ``time``.

    Args:
        level: density there, per unit of a world whose innermost cube has half side 1.5; None:
            ``LEVEL``.
        cells: along an axis of the cube; None: ``CELLS``.

    Raises:
        DyngsError: the density is nowhere, or everywhere, of that level.
    """
    from skimage.measure import marching_cubes

    level = LEVEL if level is None else level
    cells = CELLS if cells is None else cells
    space = scene.field.space
    grid = _densities(scene, time, cells) * (space.half / PUBLISHED_HALF)
    if not float(grid.min()) < level < float(grid.max()):
        raise DyngsError(
            f"no surface: densities are from {float(grid.min()):.3g} to {float(grid.max()):.3g}, none of them "
            f"{level:g}; give another --level"
        )
    # x is the first axis of the grid; a logarithm, because density rises by orders of magnitude
    # within a cell
    found = marching_cubes(
        np.log(np.maximum(grid.numpy(), 1e-6)), np.log(level), gradient_direction="ascent"
    )
    places = found[0]
    faces = found[1]
    normals = found[2]
    vertices = torch.from_numpy(places.copy()) * (2 * space.half / cells) + (
        torch.tensor(space.centre, device="cpu") - space.half
    )
    inwards = torch.nn.functional.normalize(torch.from_numpy(-normals.copy()), dim=1)
    colours = [
        scene.field.colours(x, d, time)
        for x, d in zip(vertices.split(POINTS), inwards.split(POINTS), strict=True)
    ]
    return Surface(vertices.numpy(), faces, torch.cat(colours).numpy())


def _densities(scene: FieldScene, time: float, cells: int) -> Tensor:
    """Return densities, per world unit, at (cells + 1)^3 places, x the first axis; 0 on the sides
    of the cube."""
    space = scene.field.space
    axis = torch.linspace(-space.half, space.half, cells + 1, device="cpu")
    x, y, z = torch.meshgrid(*(axis + middle for middle in space.centre), indexing="ij")
    points = torch.stack([x, y, z], -1).view(-1, 3)
    found = torch.zeros(len(points), device="cpu")
    for which in scene.field.may_be_occupied(points).nonzero()[:, 0].split(POINTS):
        found[which] = scene.field.densities(points[which], time)
    found = found.view(x.shape)
    inner = torch.zeros_like(found)
    inner[1:-1, 1:-1, 1:-1] = found[1:-1, 1:-1, 1:-1]
    return inner
