"""Radiance fields: interface, rendering, placement in a capture, and surface extraction."""

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
from dyngs.models.renderable import DrawOptions, RayScene, Surface, SurfaceOptions
from dyngs.models.views import evaluation_background
from dyngs.models.volume import camera_rays
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.ops.rays import Rays, Space

NEAR = 0.05  # near plane, in half sides of the innermost cube
CHUNK = 1 << 13  # rays rendered at once
MAX_CASCADES = 7  # nested cubes of surroundings: the outermost is 64 times the innermost
# Cells along an axis of a single cube, and of each of several.
GRID, FAR_GRID = 128, 64
CAMERA_MARGIN = 1.25
"""Half side of an innermost cube around the cameras, in the largest camera distance from its
centre."""
OUTLIER_FRACTION = 0.02  # fraction of the sparse points that may lie outside the outermost cube
CELLS = 192  # default cells along an axis of the innermost cube
LEVEL = 25.0
"""Default density at the surface, per unit of a world with an innermost cube of half side 1.5.

A 36th of a unit at this density absorbs half of the light.
"""
POINTS = 1 << 17  # points evaluated at once
LARGEST_EXPONENT = 15.0
TIME_OCTAVES = 4
TIME = 1 + 2 * TIME_OCTAVES
"""Size of the encoding of a time in [0, 1]."""
PUBLISHED_HALF = 1.5
"""Half side of the cube of the published scenes; densities are per unit of that world."""
PUBLISHED_PIXELS = 800  # image side of the published scenes

F = TypeVar("F", bound="RadianceField")


@dataclass(frozen=True)
class RenderedRays:
    """Rendering of R rays on black."""

    colour: Tensor  # (R, 3)
    transmittance: Tensor  # (R,)
    depth: Tensor  # (R,) sum of weight times distance
    num_samples: int  # number of samples
    coarse: RenderedRays | None = None  # rendering of the coarse network, if any


@dataclass(frozen=True)
class RadianceField(ABC):
    """Interface of radiance fields.

    Attributes:
        space: nested cubes in which the field has a density.
        parameters: trained tensors by name; leaves in training.
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
        """Create a field before the first step; ``pixels``: longest side of the images."""

    @classmethod
    @abstractmethod
    def from_state(cls: type[F], model: Any, space: Space, stored: Mapping[str, Tensor]) -> F:
        """Return the field in a state. Raises KeyError or ValueError for inconsistent tensors."""

    @property
    @abstractmethod
    def num_random_values(self) -> int:
        """Number K of random values that a ray needs in training."""

    @abstractmethod
    def render_rays(
        self, rays: Rays, time: float, *, near: float, shifts: Tensor | None = None
    ) -> RenderedRays:
        """Render rays at ``time``; differentiable in the parameters.

        Args:
            near: near plane, world units.
            shifts: (R, K) random numbers in [0, 1) that place the samples, see
                ``num_random_values``; None: evenly spaced.
        """

    @abstractmethod
    def densities(self, points: Tensor, time: float) -> Tensor:
        """Return densities (M,), per world unit, at world ``points`` (M, 3)."""

    @abstractmethod
    def colours(self, points: Tensor, directions: Tensor, time: float) -> Tensor:
        """Return colours (M, 3) at world ``points`` (M, 3) along unit ``directions`` (M, 3)."""

    def may_be_occupied(self, points: Tensor) -> Tensor:
        """Return a conservative mask (M,) of world ``points`` (M, 3) that may have density."""
        return torch.ones(len(points), dtype=torch.bool, device=points.device)

    def state(self) -> State:
        """Return the parameters by name with their role."""
        return with_role({name: x.detach() for name, x in self.parameters.items()}, Role.SHARED)

    def with_time(self, x: Tensor, time: float) -> Tensor:
        """Append the encoded ``time`` to network inputs (M, K) of dynamic fields (T-NeRF)."""
        if not self.model.time:
            return x
        when = encode_frequencies(x.new_full((1, 1), time), TIME_OCTAVES)
        return torch.cat([x, when.expand(len(x), -1)], 1)


def restore_parameters(
    stored: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, Tensor]:
    """Return the parameters in a state. Raises KeyError or ValueError for inconsistent tensors."""
    return {
        name: require_tensor(name, stored[name], shape).clone() for name, shape in shapes.items()
    }


class _TruncatedExp(torch.autograd.Function):
    """exp with the gradient clamped to that at ``LARGEST_EXPONENT`` (Instant-NGP)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (x,) = ctx.saved_tensors
        return grad * x.clamp(max=LARGEST_EXPONENT).exp()


