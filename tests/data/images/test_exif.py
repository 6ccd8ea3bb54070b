"""EXIF tags: all eight orientations, focal lengths, exposure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps
from PIL.TiffImagePlugin import IFDRational

from dyngs.capture.photos import gather_photos, lay_out
from dyngs.data.images.images import read_header, read_image

_RNG = np.random.default_rng(0)
UPRIGHT = _RNG.integers(0, 256, (6, 10, 3), dtype=np.uint8)


def _photo(path: Path, orientation: int, pixels: np.ndarray, tags: Mapping[int, object] | None = None) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    for key, value in (tags or {}).items():
        exif.get_ifd(0x8769)[key] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
def test_each_orientation_is_turned_as_pillow_turns_it(tmp_path: Path, orientation: int) -> None:
    path = _photo(tmp_path / "a.png", orientation, UPRIGHT)
    with Image.open(path) as image:
        shown = np.asarray(ImageOps.exif_transpose(image))
    assert np.array_equal(read_image(path, upright=True).numpy(), shown)
    header = read_header(path)
    assert header.upright_size == shown.shape[1::-1]
    assert np.array_equal(read_image(path).numpy(), UPRIGHT), "as stored"
    assert np.array_equal(read_image(path, (10, 6)).numpy(), UPRIGHT), "the camera has the stored shape"
    if header.upright_size != header.size:
        assert np.array_equal(read_image(path, header.upright_size).numpy(), shown)
        assert header.size_for((30, 50)) == header.upright_size, "of another size, too"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_upright_for_colmap_and_for_us(tmp_path: Path, orientation: int) -> None:
    """What COLMAP sees is what the loader gets for a camera of the size that COLMAP saw."""
    path = _photo(tmp_path / "photos" / "a b.png", orientation, UPRIGHT)
    shown = read_image(path, upright=True).numpy()
    photos, _ = gather_photos(tmp_path / "photos", tmp_path / "images", tmp_path / "out")
    (name,) = lay_out(photos, tmp_path / "images", tmp_path / "images", {})
    with Image.open(tmp_path / "images" / name) as image:
        seen = np.asarray(image)
    assert np.array_equal(seen, shown)
    size = (seen.shape[1], seen.shape[0])
    stored = tmp_path / "images" / photos[0].name
    assert read_header(stored).size_for(size) == size
    assert np.array_equal(read_image(stored, size).numpy(), shown)


def test_focal_length_and_exposure(tmp_path: Path) -> None:
    pixels = np.zeros((300, 400, 3), np.uint8)
    exposed = {0x829A: IFDRational(1, 100), 0x829D: IFDRational(2, 1), 0x8827: 400}
    tags = read_header(_photo(tmp_path / "a.jpg", 1, pixels, exposed | {0xA405: 35})).tags
    assert tags.focal_px == pytest.approx(35 / 43.2666 * 500, rel=1e-4), "by the diagonals"
    assert tags.exposure == pytest.approx(0.01 * 4 / 4)
    # 4 mm over 2,000 pixels an inch, of an image that was 800 px wide when it was taken
    sensor = {0x920A: IFDRational(4, 1), 0xA20E: IFDRational(25400, 10), 0xA210: 2, 0xA002: 800}
    assert read_header(_photo(tmp_path / "b.jpg", 1, pixels, sensor)).tags.focal_px == pytest.approx(4 * 100 / 2)
    absurd = {0xA405: 60000, 0x829A: IFDRational(0, 1)}
    tags = read_header(_photo(tmp_path / "c.jpg", 9, pixels, absurd)).tags
    assert (tags.focal_px, tags.exposure, tags.orientation) == (None, None, 1)
