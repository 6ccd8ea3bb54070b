"""Python processes of ours run no code of the current folder, and find what this process finds."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import dyngs
from dyngs.io.child import python_command

ROOT = Path(dyngs.__file__).resolve().parents[1]
HOSTILE = (
    "numpy.py",
    "torch.py",
    "runpy.py",
    "site.py",
    "sitecustomize.py",
    "usercustomize.py",
    "usd_child.py",
)
HOSTILE += ("dyngs/__init__.py", "dyngs/io/formats/__init__.py", "dyngs/io/formats/usd_child.py")


def hostile(folder: Path) -> Path:
    """A folder of downloads in which everything that a Python process may import leaves a mark."""
    (folder / "dyngs" / "io" / "formats").mkdir(parents=True)
    for name in HOSTILE:
        (folder / name).write_text("import pathlib\npathlib.Path('ran').touch()\n")
    return folder


def run(command: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command,
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.mark.parametrize("place", ["", ".", "folder", "link"])
def test_nothing_of_the_current_folder_runs(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = hostile(tmp_path / "downloads")
    (tmp_path / "link").symlink_to(folder)
    monkeypatch.chdir(folder)
    first = {"folder": str(folder), "link": str(tmp_path / "link")}.get(place, place)
    monkeypatch.setattr(sys, "path", [first, *sys.path])
    done = run(
        python_command("dyngs.io.formats.usd_child", "missing.usdc", "out.npz"),
        folder,
        PYTHONPATH=first,
    )
    assert "FileNotFoundError" in done.stderr  # it has imported numpy and looked for its file
    assert "missing.usdc" in done.stderr
    assert not (folder / "ran").exists()


def test_no_other_place_starts_python() -> None:
    starting = [
        x.relative_to(ROOT).as_posix()
        for x in (ROOT / "dyngs").rglob("*.py")
        if "sys.executable" in x.read_text()
    ]
    assert starting == ["dyngs/io/child.py"]