def truncated_exp(x: Tensor) -> Tensor:
    """Return exp(x) with its gradient clamped to exp(15)."""
    result: Tensor = _TruncatedExp.apply(x)  # pyright: ignore[reportAssignmentType]
    return result


def encode_frequencies(x: Tensor, octaves: int) -> Tensor:
    """Encode x (M, D) as x, sin(2^k x), cos(2^k x) of each octave k, without pi (NeRF)."""
    parts = [x]
    for k in range(octaves):
        parts += [(2.0**k * x).sin(), (2.0**k * x).cos()]
    return torch.cat(parts, 1)


def mlp(x: Tensor, weights: Sequence[Tensor]) -> Tensor:
    """Return the outputs (M, out) of an MLP without biases."""
    return perceptron(x, [Layer(weight, weight.new_zeros(len(weight))) for weight in weights])


@dataclass(frozen=True, repr=False)
class FieldScene(RayScene):
    """Scene of a radiance field.

    ``training_times``: distinct training times in [0, 1], ascending, of dynamic fields.
    """

    field: RadianceField
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
    def example(self) -> Tensor:
        return next(iter(self.field.parameters.values()))

    def state(self) -> State:
        space = self.field.space
        numbers = [*space.centre, space.half, space.cascades, space.cells]
        own = {"space": torch.tensor(numbers, dtype=torch.float64, device="cpu")}
        if self.training_times:
            own["times"] = torch.tensor(self.training_times, dtype=torch.float64, device="cpu")
        return add_prefix("field", with_role(own, Role.SHARED) | self.field.state())

    def render_camera(
        self, camera: Cameras, time: float, options: DrawOptions
    ) -> tuple[Tensor, Tensor, Tensor]:
        rays, z = camera_rays(camera)
        parts = []
        for begin in range(0, len(rays), CHUNK):
            chosen = slice(begin, begin + CHUNK)
            seen = self.field.render_rays(rays[chosen], time, near=options.near)
            parts.append((seen.colour, seen.transmittance, seen.depth * z[chosen]))
        colour, through, depth = (torch.cat(x) for x in zip(*parts, strict=True))
        shape = camera.height, camera.width
        return colour.view(*shape, 3), through.view(shape), depth.view(shape)


def restore_scene(
    field_class: type[RadianceField], model: FieldModel, checkpoint: Checkpoint
) -> FieldScene:
    """Return the scene in a checkpoint. Raises KeyError or ValueError for inconsistent tensors."""
    stored = checkpoint.part("field")
    numbers = require_tensor("space", stored["space"], (6,), torch.float64).tolist()
    x, y, z, half, cascades, cells = numbers
    if not (half > 0 and cascades in range(1, 17) and cells in range(1, 1025)):
        raise ValueError(f"invalid 'space': {numbers}")
    space = Space((x, y, z), half, int(cascades), int(cells))
    field = field_class.from_state(model, space, stored)
    times = require_times("times", stored["times"]).tolist() if "times" in stored else ()
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return FieldScene(field, tuple(times), DrawOptions(near=NEAR * half), behind)


