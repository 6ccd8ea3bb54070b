"""Colours of first points under the names and types that programs give to them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.data.readers.transforms import GREY, point_colours, read_points

COLOURS = np.array([[255, 0, 51], [0, 204, 102], [12, 34, 56]], np.uint8)
KINDS = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint", "i4": "int"}


def write_ply(path: Path, columns: dict[str, np.ndarray], byte_order: str | None) -> Path:
    """Three points with these columns of colours; ascii where ``byte_order`` is None."""
    every = {axis: np.arange(3, dtype=np.float32) for axis in "xyz"} | columns
    form = {"<": "binary_little_endian", ">": "binary_big_endian", None: "ascii"}[byte_order]
    header = ["ply", f"format {form} 1.0", "element vertex 3"]
    header += [f"property {KINDS[value.dtype.str[1:]]} {name}" for name, value in every.items()]
    head = "\n".join([*header, "end_header", ""]).encode()
    if byte_order is None:
        rows = zip(*every.values(), strict=True)
        body = "".join(
            " ".join(repr(number.item()) for number in row) + "\n" for row in rows
        ).encode()
    else:
        table = np.zeros(
            3, [(name, byte_order + value.dtype.str[1:]) for name, value in every.items()]
        )
        for name, value in every.items():
            table[name] = value
        body = table.tobytes()
    path.write_bytes(head + body)
    return path


def three(names: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip(names.split(), values.T, strict=True))


CASES = {
    "bytes": three("red green blue", COLOURS),
    "floats to 255": three("red green blue", COLOURS.astype(np.float32)),
    "doubles to 255": three("red green blue", COLOURS.astype(np.float64)),
    "floats to 1": three("red green blue", (COLOURS / 255).astype(np.float32)),
    "diffuse": three("diffuse_red diffuse_green diffuse_blue", COLOURS),
    "short names": three("r g b", COLOURS),
    "short names, floats to 1": three("r g b", (COLOURS / 255).astype(np.float32)),
    "capitals": three("Red Green Blue", COLOURS),
    "16 bits": three("red green blue", COLOURS.astype(np.uint16) * 257),
    "bytes in 16 bits": three("red green blue", COLOURS.astype(np.uint16)),
}


@pytest.mark.parametrize("byte_order", ["<", ">", None])
@pytest.mark.parametrize("case", CASES)
def test_colours_have_their_values(tmp_path: Path, case: str, byte_order: str | None) -> None:
    points = read_points(write_ply(tmp_path / "points.ply", CASES[case], byte_order))
    np.testing.assert_array_equal(points.rgb, COLOURS)
    np.testing.assert_array_equal(points.xyz[:, 1], [0, 1, 2])


@pytest.mark.parametrize(
    "columns", [{}, {"red": np.zeros(3, np.uint8)}, {"intensity": np.ones(3, np.float32)}]
)
def test_points_without_colours_are_grey(tmp_path: Path, columns: dict[str, np.ndarray]) -> None:
    points = read_points(write_ply(tmp_path / "points.ply", columns, "<"))
    assert (points.rgb == GREY).all()
    assert points.rgb.shape == (3, 3)


def test_odd_colours_are_bytes_nevertheless() -> None:
    wild = np.array([np.nan, -5, np.inf, 300], np.float32)
    found = point_colours({"red": wild, "green": wild, "blue": wild}, 4)
    assert found.dtype == np.uint8
    assert found[:2].tolist() == [[GREY] * 3, [0] * 3]
    # of another element
    assert (point_colours({"red": wild, "green": wild, "blue": wild}, 3) == GREY).all()
