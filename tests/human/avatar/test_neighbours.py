"""The nearest neighbours of points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dyngs.config import HumanModel
from dyngs.errors import DyngsError
from dyngs.human.avatar.neighbours import linked_neighbours, nearest_neighbours
from dyngs.human.template.atlas import atlas_texels
from dyngs.human.template.joints import JOINT_NAMES
from dyngs.human.template.load import default_template, load_template


@settings(max_examples=40, deadline=None)
@given(arrays(np.float64, st.tuples(st.integers(0, 12), st.just(3)), elements=st.integers(0, 3)), st.integers(1, 5))
def test_neighbours_are_the_nearest_others(places: np.ndarray, count: int) -> None:
    """By all distances; on a grid, so that many points coincide and are equally far."""
    points = torch.from_numpy(places)
    found = nearest_neighbours(points, count)
    columns = max(0, min(count, len(points) - 1))
    assert found.shape == (len(points), columns)
    apart = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    for i, row in enumerate(found):
        assert i not in row.tolist()
        assert len(set(row.tolist())) == columns
        others = torch.cat([apart[i, :i], apart[i, i + 1 :]]).sort().values
        torch.testing.assert_close(apart[i, row], others[:columns])


def test_neighbours_on_the_skin_are_next_texels() -> None:
    texels = atlas_texels(default_template(), 64)
    found = nearest_neighbours(texels.points)
    assert found.shape == (len(texels), 5)
    apart = (texels.points[found] - texels.points[:, None]).norm(dim=-1)
    assert bool((apart.diff(dim=1) >= 0).all())
    assert float((apart[:, 0] / texels.size).median()) == pytest.approx(1, abs=0.3)


def test_neighbours_need_finite_points() -> None:
    points = torch.rand(10, 3)
    points[4, 1] = math.nan
    with pytest.raises(DyngsError, match="not finite"):
        nearest_neighbours(points)


def test_neighbours_that_follow_other_joints_are_not_linked() -> None:
    points = torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0.01, 0, 0], [0.012, 0, 0]])
    weights = torch.tensor([[1.0, 0, 0], [0.0, 1, 0], [0.8, 0.2, 0], [0.0, 0.9, 0.1]])
    assert linked_neighbours(points, weights, 2).tolist() == [[2, 0], [3, 1], [0, 2], [1, 3]]
    assert linked_neighbours(points[:1], weights[:1]).shape == (1, 0)


def test_no_gaussian_of_an_arm_is_linked_to_the_trunk_or_of_a_finger_to_another() -> None:
    body = load_template(HumanModel())
    texels = atlas_texels(body, 96)
    near, first = linked_neighbours(texels.points, texels.weights), texels.weights.argmax(1)
    names = JOINT_NAMES[: len(body.parents)]
    part = {"left_elbow": 1, "left_wrist": 1, "spine1": 2, "spine2": 2, "left_knee": 3, "right_knee": 4}
    fingers = ("index", "middle", "pinky", "ring", "thumb")
    part |= {f"left_{name}{i}": 5 + k for k, name in enumerate(fingers) for i in (2, 3)}
    parts = torch.tensor([part.get(name, 0) for name in names])[first]
    parts[texels.weights.amax(1) < 0.9] = 0  # between joints
    known = parts > 0
    linked = parts[near[known]]
    assert bool(((linked == parts[known, None]) | (linked == 0)).all())
    assert float((near == torch.arange(len(near))[:, None]).float().mean()) < 0.02, "few lack neighbours"
