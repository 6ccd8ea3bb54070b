from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps
from tiny_captures import random_pixels, write_image

from dyngs.capture.sfm.photos import gather_photos, prepare_colmap_images
from dyngs.core.conventions import encode_srgb
from dyngs.core.errors import DyngsError
from dyngs.data.images.images import (
    area_downscale,
    check_image,
    premultiply,
    read_header,
    read_image,
    read_mask,
    read_raw,
    target_size,
    to_straight_uint8,
)


@pytest.mark.parametrize("channels", [3, 4])
def test_8_bit_png_comes_out_bit_for_bit(tmp_path: Path, channels: int) -> None:
    """Straight alpha, also where alpha is 0."""
    pixels = random_pixels(5, 7, channels)
    write_image(tmp_path / "a.png", pixels)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png").numpy(), pixels)


def test_exr_is_linear_and_clamped(tmp_path: Path) -> None:
    """0.18 linear is 117.8 in 8-bit sRGB; out of range and NaN become black or white."""
    values = [0.0, 0.18, 0.5, 1.0, 7.0, -1.0, np.nan, 0.002]
    pixels = np.repeat(np.array(values, np.float32)[None, :, None], 3, axis=2)
    write_image(tmp_path / "a.exr", pixels)
    assert read_image(tmp_path / "a.exr")[0, :, 0].tolist() == [0, 118, 188, 255, 255, 0, 0, 7]


@pytest.mark.parametrize("name", ["a.png", "a.jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.1, 0.5, 0.9])
def test_truncated_image_is_named_by_check_and_by_read(
    tmp_path: Path, name: str, kept: float
) -> None:
    path = tmp_path / name
    write_image(path, random_pixels(64, 64, 3))
    check_image(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    for refuse in (check_image, read_image):
        with pytest.raises(DyngsError) as caught:
            refuse(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def write_exr(
    path: Path,
    parts: Sequence[tuple[str, dict[str, float]]],
    window: tuple[int, int, int, int] = (0, 0, 4, 3),
) -> None:
    """An EXR of parts (name, channels with their value), data in ``window`` (x, y, width, height)
    of 4x3 pixels."""
    specs = []
    for name, channels in parts:
        spec = oiio.ImageSpec(window[2], window[3], len(channels), "half")
        spec.x, spec.y = window[:2]
        spec.full_width, spec.full_height = 4, 3
        spec.channelnames = list(channels)
        if name:
            spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs))
    for index, (spec, (_, channels)) in enumerate(zip(specs, parts, strict=True)):
        if index:
            assert output.open(str(path), spec, "AppendSubimage")
        values = np.array(list(channels.values()), np.float32)
        assert output.write_image(np.tile(values, (window[3], window[2], 1)))
    output.close()


RGB = {"R": 1.0, "G": 0.5, "B": 0.0}
SHOWN = [255, 188, 0]


@pytest.mark.parametrize("prefix", ["View Layer.Combined.", "Image.", "beauty.", ""])
def test_the_beauty_pass_of_several_layers_is_found_by_name(tmp_path: Path, prefix: str) -> None:
    path = tmp_path / "a.exr"
    others = {"A.R": 0.1, "A.G": 0.1, "A.B": 0.1, "N.X": 0.2, "N.Y": 0.2, "N.Z": 0.2, "Z": 3.0}
    own = {f"{prefix}{channel}": 0.5 * value for channel, value in {**RGB, "A": 1.0}.items()}
    write_exr(path, [("", {**others, **own})])
    assert read_image(path)[1, 1].tolist() == [*SHOWN, 128], (
        "colours are multiplied by the layer's own alpha"
    )


@pytest.mark.parametrize(
    ("window", "covered"),
    [
        ((1, 1, 2, 2), (slice(1, 3), slice(1, 3))),
        ((-2, -1, 9, 9), (slice(0, 3), slice(0, 4))),
        ((2, -3, 5, 5), (slice(0, 2), slice(2, 4))),
        ((9, 9, 2, 2), (slice(0, 0), slice(0, 0))),
    ],
)
def test_an_exr_is_read_in_its_display_window(
    tmp_path: Path, window: tuple[int, int, int, int], covered: tuple[slice, slice]
) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, [("", {**RGB, "A": 1.0})], window)
    expected = np.zeros((3, 4, 4), np.uint8)
    expected[covered] = [*SHOWN, 255]
    assert read_header(path).size == (4, 3)
    assert np.array_equal(read_image(path).numpy(), expected)
    assert np.array_equal(read_raw(path)[0][..., 3], expected[..., 3] / 255)


@pytest.mark.parametrize("is_associated", [True, False])
@pytest.mark.parametrize("kind", ["uint8", "uint16", "float"])
@pytest.mark.parametrize("names", [("R", "G", "B", "A"), ("Y", "A")])
def test_alpha_of_tiff_is_as_the_file_says(
    tmp_path: Path, is_associated: bool, kind: str, names: tuple[str, ...]
) -> None:
    """Orange that fades out; floats are linear."""
    alpha = np.linspace(0.25, 1, 16)[None, :, None].repeat(3, 0)
    colour = np.broadcast_to([0.8, 0.4, 0.2][: len(names) - 1], (3, 16, len(names) - 1))
    spec = oiio.ImageSpec(16, 3, len(names), kind)
    spec.channelnames = names
    spec.alpha_channel = len(names) - 1
    spec["oiio:UnassociatedAlpha"] = int(not is_associated)
    output = oiio.ImageOutput.create(str(tmp_path / "a.tif"))
    assert output.open(str(tmp_path / "a.tif"), spec)
    stored = np.dstack([colour * alpha if is_associated else colour, alpha])
    assert output.write_image(np.ascontiguousarray(stored, np.float32))
    output.close()
    image = read_image(tmp_path / "a.tif").numpy().astype(float)
    shown = 255 * (encode_srgb(colour) if kind == "float" else colour)
    assert np.abs(image[..., :3] - shown).max() <= (2.5 if kind == "uint8" else 0.6)
    assert np.abs(image[..., 3:] - 255 * alpha).max() <= 0.6


def test_mask_keeps_white(tmp_path: Path) -> None:
    write_image(tmp_path / "m.png", np.array([[[0], [127], [128], [255]]], np.uint8))
    assert read_mask(tmp_path / "m.png").tolist() == [[False, False, True, True]]


def test_area_filter_known_answer() -> None:
    """5 pixels to 2: each covers two and a half."""
    row = torch.tensor([1.0, 2, 3, 4, 10]).reshape(1, 5, 1)
    wanted = [(1 + 2 + 0.5 * 3) / 2.5, (0.5 * 3 + 4 + 10) / 2.5]
    torch.testing.assert_close(area_downscale(row, 2, 1)[0, :, 0], torch.tensor(wanted))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 40), st.data())
