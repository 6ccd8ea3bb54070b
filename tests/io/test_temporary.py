"""Removal of temporary files of killed processes; all other files stay."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.write import remove_leftovers, temporary_beside, temporary_folder_beside, write_text

START = "import os, signal, sys; from pathlib import Path; folder = Path(sys.argv[1]);"


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.skipif(os.name != "posix", reason="kills")
def test_the_next_process_that_writes_there_cleans_up(tmp_path: Path) -> None:
    code = (
        "from dyngs.io.write import temporary_beside, temporary_folder_beside; "
        "temporary_beside(folder / 'a.png').touch(); (temporary_folder_beside(folder / 'run') / "
        "'inner').mkdir(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", f"{START} {code}", str(tmp_path)], check=False)
    assert done.returncode == -signal.SIGKILL
    left = _names(tmp_path)
    assert len(left) == 2
    assert all(name.startswith(".") and ".dyngs" in name for name in left)
    write_text(tmp_path / "b.txt", "b")
    assert _names(tmp_path) == {"b.txt"}


def test_files_of_running_processes_and_other_files_stay(tmp_path: Path) -> None:
    mine = temporary_beside(tmp_path / "mine.json")
    dead = mine.name.replace(str(os.getpid()), "999999999")
    elsewhere = dead[: dead.index("-") + 1] + "000000.dyngs.json"
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").touch()
    folder = tmp_path / "folder"
    folder.mkdir()
    kept = {
        mine.name,
        elsewhere,
        ".notes.123.txt",
        ".step_0000010.123.safetensors",
        "a.1-abcdef.dyngs.png",
    }
    for name in kept:
        (folder / name).touch()
    link = dead.replace("mine", "link")
    (folder / link).symlink_to(outside)
    (folder / dead).touch()
    remove_leftovers(folder)
    assert _names(folder) == {*kept, link}
    assert (outside / "precious").exists()
    remove_leftovers(folder, {"mine.json"}.__contains__)
    assert _names(folder) == {*kept, link} - {mine.name, elsewhere}


def test_nobody_can_plant_a_link_at_a_temporary_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither at that of an earlier file of the same process, nor at one that is guessed."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    for make in (temporary_beside, temporary_folder_beside):
        first = make(tmp_path / "run.json")
        first.unlink() if first.is_file() else first.rmdir()
        first.symlink_to(precious)
        assert make(tmp_path / "run.json") != first
        guessed = first.name.split("-")[2].partition(".")[0]
        monkeypatch.setattr("secrets.token_hex", lambda size, guessed=guessed: guessed)
        with pytest.raises((FileExistsError, DyngsError)):
            make(tmp_path / "run.json")
        with pytest.raises(DyngsError, match=r"cannot write .*run.json: File exists"):
            write_text(tmp_path / "run.json", "theirs")
        monkeypatch.undo()
    assert precious.read_text() == "mine"
