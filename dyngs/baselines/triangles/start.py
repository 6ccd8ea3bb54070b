"""The kind ``bg_triangle``: the triangles that it begins with, and how it is restored."""

from __future__ import annotations

import torch

from dyngs.baselines.triangles.first import first_surface
from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.baselines.triangles.patches import Patches, flat_triangles
from dyngs.baselines.triangles.scene import TriangleScene, scene_options, stored_triangles
from dyngs.baselines.triangles.training import TriangleTraining
from dyngs.core.conventions import SH_C0, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.gaussians.start import StartValues, initial_gaussians, surroundings
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.views import evaluation_background
from dyngs.ops.patches import NUM_POINTS, lattice_size

VALUE_BYTES = 1.3  # In a file, per value of a triangle
FEWEST = 100  # Fewest triangles that a limit on the file must have room for
RADIUS = 1.5  # Of the first triangles, in mean distances of their points' three nearest neighbours
INNER = 0.02  # Fraction of the points on either side that does not count for the scene's size


def start(run: RunStart) -> TriangleTraining:
    """Return triangles turned at random at the first points of a capture, in whose place those of a
    surface come.

    Raises DyngsError: the points are no scene, or ``budget.max_mb`` has no room.
    """
    model = run.config.model
    assert isinstance(model, BgTriangleModel)
    megabytes = run.config.budget.max_mb
    model = model if megabytes is None else _within(model, megabytes)
    return TriangleTraining(
        run, *_at_points(run, model), model, first=_on_surface if model.gaussian_steps else None
    )


def _within(model: BgTriangleModel, megabytes: float) -> BgTriangleModel:
    """Return ``model`` with as many triangles as a file of so many 1e6 bytes holds at the usual
    precision."""
    values = 3 * (NUM_POINTS + lattice_size(model.texture) + num_sh_terms(model.sh_degree) - 1)
    most = int(1e6 * megabytes / (VALUE_BYTES * values))
    if most < FEWEST:
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: has no room for {FEWEST} triangles; "
            f"{1e-6 * FEWEST * VALUE_BYTES * values * 1.05:.2g} would do"
        )
    return model.model_copy(update={"max_triangles": min(most, model.max_triangles)})


def _at_points(run: RunStart, model: BgTriangleModel) -> tuple[Patches, float]:
    """Return triangles turned at random, and half the side of the scene."""
    values = StartValues(max_gaussians=min(model.num_first, model.max_triangles))
    first = initial_gaussians(surroundings(run.capture), run.config.init, values, 0, run.generator)
    ends = first.means.quantile(torch.tensor([INNER, 1 - INNER], device="cpu"), dim=0)
    unit = float((ends[1] - ends[0]).max()) / 2
    if not unit > 0:
        raise DyngsError(
            f"{run.config.data.root}: the {len(first.means)} first points are all in one place, where there are no "
            "triangles: give init.kind=random"
        )
    radius = first.log_scales.exp().amax(1).clamp(max=unit / 2) * RADIUS
    corners = first.means[:, None] + radius[:, None, None] * _random_triangles(
        len(first.means), run.generator
    )
    colours = 0.5 + SH_C0 * first.sh[:, 0]
    return _flat(corners, colours[:, None].repeat(1, 3, 1), model), unit


def _on_surface(run: RunStart, model: BgTriangleModel) -> tuple[Patches, float]:
    """Return triangles on the surface of Gaussians, and half the side of the scene."""
    found = first_surface(run, model.gaussian_steps, min(model.num_first, model.max_triangles))
    corners = found.corners.flatten(0, 1)
    unit = float((corners.amax(0) - corners.amin(0)).max()) / 2
    return _flat(found.corners, found.colours, model), unit


def _flat(corners: torch.Tensor, colours: torch.Tensor, model: BgTriangleModel) -> Patches:
    harmonics = torch.zeros((len(corners), num_sh_terms(model.sh_degree) - 1, 3), device="cpu")
    return Patches(flat_triangles(corners), flat_triangles(colours), harmonics)


def _random_triangles(count: int, generator: torch.Generator) -> torch.Tensor:
    """Return (count, 3, 3) corners of equilateral triangles in circles of radius 1, turned at
    random."""
    axes = torch.randn((count, 2, 3), generator=generator, device="cpu")
    one = torch.nn.functional.normalize(axes[:, 0], dim=1)
    other = torch.nn.functional.normalize(torch.linalg.cross(one, axes[:, 1]), dim=1)
    angles = torch.arange(3, device="cpu") * (2 * torch.pi / 3)
    return angles.cos()[:, None] * one[:, None] + angles.sin()[:, None] * other[:, None]


def restore(model: BgTriangleModel, checkpoint: Checkpoint) -> TriangleScene:
    """Return the scene of a checkpoint."""
    patches, unit = stored_triangles(checkpoint)
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return TriangleScene(patches, unit, scene_options(model, unit), behind)
