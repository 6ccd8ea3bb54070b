"""No output replaces an input, by whatever name; folders that are made appear complete or not at
all."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.outputs import SOURCES_NAME, Inputs, new_folder, note_sources, require_new_folder


def filled(root: Path) -> Path:
    """A capture with two images, one of them behind a link to a folder elsewhere."""
    for path in (root / "images" / "1.jpg", root.parent / "photos" / "2.jpg", root / "points.ply"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(path.name)
    (root / "more").symlink_to(root.parent / "photos")
    return root


def spellings(path: Path, folder: Path) -> dict[str, Path]:
    """Names of one file: as it is, by a way around, below a link, and links to it in ``folder``."""
    folder.mkdir()
    (folder / "way").symlink_to(path.parent)
    (folder / "symbolic").symlink_to(path)
    os.link(path, folder / "hard")
    around = path.parent / ".." / path.parent.name / path.name
    relative = Path(os.path.relpath(path))
    below = folder / "way" / path.name
    links = {"symbolic link": folder / "symbolic", "hard link": folder / "hard"}
    return {"same": path, "around": around, "relative": relative, "below a link": below} | links


@pytest.mark.parametrize("as_folder", [True, False])
def test_a_file_that_is_read_is_no_output_by_any_name(tmp_path: Path, as_folder: bool) -> None:
    root = filled(tmp_path / "capture")
    for number, file in enumerate((root / "images" / "1.jpg", tmp_path / "photos" / "2.jpg")):
        inputs = Inputs([root if as_folder else file])
        for name, out in spellings(file, tmp_path / f"other{number}").items():
            with pytest.raises(DyngsError, match="is read") as caught:
                inputs.require_output(out)
            assert "\n" not in str(caught.value), name
        inputs.require_output(tmp_path / f"other{number}" / "new.jpg")


def test_folders_around_and_within_a_capture(tmp_path: Path) -> None:
    root = filled(tmp_path / "scans" / "capture")
    inputs = Inputs([root])
    (tmp_path / "link").symlink_to(root)
    (root / "empty").mkdir()
    for out, reason in (
        (root, "is the folder that is read"),
        (tmp_path / "link", "is the folder that is read"),
        (root / "images" / "..", "is the folder that is read"),
        (root / "images", "exists and lies in"),
        (root / "more", "exists and lies in"),
        (tmp_path / "link" / "points.ply", "exists and lies in"),
    ):
        with pytest.raises(DyngsError, match=reason):
            inputs.require_output(out)
    for out in (
        root / "renders",
        root / "images" / "3.jpg",
        root / "empty",
        tmp_path / "elsewhere",
        tmp_path,
        root.parent,
    ):
        inputs.require_output(out)


def test_a_folder_with_a_link_to_an_input(tmp_path: Path) -> None:
    root = filled(tmp_path / "capture")
    out = tmp_path / "out"
    out.mkdir()
    (out / "scene.ply").write_text("read as well")
    Inputs([root, out / "scene.ply"]).require_output(out)  # the file itself may lie there
    os.link(root / "images" / "1.jpg", out / "0000.jpg")
    with pytest.raises(DyngsError, match=r"holds 0000.jpg, a link to .*1\.jpg"):
        Inputs([root]).require_output(out)


def test_a_made_capture_stands_for_the_video_it_is_made_of(tmp_path: Path) -> None:
    root = filled(tmp_path / "capture")
    video = tmp_path / "walk.mp4"
    other = tmp_path / "copy.mp4"
    for path in (video, other):
        path.write_text("a video")
        Inputs([root]).require_output(path)
        note_sources(root, path)
        with pytest.raises(DyngsError, match="is the file that is read"):
            Inputs([root]).require_output(path)
    assert json.loads((root / SOURCES_NAME).read_text()) == {"sources": [str(video), str(other)]}
    for broken in ("{", "[]", '{"sources": 3}', '{"sources": [3, "a\\u0000b"]}', "[" * 100_000):
        (root / SOURCES_NAME).write_text(broken)
        Inputs([root]).require_output(video)


def stopped(out: Path, error: type[BaseException]) -> None:
    with new_folder(out) as started:
        (started / "1.jpg").write_text("half")
        raise error


def test_a_new_folder_appears_complete_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            stopped(out, error)
        assert list(tmp_path.iterdir()) == []
    with new_folder(out) as started:
        (started / "1.jpg").write_text("full")
        assert not out.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]
    assert (out / "1.jpg").read_text() == "full"
    for taken in (out, out / "1.jpg"):
        with pytest.raises(DyngsError, match="exists already; name a new folder"):
            require_new_folder(taken)


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_outputs_in_a_run_stay_there(tmp_path: Path) -> None:
    """A link of a stranger's run must not lead a sequence or a sweep elsewhere; that of the run
    itself may."""
    (tmp_path / "disk" / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "disk" / "run" / "config.yaml").touch()
    (tmp_path / "precious").mkdir()
    run = tmp_path / "run"
    run.symlink_to(tmp_path / "disk" / "run")
    for name in ("frames", "tradeoff/training/one"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        Inputs(()).require_output(run / name)
        (run / name).symlink_to(tmp_path / "precious")
        for out in (run / name, run / name / "frame_0000.ply", run / name / "new" / "a.png"):
            with pytest.raises(DyngsError, match=r"a link leads to .*precious.*, out of the run"):
                Inputs(()).require_output(out)
    (run / "splats.ply").symlink_to(tmp_path / "precious.ply")
    Inputs(()).require_output(run / "splats.ply")  # an atomic file replaces the link itself
