"""Files appear whole or not at all; images keep their values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from dyngs.data.images.images import read_image
from dyngs.errors import DyngsError
from dyngs.files.write import atomic_file, to_uint8, write_image, write_text


def test_png_keeps_straight_alpha_exactly(tmp_path: Path) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    write_image(tmp_path / "new" / "a.png", rgba)
    assert np.array_equal(read_image(tmp_path / "new" / "a.png").numpy(), rgba)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]


def test_exr_keeps_floats_beyond_one(tmp_path: Path) -> None:
    depth = np.array([[0.0, 1.5], [1e4, -2.0]], np.float32)
    write_image(tmp_path / "d.exr", depth)
    assert np.array_equal(np.asarray(oiio.ImageBuf(str(tmp_path / "d.exr")).get_pixels(oiio.FLOAT))[..., 0], depth)


def test_to_uint8_rounds_clamps_and_drops_nan() -> None:
    assert to_uint8(np.array([-1.0, 0.5, 2.0, np.nan, np.inf])).tolist() == [0, 128, 255, 0, 255]


def test_unknown_suffix_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"a\.nope.*\.png"):
        write_image(tmp_path / "a.nope", np.zeros((2, 2, 3)))
    assert not list(tmp_path.iterdir())


def test_failure_leaves_the_former_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(RuntimeError):
        _write_half(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def _write_half(path: Path) -> None:
    with atomic_file(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DyngsError, match="cannot write"):
        write_text(tmp_path / "file" / "below.txt", "x")


def test_full_disk_is_one_line(tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(DyngsError, match="No space left"), atomic_file(tmp_path / "a.txt"):
        full.write_text("x")


def test_whole_numbers_of_16_bits_stay_as_they_are(tmp_path: Path) -> None:
    values = np.array([[0, 1, 255], [256, 40000, 65535]], dtype=np.uint16)
    write_image(tmp_path / "a.png", values)
    assert np.array_equal(oiio.ImageBuf(str(tmp_path / "a.png")).get_pixels(oiio.UINT16)[..., 0], values)