def test_area_filter_is_the_mean_over_the_covered_rectangle(
    height: int, width: int, data: st.DataObject
) -> None:
    """Against the integral image, in float64; so also the mean of the image is kept."""
    new_height = data.draw(st.integers(1, height))
    new_width = data.draw(st.integers(1, width))
    pixels = np.random.default_rng(height * 41 + width).random((height, width, 2))

    def axis_means(array: np.ndarray, size: int) -> np.ndarray:
        old = len(array)
        summed = np.concatenate([np.zeros_like(array[:1]), np.cumsum(array, axis=0)])
        edges = np.arange(size + 1) * old / size
        low = np.minimum(edges.astype(int), old - 1)
        at_edges = summed[low] + (edges - low)[:, None, None] * (summed[low + 1] - summed[low])
        return np.diff(at_edges, axis=0) * size / old

    wanted = axis_means(axis_means(pixels, new_height).swapaxes(0, 1), new_width).swapaxes(0, 1)
    found = area_downscale(torch.from_numpy(pixels), new_width, new_height).numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), pixels.mean(axis=(0, 1)), atol=1e-12)


def test_colour_of_transparent_pixels_does_not_bleed() -> None:
    """Opaque red beside invisible green shrinks to half-covered red."""
    pixels = torch.tensor([[[255, 0, 0, 255], [0, 255, 0, 0]]], dtype=torch.uint8)
    small = to_straight_uint8(area_downscale(premultiply(pixels), 1, 1))
    assert small[0, 0].tolist() == [255, 0, 0, 128]


@pytest.mark.parametrize(
    ("size", "downscale", "longest", "wanted"),
    [
        ((800, 600), 1, None, (800, 600)),
        ((800, 600), 2, None, (400, 300)),
        ((801, 600), 2, None, (401, 300)),
        ((800, 600), 1.5, None, (533, 400)),
        ((800, 600), 1, 200, (200, 150)),
        ((600, 800), 2, 1000, (300, 400)),
        ((800, 600), 2, 100, (100, 75)),
        ((800, 600), 1, 4000, (800, 600)),
        ((3, 2), 100, None, (1, 1)),
    ],
)
def test_target_size(
    size: tuple[int, int], downscale: float, longest: int | None, wanted: tuple[int, int]
) -> None:
    assert target_size(*size, downscale, longest) == wanted


# -------------------------------------------------------------------------------- damaged and huge


def write_empty_png(path: Path, side: int) -> None:
    """A real grey image, black throughout."""
    data = zlib.compress(bytes((1 + side // 8) * side), 6)
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)),
        (b"IDAT", data),
        (b"IEND", b""),
    ]
    chunks = [
        struct.pack(">I", len(d)) + kind + d + struct.pack(">I", zlib.crc32(kind + d))
        for kind, d in parts
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def test_a_small_file_with_a_huge_image_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    """It took 2.7 GB."""
    resource = pytest.importorskip("resource")
    path = tmp_path / "a.png"
    write_empty_png(path, 20_000)
    assert path.stat().st_size < 400_000
    assert read_header(path).width == 20_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in (read_image, read_mask, check_image):
        with pytest.raises(DyngsError, match=r"400,000,000 pixels exceed"):
            read(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


_RNG = np.random.default_rng(0)
UPRIGHT = _RNG.integers(0, 256, (6, 10, 3), dtype=np.uint8)


def _photo(
    path: Path, orientation: int, pixels: np.ndarray, tags: Mapping[int, object] | None = None
) -> Path:
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
    assert np.array_equal(read_image(path, (10, 6)).numpy(), UPRIGHT), (
        "the camera has the stored shape"
    )
    if header.upright_size != header.size:
        assert np.array_equal(read_image(path, header.upright_size).numpy(), shown)
        assert header.size_matching((30, 50)) == header.upright_size, "of another size, too"


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_upright_for_colmap_and_for_us(tmp_path: Path, orientation: int) -> None:
    """The loader and COLMAP read the same upright image."""
    path = _photo(tmp_path / "photos" / "a b.png", orientation, UPRIGHT)
    shown = read_image(path, upright=True).numpy()
    photos, _ = gather_photos(tmp_path / "photos", tmp_path / "images", tmp_path / "out")
    (name,) = prepare_colmap_images(photos, tmp_path / "images", tmp_path / "images", {})
    with Image.open(tmp_path / "images" / name) as image:
        seen = np.asarray(image)
    assert np.array_equal(seen, shown)
    size = (seen.shape[1], seen.shape[0])
    stored = tmp_path / "images" / photos[0].name
    assert read_header(stored).size_matching(size) == size
    assert np.array_equal(read_image(stored, size).numpy(), shown)
