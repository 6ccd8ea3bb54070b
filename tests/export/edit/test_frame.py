"""Parsing of coordinate frames and control points; each invalid word is refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.export.edit.frame import (
    control_point_frame,
    parse_direction,
    parse_number,
    parse_point,
    parse_scale,
)
from dyngs.io.formats.similarity import Similarity

SCENE = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0.5, 0.5, 1]])
WORLD = Similarity((0.6, 0.0, 0.8, 0.0), 20.0)


def table(path: Path, world: np.ndarray, scene: np.ndarray = SCENE, start: str = "") -> Path:
    rows = np.concatenate([scene, world], axis=1)
    path.write_text(start + "\n".join(",".join(repr(float(x)) for x in row) for row in rows) + "\n")
    return path


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: parse_point("1,2", "--origin"),
            "--origin: '1,2' is not a point; use three numbers",
        ),
        (lambda: parse_point("1,2,nan", "--origin"), "'1,2,nan' is not a point"),
        (lambda: parse_number("x", "--max-loss"), "--max-loss: 'x' is not a number"),
        (lambda: parse_direction("0,0,0"), "is not a direction"),
        (lambda: parse_direction("up"), "'up' is not a point"),
        (lambda: parse_scale("0,0,0 1,0,0"), "is not a number"),
        (lambda: parse_scale("nan"), "'nan' is not a number"),
        (lambda: parse_scale("0"), "is not a factor"),
        (lambda: parse_scale("-2"), "is not a factor"),
        (lambda: parse_scale("1e300"), "is not a factor"),
        (lambda: parse_scale("1,1,1 1,1,1 2m"), "is not a factor"),
    ],
)
def test_words_that_mean_nothing(call: Callable[[], object], said: str) -> None:
    with pytest.raises(DyngsError, match=said) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_control_points(tmp_path: Path) -> None:
    found = control_point_frame(
        table(tmp_path / "a.csv", WORLD.points(SCENE), start="x,y,z,X,Y,Z\n# measured in May\n\n")
    )
    np.testing.assert_allclose(found.similarity.points(SCENE), WORLD.points(SCENE), atol=1e-9)
    assert found.offset == (0.0, 0.0, 0.0)
    assert len(found.lines) == 1
    assert "4 control points: scale 20; residuals" in found.lines[0]
    bent = WORLD.points(SCENE) + np.array([[0.3, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    found = control_point_frame(table(tmp_path / "b.csv", bent)).similarity
    assert 0.01 < np.linalg.norm(found.points(SCENE) - bent, axis=1).max() < 0.3


def test_coordinates_too_large_for_float32_get_an_offset(tmp_path: Path) -> None:
    world = WORLD.points(SCENE) + np.array([691000.25, 5334000.5, 520])
    found = control_point_frame(table(tmp_path / "a.csv", world))
    np.testing.assert_allclose(found.similarity.points(SCENE) + found.offset, world, atol=1e-6)
    assert np.abs(found.similarity.points(SCENE)).max() < 100
    assert "to add to positions: 691002 5334018 507" in found.lines[1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "0 control points are too few"),
        ("0 0 0 1 1 1\n1 0 0 2 1 1\n", "2 control points"),
        ("0 0 0 1 1 1\n1 1 1 2 2 2\n2 2 2 3 3 3\n", "lie on one line in the scene"),
        ("0 0 0 1 1 1\n1 1 2\n", "'1 1 2': expected six numbers"),
        ("a b\n0 0 0 1 1 nan\n", "'0 0 0 1 1 nan': expected six numbers"),
        ("0 0 0 0 0 0\n1 0 0 1e12 0 0\n0 1 0 0 1e12 0\n", "the scale is implausible"),
    ],
)
def test_control_points_that_are_none(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(DyngsError, match=said) as caught:
        control_point_frame(tmp_path / "a.txt")
    assert str(caught.value).startswith(f"{tmp_path / 'a.txt'}: ")
    with pytest.raises(DyngsError, match="no such file"):
        control_point_frame(tmp_path / "b.txt")
