"""Speed is measured in turn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scene import Sliding, camera, moving_scene

from dyngs.data.loader import Image
from dyngs.evaluate.view_scores import Drawing
from dyngs.gaussians.rendering import RenderOptions
from dyngs.study.speed import quartiles, time_interleaved

pytestmark = pytest.mark.usefixtures("one_thread")


def test_all_draw_every_image_in_turn() -> None:
    scenes = [moving_scene(Sliding()), moving_scene(Sliding())]
    drawings = [Drawing(scene, RenderOptions(), torch.zeros(3)) for scene in scenes]
    views = [Image("view", camera(), drawings[0].image(camera(), 0.5), None, None, 0.5)] * 3
    before = [scene.field.calls for scene in scenes if isinstance(scene.field, Sliding)]
    speeds = time_interleaved(drawings, views, rounds=2)
    after = [scene.field.calls for scene in scenes if isinstance(scene.field, Sliding)]
    # a warm-up, and twice three views
    assert [b - a for a, b in zip(before, after, strict=True)] == [7, 7]
    assert speeds[0].gain.low == speeds[0].gain.median == speeds[0].gain.high == 1.0
    assert all(s.ms.low <= s.ms.median <= s.ms.high for s in speeds)


def test_quartiles() -> None:
    found = quartiles(np.array([4.0, 1.0, 2.0, 3.0, 100.0]))
    assert (found.low, found.median, found.high) == (2.0, 3.0, 4.0)
