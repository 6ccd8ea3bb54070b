"""Colours of unseen texels: from their surroundings at rest, and from the other side."""

from __future__ import annotations

from functools import cache

import torch

from dyngs.human.prediction.unseen import colours_nearby, mirror_texels
from dyngs.human.template.atlas import Texels, atlas_texels
from dyngs.human.template.load import default_template


@cache
def texels() -> Texels:
    body = default_template()
    return atlas_texels(body, 64, body.vertices)


def test_mirror_texels_lie_on_the_other_side() -> None:
    """Within two widths of a texel (3 cm), and mirrored twice most come back to where they were."""
    points = texels().points
    mirror = mirror_texels(texels())
    there = points[mirror] * torch.tensor([-1.0, 1.0, 1.0])
    assert (there - points).norm(dim=1).quantile(0.95) < 0.06
    assert (points[mirror[mirror]] - points).norm(dim=1).quantile(0.95) < 0.06


def test_unseen_texels_take_colours_from_their_surroundings() -> None:
    """The back of a person seen from the front: legs like legs, the chest like the chest; what is seen stays."""
    points, normals = texels().points, texels().normals
    seen = normals[:, 2].clamp_min(0)
    rgb = torch.where((points[:, 1] > 0)[:, None], torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
    found = colours_nearby(texels(), rgb * (seen > 0)[:, None], seen)
    assert torch.equal(found[seen > 0], rgb[seen > 0])
    away = (seen == 0) & (points[:, 1].abs() > 0.15)
    assert away.sum() > 100
    assert ((found - rgb)[away].abs().amax(1) < 0.01).float().mean() > 0.99


def test_few_or_no_seen_texels_are_enough() -> None:
    rgb, none = torch.rand(len(texels()), 3), torch.zeros(len(texels()))
    assert (colours_nearby(texels(), rgb, none) == 0.5).all()
    one = none.clone()
    one[7] = 1.0
    torch.testing.assert_close(colours_nearby(texels(), rgb, one), rgb[7].expand_as(rgb))
    assert torch.equal(colours_nearby(texels(), rgb, none + 1), rgb)
