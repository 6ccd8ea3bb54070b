"""Clothes of the synthetic person: colours of known positions, and where the surface goes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from dyngs.core.errors import DyngsError
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.mesh import vertex_normals
from dyngs.human.synthetic.clothes import Outfit, dress_body, paint_texture, random_outfit


@cache
def body() -> BodyTemplate:
    return default_template()


@cache
def texture() -> np.ndarray:
    return paint_texture(body(), random_outfit(0))


def test_the_texture_differs_by_seed_side_and_front() -> None:
    """By the colours at the vertices of hands, shoes and chest."""
    vertices = body().vertices.double().numpy()
    uv = body().uv
    uv_faces = body().uv_faces
    assert uv is not None
    assert uv_faces is not None
    positions = np.zeros((len(vertices), 2))
    positions[body().faces.numpy().ravel()] = uv.numpy()[uv_faces.numpy().ravel()]
    colors = texture()[
        ((1 - positions[:, 1]) * 512).astype(int), (positions[:, 0] * 512).astype(int)
    ]
    palm = np.abs(vertices[:, 0]) > 0.83
    sole = vertices[:, 1] < -0.8
    for part in (palm, sole):
        left, right = (colors[part & (sign * vertices[:, 0] > 0)] for sign in (1, -1))
        for side in (left, right):
            assert (np.abs(side - np.median(side, axis=0)) < 1e-9).all(1).mean() > 0.95, (
                "one colour"
            )
        assert np.abs(np.median(left, axis=0) - np.median(right, axis=0)).max() > 0.2
    chest = (np.abs(vertices[:, 0]) < 0.1) & (np.abs(vertices[:, 1] - 0.35) < 0.1)
    front, back = (
        colors[chest & (sign * (vertices[:, 2] + 0.02) > 0.02)].mean(0) for sign in (1, -1)
    )
    assert np.abs(front - back).max() > 0.1
    other = paint_texture(body(), random_outfit(1), 64)
    assert np.abs(other - paint_texture(body(), random_outfit(0), 64)).mean() > 0.05
    assert (other >= 0).all()
    assert (other <= 1).all()


def test_texels_beside_the_atlas_repeat_the_nearest_one() -> None:
    """No texel is left black, however coarse the texture; the darkest cloth is 0.08."""
    for resolution in (1, 7, 64):
        assert paint_texture(body(), random_outfit(0), resolution).shape == (
            resolution,
            resolution,
            3,
        )
        assert paint_texture(body(), random_outfit(0), resolution).max(-1).min() >= 0.08


def test_a_body_without_an_atlas_is_refused() -> None:
    with pytest.raises(DyngsError, match="no texture coordinates"):
        paint_texture(replace(body(), uv=None, uv_faces=None), random_outfit(0))


def test_patterns_are_as_wide_and_as_long_as_the_outfit_says() -> None:
    """Twice the pitch halves the changes of colour over the trousers; shorts and short sleeves show
    skin."""
    palette = random_outfit(0).palette
    fine, coarse = (
        paint_texture(body(), Outfit(palette, pitch=pitch), 128) for pitch in (1.0, 2.0)
    )
    changes = [(np.abs(np.diff(x, axis=0)).max(-1) > 0.05).sum() for x in (fine, coarse)]
    assert 0.4 < changes[1] / changes[0] < 0.9, "outlines of garments stay"
    skin = [
        (
            paint_texture(body(), Outfit(palette, long_sleeves=long, long_legs=long), 128)
            == palette["skin"]
        )
        .all(-1)
        .sum()
        for long in (True, False)
    ]
    assert skin[0] + 300 < skin[1]


def test_the_first_person_is_the_template() -> None:
    assert torch.equal(dress_body(body(), random_outfit(0)).vertices, body().vertices)
    assert random_outfit(0).size == 1


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_clothes_stand_away_from_the_skin_by_up_to_four_centimetres(seed: int) -> None:
    """Along the normals, nowhere inwards; hands and the face stay; joints, weights and atlas
    too."""
    outfit = random_outfit(seed)
    clothed = dress_body(body(), outfit)
    skin = body().vertices.double()
    moved = (clothed.vertices.double() - skin).numpy()
    height = (moved * vertex_normals(skin.numpy(), body().faces.numpy())).sum(1)
    # float32 vertices
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.abs(height), atol=1e-6)
    assert height.min() > -1e-6
    assert 0.6 * max(outfit.shirt, outfit.trousers) < height.max() <= 0.04
    hands = np.abs(skin[:, 0].numpy()) > body().joints[JOINT_NAMES.index("left_index1"), 0].item()
    assert height[hands].max() < 1e-3
    assert clothed.joints is body().joints
    assert clothed.weights is body().weights
    assert 0.88 <= outfit.size <= 1.04


def test_a_seed_always_means_the_same() -> None:
    a = random_outfit(7)
    b = random_outfit(7)
    other = random_outfit(8)
    assert (
        (a.pitch, a.shirt, a.size)
        == (b.pitch, b.shirt, b.size)
        != (other.pitch, other.shirt, other.size)
    )


def test_usual_clothes_are_alike_on_both_sides() -> None:
    for seed in (1, 2, 3):
        palette = random_outfit(seed, True).palette
        other = random_outfit(seed).palette
        for part in ("leg", "shoe", "hand"):
            assert np.array_equal(palette[f"left_{part}"], palette[f"right_{part}"])
            assert not np.array_equal(other[f"left_{part}"], other[f"right_{part}"])
        assert np.array_equal(palette["left_hand"], palette["skin"])
        assert all(0 <= color.min() <= color.max() <= 1 for color in palette.values())
