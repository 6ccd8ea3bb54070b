"""The surface of a known field: a ball."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.ngp import NgpField
from dyngs.baselines.fields.scene import FieldScene, extract_surface
from dyngs.ops.rays import Space

MIDDLE = torch.tensor([0.3, -0.1, 0.2])


@dataclass(frozen=True)
class Ball(NgpField):
    """A ball with density exp(10 (0.5 - distance)), coloured by direction."""

    def densities(self, points: torch.Tensor, time: float) -> torch.Tensor:
        return 25 * torch.exp(10 * (0.5 - (points - MIDDLE).norm(dim=1))) * (1.5 / self.space.half)

    def colours(self, points: torch.Tensor, directions: torch.Tensor, time: float) -> torch.Tensor:
        return directions / 2 + 0.5


@pytest.fixture(scope="module")
def scene() -> FieldScene:
    space = Space((0.1, 0.0, 0.0), 1.0, 2, 8)
    plain = NgpField.new(NgpModel(sizes="tiny"), space, torch.Generator().manual_seed(0))
    return FieldScene(Ball(**vars(plain)))


def test_mesh_of_a_ball_has_outward_faces_and_colours(scene: FieldScene) -> None:
    found = extract_surface(scene, cells=40)
    offsets = found.vertices - MIDDLE.numpy()
    assert np.linalg.norm(offsets, axis=1) == pytest.approx(np.full(len(offsets), 0.5), abs=2e-3)
    corners = found.vertices[found.faces] - MIDDLE.numpy()
    volume = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.01), "a negative one is inside out"
    straight = 0.5 - offsets  # seen from straight ahead: against the normal, of length 1/2
    assert np.abs(found.colours - straight).max() < 0.05
