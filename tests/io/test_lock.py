"""One writer at a time in a run folder, by real processes."""

from __future__ import annotations

import errno
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

from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.evaluate.report import evaluate_run
from dyngs.io import lock as run_lock
from dyngs.io.lock import LOCK_NAME, InUseError, make_once, writing
from dyngs.io.outputs import new_folder
from dyngs.runs.checkpoint import checkpoint_paths, load_run

pytestmark = pytest.mark.usefixtures("one_thread")
HOLD = "import sys, time; from pathlib import Path; from dyngs.io.lock import writing\n"
HOLD += "with writing(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"


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


def _train(capture: Path, run_dir: Path, *words: str) -> list[str]:
    """Words of a command for a run that is not soon over."""
    keys = (
        f"data.root={capture}",
        f"run.dir={run_dir}",
        "run.threads=1",
        "train.steps=100000",
        "train.save_every=5",
    )
    more = ("init.kind=random", "init.num_random=50", "model.sh_degree=0", "train.log_every=5")
    return ["train", "static", *keys, *more, *words]


def test_the_second_is_told_who_holds_it(tmp_path: Path) -> None:
    with (
        _holder(tmp_path / "run") as process,
        pytest.raises(InUseError) as caught,
        writing(tmp_path / "run"),
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
        with writing(run) as held:
            assert held.alone
            assert json.loads((run / LOCK_NAME).read_text())["pid"] == os.getpid()
    assert not run.exists() or not list(run.iterdir())


def test_what_came_of_nothing_leaves_nothing(tmp_path: Path) -> None:
    with writing(tmp_path / "a" / "b"):
        assert (tmp_path / "a" / "b" / LOCK_NAME).is_file()
    assert not (tmp_path / "a").exists()
    with writing(tmp_path / "c"):
        (tmp_path / "c" / "mine").touch()
    assert [path.name for path in (tmp_path / "c").iterdir()] == ["mine"]


def test_one_process_cannot_have_it_twice(tmp_path: Path) -> None:
    with (
        writing(tmp_path),
        pytest.raises(InUseError, match=f"process {os.getpid()}"),
        writing(tmp_path),
    ):
        raise AssertionError


@pytest.mark.skipif(not hasattr(os, "O_NOFOLLOW"), reason="follows links")
def test_a_lock_file_that_is_none_is_told_and_left(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    for name, make in {
        "link": lambda path: path.symlink_to(precious),
        "folder": lambda path: path.mkdir(),
        "pipe": lambda path: os.mkfifo(path),
    }.items():
        (tmp_path / name).mkdir()
        make(tmp_path / name / LOCK_NAME)
        with pytest.raises(DyngsError, match=LOCK_NAME), writing(tmp_path / name):
            raise AssertionError
        assert os.path.lexists(tmp_path / name / LOCK_NAME)
    assert precious.read_text() == "mine"
    with pytest.raises(DyngsError, match="not a folder"), writing(precious):
        raise AssertionError


@pytest.mark.skipif(
    not Path("/proc/self/fd").exists(), reason="the system does not say where an open folder is"
)
def test_a_folder_that_is_renamed_is_found(tmp_path: Path) -> None:
    (tmp_path / "above").mkdir()
    with writing(tmp_path / "above" / "a") as held:
        (tmp_path / "above" / "a").rename(tmp_path / "above" / "b")
        assert held.folder() == tmp_path / "above" / "b"
        (tmp_path / "above").rename(tmp_path / "below")
        (tmp_path / "above" / "b").mkdir(parents=True)  # another one takes its place
        assert held.folder() == tmp_path / "below" / "b"
        with pytest.raises(InUseError), writing(tmp_path / "below" / "b"):
            raise AssertionError
    assert list((tmp_path / "below" / "b").iterdir()) == []  # the lock went with it
    with writing(tmp_path / "c") as held:
        (tmp_path / "c" / LOCK_NAME).unlink()
        assert held.folder() == tmp_path / "c"
        (tmp_path / "c").rmdir()
        assert held.folder() is None


def test_without_locks_a_line_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_locks(file: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(run_lock, "_lock", no_locks)
    with writing(tmp_path / "run") as held:
        assert not held.alone
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "no locks" in told


def test_of_many_that_want_it_at_once_one_has_it(tmp_path: Path) -> None:
    """Also while the lock file is removed and made anew all the time."""
    code = HOLD.partition("\n")[0] + (
        "\nfrom dyngs.core.errors import DyngsError\nfolder, count = Path(sys.argv[1]), 0\nwhile count < 30:\n"
        "    try:\n        with writing(folder):\n            count += 1\n"
        "            n = int((folder / 'n').read_text()); time.sleep(1e-4); (folder / 'n').write_text(str(n + 1))\n"
        "    except DyngsError: time.sleep(1e-3)\n"
    )
    (tmp_path / "n").write_text("0")
    processes = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(3)]
    assert [process.wait() for process in processes] == [0, 0, 0]
    assert (tmp_path / "n").read_text() == "90"


def test_two_trainings_into_one_folder(
    still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second ends at once with one line; readers may read; the first goes on, and can be
    resumed after a kill."""
    run = tmp_path / "run"
    words = [sys.executable, "-m", "dyngs", *_train(still, run)]
    first = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while not checkpoint_paths(run):
            assert first.poll() is None
            time.sleep(0.05)
        for second in (_train(still, run, "run.seed=1"), ["train", "--resume", str(run)]):
            assert main(second) == 2
            told = capsys.readouterr().err
            assert told.count("\n") == 1
            assert f"process {first.pid} on " in told
        for _ in range(5):
            assert load_run(run).step > 0
        assert evaluate_run(run).num_views == 1
        assert first.poll() is None
    finally:
        first.kill()
        first.wait()
    assert load_run(run).step % 5 == 0


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
        pytest.raises(DyngsError, match=rf"{name}: is a link to .*precious, out of .*run"),
        writing(run),
    ):
        pytest.fail("it may be written to")
    assert list((tmp_path / "precious").iterdir()) == []
    (run / name).unlink()
    (run / "own").mkdir()
    (run / name).symlink_to(run / "own")
    with writing(run):
        pass


# --- folders of the cache
# ---------------------------------------------------------------------------------------------


def _made_by(
    count: int, folder: Path, make: Callable[[], None]
) -> tuple[list[str], list[Exception]]:
    """Let so many threads make the folder at once; return what they said, and the errors."""
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
    with new_folder(folder) as started:
        time.sleep(0.2)
        (started / "x.txt").write_text(content)


@pytest.fixture
def short_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_lock, "_WAIT", 0.02)


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


@pytest.mark.usefixtures("short_wait")
def test_where_the_first_fails_the_next_tries(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    calls = list[int]()

    def make() -> None:
        calls.append(1)
        time.sleep(0.2)
        if len(calls) == 1:
            raise DyngsError("too dark")
        _publish(folder, "second")

    said, errors = _made_by(3, folder, make)
    assert [str(error) for error in errors] == ["too dark"]
    assert len(calls) == 2
    assert said.count("found") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_without_locks_the_first_that_is_done_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(_: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(run_lock, "_lock", no_locks)
    folder = tmp_path / "a"
    said = list[str]()

    def make() -> None:
        with new_folder(folder) as started:
            (started / "ours").touch()
            folder.mkdir()  # by another process, which ends first
            (folder / "theirs").touch()

    make_once(folder, make, said.append, "found")
    assert said == ["found"]
    assert [path.name for path in folder.iterdir()] == ["theirs"]
    assert [path for path in tmp_path.iterdir() if path.suffix != ".lock"] == [folder]
