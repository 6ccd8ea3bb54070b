"""No output replaces an input under any name, and folders appear complete or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.outputs import Inputs, atomic_folder, require_new_folder


def filled(root: Path) -> Path:
    """A capture with two images, one of them behind a link to a folder elsewhere."""
    for path in (root / "images" / "1.jpg", root.parent / "photos" / "2.jpg", root / "points.ply"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(path.name)
    (root / "more").symlink_to(root.parent / "photos")
    return root


def test_folders_around_and_within_a_capture(tmp_path: Path) -> None:
    root = filled(tmp_path / "scans" / "capture")
    inputs = Inputs([root])
    (tmp_path / "link").symlink_to(root)
    (root / "empty").mkdir()
    for out, reason in (
        (root, "exists, which is an input"),
        (tmp_path / "link", "exists, which is an input"),
        (root / "images" / "..", "exists, which is an input"),
        (root / "images", "exists in .*, which is an input"),
        (root / "more", "exists, which is an input"),
        (root.parent / "photos" / "2.jpg", "exists in .*photos, which is an input"),
        (tmp_path / "link" / "points.ply", "exists in .*, which is an input"),
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


def stopped(out: Path, error: type[BaseException]) -> None:
    with atomic_folder(out) as started:
        (started / "1.jpg").write_text("half")
        raise error


def test_a_new_folder_appears_complete_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    for error in (ValueError, KeyboardInterrupt):
        with pytest.raises(error):
            stopped(out, error)
        assert list(tmp_path.iterdir()) == []
    with atomic_folder(out) as started:
        (started / "1.jpg").write_text("full")
        assert not out.exists()
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]
    assert (out / "1.jpg").read_text() == "full"
    for taken in (out, out / "1.jpg"):
        with pytest.raises(DyngsError, match="exists already; choose a new folder"):
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
            with pytest.raises(
                DyngsError, match=r"is a link to .*precious.*, outside the run folder"
            ):
                Inputs(()).require_output(out)
    (run / "splats.ply").symlink_to(tmp_path / "precious.ply")
    Inputs(()).require_output(run / "splats.ply")  # an atomic file replaces the link itself
