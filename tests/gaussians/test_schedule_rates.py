import pytest
from hypothesis import given
from hypothesis import strategies as st

from dyngs.gaussians.schedule import Rates


@given(st.integers(1, 1000), st.floats(0, 1))
def test_rates_fall_once_over_training(steps: int, fraction: float) -> None:
    rates, since = Rates(steps), int(fraction * (steps - 1))
    progress = [rates.progress(step, since) for step in range(steps + 20)]
    assert progress == sorted(progress)
    assert progress[: since + 1] == [0] * (since + 1)
    assert progress[steps:] == [1] * 20
    assert progress[steps - 1] < 1


def test_a_stage_goes_back_and_falls_again() -> None:
    rates = Rates(1000, 200, 0.5)
    assert rates.progress(1000) == 1
    assert rates.progress(1001) == pytest.approx(0.5 + 0.5 / 200)
    assert rates.progress(1100) == pytest.approx(0.75)
    assert rates.progress(1200) == rates.progress(5000) == 1
    assert rates.progress(1100, since=500) == pytest.approx(0.5), "rates that fall from step 500 on are half-way"
    assert rates.progress(1001, since=600) == 0, "they do not rise above their first value"


def test_a_rewind_of_one_stays_at_the_lowest() -> None:
    assert [Rates(10, 5).progress(step) for step in (10, 11, 15)] == [1, 1, 1]
