"""Photos as people have them: of many formats, with equal stems, truncated."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from dyngs.capture.sfm.estimate import estimate_poses
from dyngs.capture.sfm.photos import gather_photos, prepare_colmap_images
from dyngs.core.errors import DyngsError
from dyngs.data.images.images import read_header, read_image

COLOURS = np.kron(np.random.default_rng(0).integers(0, 256, (3, 4, 3)), np.ones((8, 8, 1))).astype(
    np.uint8
)


def _save(path: Path, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(COLOURS).save(path, **options)  # type: ignore[arg-type]
    return path


def _save_heic(path: Path, orientation: int = 1) -> Path:
    heif = pytest.importorskip("pillow_heif")
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Phone", orientation
    exif.get_ifd(0x8769).update({0x829A: IFDRational(1, 50), 0xA405: 26})
    path.parent.mkdir(parents=True, exist_ok=True)
    heif.from_pillow(Image.fromarray(COLOURS)).save(path, quality=95, exif=exif.tobytes())
    return path


def _gather(tmp_path: Path) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return {source: stored name} of all photos, and the notes on skipped files."""
    photos, notes = gather_photos(tmp_path / "photos", tmp_path / "images", tmp_path / "out")
    return {photo.source: photo.name for photo in photos}, notes


def test_every_suffix_is_taken_or_said_to_be_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    for name in ("a.jpg", "b.JPEG", "c.png", "d.tif", "e.bmp", "f.webp", "g.gif"):
        _save(folder / name)
    for name in ("h.dng", "i.dng", "notes.txt", ".hidden", "README"):
        (folder / name).write_text("no photo")
    names, notes = _gather(tmp_path)
    assert names == {x: x for x in ("a.jpg", "b.JPEG", "c.png", "d.tif", "e.bmp", "f.webp")} | {
        "g.gif": "g.png"
    }
    assert notes[0].startswith("4 files skipped, not photos (.bmp, ")
    assert read_image(tmp_path / "images" / "g.png").shape == (24, 32, 3), (
        "an opaque GIF has no alpha"
    )


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_heic_becomes_png_with_its_tags(tmp_path: Path, orientation: int) -> None:
    """Apply the rotation of a HEIC file once: libheif applies it, and the EXIF tag repeats it."""
    _save_heic(tmp_path / "photos" / "a.HEIC", orientation)
    names, notes = _gather(tmp_path)
    assert (names, notes) == ({"a.HEIC": "a.png"}, [])
    header = read_header(tmp_path / "images" / "a.png")
    assert (header.camera, header.orientation) == ("Phone", 1)
    assert header.exposure == pytest.approx(0.02)
    assert header.focal_px == pytest.approx(26 / 43.2666 * np.hypot(24, 32), rel=1e-4)
    stored = read_image(tmp_path / "images" / "a.png").numpy().astype(int)
    heif = pytest.importorskip("pillow_heif")
    shown = np.asarray(heif.HeifImageFile(tmp_path / "photos" / "a.HEIC").convert("RGB"))
    assert np.array_equal(stored, shown)


@pytest.mark.parametrize(
    ("content", "name"),
    [("jpeg", "a.png"), ("png", "a.jpg"), ("webp", "a.jpg"), ("webp", "a.png"), ("jpeg", "a.heic")],
)
def test_photos_are_read_by_content_whatever_their_name(
    tmp_path: Path, content: str, name: str
) -> None:
    options = {"jpeg": {"quality": 98, "subsampling": 0}, "webp": {"lossless": True}}
    _save(tmp_path / "photos" / name, format=content, **options.get(content, {}))
    photos, _ = gather_photos(tmp_path / "photos", tmp_path / "images", tmp_path / "out")
    tolerance = 6 if content == "jpeg" else 0
    stored = read_image(tmp_path / "images" / photos[0].name).numpy().astype(int)
    assert np.abs(stored - COLOURS).max() <= tolerance
    (tmp_path / "work").mkdir()
    (laid,) = prepare_colmap_images(photos, tmp_path / "images", tmp_path / "work" / "images", {})
    with Image.open(tmp_path / "work" / "images" / laid) as image:
        assert image.format is not None
        assert image.format.lower() in ("jpeg", "png")
        assert Path(laid).suffix == {"JPEG": ".jpg", "PNG": ".png"}[image.format], (
            "as programs that trust names read it"
        )
        assert np.abs(np.asarray(image).astype(int) - COLOURS).max() <= tolerance


def test_heic_without_its_package_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _save(tmp_path / "photos" / "a.jpg")
    (tmp_path / "photos" / "b.heic").write_bytes(b"photo")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(
        DyngsError, match=r"1 HEIC photos?, first b\.heic.*pip install 'dyngs\[heic\]'"
    ):
        _gather(tmp_path)


def test_photos_that_differ_in_the_suffix_get_names_that_do_not(tmp_path: Path) -> None:
    """Views are named without the suffix, and a capture with one name for two images is refused;
    names that differ in upper and lower case are one name to Windows and macOS."""
    for name in ("a.TIF", "a.png", "a.jpg", "a.gif", "sub/a.png", "a.png.bmp", "B.gif", "b.png"):
        _save(tmp_path / "photos" / name)
    names, _ = _gather(tmp_path)
    assert names == {
        "a.TIF": "a.TIF",
        "B.gif": "B.gif.png",
        "a.gif": "a.gif.png",
        "a.jpg": "a.jpg.jpg",
        "a.png": "a.png.png",
        "a.png.bmp": "a.png.bmp.bmp",
        "b.png": "b.png",
        "sub/a.png": "sub/a.png",
    }
    assert len({Path(name).with_suffix("") for name in names.values()}) == len(names)
    assert sorted(
        p.relative_to(tmp_path / "images").as_posix() for p in (tmp_path / "images").rglob("*.*")
    ) == sorted(names.values())


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".bmp", ".webp", ".gif"])
def test_a_truncated_photo_is_refused_at_once(tmp_path: Path, suffix: str) -> None:
    for name in ("a.jpg", "b.jpg"):
        _save(tmp_path / "photos" / name)
    path = _save(tmp_path / "photos" / f"c{suffix}")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DyngsError, match=rf"c\{suffix}: "):
        estimate_poses(tmp_path / "photos", tmp_path / "capture")
    assert not (tmp_path / "capture").exists()
