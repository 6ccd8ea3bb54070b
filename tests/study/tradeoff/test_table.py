"""Requirements are parsed without running anything, and the choice is the best of what meets
them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dyngs.core.errors import DyngsError
from dyngs.study.tradeoff.table import (
    Goal,
    Requirement,
    TableRow,
    choose,
    parse_goal,
    parse_requirements,
)
from dyngs.study.tradeoff.variants import Variant


def row(prune: float, psnr: float, fps: float, mb: float) -> TableRow:
    return TableRow(
        Variant(prune=prune), psnr, 0.9, None, fps, 1.0, 1.0, 1.0, 1e3 / fps, mb, 100.0, 1000, True
    )


ROWS = [row(0.0, 32.0, 5.0, 9.0), row(0.5, 30.5, 18.0, 4.5), row(0.8, 27.0, 40.0, 2.0)]


def test_conditions() -> None:
    assert parse_requirements("psnr>=30, fps >= 2e1,mb<=5") == (
        Requirement("psnr", False, 30.0),
        Requirement("fps", False, 20.0),
        Requirement("mb", True, 5.0),
    )


@given(
    st.sampled_from(["psnr", "mb", "memory_mb", "gaussians"]), st.booleans(), st.floats(-1e6, 1e6)
)
def test_what_is_printed_is_read_again(name: str, at_most: bool, bound: float) -> None:
    wanted = Requirement(name, at_most, float(f"{bound:g}"))
    assert parse_requirements(str(wanted)) == (wanted,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no condition; write for instance psnr>=30"),
        ("psnr>30", "is no condition"),
        ("psnr>=30,,mb<=5", "is no condition"),
        ("psnr=30", "is no condition"),
        ("speed>=3", "no such metric; there are psnr, ssim, lpips, fps"),
        ("variant>=3", "no such metric"),
        ("psnr>=thirty", "'thirty' is not a number"),
        ("psnr>=nan", "'nan' is not a number"),
        ("psnr>=__import__('os')", "is not a number"),
    ],
)
def test_what_is_no_condition_is_refused(text: str, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        parse_requirements(text)


def test_goals() -> None:
    assert parse_goal("mb", smallest=True) == Goal("mb", True)
    with pytest.raises(DyngsError, match="--maximize size: no such metric"):
        parse_goal("size", smallest=False)


def test_the_best_of_what_qualifies() -> None:
    asked = parse_requirements("psnr>=30")
    assert choose(ROWS, asked, Goal("mb", True)) == ROWS[1]
    assert choose(ROWS, asked, Goal("psnr", False)) == ROWS[0]
    assert choose(ROWS, (), Goal("fps", False)) == ROWS[2]


def test_the_binding_requirement_is_named() -> None:
    with pytest.raises(
        DyngsError, match=r"fps>=20 is too strict: with the others met the best is 18 \(prune=0.5\)"
    ) as caught:
        choose(ROWS, parse_requirements("psnr>=30,fps>=20,mb<=5"), Goal("mb", True))
    assert "psnr>=30 is too strict: with the others met the best is 27 (prune=0.8)" in str(
        caught.value
    )
    assert "mb<=5 is too strict" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_a_single_binding_one_the_best_of_each_is_named() -> None:
    with pytest.raises(
        DyngsError, match="psnr>=50 alone: the best is 32; fps>=90 alone: the best is 40"
    ):
        choose(ROWS, parse_requirements("psnr>=50,fps>=90"), Goal("psnr", False))


def test_what_is_not_known_does_not_qualify() -> None:
    with pytest.raises(DyngsError, match=r"lpips<=0\.5 alone: not measured here"):
        choose(ROWS, parse_requirements("lpips<=0.5"), Goal("psnr", False))


@given(st.floats(20, 40), st.floats(1, 60), st.floats(1, 10))
def test_a_choice_meets_everything_and_nothing_that_does_is_better(
    psnr: float, fps: float, mb: float
) -> None:
    asked = (
        Requirement("psnr", False, psnr),
        Requirement("fps", False, fps),
        Requirement("mb", True, mb),
    )
    fitting = [p for p in ROWS if p.psnr >= psnr and p.fps >= fps and p.mb <= mb]
    if fitting:
        assert choose(ROWS, asked, Goal("mb", True)).mb == min(p.mb for p in fitting)
    else:
        with pytest.raises(DyngsError, match="no measured variant has"):
            choose(ROWS, asked, Goal("mb", True))
