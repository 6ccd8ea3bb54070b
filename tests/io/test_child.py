"""Python processes of ours run no code of the current folder, and find what this process finds."""

from __future__ import annotations

import os
import site
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
    (folder / "dyngs" / "splats").mkdir(parents=True)
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


def test_dyngs_is_found_in_a_checkout_that_is_the_current_folder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(ROOT)
    done = run(python_command("dyngs.io.formats.usd_child", "missing.usdc", "out.npz"), ROOT)
    assert "FileNotFoundError" in done.stderr


def test_packages_of_the_parent_are_found_in_its_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PYTHONPATH comes first, packages of ``pip install --user`` and what their .pth files add are
    there."""
    chosen, user, added = (
        tmp_path / name for name in ("chosen", "user", "added with 'quotes' \udcff")
    )
    for folder in (chosen, user, added):
        folder.mkdir()
        (folder / "probe.py").write_text(f"print({folder.name[0]!r})\n")
    (added / "only_added.py").write_text("import probe, sys; print(sys.argv[1:])\n")
    (user / "editable.pth").write_text(f"import sys; sys.path.append({str(added)!a})\n")
    monkeypatch.setattr(site, "ENABLE_USER_SITE", True)
    monkeypatch.setattr(site, "getusersitepackages", lambda: str(user))
    assert (
        run(python_command("only_added", "a b", "\udcff"), tmp_path).stdout
        == f"u\n{['a b', chr(0xDCFF)]!r}\n"
    )
    monkeypatch.setattr(sys, "path", [str(chosen), *sys.path])
    assert run(python_command("probe"), tmp_path).stdout == "c\n"


def test_no_other_place_starts_python() -> None:
    starting = [
        x.relative_to(ROOT).as_posix()
        for x in (ROOT / "dyngs").rglob("*.py")
        if "sys.executable" in x.read_text()
    ]
    assert starting == ["dyngs/io/child.py"]
