"""Requirements are parsed without running anything, and the choice is the best of what meets
them."""

from __future__ import annotations

import pytest

from dyngs.core.errors import DyngsError
from dyngs.study.sweep import Requirement, Row, choose, parse_goal, parse_requirements


def row(prune: float, psnr: float, fps: float, mb: float) -> Row:
    name = f"prune={prune}"
    return {"name": name, "psnr": psnr, "fps": fps, "mb": mb, "lpips": None}


ROWS = [row(0.0, 32.0, 5.0, 9.0), row(0.5, 30.5, 18.0, 4.5), row(0.8, 27.0, 40.0, 2.0)]


def test_conditions() -> None:
    assert parse_requirements("psnr>=30, fps >= 2e1,mb<=5") == (
        Requirement("psnr", False, 30.0),
        Requirement("fps", False, 20.0),
        Requirement("mb", True, 5.0),
    )


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
    assert parse_goal("mb", smallest=True).at_most
    with pytest.raises(DyngsError, match="--maximize size: no such metric"):
        parse_goal("size", smallest=False)


def test_the_best_of_what_qualifies() -> None:
    asked = parse_requirements("psnr>=30")
    assert choose(ROWS, asked, Requirement("mb", True)) == 1
    assert choose(ROWS, asked, Requirement("psnr", False)) == 0
    assert choose(ROWS, (), Requirement("fps", False)) == 2


def test_the_binding_requirement_is_named() -> None:
    with pytest.raises(
        DyngsError, match=r"fps>=20 is too strict: with the others met the best is 18 \(prune=0.5\)"
    ) as caught:
        choose(ROWS, parse_requirements("psnr>=30,fps>=20,mb<=5"), Requirement("mb", True))
    assert "psnr>=30 is too strict: with the others met the best is 27 (prune=0.8)" in str(
        caught.value
    )
    assert "mb<=5 is too strict" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_a_single_binding_one_the_best_of_each_is_named() -> None:
    with pytest.raises(
        DyngsError, match="psnr>=50 alone: the best is 32; fps>=90 alone: the best is 40"
    ):
        choose(ROWS, parse_requirements("psnr>=50,fps>=90"), Requirement("psnr", False))


def test_what_is_not_known_does_not_qualify() -> None:
    with pytest.raises(DyngsError, match=r"lpips<=0\.5 alone: not measured here"):
        choose(ROWS, parse_requirements("lpips<=0.5"), Requirement("psnr", False))
