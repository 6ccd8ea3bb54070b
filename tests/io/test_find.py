"""Files by the names that other programs wrote."""

from __future__ import annotations

import unicodedata
from contextlib import suppress
from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.containment import check_inside, restrict_paths_to
from dyngs.io.find import FileFinder, downscaled_image_folders, images_folder

FORMS = {form: unicodedata.normalize(form, "Gärten/é 1.png") for form in ("NFC", "NFD")}


def touched(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


@pytest.mark.parametrize(
    "written",
    [
        "images/cam1/a b.jpg",
        "./images/cam1/a b.jpg",
        "images\\cam1\\a b.jpg",
        ".\\images\\cam1/a b.jpg",
        "Images/CAM1/a b.JPG",
        "C:\\scans\\house\\images\\cam1\\a b.jpg",
        "D:/images/cam1/a b.jpg",
        "\\\\server\\share\\images\\cam1\\a b.jpg",
        "/scans/images/cam1/a b.jpg",
        "images/other/../cam1/a b.jpg",
    ],
)
def test_file_that_is_meant(tmp_path: Path, written: str) -> None:
    image = touched(tmp_path / "images/cam1/a b.jpg")
    touched(tmp_path / "images/cam2/a b.jpg")
    assert FileFinder(tmp_path).find(written) == image


def test_longest_end_of_an_absolute_path_counts(tmp_path: Path) -> None:
    touched(tmp_path / "a.png")
    image = touched(tmp_path / "right/a.png")
    assert FileFinder(tmp_path).find("C:\\left\\right\\a.png") == image
    assert FileFinder(tmp_path).find("C:\\left\\a.png") == tmp_path / "a.png"
    assert not FileFinder(tmp_path).find("left\\a.png").exists()  # a relative path names its folder


@pytest.mark.parametrize("form", FORMS)
def test_unicode_forms(tmp_path: Path, form: str) -> None:
    image = touched(tmp_path / FORMS[form])
    assert [FileFinder(tmp_path).find(name) for name in FORMS.values()] == [image, image]


def test_names_that_differ_by_case_alone_are_not_mixed_up(tmp_path: Path) -> None:
    first = touched(tmp_path / "a.png")
    second = touched(tmp_path / "A.png")
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this file system ignores case")
    finder = FileFinder(tmp_path)
    assert [finder.find("a.png"), finder.find("A.png")] == [first, second]
    assert finder.find("a.PNG") == tmp_path / "a.PNG"  # one of two: neither is taken


@pytest.mark.parametrize(
    "written", ["C:\\x\\..\\..\\secret.txt", "..\\secret.txt", "Link/secret.txt", "../secret.TXT"]
)
def test_nothing_outside_is_found(tmp_path: Path, written: str) -> None:
    secret = touched(tmp_path / "secret.txt")
    root = tmp_path / "capture"
    root.mkdir()
    (root / "link").symlink_to(tmp_path)
    with restrict_paths_to(root), suppress(DyngsError):
        assert check_inside(FileFinder(root).find(written)).resolve() != secret


def test_images_of_another_size(tmp_path: Path) -> None:
    assert images_folder(tmp_path) == tmp_path / "images"
    for name in ("images_8", "images_2", "images_old", "other_3"):
        (tmp_path / name).mkdir()
    touched(tmp_path / "images_5")
    assert downscaled_image_folders(tmp_path / "images") == {
        2: tmp_path / "images_2",
        8: tmp_path / "images_8",
    }
    assert images_folder(tmp_path) == tmp_path / "images_2"
    small = touched(tmp_path / "images_2/1.png")
    assert FileFinder(tmp_path).find("images/1.png") == small
    (tmp_path / "images").mkdir()
    assert images_folder(tmp_path) == tmp_path / "images"
    assert FileFinder(tmp_path).find("images/1.png") == tmp_path / "images/1.png"