def space_of(model: FieldModel, cells: int | None, capture: Capture) -> Space:
    """Return the nested cubes of a field of ``capture``.

    For objects (images with alpha): one cube around the focus point of the cameras, as large as
    the region framed by all. Otherwise the innermost cube is placed likewise, or around the
    cameras if they have no common focus, with cubes of surroundings around it.

    Args:
        cells: along an axis of each cube; None: by the number of cubes.

    Raises:
        DyngsError: all cameras share one position.
    """
    views = capture.splits["train"]
    requested = None if model.half_extent is None else model.half_extent / capture.world_scale
    poses = np.stack([invert_rigid(view.cam_from_world) for view in views])
    centres = poses[:, :3, 3]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if not camera_extent(centres):
        raise DyngsError(
            "all images have the same camera position, so that depth is unknown; "
            "add images from other positions"
        )
    focus = focus_point(poses)
    focus_in_view = focus if focus is not None and fraction_in_front(poses, focus) > 0.5 else None
    far = model.surroundings == "always" or (model.surroundings == "auto" and not capture.has_alpha)
    if not far:
        middle = centres.mean(axis=0) if focus_in_view is None else focus_in_view
        return _space(middle, requested or _framed_half_side(views, middle), 1, cells)
    middle = centres.mean(axis=0)
    if focus_in_view is not None and np.linalg.norm(focus_in_view - middle) < 2 * spread:
        middle = focus_in_view
    beside = CAMERA_MARGIN * float(np.abs(centres - middle).max())
    framed = (
        beside if middle is not focus_in_view else min(beside, _framed_half_side(views, middle))
    )
    half = requested or framed
    return _space(middle, half, _num_cascades(capture, middle, half), cells)


def _space(middle: np.ndarray, half: float, cascades: int, cells: int | None) -> Space:
    x, y, z = (float(value) for value in middle)
    return Space((x, y, z), float(half), cascades, cells or (GRID if cascades == 1 else FAR_GRID))


def _framed_half_side(views: Sequence[View], middle: np.ndarray) -> float:
    """Return the half side of the cube around ``middle`` that images frame, median over views."""
    halves = []
    for view in views:
        x, y, z = view.cam_from_world[:3, :3] @ middle + view.cam_from_world[:3, 3]
        focal = min(view.intrinsics[0, 0] / view.width, view.intrinsics[1, 1] / view.height)
        halves.append(float(np.linalg.norm([x, y, z])) * 0.5 / float(focal))
    return float(np.median(halves))


def _num_cascades(capture: Capture, middle: np.ndarray, half: float) -> int:
    """Return the number of cubes that contain the sparse points; the maximum without points."""
    if capture.points is None or not len(capture.points.xyz):
        return MAX_CASCADES
    norms = np.abs(capture.points.xyz - middle).max(axis=1) / half
    needed = 1 + math.ceil(math.log2(max(float(np.quantile(norms, 1 - OUTLIER_FRACTION)), 1.0)))
    return min(max(needed + 1, 2), MAX_CASCADES)  # includes space behind the points


@torch.no_grad()
def extract_surface(
    scene: FieldScene, time: float = 0.0, level: float | None = None, cells: int | None = None
) -> Surface:
    """Extract the surface in the innermost cube at ``time``.

    Args:
        level: density at the surface, per unit of a world with an innermost cube of half side 1.5;
            None: ``LEVEL``.
        cells: along an axis of the cube; None: ``CELLS``.

    Raises:
        DyngsError: no density, or all densities, are below the level.
    """
    from skimage.measure import marching_cubes

    level = LEVEL if level is None else level
    cells = CELLS if cells is None else cells
    space = scene.field.space
    grid = _densities(scene, time, cells) * (space.half / PUBLISHED_HALF)
    if not float(grid.min()) < level < float(grid.max()):
        raise DyngsError(
            f"no surface at density {level:g}: densities range from {float(grid.min()):.3g} to "
            f"{float(grid.max()):.3g}; set another --level"
        )
    # x is the first axis. Logarithms, because density rises by orders of magnitude within a cell.
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
    """Return densities per world unit on a grid of (cells + 1)^3 points, x first; 0 on the
    boundary."""
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
