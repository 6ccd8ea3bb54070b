"""Light that is fixed in the world: known colours, gradients, and what tells light from clothes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.conventions import SH_C0
from dyngs.human.avatar.anchors import texel_gaussians
from dyngs.human.avatar.light import TERMS, Light, difference_of_sides, harmonics, rest_normals
from tests.bare_person import atlas, bare_scene


def from_the_left() -> Tensor:
    """Twice as bright as even light where the surface faces +x, black where it faces -x; red only."""
    factors = torch.zeros(TERMS, 3)
    factors[0, 0] = 1.0
    return factors


def turned(angle: float) -> Tensor:
    """A rotation about y."""
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def colours(sh: Tensor) -> Tensor:
    return 0.5 + SH_C0 * sh[:, 0]


def test_colours_follow_where_the_surface_faces() -> None:
    albedo = torch.tensor([[0.4, 0.3, 0.2]])
    sh = ((albedo - 0.5) / SH_C0)[:, None]
    light = Light(torch.tensor([[2.0, 0, 0]]), from_the_left())
    for angle in (0.0, 0.7, math.pi / 2, math.pi):
        found = colours(light.on(sh, 3 * turned(angle)[None]))
        expected = albedo * torch.tensor([1 + math.cos(angle), 1.0, 1.0])
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_higher_harmonics_are_dimmed_with_the_colour() -> None:
    sh = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(0))
    light = Light(torch.tensor([[0.0, 1, 0]]).expand(5, 3), 0.3 * torch.ones(TERMS, 3))
    found = light.on(sh, torch.eye(3).expand(5, 3, 3))
    factor = 1 + 0.3 * harmonics(torch.tensor([[0.0, 1, 0]])).sum()
    torch.testing.assert_close(found[:, 1:], factor * sh[:, 1:])
    torch.testing.assert_close(colours(found), factor * colours(sh))


def test_gradients_are_those_of_finite_differences() -> None:
    make = torch.Generator().manual_seed(1)
    shapes = ((3, 1, 3), (3, 3, 3), (3, 3), (TERMS, 3))
    values = [torch.randn(shape, generator=make, dtype=torch.float64).requires_grad_() for shape in shapes]
    assert torch.autograd.gradcheck(lambda sh, linear, normals, light: Light(normals, light).on(sh, linear), values)


def test_normals_of_the_first_gaussians_point_away_from_the_body() -> None:
    texels = atlas()
    gaussians, _ = texel_gaussians(texels, [0.0], 0)
    torch.testing.assert_close(rest_normals(gaussians), texels.normals, atol=1e-5, rtol=0)


def test_a_person_is_lit_in_the_world() -> None:
    scene = bare_scene(light=True)
    dark, _ = scene.in_frame(0)
    scene.learned["light"].data.copy_(from_the_left())
    lit, _ = scene.in_frame(0)
    assert torch.equal(lit.means, dark.means)
    ratio = colours(lit.sh) / colours(dark.sh)
    torch.testing.assert_close(ratio[:, 1:], torch.ones_like(ratio[:, 1:]), atol=1e-5, rtol=0)
    right, left = ratio[:, 0].topk(500, largest=False).indices, ratio[:, 0].topk(500).indices
    middle = dark.means[:, 0].median()
    assert dark.means[left, 0].median() > middle > dark.means[right, 0].median()


def test_sides_of_other_colours_differ() -> None:
    gaussians = bare_scene().gaussians.select(torch.arange(4))
    sh = torch.tensor([0.1, 0.4, 0.4, 0.0])[:, None, None].expand(4, 1, 3) / SH_C0
    images, known = torch.tensor([1, 0, 1, 2]), torch.tensor([True, True, True, False])
    found = difference_of_sides(gaussians.replace(sh=sh), images, known)
    torch.testing.assert_close(found, torch.tensor(3 * 2 * 0.09 / 4))
