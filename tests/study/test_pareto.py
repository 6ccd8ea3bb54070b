"""The front, exchange rates and what is put together: known answers and properties."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dyngs.study.measure import Measurement, Quartiles, Speed
from dyngs.study.sweep import combinations, exchange_rates, pareto_mask, slope, table_rows
from dyngs.study.variants import Variant

GOALS = st.lists(st.tuples(*[st.integers(0, 5)] * 3), min_size=1, max_size=12)


def measurement(variant: Variant, psnr: float, gain: float = 1.0, mb: float = 8.0) -> Measurement:
    speed = Speed(Quartiles(10 / gain, 9 / gain, 11 / gain), Quartiles(gain, gain, gain))
    return Measurement(
        name=variant.name, changes=variant.changes, num_views=4, psnr=psnr, ssim=0.9, lpips=None,
        psnr_foreground=None, psnr_moving=None, gaussians=100, mb=mb, memory_mb=None, steps=1,
        seconds=1.0, speed=speed,
    )  # fmt: skip


BASE = measurement(Variant(), 30.0)


@given(GOALS)
def test_every_point_is_on_the_front_or_beaten_by_one_that_is(goals: list[tuple[int, ...]]) -> None:
    best = pareto_mask(goals)
    front = [goal for goal, is_best in zip(goals, best, strict=True) if is_best]
    assert front
    for goal, is_best in zip(goals, best, strict=True):
        beaten = any(
            other != goal and all(x >= y for x, y in zip(other, goal, strict=True))
            for other in front
        )
        assert beaten != is_best


@given(GOALS)
def test_the_front_does_not_depend_on_the_order(goals: list[tuple[int, ...]]) -> None:
    found = dict(zip(goals, pareto_mask(goals), strict=True))
    backwards = goals[::-1]
    assert pareto_mask(backwards) == [found[goal] for goal in backwards]


def test_speed_size_and_quality_count() -> None:
    points = [
        BASE,
        measurement(Variant(prune=0.5), 29.0, 2.0, 4.0),
        measurement(Variant(scale=0.5), 28.0, 2.0, 8.0),
    ]
    assert [row["on_front"] for row in table_rows(points)] == [True, True, False]


@given(st.floats(-3, 3), st.lists(st.integers(1, 4), min_size=1, max_size=5))
def test_slope_of_points_on_a_line_is_that_line(per_doubling: float, doublings: list[int]) -> None:
    assert slope([(per_doubling * k, 2.0**k) for k in doublings]) == pytest.approx(
        per_doubling, abs=1e-9
    )


def test_no_gain_has_no_price() -> None:
    assert slope([(1.0, 1.01)]) is None
    assert slope([(1.0, 0.9), (2.0, 1.0)]) is None
    assert slope([(1.0, 4.0)]) == 0.5


def test_exchange_rates_are_those_of_single_settings() -> None:
    points = [
        BASE,
        measurement(Variant(prune=0.5), 29.0, 2.0, 4.0),
        measurement(Variant(prune=0.75), 28.0, 4.0, 2.0),
        measurement(Variant(storage="auto"), 30.0, 1.0, 1.0),
        measurement(Variant(storage="auto", prune=0.5), 20.0, 2.0, 0.5),
    ]
    prune, storage = exchange_rates(points)
    assert (prune.setting, prune.db_per_speed, prune.db_per_size) == (
        "prune",
        pytest.approx(1.0),
        pytest.approx(1.0),
    )
    assert (prune.speed, prune.size) == (4.0, 4.0)
    assert (storage.setting, storage.db_per_speed, storage.db_per_size) == (
        "storage",
        None,
        pytest.approx(0.0),
    )


def test_what_is_cheapest_is_put_together_first() -> None:
    singles = [
        measurement(Variant(prune=0.5), 29.0, 2.0, 4.0),
        measurement(Variant(prune=0.75), 26.0, 4.0, 2.0),
        measurement(Variant(storage="auto"), 29.9, 1.0, 1.0),
        measurement(Variant(alpha_min=0.01), 29.8, 1.5),
        measurement(Variant(scale=0.5), 20.0, 4.0),  # loses too much to be combined
    ]
    found = combinations(BASE, singles, 9)
    assert Variant(prune=0.5, alpha_min=0.01) in found
    assert Variant(prune=0.75, alpha_min=0.01) in found
    assert Variant(prune=0.5, storage="auto") in found
    assert found.index(Variant(prune=0.5, alpha_min=0.01)) < found.index(
        Variant(prune=0.75, alpha_min=0.01)
    )
    assert all(len(v.settings) > 1 and v.scale == 1 for v in found)
    assert len(set(found)) == len(found)
    assert combinations(BASE, singles, 0) == []


def test_a_weaker_value_never_replaces_a_stronger_one() -> None:
    singles = [
        measurement(Variant(prune=0.3), 28.0, 1.5),
        measurement(Variant(prune=0.6), 29.9, 2.0),
        measurement(Variant(alpha_min=0.01), 29.9, 1.5),
    ]
    assert all(v.prune != 0.3 for v in combinations(BASE, singles, 9))
