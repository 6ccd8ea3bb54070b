"""What events say is so when it is asked for."""

from __future__ import annotations

import math

import pytest
from steps import report_of, step_done


def test_the_quality_of_a_step_is_that_of_its_image() -> None:
    assert report_of(1, 0.1).psnr == pytest.approx(20.0, abs=1e-4)
    assert report_of(1, 0.0).psnr == 100.0, "the most there is"
    assert math.isnan(report_of(1, math.nan).psnr)


def test_a_step_is_the_last_by_the_number_of_steps_that_is_known_now() -> None:
    event = step_done(7, 9)
    assert (event.step, event.total, event.is_last) == (7, 9, False)
    event.loop.expect(7)
    assert (event.total, event.is_last) == (7, True)


def test_a_step_tells_of_what_is_trained_now() -> None:
    event = step_done(7, 9)
    assert (event.num_gaussians, event.num_moving, event.bad_gradients) == (1234, 56, 0)
    event.loop.trainer = step_done(7, 9).loop.trainer
    event.loop.trainer.bad_gradients = 3
    assert event.bad_gradients == 3
    before = event.seconds
    event.loop.watch.pause(-100)
    assert 100 <= event.seconds - before < 160
