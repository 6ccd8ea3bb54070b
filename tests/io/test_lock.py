"""One writer at a time in a run folder, by real processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io import outputs
from dyngs.io.outputs import LOCK_NAME, InUseError, atomic_folder, lock_folder, make_once

pytestmark = pytest.mark.usefixtures("one_thread")
HOLD = "import sys, time; from pathlib import Path; from dyngs.io.outputs import lock_folder\n"
HOLD += "with lock_folder(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"


@contextmanager
def _holder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has the lock of ``folder``."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


def test_the_second_is_told_who_holds_it(tmp_path: Path) -> None:
    with (
        _holder(tmp_path / "run") as process,
        pytest.raises(InUseError) as caught,
        lock_folder(tmp_path / "run"),
    ):
        raise AssertionError("both have it")
    told = str(caught.value)
    assert f"process {process.pid} on " in told
    assert "wait" in told
    assert "\n" not in told


def test_a_killed_owner_frees_it(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with _holder(run) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert json.loads((run / LOCK_NAME).read_text())["pid"] == process.pid
        with lock_folder(run) as alone:
            assert alone
            assert json.loads((run / LOCK_NAME).read_text())["pid"] == os.getpid()
    assert not run.exists() or not list(run.iterdir())


def test_of_many_that_want_it_at_once_one_has_it(tmp_path: Path) -> None:
    """Also while the lock file is removed and made anew all the time."""
    code = HOLD.partition("\n")[0] + (
        "\nfrom dyngs.core.errors import DyngsError\nfolder, count = Path(sys.argv[1]), 0\nwhile "
        "count < 30:\n    try:\n        with lock_folder(folder):\n            count += 1\n      "
        "      n = int((folder / 'n').read_text()); time.sleep(1e-4); (folder / "
        "'n').write_text(str(n + 1))\n    except DyngsError: time.sleep(1e-3)\n"
    )
    (tmp_path / "n").write_text("0")
    processes = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(3)]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert (tmp_path / "n").read_text() == "90"


@pytest.mark.skipif(os.name != "posix", reason="links")
@pytest.mark.parametrize(
    "name", ["checkpoints", "export", "log.jsonl", "tradeoff/training", "body"]
)
def test_nothing_is_written_through_links_of_a_run(name: str, tmp_path: Path) -> None:
    """The run of a stranger may hold links to files and folders of the user, which training would
    change."""
    run = tmp_path / "run"
    (run / name).parent.mkdir(parents=True)
    (tmp_path / "precious").mkdir()
    (run / name).symlink_to(tmp_path / "precious")
    with (
        pytest.raises(DyngsError, match=rf"{name}: is a link to .*precious, outside .*run"),
        lock_folder(run),
    ):
        pytest.fail("it may be written to")
    assert list((tmp_path / "precious").iterdir()) == []
    (run / name).unlink()
    (run / "own").mkdir()
    (run / name).symlink_to(run / "own")
    with lock_folder(run):
        pass


# --- folders of the cache
# ---------------------------------------------------------------------------------------------


def _made_by(
    count: int, folder: Path, make: Callable[[], None]
) -> tuple[list[str], list[Exception]]:
    """Run ``make_once`` in ``count`` threads at once; return the messages and the errors."""
    said: list[str] = []
    errors: list[Exception] = []

    def work() -> None:
        try:
            make_once(folder, make, said.append, "found")
        except DyngsError as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
        assert not thread.is_alive()
    return said, errors


def _publish(folder: Path, content: str) -> None:
    """Make the folder in one piece."""
    with atomic_folder(folder) as started:
        time.sleep(0.2)
        (started / "x.txt").write_text(content)


@pytest.fixture
def short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "_WAIT", 0.02)


@pytest.mark.usefixtures("short_wait")
def test_of_three_one_makes_the_folder_and_the_others_use_it(tmp_path: Path) -> None:
    folder = tmp_path / "cache" / "a"
    calls = list[int]()

    def make() -> None:
        calls.append(1)
        _publish(folder, "whole")

    said, errors = _made_by(3, folder, make)
    assert errors == []
    assert calls == [1]
    assert [line for line in said if line == "found"] == ["found", "found"]
    waits = [line for line in said if line != "found"]
    assert len(waits) == 2
    assert all(f"process {os.getpid()} on " in line and str(folder) in line for line in waits)
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["a"]
    assert (folder / "x.txt").read_text() == "whole"
