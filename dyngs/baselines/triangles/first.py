"""Where triangles begin: on the surface that a short run of Gaussians shows, since they cannot move
through each other.

What lies behind a triangle gets no gradient, so that triangles at random stay where they are in
each other's way; Gaussians are seen through.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import DefaultStrategy, ShColour
from dyngs.config.kinds import section_of_kind
from dyngs.core.errors import DyngsError
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.colour.training import ColourTraining
from dyngs.gaussians.model import GaussianModel, SceneTraining
from dyngs.gaussians.start import densifier_of, first_gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.surface import (
    DepthView,
    Mesh,
    colours_of,
    fused,
    opaque_box,
    seen_by,
    simplified,
)
from dyngs.models.kind import RunStart
from dyngs.models.views import background_colour
from dyngs.ops.loss import l1_ssim_loss

LONGEST_SIDE = 160  # Of the images that Gaussians learn, px
MOST_GAUSSIANS = 20_000
VIEWS = 64  # Whose depths are fused
CELLS = 128  # Along the scene, at most; no more than pixels along an image


@dataclass(frozen=True)
class FirstSurface:
    """Flat triangles of the first surface."""

    corners: Tensor  # (F, 3, 3) world
    colours: Tensor  # (F, 3, 3) of the corners


def first_surface(run: RunStart, steps: int, most: int) -> FirstSurface:
    """Return at most ``most`` triangles where Gaussians are after ``steps``.

    Raises DyngsError: what they show is no surface.
    """
    trained = _trained(run, steps)
    seen, (low, high) = _views(run, trained), opaque_box(trained.scene.gaussians)
    cells = min(CELLS, max(max(one.depth.shape) for one in seen))
    mesh = fused(seen, low, high, cells)
    mesh = None if mesh is None else simplified(mesh, most)
    if mesh is None or len(mesh.faces) == 0:
        raise DyngsError(
            f"{run.config.data.root}: {steps} steps of Gaussians show no surface for triangles to begin on: give more "
            "(model.gaussian_steps), or 0, to begin at points"
        )
    return _coloured(mesh, seen, float((high - low).max()) / cells)


def _coloured(mesh: Mesh, seen: list[DepthView], size: float) -> FirstSurface:
    vertices = torch.from_numpy(mesh.vertices).float()
    faces = torch.from_numpy(mesh.faces)
    return FirstSurface(vertices[faces], colours_of(seen, vertices, 2 * size)[faces])


def _trained(run: RunStart, steps: int) -> GaussianModel:
    """Return Gaussians after so many steps."""
    config = run.config
    strategy = DefaultStrategy(max_gaussians=MOST_GAUSSIANS)
    train = config.train.model_copy(update={"steps": steps, "initial_downscale": 1})
    changed = {
        "model": section_of_kind("static").model_validate({"sh_degree": 0}),
        "strategy": strategy,
        "train": train,
        "colour": ShColour(),
    }
    own = config.model_copy(update=changed)
    start = replace(run, config=own, asked=own)
    scene = StaticScene(gaussians=first_gaussians(start))
    model = GaussianModel(
        start, scene, SceneTraining(), densifier_of(start), ColourTraining(ShColour())
    )
    order = torch.randint(len(run.images), (steps,), generator=run.generator, device="cpu")
    for step, index in enumerate(order.tolist(), 1):
        image = run.images[index]
        image = image.shrunk(_divisor(image.cameras.width, image.cameras.height))
        background = background_colour(run.background, run.generator)
        drawn = model.draw(image, step, background)
        loss = l1_ssim_loss(
            drawn.rendering.rgb[0],
            image.composite(background),
            config.train.ssim_weight,
            image.mask,
        )
        loss.backward()
        drawn.after_backward()
        model.update(step)
    return model


def _divisor(width: int, height: int) -> int:
    return -(-max(width, height) // LONGEST_SIDE)


@torch.no_grad()
def _views(run: RunStart, model: GaussianModel) -> list[DepthView]:
    scene = replace(model.scene, options=model.options)
    found = []
    for index in evenly_spaced(len(run.images), VIEWS):
        image = run.images[index]
        image = image.shrunk(_divisor(image.cameras.width, image.cameras.height))
        own = image.composite(torch.zeros(3, device="cpu"))
        found.append(replace(seen_by(scene, image.cameras), colour=own))
    return found
