"""Captures in archives: unpacking, refused archives, and no files left elsewhere."""

from __future__ import annotations

import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import edit_json, random_pixels, write_frames, write_image

from dyngs.api.load import read_capture
from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.data.read import is_capture
from dyngs.io.archive import unpack_archive
from dyngs.io.write import cache_folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A nerfstudio capture of four images."""
    folder = tmp_path / "scene"
    names = [f"images/{i}.png" for i in range(4)]
    for i, name in enumerate(names):
        write_image(folder / name, random_pixels(8, 12, 3, seed=i))
    write_frames(folder / "transforms.json", names, {"w": 12, "h": 8, "fl_x": 10.0})
    return folder


def packed(path: Path, root: Path, top: str = "", more: dict[str, bytes] | None = None) -> Path:
    """An archive of the files below ``root``, under the folder ``top``, and of others."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for source in sorted(root.rglob("*")):
            file.write(source, top + source.relative_to(root).as_posix())
        for name, content in (more or {}).items():
            file.writestr(name, content)
    return path


def left() -> list[str]:
    """All that the cache of captures holds."""
    folder = cache_folder("captures")
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


@pytest.mark.parametrize("top", ["", "my scene/", "a/b/"])
def test_an_archive_is_read_as_its_folder(tmp_path: Path, root: Path, top: str) -> None:
    junk = {
        "__MACOSX/._x.png": b"x",
        "__MACOSX/scene/._transforms.json": b"{",
        ".DS_Store": b"",
        f"{top}._a.png": b"",
    }
    file = packed(tmp_path / "scene.zip", root, top, junk)
    views = read_capture(file).splits["train"]
    expected = read_capture(root).splits["train"]
    assert is_capture(file)
    assert [view.name for view in views] == [view.name for view in expected]
    for view, other in zip(views, expected, strict=True):
        np.testing.assert_array_equal(view.cam_from_world, other.cam_from_world)
        assert view.image_path.read_bytes() == other.image_path.read_bytes()
        assert cache_folder("captures") in view.image_path.parents
    assert not [path for path in cache_folder("captures").rglob("*") if path.name.startswith("._")]


def test_an_archive_is_unpacked_once_and_anew_after_a_change(tmp_path: Path, root: Path) -> None:
    file = packed(tmp_path / "scene.zip", root)
    folder = unpack_archive(file)
    before = (folder / "transforms.json").stat()
    assert unpack_archive(file) == folder
    assert (folder / "transforms.json").stat() == before
    edit_json(root / "transforms.json", lambda content: content["frames"].pop())
    assert unpack_archive(packed(file, root)) != folder
    assert len(read_capture(file).splits["train"]) == 3 - 1  # one for testing


BAD_NAMES = (
    "../evil.png",
    "a/../../evil.png",
    "/tmp/evil.png",
    "..\\evil.png",
    "C:\\evil.png",
    "images/aux.png",
)


@pytest.mark.parametrize("name", BAD_NAMES)
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, root: Path, name: str) -> None:
    file = packed(tmp_path / "scene.zip", root, more={name: b"evil"})
    with pytest.raises(DyngsError, match=r"scene\.zip: unsafe file name .* in the archive"):
        unpack_archive(file)
    assert left() == []
    assert not list(tmp_path.rglob("evil*"))


def test_links_are_refused(tmp_path: Path, root: Path) -> None:
    file = packed(tmp_path / "scene.zip", root)
    link = zipfile.ZipInfo("images/9.png")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(file, "a") as out:
        out.writestr(link, "/etc/passwd")
    with pytest.raises(DyngsError, match=r"'images/9\.png' is a link"):
        unpack_archive(file)


def test_bombs_are_refused_before_they_are_unpacked(tmp_path: Path) -> None:
    file = tmp_path / "bomb.zip"
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as out,
        out.open("zeros.png", "w") as member,
    ):
        for _ in range(160):
            member.write(bytes(2**20))
    with pytest.raises(DyngsError, match=r"167,772,160 bytes exceed the limit of 134,217,728.*=2$"):
        unpack_archive(file)
    assert left() == []


def encrypted(content: bytes) -> bytes:
    """Sets the flag in the local header and in the directory of an archive of one file."""
    at = content.rindex(b"PK\1\2")
    return content[:6] + b"\1" + content[7 : at + 8] + b"\1" + content[at + 9 :]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: b"", "cannot be read"),
        (lambda content: content[:-40], "cannot be read"),
        (
            lambda content: b"not a zip at all",
            "cannot be read .*not a zip file.*; download it again, or unpack it",
        ),
        (lambda content: content.replace(b"abcdefgh", b"abXdefgh"), "cannot be read .*CRC"),
        (encrypted, "'a.txt' is a link, encrypted"),
    ],
)
def test_damaged_archives_are_one_line(
    tmp_path: Path, change: object, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "scene.zip"
    with zipfile.ZipFile(file, "w") as out:
        out.writestr("a.txt", "abcdefgh")
    file.write_bytes(change(file.read_bytes()))  # type: ignore[operator]
    with pytest.raises(DyngsError, match=rf"scene\.zip: {message}"):
        read_capture(file)
    assert left() == []
    assert main(["data", "inspect", str(file)]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
