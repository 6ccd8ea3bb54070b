"""Curved triangles as something to draw: a z-buffer whose edges are blended where they are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.baselines.triangles.patches import CORNERS, Patches, evaluated
from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.core.gaussians import storage_order
from dyngs.core.state import Role, State, StateTensor, prefixed
from dyngs.core.tensor_checks import require_positive, require_tensor
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.renderable import (
    DrawOptions,
    Renderable,
    Rendering,
    Surface,
    SurfaceOptions,
    TimeStep,
    composited,
    fixed_cameras,
)
from dyngs.ops.harmonics import evaluate_harmonics
from dyngs.ops.patches import (
    SEGMENTS,
    Places,
    blend_patches,
    lattice,
    outline_crossings,
    patch_values,
    project_points,
    visible_patches,
)

_ABOVE = 2.0  # Added to harmonics so that the kernel's clamp at 0 does not cut them


NEAR = 0.05  # Near plane, in half sides of the scene


@dataclass(frozen=True)
class TriangleOptions(DrawOptions):
    """How triangles are drawn."""

    segments: int = SEGMENTS  # of an edge: a triangle is drawn as their square
    supersampling: int = 1  # a pixel is the mean of its square


@dataclass(frozen=True)
class View:
    """One view as it is drawn."""

    colour: Tensor  # (H, W, 3) before black
    transmittance: Tensor  # (H, W)
    depth: Tensor | None  # (H, W) sum of weight times z
    places: Places  # what each drawn pixel shows


@dataclass(frozen=True)
class TriangleScene(Renderable):
    """Triangles; ``unit``: half the side of their scene, world units."""

    patches: Patches
    unit: float
    options: TriangleOptions = dataclasses.field(default_factory=TriangleOptions)
    background: Tensor | None = None
    surface_options: ClassVar[frozenset[str]] = frozenset({"segments"})

    def __len__(self) -> int:
        return len(self.patches)

    @torch.no_grad()
    def own_surface(self, time: float, options: SurfaceOptions) -> Surface:
        """Return the surface: of each triangle ``segments``^2 flat ones, with the colours without
        harmonics.

        Triangles do not share vertices, as they do not in the scene. Without ``segments`` they are
        as many as the scene is drawn with, or as its textures need.
        """
        patches = self.patches
        count = options.segments or max(SEGMENTS, patches.texture)
        places, faces = lattice(count)
        vertices = evaluated(patches.points, places)
        ids = torch.arange(len(patches), dtype=torch.int32, device="cpu").repeat_interleave(
            len(places)
        )
        colours = patches.colours_at(ids, places.to(vertices.dtype).repeat(len(patches), 1))
        first = torch.arange(len(patches), device="cpu")[:, None, None] * len(places)
        flat = (faces + first).flatten(0, 1)
        return Surface(vertices.flatten(0, 1).numpy(), flat.numpy(), colours.clamp(0, 1).numpy())

    def page_lists(self) -> tuple[dict[str, Any], dict[str, tuple[Tensor, Literal[8, 16]]]]:
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
        unit = torch.tensor([self.unit], dtype=torch.float64, device="cpu")
        return prefixed(
            "triangles", self.patches.state() | {"unit": StateTensor(unit, Role.SHARED)}
        )

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
        views = [self.view(cameras.select(i), options) for i in range(len(cameras))]
        return rendering_of(views, behind, options)

    def view(self, camera: Cameras, options: TriangleOptions) -> View:
        """Return what one camera sees; differentiable."""
        times = options.supersampling
        patches = self.patches
        camera = camera.to(device=self.device)
        fine = camera.scaled(times)
        places = Places.of(
            *visible_patches(patches.points.detach(), fine, options.near, options.segments)
        )
        at = project_points(
            patch_values(patches.points, places.ids, places.uv), fine, torch.zeros_like(places.ids)
        )
        colours = patches.colours_at(places.ids, places.uv)
        if patches.harmonics.shape[1]:
            colours = colours + self._by_direction(camera)[places.ids.long()]
        channels = colours.clamp_min(0)
        if options.depth != "none":
            channels = torch.cat([channels, at.depths[:, None]], 1)
        crossings = outline_crossings(patches.points, fine, places)
        image, through = blend_patches(at.means, channels, crossings, places)
        image = image[0]
        through = through[0]
        if times > 1:
            image = avg_pool2d(image.permute(2, 0, 1)[None], times)[0].permute(1, 2, 0)
            through = avg_pool2d(through[None, None], times)[0, 0]
        return View(
            image[..., :3], through, image[..., 3] if options.depth != "none" else None, places
        )

    def _by_direction(self, camera: Cameras) -> Tensor:
        """Return (P, 3): what harmonics add to the colours of each triangle, seen from
        ``camera``."""
        patches = self.patches
        middles = patches.points.detach()[:, CORNERS].mean(1)
        constant = patches.harmonics.new_full((len(patches), 1, 3), _ABOVE / SH_C0)
        everywhere = torch.ones((1, len(patches), 2), dtype=torch.int32, device="cpu")
        sh = torch.cat([constant, patches.harmonics], 1)
        return evaluate_harmonics(middles, camera.centers, sh, everywhere, patches.sh_degree)[0] - (
            _ABOVE + 0.5
        )


def rendering_of(
    views: list[View], background: Tensor | None, options: TriangleOptions
) -> Rendering:
    """Return the images of ``views`` before ``background``; None is black."""
    rgb = torch.stack([view.colour for view in views])
    through = torch.stack([view.transmittance for view in views])
    found = [view.depth for view in views if view.depth is not None]
    return composited(rgb, through, torch.stack(found) if found else None, options, background)


def scene_options(model: BgTriangleModel, unit: float) -> TriangleOptions:
    """Return how triangles of a scene of half side ``unit`` are drawn."""
    return TriangleOptions(near=NEAR * unit, supersampling=model.supersampling)


def stored_triangles(checkpoint: Checkpoint) -> tuple[Patches, float]:
    """Return the triangles and unit of a checkpoint. Raises KeyError or ValueError where its
    tensors do not fit."""
    stored = checkpoint.part("triangles")
    unit = require_positive("unit", require_tensor("unit", stored["unit"], (1,), torch.float64))
    return Patches.restored(stored), float(unit)
