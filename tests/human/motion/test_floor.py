"""The lowest vertex of a motion on the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_files import (
    pelvis_path,
    random_motion,
    slow_vertices,
    tiny_body,
)

from dyngs.human.motion.floor import place_on_floor


@pytest.mark.parametrize("count", [24, 52, 55])
def test_the_lowest_vertex_comes_to_the_floor(count: int) -> None:
    body = tiny_body(count)
    motion = replace(random_motion(), scale=torch.tensor([0.5, 1.0, 1.5, 2.0]))
    landed = place_on_floor(motion, body)
    assert slow_vertices(body, landed)[..., 1].min() == pytest.approx(0, abs=1e-6)
    assert torch.equal(landed.trans[:, ::2], motion.trans[:, ::2])
    rise = pelvis_path(body, landed) - pelvis_path(body, motion)
    assert np.ptp(rise[:, 1]) < 1e-6
