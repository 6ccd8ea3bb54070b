"""Clips of the synthetic person: on the floor, within sight, and what their names say."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
import pytest
import torch

from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.clips import random_clip, squat, walk

DANCE = partial(random_clip, seed=1)
OTHER = partial(random_clip, seed=2)


@cache
def body() -> BodyTemplate:
    return default_template()


def posed(motion: Motion, frame: int) -> np.ndarray:
    exact = body().to(dtype=torch.float64)
    return posed_vertices(exact, motion.poses[[frame]].double(), motion.trans[[frame]].double())[
        0
    ].numpy()


@pytest.mark.parametrize("clip", [walk, squat, DANCE, OTHER])
def test_the_person_stands_on_the_floor_within_sight(
    clip: Callable[[BodyTemplate, int], Motion],
) -> None:
    """In every frame the lowest vertex is at y = 0, and all are inside a cylinder that the cameras
    see."""
    motion = clip(body(), 5)
    for frame in range(5):
        x, y, z = posed(motion, frame).T
        assert abs(y.min()) < 1e-6
        assert y.max() < 2.0
        assert np.hypot(x, z).max() < 1.0
    assert motion.poses.diff(dim=0).abs().amax((1, 2)).min() > 0.05, "no frame like the one before"


def test_the_clips_are_what_their_names_say() -> None:
    """Feet pass each other in a walk; in a squat the pelvis goes down and the hands go up."""

    def vertex(joint: str) -> int:
        return int(
            torch.linalg.vector_norm(
                body().vertices - body().joints[JOINT_NAMES.index(joint)], dim=-1
            ).argmin()
        )

    left, right, wrist = (vertex(name) for name in ("left_ankle", "right_ankle", "left_wrist"))
    steps = [posed(walk(body(), 7), frame)[[left, right]] for frame in (1, 3)]
    ahead = [feet[0, 2] - feet[1, 2] for feet in steps]
    assert ahead[0] > 0.3
    assert ahead[1] < -0.3
    motion = squat(body(), 3)
    first = posed(motion, 0)[wrist]
    last = posed(motion, 2)[wrist]
    assert motion.trans[2, 1] < motion.trans[0, 1] - 0.2
    assert last[1] > first[1] + 0.2


def test_a_seed_is_a_clip() -> None:
    """The same again for the same seed, another for another; every kind is drawn."""
    first, again, other = (random_clip(body(), 3, seed) for seed in (1, 1, 2))
    assert torch.equal(first.poses, again.poses)
    assert not torch.equal(first.poses, other.poses)
    turned = [random_clip(body(), 2, seed).poses[1].abs().amax(-1) > 1e-4 for seed in range(8)]
    assert len({tuple(joints.tolist()) for joints in turned}) >= 3
