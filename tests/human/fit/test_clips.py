"""Another clip of a fitted person: moved to its silhouettes, by the same shift in all frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.human.fit.capture_fit import RESOLUTION, CaptureFit, FitEffort, TriedFit
from dyngs.human.fit.clips import fitted_clips, placed_clip
from dyngs.human.fit.silhouettes import surface_of
from dyngs.human.fit.solve import body_fit, new_fit
from dyngs.human.motion.clip import captured_motion
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.human.template.body_reader import default_template

OPTIONS = HumanOptions(size=96, num_frames=2, num_new=2, num_cameras=4, num_test=4, seed=0, samples=1)
EFFORT = FitEffort(side=64, steps=40)
AWAY = np.array([0.03, -0.02, 0.02])


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return read_capture(DataConfig(root=write_human_capture(tmp_path_factory.mktemp("clip") / "ann", OPTIONS)))


def as_given(capture: Capture) -> CaptureFit:
    """A fit that took the poses as they are."""
    body = default_template()
    assert capture.body is not None
    motion = captured_motion(capture.root, capture.body["train"], capture.splits["train"], body.joints)
    learned = new_fit(motion.clip, surface_of(body, RESOLUTION))
    candidate = TriedFit("the poses as given", learned, 0.9, (0.9, 0.9))
    return CaptureFit(body_fit(learned, 55), motion, candidate, (candidate,), 0)


def moved(capture: Capture, away: np.ndarray) -> Capture:
    """The capture with the poses of its new clip away from where they are."""
    assert capture.body is not None
    given = capture.body["pose"]
    return capture.replace(body={**capture.body, "pose": replace(given, trans=given.trans + away.astype(np.float32))})


def test_a_clip_that_stands_elsewhere_is_moved_to_its_silhouettes(capture: Capture) -> None:
    wrong, fit, body = moved(capture, AWAY), as_given(capture), default_template()
    found = placed_clip(wrong, DataConfig(root=capture.root), body, fit, lambda *_: None, EFFORT)
    assert found is not None
    assert found.iou_moved is not None
    assert found.iou_moved > found.iou + 0.02
    assert np.abs(found.shift.numpy() + AWAY).max() < 0.008, "mm that the drawn discs and the mesh differ by"
    assert "moved" in found.summary()
    clip, given = fitted_clips(wrong, body, fit, found)["pose"].clip, found.motion.clip
    torch.testing.assert_close(clip.trans - given.trans, found.shift.expand_as(given.trans), atol=1e-6, rtol=0)
    assert torch.equal(clip.poses, given.poses)


def test_without_another_clip_nothing_is_placed(capture: Capture, tmp_path: Path) -> None:
    alone = capture.replace(splits={**capture.splits, "pose": ()})
    assert placed_clip(alone, DataConfig(root=tmp_path), default_template(), as_given(capture), print) is None
