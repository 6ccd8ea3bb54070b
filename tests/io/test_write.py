"""Files appear whole or not at all; images keep their values."""

from __future__ import annotations

import io
import os
import shutil
import stat
import sys
import tempfile
from contextlib import redirect_stderr
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from splat_scenes import cloud

from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.data.images.images import read_image
from dyngs.export.video import video_writer
from dyngs.io.formats.formats import write_splats
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.outputs import Inputs
from dyngs.io.write import atomic_file, require_replaceable, to_uint8, write_image, write_text


def test_png_keeps_straight_alpha_exactly(tmp_path: Path) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (5, 7, 4), dtype=np.uint8)
    write_image(tmp_path / "new" / "a.png", rgba)
    assert np.array_equal(read_image(tmp_path / "new" / "a.png").numpy(), rgba)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a.png"]


def test_exr_keeps_floats_beyond_one(tmp_path: Path) -> None:
    depth = np.array([[0.0, 1.5], [1e4, -2.0]], np.float32)
    write_image(tmp_path / "d.exr", depth)
    assert np.array_equal(
        np.asarray(oiio.ImageBuf(str(tmp_path / "d.exr")).get_pixels(oiio.FLOAT))[..., 0], depth
    )


def test_to_uint8_rounds_clamps_and_drops_nan() -> None:
    assert to_uint8(np.array([-1.0, 0.5, 2.0, np.nan, np.inf])).tolist() == [0, 128, 255, 0, 255]


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


def test_full_disk_is_one_line(tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(DyngsError, match="No space left"), atomic_file(tmp_path / "a.txt"):
        full.write_text("x")


def _video(path: Path) -> None:
    with video_writer(path, 10.0) as add:
        add(np.zeros((16, 16, 3), np.uint8))


def _by_command(path: Path) -> None:
    """A .ply as a user converts it; the error becomes an exit code and a line."""
    source = Path(tempfile.mkdtemp()) / "source.ply"
    write_splats(source, SplatFile(cloud(20)))
    printed = io.StringIO()
    with redirect_stderr(printed):
        assert main(["convert", str(source), str(path)]) == 2
    shutil.rmtree(source.parent)
    raise DyngsError(printed.getvalue().removeprefix("dyngs: error: "))


WAYS = {
    "text": lambda path: write_text(path, "x"),
    "image": lambda path: write_image(path, np.zeros((2, 2, 3))),
    "video": _video,
    "check": lambda path: Inputs([]).require_output(path),
    "command": _by_command,
}
"""Whatever writes to a path."""


@pytest.mark.skipif(sys.platform == "win32", reason="pipes have no names in folders there")
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", ["pipe", "link to a pipe", "device", "link to a device"])
def test_devices_and_pipes_are_refused_and_stay(kind: str, way: str, tmp_path: Path) -> None:
    path = tmp_path / ("out.mp4" if way == "video" else "out.ply")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link to a pipe":
        os.mkfifo(tmp_path / "pipe")
        path.symlink_to(tmp_path / "pipe")
    elif kind == "link to a device":
        path.symlink_to("/dev/null")
    elif os.getuid():
        path = Path("/dev/null")
    else:  # whom nothing keeps from replacing /dev/null
        try:
            os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        except OSError:
            pytest.skip("devices cannot be made here")
    before = path.lstat()
    with pytest.raises(DyngsError, match=r"cannot write .*: not a regular file; give a file name"):
        WAYS[way](path)
    after = path.lstat()
    assert (after.st_ino, after.st_mode) == (before.st_ino, before.st_mode)
    assert not [entry for entry in tmp_path.iterdir() if ".dyngs" in entry.name]


@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/dev/new.txt", "/proc/self/fd/1"])
def test_stdout_is_no_file_even_where_it_is_redirected_to_one(name: str) -> None:
    """The link in /dev would be replaced; the check writes nothing."""
    if not Path("/proc/self").exists():
        pytest.skip("not Linux")
    with pytest.raises(DyngsError, match=f"cannot write {name}: not a regular file"):
        require_replaceable(Path(name))


WRITERS = (
    "train static data.root=STILL run.dir=run run.threads=1 train.steps=3 init.kind=random "
    "init.num_random=60",
    "render run --out images --depth",
    "export run --format ply --out files/a.ply",
    "export run --format html --out files/a.html",
    "export run --format dyngs --out stored",
    "edit run --out edited --up -y",
    "train human data.root=PERSON run.dir=person run.threads=1 train.steps=2 model.resolution=24 "
    "model.fit=false",
    "export person --format avatar --out files/person.safetensors",
)
"""Commands that write files."""


@pytest.mark.parametrize("umask", [0o002, 0o077], ids=["shared", "private"])
def test_files_and_folders_have_what_the_umask_allows(
    umask: int, still: Path, person: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    captures = {"STILL": str(still), "PERSON": str(person)}
    before = os.umask(umask)
    try:
        for words in WRITERS:
            for name, folder in captures.items():
                words = words.replace(name, folder)
            assert main(words.split()) == 0, words
    finally:
        os.umask(before)
    found = {
        str(path.relative_to(work)): (path.is_dir(), stat.S_IMODE(path.stat().st_mode))
        for path in work.rglob("*")
    }
    assert len(found) > 20
    wrong = {
        name: oct(mode)
        for name, (is_dir, mode) in found.items()
        if mode != (0o777 if is_dir else 0o666) & ~umask
    }
    assert wrong == {}
