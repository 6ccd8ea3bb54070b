import socket
import urllib.request
from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.cli import main


def test_a_page_is_served_until_it_is_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'dyngs[view]')")
    seen: list[bytes] = []

    def look() -> None:
        link = capsys.readouterr().out.split()[2]
        seen.append(urllib.request.urlopen(link, timeout=10).read())

    monkeypatch.setattr("dyngs.cli.view.wait_for_interrupt", look)
    assert main(["view", str(write_moving_run(tmp_path))]) == 0
    assert b"<html" in seen[0]
    assert "viewer stopped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("is_terminal", "words", "stays"),
    [
        (True, ["--view"], True),
        (False, ["--view"], False),
        (True, ["--view", "--close-viewer"], False),
    ],
)
def test_after_training_the_page_stays_open_on_a_terminal(
    is_terminal: bool,
    words: list[str],
    stays: bool,
    still: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'dyngs[view]')")
    seen: list[bytes] = []

    def look() -> None:
        line = capsys.readouterr().out.splitlines()[-1]
        assert line.startswith("training finished; viewer open at http://localhost:")
        seen.append(urllib.request.urlopen(line.split()[5].rstrip(";"), timeout=10).read())

    monkeypatch.setattr("dyngs.cli.train.wait_for_interrupt", look)
    monkeypatch.setattr("sys.stdin.isatty", lambda: is_terminal, raising=False)
    options = ["train.steps=2", "init.num_random=40", f"run.dir={tmp_path / 'run'}"]
    assert main(["train", "static", f"data.root={still}", *options, *words]) == 0
    assert [b"<html" in page for page in seen] == [True] * stays
    assert main(["train", "static", f"data.root={still}", "--close-viewer"]) == 2
    assert "--close-viewer requires --view" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["nothing"], "no such file"),
        ([".", "--port", "0"], "not a port"),
        ([".", "--port", "70000"], "not a port"),
        (["."], "no runs found"),
    ],
)
def test_unviewable_inputs_are_refused_in_one_line(
    words: list[str],
    line: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'dyngs[view]')")
    monkeypatch.chdir(tmp_path)
    assert main(["view", *words]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1


def test_a_taken_port_and_motions_of_no_person_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'dyngs[view]')")
    run = str(write_moving_run(tmp_path))
    (tmp_path / "walk.npz").write_bytes(b"")
    with socket.create_server(("127.0.0.1", 0)) as other:
        assert main(["view", run, "--port", str(other.getsockname()[1])]) == 2
    assert "cannot listen" in capsys.readouterr().err
    assert main(["view", run, "--motion", str(tmp_path / "walk.npz")]) == 2
    assert "requires a person" in capsys.readouterr().err


def test_without_viser_one_line_names_the_extra(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["view", str(tmp_path)]) == 2
    assert "dyngs[view]" in capsys.readouterr().err
