"""Textures: colours lie where the atlas has them, upside up and not mirrored, and gaps are filled
sensibly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from bare_person import atlas, bands, bare_scene, template

from dyngs.core.conventions import SH_C0
from dyngs.export.rigged.skeleton import anchor_normals
from dyngs.export.rigged.texture import (
    BakedTexels,
    bake_texels,
    fill_unseen,
    frontal_colours,
    texture_image,
)
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.atlas import Texels, atlas_texels


def baked(scene: HumanScene, texels: Texels) -> BakedTexels:
    with torch.no_grad():
        return bake_texels(
            scene, texels, anchor_normals(scene.anchors, template(), template().vertices)
        )


def test_a_texel_has_the_colour_of_its_place() -> None:
    """Within the blur of Gaussians of 30 mm; at twice the resolution of the Gaussians."""
    texels = atlas_texels(template(), 128)
    found = baked(bare_scene(), texels)
    wanted = bands(texels.points)
    error = (found.rgb - wanted).abs().amax(1)
    assert float(error.quantile(0.95)) < 0.06
    assert float(error.median()) < 0.02
    assert float((found.alpha > 0.5).float().mean()) > 0.97


def test_the_image_is_upside_up_and_not_mirrored() -> None:
    """Read as renderers do, row = (1 - v) H: at each vertex of the head and hands its own
    colour."""
    body = template()
    texels = atlas_texels(template(), 128)
    assert body.uv is not None
    assert body.uv_faces is not None
    image = texture_image(bands(texels.points), texels)
    uv = body.uv[body.uv_faces.flatten()]
    at = body.vertices[body.faces.flatten()]
    column = (uv[:, 0] * 128).long().clamp(0, 127)
    row = ((1 - uv[:, 1]) * 128).long().clamp(0, 127)
    found = torch.from_numpy(image[row, column]).float() / 255
    error = (found - bands(at)).abs().amax(1)
    assert float(error.quantile(0.99)) < 0.06


def test_another_layer_covers_what_lies_below() -> None:
    """Blended from the outside in: white at 2 cm hides black on the skin, and is where the surface
    is seen."""
    scene = bare_scene(colours=torch.zeros_like)
    normals = anchor_normals(scene.anchors, template(), template().vertices)
    above = scene.gaussians.replace(
        means=scene.gaussians.means + 0.02 * normals,
        sh=torch.full_like(scene.gaussians.sh, 0.5 / SH_C0),
    )
    both = type(above)(
        **{k: torch.cat([x, above.tensors()[k]]) for k, x in scene.gaussians.tensors().items()}
    )
    twice = scene.select(torch.arange(len(scene)).repeat(2)).with_gaussians(both)
    assert isinstance(twice, HumanScene)
    trunk = atlas().weights[:, [3, 6, 9]].sum(1) > 0.95
    found = baked(twice, atlas())
    assert float(found.rgb[trunk].mean()) > 0.95
    assert abs(float(found.top[trunk].median()) - 0.02) < 0.004


def test_colours_that_depend_on_the_side_are_those_from_above_the_skin() -> None:
    """Harmonics of degree 1 that shine along +x are bright where the skin is seen along +x: on the
    right side."""
    scene = bare_scene(colours=lambda x: torch.full_like(x, 0.5))
    sh = torch.zeros(len(scene), 4, 3)
    sh[:, 3] = -0.6
    normals = anchor_normals(scene.anchors, template(), template().vertices)
    found = frontal_colours(scene.with_gaussians(scene.gaussians.replace(sh=sh)), normals)
    wanted = (0.5 - 0.4886025119 * 0.6 * normals[:, :1]).clamp(0, 1).expand(-1, 3)
    torch.testing.assert_close(found, wanted, atol=1e-5, rtol=0)


def test_gaps_are_filled_from_around_and_large_holes_from_the_mirror_side() -> None:
    """The whole left forearm is missing: it gets the right one's colours, at the same heights."""
    texels = atlas(192)
    left = texels.weights[:, [18, 20]].sum(1) > 0.5
    make = torch.Generator().manual_seed(0)
    alone = (torch.rand(len(texels), generator=make) < 0.02) & (
        texels.weights[:, [3, 6, 9]].sum(1) > 0.9
    )
    colours = (
        torch.stack(
            [texels.points[:, 0].abs(), texels.points[:, 1] + 1, texels.points[:, 2] + 0.5], dim=1
        )
        / 2
    )
    alpha = torch.where(left | alone, 0.0, 1.0)
    given = torch.where((alpha > 0)[:, None], colours, 0.0)
    filled = fill_unseen(BakedTexels(given, alpha, torch.zeros(len(texels))), texels)
    assert filled.mirrored > 0.9 * int(left.sum())
    assert filled.spread >= int(alone.sum())
    assert float((filled.rgb - colours)[left].abs().quantile(0.95)) < 0.02
    assert float((filled.rgb - colours)[alone].abs().max()) < 0.03
    assert torch.equal(filled.rgb[alpha > 0], colours[alpha > 0])


def test_nothing_seen_or_nothing_missing_changes_nothing() -> None:
    texels = atlas()
    for value in (0.0, 1.0):
        given = BakedTexels(
            bands(texels.points), torch.full((len(texels),), value), torch.zeros(len(texels))
        )
        filled = fill_unseen(given, texels)
        assert (filled.mirrored, filled.spread) == (0, 0)
        assert torch.equal(filled.rgb, given.rgb)


def test_what_no_triangle_covers_has_the_nearest_colour() -> None:
    texels = atlas()
    few = replace(texels, index=torch.tensor([0, 64 * 64 - 1]))
    image = texture_image(torch.tensor([[1.0, 0, 0], [0, 0, 1.0]]), few)
    assert image.shape == (64, 64, 3)
    assert image[10, 10].tolist() == [255, 0, 0]
    assert image[60, 40].tolist() == [0, 0, 255]
    assert set(np.unique(image[..., 1])) == {0}
