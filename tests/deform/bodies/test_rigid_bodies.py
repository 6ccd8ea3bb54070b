"""Initial rigid bodies: rotating bodies are accepted, and their Gaussians follow the true motion."""

from __future__ import annotations

import numpy as np
import torch
from rolling_ball import rolling
from tiny_fields import tiny_options

from dyngs.deform.bodies.rigid_bodies import angles_deg, find_bodies
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import create_field


def test_rolling_ball_is_initialized_with_its_trajectory() -> None:
    """The seeds lie on the ball at the middle of the clip, and the field moves them along the true
    path.
    """
    frame_stack, centers, turns = rolling()
    found = find_bodies(frame_stack, 400, 4)
    assert found is not None
    assert found.explains_all_motion
    assert found.message.startswith("found 1 rigid body rotating by ")
    (seeds,) = found.seeds
    assert 100 < len(seeds) <= 400
    middle = len(frame_stack) // 2
    arms = seeds.means.numpy() - centers[middle]
    assert np.linalg.norm(arms, axis=1).max() < 1.3 * 0.28
    others = 5
    setup = FieldSetup(torch.zeros(3), torch.ones(3), len(frame_stack), others + len(seeds), 1.0)
    field = found.build_field(create_field(tiny_options("control_nodes"), setup, torch.Generator()))
    assert field.rest.labels.tolist() == [-1] * others + [0] * len(seeds)
    means = torch.cat([torch.zeros(others, 3), seeds.means])
    for t in (0, 5, middle, len(frame_stack) - 1):
        with torch.no_grad():
            moved = (means + field.offsets(means, float(frame_stack.times[t])).means)[
                others:
            ].numpy()
        expected = arms @ (turns[t] @ turns[middle].T).T + centers[t]
        # At the ends of the clip, which have neighbours on one side only, more.
        assert (
            np.linalg.norm(moved - expected, axis=1).mean()
            < (0.4 if t in (0, len(frame_stack) - 1) else 0.25) * 0.28
        )


def test_sliding_body_is_not_a_rigid_rotation() -> None:
    """It is left to other models or becomes a body with little rotation. Its path is estimated,
    too.
    """
    frame_stack, _, _ = rolling(turns=False)
    found = find_bodies(frame_stack, 400, 4)
    assert found is None or angles_deg(found.bodies[0].rotation.rotations).max() < 12
