"""Quadratic Bezier triangles: surface, colours, rendering and mesh export.

Rendered by a z-buffer, as faces with blended edges or as one Gaussian per pixel. P triangles with
K colours each: at the six control points while ``texture`` is 0, else at the points of a lattice.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dyngs.baselines.triangles.kind import BgTriangleModel
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, num_sh_terms
from dyngs.core.gaussians import storage_order
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.renderable import (
    DrawOptions,
    Renderable,
    Rendering,
    Surface,
    SurfaceOptions,
    TimeStep,
    composite_background,
    concatenate_renderings,
    fixed_cameras,
    single_views,
)
from dyngs.models.views import evaluation_background
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.patches import (
    NUM_POINTS,
    SEGMENTS,
    PatchSamples,
    blend_patches,
    lattice,
    lattice_size,
    outline_crossings,
    patch_values,
    project_points,
    visible_patches,
)
from dyngs.ops.projection import ProjectionOptions, project
from dyngs.ops.rasterization import Boundaries, rasterize

CORNERS = (0, 3, 5)  # control points 200, 020, 002
_EDGES = ((0, 3), (0, 5), (3, 5))  # corners around the control points 110, 101, 011
_BETWEEN = (1, 2, 4)
MAX_TEXTURE, MAX_DEGREE = 16, 4
# Gaussians of pixels (Wu et al. 2025): opacity; the ratio of scales at the start of textures to
# those before; segments of the lattice of scales and rotations, three points per edge.
OPACITY = 0.92
FIRST_SCALE = math.exp(-1)
SHAPE_SEGMENTS = 2
BOUNDARY_RADIUS = 2.0  # px; three standard deviations of the pixel filter, rounded up


@dataclass(frozen=True)
class Patches:
    """P curved triangles."""

    points: Tensor  # (P, 6, 3) control points, world
    colours: Tensor  # (P, K, 3) colours without harmonics
    # (P, T - 1, 3) SH coefficients by view direction, without the constant term.
    harmonics: Tensor
    texture: int = 0  # segments of the colour lattice; 0: colours at the control points
    # (P, 6, 3) log world units and (P, 6, 4) wxyz of Gaussians on a lattice; None: constants
    log_scales: Tensor | None = None
    quats: Tensor | None = None

    def __len__(self) -> int:
        return len(self.points)

    @property
    def sh_degree(self) -> int:
        return int((self.harmonics.shape[1] + 1) ** 0.5) - 1

    @property
    def num_values(self) -> int:
        """Number of trained values."""
        return sum(x.numel() for x in self.tensors.values())

    @property
    def tensors(self) -> Mapping[str, Tensor]:
        """Trained tensors by name; row i belongs to triangle i."""
        own = {"points": self.points, "colours": self.colours, "harmonics": self.harmonics}
        shapes = {"log_scales": self.log_scales, "quats": self.quats}
        return own | {name: x for name, x in shapes.items() if x is not None}

    def colours_at(self, ids: Tensor, uv: Tensor) -> Tensor:
        """Return colours (N, 3) without harmonics at ``uv`` (N, 2) on triangles ``ids`` (N,)
        int32."""
        return patch_values(self.colours, ids, uv, self.texture)

    def shapes_at(self, ids: Tensor, uv: Tensor, scale: float) -> tuple[Tensor, Tensor]:
        """Return quaternions (N, 4) and scales (N, 3), world units, of Gaussians at ``uv`` (N, 2)
        on triangles ``ids`` (N,) int32; ``scale``: that of all without textures."""
        if self.log_scales is None or self.quats is None:
            scales = uv.new_full((len(ids), 3), scale)
            return uv.new_tensor([1.0, 0, 0, 0]).expand(len(ids), 4), scales
        quats = patch_values(self.quats, ids, uv, SHAPE_SEGMENTS)
        return quats, patch_values(self.log_scales, ids, uv, SHAPE_SEGMENTS).exp()

    def with_shapes(self, scale: float) -> Patches:
        """Add textures of scales, ``scale`` world units, and rotations of Gaussians."""
        shape = len(self), lattice_size(SHAPE_SEGMENTS)
        scales = self.points.new_full((*shape, 3), math.log(scale))
        quats = self.points.new_tensor([1.0, 0, 0, 0]).repeat(*shape, 1)
        return replace(self, log_scales=scales, quats=quats)

    def with_texture(self, segments: int) -> Patches:
        """Resample the colours to a lattice of ``segments``."""
        places, _ = lattice(segments)
        return replace(
            self, colours=evaluate_patches(self.colours.detach(), places), texture=segments
        )

    def state(self) -> State:
        own = {name: x.detach() for name, x in self.tensors.items()}
        own["texture"] = torch.tensor([self.texture], device="cpu")
        return with_role(own, Role.SHARED)

    @staticmethod
    def from_state(stored: Mapping[str, Tensor]) -> Patches:
        """Load triangles from a state. Raises KeyError or ValueError for inconsistent tensors."""
        texture = int(require_indices("texture", stored["texture"], (1,), MAX_TEXTURE + 1))
        points = require_tensor("points", stored["points"], (None, NUM_POINTS, 3))
        count = len(points)
        size = lattice_size(texture) if texture else NUM_POINTS
        colours = require_tensor("colours", stored["colours"], (count, size, 3))
        harmonics = require_tensor("harmonics", stored["harmonics"], (count, None, 3))
        if count == 0 or harmonics.shape[1] + 1 not in {
            num_sh_terms(n) for n in range(MAX_DEGREE + 1)
        }:
            raise ValueError(
                f"invalid 'points' or 'harmonics': {count} triangles, {harmonics.shape[1]} terms"
            )
        patches = Patches(points.clone(), colours.clone(), harmonics.clone(), texture)
        if "log_scales" not in stored:
            return patches
        places = lattice_size(SHAPE_SEGMENTS)
        log_scales = require_tensor("log_scales", stored["log_scales"], (count, places, 3))
        quats = require_tensor("quats", stored["quats"], (count, places, 4))
        return replace(patches, log_scales=log_scales.clone(), quats=quats.clone())


def evaluate_patches(values: Tensor, places: Tensor) -> Tensor:
    """Evaluate quadratic ``values`` (P, 6, C) of every triangle at ``places`` (N, 2); (P, N, C)."""
    count = len(values)
    ids = torch.arange(count, dtype=torch.int32, device="cpu").repeat_interleave(len(places))
    uv = places.to(values.dtype).repeat(count, 1)
    return patch_values(values, ids, uv).view(count, len(places), values.shape[2])


def subdivide(values: Tensor) -> Tensor:
    """Split each triangle at its edge middles; return the values (4 P, 6, C) of quadratic
    ``values``."""
    places, faces = lattice(2)
    corners = places[faces]  # (4, 3, 2)
    middles = torch.stack(
        [(corners[:, i] + corners[:, j]) / 2 for i, j in ((0, 1), (0, 2), (1, 2))], 1
    )
    at = evaluate_patches(values, torch.cat([corners, middles], 1).flatten(0, 1)).view(
        -1, 6, values.shape[2]
    )
    parts = torch.empty_like(at)
    parts[:, list(CORNERS)] = at[:, :3]
    for n, (between, (a, b)) in enumerate(zip(_BETWEEN, _EDGES, strict=True)):
        parts[:, between] = 2 * at[:, 3 + n] - 0.5 * (parts[:, a] + parts[:, b])
    return parts


def flat_triangles(corners: Tensor) -> Tensor:
    """Return control points (P, 6, C) of flat triangles with ``corners`` (P, 3, C)."""
    a, b, c = corners.unbind(1)
    return torch.stack([a, (a + b) / 2, (a + c) / 2, b, (b + c) / 2, c], 1)


_CLAMP_OFFSET = 2.0  # offset that keeps harmonics above the clamp at 0
NEAR = 0.05  # near plane, in half sides of the scene


@dataclass(frozen=True)
class TriangleOptions(DrawOptions):
    """Render options of triangles."""

    segments: int = SEGMENTS  # per edge: a triangle is rendered as ``segments``^2 flat faces
    supersampling: int = 1  # a pixel is the mean of this squared number of samples
    primitives: Literal["faces", "gaussians"] = "faces"
    # Of Gaussians near the outlines of their triangles, while these have no textures of scales.
    # Later Gaussians are too narrow: half weights from both sides of a seam leave it transparent.
    boundary_weights: bool = True


@dataclass(frozen=True, repr=False)
class TriangleScene(Renderable):
    """Scene of triangles.

    Attributes:
        unit: half side of the scene, world units.
        scale: standard deviation of Gaussians without textures, world units.
    """

    patches: Patches
    unit: float
    options: TriangleOptions = dataclasses.field(default_factory=TriangleOptions)
    background: Tensor | None = None
    scale: float = 1.0
    surface_options: ClassVar[frozenset[str]] = frozenset()

    def __len__(self) -> int:
        return len(self.patches)

    @torch.no_grad()
    def own_surface(self, time: float, options: SurfaceOptions) -> Surface:
        """Return each triangle as ``segments``^2 flat faces, with colours without harmonics.

        Triangles do not share vertices. ``segments``: as rendered, or as the textures need.
        """
        patches = self.patches
        count = max(SEGMENTS, patches.texture)
        places, faces = lattice(count)
        vertices = evaluate_patches(patches.points, places)
        ids = torch.arange(len(patches), dtype=torch.int32, device="cpu").repeat_interleave(
            len(places)
        )
        colours = patches.colours_at(ids, places.to(vertices.dtype).repeat(len(patches), 1))
        first = torch.arange(len(patches), device="cpu")[:, None, None] * len(places)
        flat = (faces + first).flatten(0, 1)
        return Surface(vertices.flatten(0, 1).numpy(), flat.numpy(), colours.clamp(0, 1).numpy())

    def page_data(self) -> tuple[dict[str, Any], dict[str, tuple[Tensor, Literal[8, 16]]]]:
        patches = self.patches
        middles = patches.points.detach()[:, CORNERS].mean(1).float().numpy()
        order = torch.from_numpy(storage_order(middles, np.zeros(0, dtype=np.int64)))
        lists: dict[str, tuple[Tensor, Literal[8, 16]]] = {
            "points": (patches.points[order].flatten(1), 16),
            "colours": (patches.colours[order].flatten(1), 8),
        }
        if patches.sh_degree:
            lists["rest"] = (patches.harmonics[order].flatten(1), 8)
        header = {
            "count": len(self),
            "frames": 0,
            "moves": False,
            "degree": patches.sh_degree,
            "texture": patches.texture,
            "segments": self.options.segments,
            "bounds": self.bounds.tolist(),
        }
        return header, lists

    @property
    def times(self) -> tuple[float, ...]:
        return ()

    @property
    def bounds(self) -> Tensor:
        corners = self.patches.points.detach()[:, CORNERS].flatten(0, 1)
        return torch.stack([corners.amin(0), corners.amax(0)])

    @property
    def device(self) -> torch.device:
        return self.patches.points.device

    def state(self) -> State:
        sizes = {"unit": self.unit, "scale": self.scale}
        own = {
            name: torch.tensor([x], dtype=torch.float64, device="cpu") for name, x in sizes.items()
        }
        return add_prefix("triangles", self.patches.state() | with_role(own, Role.SHARED))

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
        cameras = fixed_cameras(cameras, behind, self.patches.points)
        views = single_views(cameras, behind)
        return concatenate_renderings(
            [self.render_view(x, options, colour)[0] for x, colour in views]
        )

    def render_view(
        self, camera: Cameras, options: TriangleOptions, background: Tensor | None = None
    ) -> tuple[Rendering, PatchSamples]:
        """Render one camera, differentiable; also return the samples of its pixels."""
        times = options.supersampling
        patches = self.patches
        camera = camera.to(device=self.device)
        fine = camera.scaled(times)
        places = PatchSamples.of(
            *visible_patches(patches.points.detach(), fine, options.near, options.segments)
        )
        means = patch_values(patches.points, places.ids, places.uv)
        colours = patches.colours_at(places.ids, places.uv)
        if patches.harmonics.shape[1]:
            colours = colours + self._view_dependent_colours(camera)[places.ids.long()]
        blend = self._blend_faces if options.primitives == "faces" else self._splat
        image, through = blend(means, colours.clamp_min(0), places, fine, options)
        if times > 1:
            image = avg_pool2d(image.permute(0, 3, 1, 2), times).permute(0, 2, 3, 1)
            through = avg_pool2d(through[None], times)[0]
        depth = image[..., 3] if options.depth != "none" else None
        return composite_background(image[..., :3], through, depth, options, background), places

    def _blend_faces(
        self,
        means: Tensor,
        colours: Tensor,
        places: PatchSamples,
        camera: Cameras,
        options: TriangleOptions,
    ) -> tuple[Tensor, Tensor]:
        """Return an image (1, H, W, 3 or 4), the last channel depth, and its transmittance.

        ``means`` (N, 3), world, and ``colours`` (N, 3) of the samples.
        """
        at = project_points(means, camera, torch.zeros_like(places.ids))
        channels = _with_depths(colours, at.depths, options)
        crossings = outline_crossings(self.patches.points, camera, places)
        return blend_patches(at.means, channels, crossings, places)

    def _splat(
        self,
        means: Tensor,
        colours: Tensor,
        places: PatchSamples,
        camera: Cameras,
        options: TriangleOptions,
    ) -> tuple[Tensor, Tensor]:
        """``_blend_faces`` with one Gaussian per sample instead."""
        quats, scales = self.patches.shapes_at(places.ids, places.uv, self.scale)
        opacities = means.new_full((len(means),), OPACITY)
        limits = ProjectionOptions(near=options.near)
        projection = project(means, quats, scales, opacities, camera, limits)
        boundaries = None
        if options.boundary_weights and self.patches.log_scales is None:
            samples = projection.means2d[0]
            boundaries = Boundaries(places.rows[0], places.ids, samples, BOUNDARY_RADIUS)
        channels = _with_depths(colours, projection.depths[0], options)[None]
        size = (camera.width, camera.height)
        blended = rasterize(projection, opacities[None], channels, size, boundaries=boundaries)
        return blended.color, blended.transmittance

    def _view_dependent_colours(self, camera: Cameras) -> Tensor:
        """Return the colours (P, 3) that harmonics add for ``camera``."""
        patches = self.patches
        middles = patches.points.detach()[:, CORNERS].mean(1)
        constant = patches.harmonics.new_full((len(patches), 1, 3), _CLAMP_OFFSET / SH_C0)
        everywhere = torch.ones((1, len(patches), 2), dtype=torch.int32, device="cpu")
        sh = torch.cat([constant, patches.harmonics], 1)
        return evaluate_harmonics(middles, camera.centers, sh, everywhere, patches.sh_degree)[0] - (
            _CLAMP_OFFSET + 0.5
        )


def _with_depths(colours: Tensor, depths: Tensor, options: TriangleOptions) -> Tensor:
    """Append ``depths`` (N,) to ``colours`` (N, 3) if they are rendered."""
    if options.depth == "none":
        return colours
    return torch.cat([colours, depths[:, None]], 1)


def scene_options(model: BgTriangleModel, unit: float) -> TriangleOptions:
    """Return the render options of triangles in a scene of half side ``unit``."""
    faces = model.primitives == "faces"
    return TriangleOptions(
        near=NEAR * unit,
        supersampling=model.supersampling if faces else 1,
        primitives=model.primitives,
        boundary_weights=model.boundary_weights,
    )


def restore_scene(model: BgTriangleModel, checkpoint: Checkpoint) -> TriangleScene:
    """Return the scene in a checkpoint. Raises KeyError or ValueError for inconsistent tensors."""
    stored = checkpoint.part("triangles")
    half = _positive("unit", stored["unit"])
    scale = _positive("scale", stored["scale"]) if "scale" in stored else 1.0
    behind = evaluation_background(checkpoint.info.background, False)[1]
    options = scene_options(model, half)
    return TriangleScene(Patches.from_state(stored), half, options, behind, scale)


def _positive(name: str, value: Tensor) -> float:
    return float(require_positive(name, require_tensor(name, value, (1,), torch.float64)))
