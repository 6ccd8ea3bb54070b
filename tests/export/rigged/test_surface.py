"""The surface of a mesh: moved to where clothes are, left alone where nothing is known."""

from __future__ import annotations

import torch
from bare_person import RESOLUTION, atlas, bare_scene, template

from dyngs.export.rigged.skeleton import anchor_normals
from dyngs.export.rigged.surface import MARGINS, FittedSurface, fitted_surface
from dyngs.export.rigged.texture import bake_texels
from dyngs.gaussians import Gaussians
from dyngs.human.body.joints import JOINT_NAMES

BODY = template()
NORMALS = anchor_normals(bare_scene().anchors, BODY, BODY.vertices)


@torch.no_grad()
def fitted(gaussians: Gaussians) -> FittedSurface:
    scene = bare_scene().with_gaussians(gaussians)
    samples = atlas(2 * RESOLUTION)
    return fitted_surface(
        gaussians, BODY, BODY.vertices, samples, bake_texels(scene, samples, NORMALS)
    )


def test_trousers_move_the_thighs_and_nothing_else() -> None:
    """Gaussians 3 cm above the thighs: there the surface rises by about as much, and silhouettes
    agree better."""
    gaussians = bare_scene().gaussians
    thighs = atlas().weights[:, [1, 2]].sum(1).clamp(0, 1)
    found = fitted(gaussians.replace(means=gaussians.means + 0.03 * thighs[:, None] * NORMALS))
    assert found.margin in MARGINS
    assert found.agreement > found.plain + 0.01
    moved = (found.vertices - BODY.vertices).norm(dim=1)
    margin = found.margin or 0.0
    inside = BODY.weights[:, [1, 2]].sum(1) > 0.95
    assert abs(float(moved[inside].median()) - 0.03 - margin) < 0.006
    shins = BODY.weights[:, [4, 5]].sum(1) > 0.95
    assert abs(float(moved[shins].median()) - margin) < 0.006
    assert float(moved.max()) < 0.06 + 1e-6


def test_fingers_swell_less() -> None:
    """Their sides pull in opposite directions; those of the trunk do not."""
    gaussians = bare_scene().gaussians
    found = fitted(gaussians.replace(means=gaussians.means + 0.02 * NORMALS))
    moved = (found.vertices - BODY.vertices).norm(dim=1)
    tips = [
        i for i, name in enumerate(JOINT_NAMES) if name.endswith(("index3", "middle3", "ring3"))
    ]
    trunk = BODY.weights[:, [0, 3, 6, 9]].sum(1) > 0.95
    assert float(moved[BODY.weights[:, tips].sum(1) > 0.9].median()) < 0.75 * float(
        moved[trunk].median()
    )


def test_the_template_stays_where_nothing_is_seen() -> None:
    gaussians = bare_scene().gaussians
    found = fitted(
        gaussians.replace(logit_opacities=torch.full_like(gaussians.logit_opacities, -9.0))
    )
    assert found.margin is None
    assert torch.equal(found.vertices, BODY.vertices)
    assert found.agreement == found.plain
