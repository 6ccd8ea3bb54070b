"""Selection of Gaussians by boxes and spheres, and refusal of invalid regions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scene import moving_scene, sliding_nodes, still_scene

from dyngs.core.errors import DyngsError
from dyngs.export.edit.crop import Box, Sphere, gaussians_in_region, parse_region
from dyngs.io.formats.similarity import Similarity

POINTS = np.random.default_rng(0).uniform(-1.5, 1.5, (3000, 3))


def test_boxes_and_spheres() -> None:
    box = parse_region(["1,-1,0", "-0.5,1,1"])
    x, y, z = POINTS.T
    np.testing.assert_array_equal(
        box.contains(POINTS), (abs(y) <= 1) & (z >= 0) & (z <= 1) & (x >= -0.5) & (x <= 1)
    )
    ball = parse_region(["1,0,0 1.2m"])  # also as one word
    np.testing.assert_array_equal(ball.contains(POINTS), (x - 1) ** 2 + y**2 + z**2 <= 1.44)
    assert isinstance(box, Box)
    assert isinstance(ball, Sphere)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["1,2,3"], "use two corners x,y,z x,y,z, or x,y,z and a radius"),
        (["1,2,3", "1,2"], "'1,2' is not a point"),
        (["1,2,3", "1,5,9"], "empty box"),
        (["1,2,3", "-1"], "radius must be positive, not -1"),
        (["1,2,3", "nan"], "is not a number"),
        (["box.obj"], "use two corners"),
        ([""], "use two corners"),
    ],
)
def test_regions_that_are_none(words: list[str], said: str) -> None:
    with pytest.raises(DyngsError, match=said) as caught:
        parse_region(words)
    assert "\n" not in str(caught.value)


def test_moving_gaussians_are_selected_if_ever_inside() -> None:
    """Balls 1 and 3 slide along x."""
    for scene in (still_scene(), moving_scene(sliding_nodes())):
        at = [scene.at(t).means for t in (0.0, 0.25, 0.5, 0.75, 1.0)]
        region = Sphere(tuple(at[2][1].tolist()), 1e-3)  # type: ignore[arg-type]
        inside = torch.stack([(x - at[2][1]).norm(dim=1) < 1e-3 for x in at]).any(0)
        assert torch.equal(gaussians_in_region(region, scene, Similarity()), inside)
        assert not gaussians_in_region(region, scene, Similarity(shift=(9.0, 0.0, 0.0))).any()
