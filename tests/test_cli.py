"""The command line: exit codes, one-line errors, instant help, and every verb once on a tiny
capture."""

from __future__ import annotations

import argparse
import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from refused import error_line

import dyngs
from dyngs.cli import doctor, main
from dyngs.cli.train import parse_config
from dyngs.config.io import load_config, save_config
from dyngs.core.errors import DyngsError, wrap_read_errors

VERBS = (
    "demo",
    "train",
    "prune",
    "eval",
    "render",
    "export",
    "convert",
    "edit",
    "data",
    "doctor",
    "predict",
    "tradeoff",
    "compare",
    "config",
    "presets",
    "docs",
)
ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"} | {
    "PYTHONPATH": str(Path(dyngs.__file__).resolve().parents[1])
}
Capture = pytest.CaptureFixture[str]


def make_doctor(monkeypatch: pytest.MonkeyPatch, action: Callable[[], None]) -> None:
    """Let `dyngs doctor` do ``action``."""

    def run(arguments: argparse.Namespace) -> int:
        action()
        return 0

    monkeypatch.setattr(doctor, "run", run)


def raising(error: BaseException) -> Callable[[], None]:
    def action() -> None:
        raise error

    return action


# ----------------------------------------------------------------------------------------- help


def test_help_names_every_command(capsys: Capture) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(re.search(rf"^\s+{verb}\s", text, re.M) for verb in VERBS)


def test_version(capsys: Capture) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"dyngs {dyngs.__version__}"


@pytest.mark.parametrize(
    "verb", [["data", "sfm"], ["data", "inspect"], ["data", "synth"], *([v] for v in VERBS[:5])]
)
def test_every_command_explains_itself(verb: list[str], capsys: Capture) -> None:
    assert main([*verb, "--help"]) == 0
    assert f"usage: dyngs {' '.join(verb)}" in capsys.readouterr().out


def test_help_is_instant_because_torch_is_not_imported() -> None:
    code = (
        "import sys; from dyngs.cli import main; main(['--help'])\n"
        "print([m for m in ('torch', 'numpy', 'pydantic') if m in sys.modules])"
    )
    seconds = []
    for _ in range(3):  # the best counts: a busy machine only ever makes it slower
        start = os.times()
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            check=True,
        )
        end = os.times()
        seconds.append(
            end.children_user + end.children_system - start.children_user - start.children_system
        )
        assert done.stdout.splitlines()[-1] == "[]"
        if seconds[-1] < 0.5:
            return
    # 0.1 s on an idle machine; the promise is 0.3 s
    pytest.fail(f"takes {min(seconds)} s of the processor")


def test_module_and_command_are_the_same() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "dyngs", "--version"],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout.strip()) == (0, f"dyngs {dyngs.__version__}")


# ------------------------------------------------------------------------------------ debugging


def fail_in_a_reader() -> None:
    with wrap_read_errors("cameras.json"):
        raise KeyError("fl_x")


@pytest.mark.parametrize("arguments", [["--debug", "doctor"], ["doctor", "--debug"]])
def test_debug_shows_the_cause_before_the_line(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    make_doctor(monkeypatch, fail_in_a_reader)
    assert main(arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("dyngs: error: cameras.json: cannot be read (KeyError: 'fl_x')")
    assert lines.count("KeyError: 'fl_x'") == 1
    assert sum(line.startswith("Traceback") for line in lines) == 2


def test_without_a_command_the_next_step_is_printed(capsys: Capture) -> None:
    """On a small screen, and nothing that does not exist."""
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 20
    assert max(map(len, lines)) <= 100
    named = set(re.findall(r"dyngs (?!docs|doctor)([a-z]+)", "\n".join(lines)))
    assert {"demo", "train", "view"} <= named <= {*VERBS, "view"}


def test_without_debug_there_is_only_the_line(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    make_doctor(monkeypatch, fail_in_a_reader)
    assert "KeyError: 'fl_x'" in error_line(capsys, "doctor")


def test_a_line_holds_nothing_that_a_terminal_obeys(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    make_doctor(monkeypatch, raising(DyngsError("a\x1b[2J.png: no such\nimage")))
    assert "a\\x1b[2J.png: no such image" in error_line(capsys, "doctor")


def test_names_that_are_no_text_can_be_printed(tmp_path: Path) -> None:
    code = "import sys; from dyngs.cli import main; main(['--version']); print('p\\udce9re.png')"
    environment = ENVIRONMENT | {"PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "p\\udce9re.png")


# ------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ("trian", "unknown command 'trian'; did you mean `dyngs train`? (see `dyngs --help`)"),
        ("people", "did you mean `dyngs data people`?"),
        ("data synt", "did you mean `dyngs data synth`?"),
        ("train", "a capture is required"),
        ("train nowhere.yaml data.root=x", "nowhere.yaml: no such preset"),
        ("train static", "data.root is required"),
        ("train static data.rot=x", "did you mean 'data.root'"),
        ("train static data.root=nowhere train.steps=0", "train.steps must be an integer >= 1"),
        ("train static data.root=nowhere", "nowhere"),
        ("train --resume nowhere", "nowhere: not a run folder"),
        ("eval", "RUN"),
        ("eval nowhere", "nowhere: not a run folder"),
        ("eval nowhere --split tset", "invalid choice: 'tset'"),
        ("render nowhere", "--out DIR"),
        ("render nowhere --out x", "nowhere: no such run or file"),
        ("render nowhere --out x --size big", "1280x720"),
        ("render nowhere --out x --size 0x5", "1280x720"),
        ("render nowhere --out x --frames 0", "whole number from 1"),
        ("render nowhere --out x --split test --path orbit", "not allowed with"),
        (
            "render nowhere",
            "add --out DIR, or --video FILE.mp4 with --path, --time, --times or --view",
        ),
        ("render nowhere --out x --time nan", "'nan' is not a time"),
        ("render nowhere --out x --time noon", "'noon' is not a time; write a number from 0 to 1"),
        ("render nowhere --out x --time 0 --times 0:1:2", "not allowed with"),
        ("render nowhere --out x --path orbit --view 3", "--view (fixed camera) and --path"),
        ("render nowhere --out x --times 0:1:2 --frames 3", "--times and --frames both set"),
        ("export nowhere", "nowhere: no such file or folder"),
        ("export nowhere --times 0:1", "'0:1': not a range of times; use START:STOP:COUNT"),
        ("export nowhere --times 0:nan:3", "not a range of times"),
        ("export nowhere --time inf", "'inf' is not a time"),
        ("export nowhere --time 0 --times 0:1:2", "not allowed with"),
        ("export nowhere --static --dynamic", "not allowed with"),
        (
            "export nowhere --format tracks --static",
            "--static is not supported with --format tracks",
        ),
        ("export nowhere --format xyz", "invalid choice: 'xyz'"),
        ("data", "COMMAND"),
        ("data inspect nowhere", "nowhere"),
        ("data sfm nowhere out", "nowhere"),
        ("data synth still out --size 0", "--size"),
        ("demo --steps 0", "--steps"),
        ("demo --steps few", "'few' is not a number of steps"),
    ],
)
def test_wrong_usage_and_missing_input_end_in_one_line(
    arguments: str, part: str, capsys: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert part in error_line(capsys, *arguments.split())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "part"),
    [
        (DyngsError("two\nlines"), "two lines"),
        (
            OSError(errno.ENOSPC, "No space left on device", "a.png"),
            "a.png: No space left on device; free disk space",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "b"),
            "b: Permission denied; choose another folder",
        ),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), "Broken pipe"),
        (MemoryError(), "out of memory"),
        (
            RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"),
            "GPU out of memory; lower strategy.max",
        ),
    ],
)
def test_errors_of_the_world_end_in_one_line(
    error: Exception, part: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_doctor(monkeypatch, raising(error))
    assert part in error_line(capsys, "doctor")


def test_bugs_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    make_doctor(monkeypatch, raising(ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError):
        main(["doctor"])


def test_interruption_prints_how_to_resume(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_doctor(monkeypatch, raising(KeyboardInterrupt("go on with: dyngs train --resume runs/a")))
    assert main(["doctor"]) == 130
    assert (
        capsys.readouterr().err.strip()
        == "dyngs: interrupted: go on with: dyngs train --resume runs/a"
    )


TALKATIVE = """
import sys
from dyngs.cli import doctor, main
doctor.run = lambda arguments: print("x" * 10_000_000) or 0
sys.exit(main(["doctor"]))
"""


def test_a_reader_that_leaves_gets_no_traceback() -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", TALKATIVE],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read().splitlines() == [
        "dyngs: error: Broken pipe; the program that reads the output has ended"
    ]
    assert process.wait(timeout=60) == 2


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_gets_no_traceback() -> None:
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-c", TALKATIVE]
        done = subprocess.run(
            command, env=ENVIRONMENT, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert done.stderr.startswith("dyngs: error: No space left on device")
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(os.name != "posix", reason="closes a file descriptor in a shell")
@pytest.mark.parametrize(
    "command", ["docs cli >&-", "config static >&-", "config static | head -n 1", "--help >&-"]
)
def test_output_that_nobody_takes_gets_no_traceback(command: str) -> None:
    line = f"'{sys.executable}' -m dyngs {command}"
    done = subprocess.run(
        line, shell=True, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr


@pytest.mark.skipif(os.name != "posix", reason="sends a signal")
def test_ctrl_c_at_any_time_of_the_start_gets_no_traceback(capture: Path, tmp_path: Path) -> None:
    """While dyngs and torch are imported, and in the first steps; a shell sees 130 each time."""
    words = ["train", "static", f"data.root={capture}", "train.steps=100000"]
    for wait in (0.7, 2.5):
        command = [
            sys.executable,
            "-m",
            "dyngs",
            *words,
            f"run.dir={tmp_path / f'run after {wait} s'}",
        ]
        process = subprocess.Popen(
            command,
            env=ENVIRONMENT,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            # tests in the background ignore it
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        time.sleep(wait)
        process.send_signal(signal.SIGINT)
        try:
            error = process.communicate(timeout=60)[1].decode()
        finally:
            process.kill()
        assert "Traceback" not in error, f"after {wait} s: {error}"
        assert process.returncode in (130, -signal.SIGINT)


@pytest.mark.parametrize("module", ["signal", "dyngs.cli", "dyngs.cli.arguments", "shlex"])
def test_ctrl_c_while_a_module_is_imported_gets_no_traceback(module: str) -> None:
    """Before there is a handler, and after."""
    code = (
        "import builtins, os, sys\n"
        "known = builtins.__import__\n"
        "def interrupted(name, *arguments):\n"
        f"    if name == {module!r} and "
        "sys._getframe(1).f_globals['__name__'].startswith('dyngs'):\n"
        "        if 'signal' not in sys.modules or name == 'signal':\n"
        "            raise KeyboardInterrupt\n"
        "        os.kill(os.getpid(), 2)\n"
        "    return known(name, *arguments)\n"
        "builtins.__import__ = interrupted\n"
        "sys.argv[1:] = ['train', '--help']\n"
        "from dyngs.__main__ import main\n"
        "sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert (done.returncode, done.stderr.strip()) in ((130, ""), (130, "dyngs: interrupted")), (
        done.stderr
    )


# -------------------------------------------------------------------------------- train's words


@pytest.mark.parametrize(
    "words",
    [
        ["prune", "RUN", "model.alpha_min=0.02", "prune.mask_times=6", "--out", "RUN2"],
        ["prune", "RUN", "--out", "RUN2", "model.alpha_min=0.02", "prune.mask_times=6"],
        [
            "prune",
            "--out",
            "RUN2",
            "RUN",
            "model.alpha_min=0.02",
            "--prune",
            "0.5",
            "prune.mask_times=6",
        ],
    ],
)
def test_overrides_may_stand_anywhere(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[argparse.Namespace] = []
    monkeypatch.setattr("dyngs.cli.prune.run", lambda arguments: found.append(arguments) or 0)
    assert main(words) == 0
    assert found[0].overrides == ["model.alpha_min=0.02", "prune.mask_times=6"]
    assert (found[0].run_dir, found[0].out) == (Path("RUN"), Path("RUN2"))


@pytest.mark.parametrize(
    "words",
    [["prune", "RUN", "--out", "X", "a.b=1", "foo"], ["eval", "RUN", "--split", "val", "foo"]],
)
def test_other_words_may_not(words: list[str], capsys: Capture) -> None:
    assert main(words) == 2
    assert f"unrecognized arguments: {words[-1]} " in capsys.readouterr().err


def test_words_after_train() -> None:
    config = parse_config(["static", "data.root=x", "train.steps=5", "run.threads=2"], None)
    assert (config.train.steps, config.run.threads, config.data.root) == (
        5,
        2,
        Path("x").absolute(),
    )
    assert parse_config(["data.root=x"], None) == load_config(None, ["data.root=x"])


def test_a_resumed_run_keeps_its_config_but_for_its_length_and_threads(tmp_path: Path) -> None:
    stored = load_config(None, ["data.root=x", "train.steps=5", "strategy.kind=mcmc"])
    save_config(stored, tmp_path / "config.yaml")
    resumed = parse_config(["run.threads=3"], tmp_path)
    assert resumed.run.threads == 3
    assert resumed.run.dir == tmp_path
    assert resumed.model_copy(update={"run": stored.run}) == stored
    assert parse_config(["train.steps=9", "data.cache_mb=5"], tmp_path).train.steps == 9
    with pytest.raises(
        DyngsError,
        match=r"'optim.lr_means=1': the configuration of a run is fixed; "
        r"--resume accepts train.steps=N.*run.threads",
    ):
        parse_config(["train.steps=9", "optim.lr_means=1"], tmp_path)


# ----------------------------------------------------------------------------------- every verb


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("still") / "capture"
    assert main(["data", "synth", "still", str(out), "--size", "24", "--views", "6"]) == 0
    return out


@pytest.fixture(scope="module")
def run_dir(capture: Path) -> Path:
    folder = capture.parent / "run"
    words = [
        f"data.root={capture}",
        f"run.dir={folder}",
        "train.steps=20",
        "init.num_random=200",
        "run.threads=1",
    ]
    assert main(["train", "static", *words]) == 0
    return folder


def test_train_writes_a_run_folder_and_never_overwrites_it(
    run_dir: Path, capture: Path, capsys: Capture
) -> None:
    assert {"config.yaml", "checkpoints", "log.jsonl"} <= {f.name for f in run_dir.iterdir()}
    before = {f: f.read_bytes() for f in run_dir.rglob("*") if f.is_file()}
    assert str(run_dir) in error_line(
        capsys, "train", "static", f"data.root={capture}", f"run.dir={run_dir}"
    )
    assert {f: f.read_bytes() for f in run_dir.rglob("*") if f.is_file()} == before
    assert main(["train", "--resume", str(run_dir)]) == 0


def test_eval_prints_and_writes_the_metrics(run_dir: Path, capsys: Capture) -> None:
    assert main(["eval", str(run_dir)]) == 0
    metrics = json.loads((run_dir / "metrics.json").read_text())
    text = capsys.readouterr().out
    assert f"{metrics['psnr']:.2f} dB" in text
    assert "metrics.json" in text
    if metrics["lpips"] is None:  # the reason is shown in full, brackets too
        reason = metrics["reasons"]["lpips"].split()
        assert set(reason) <= set(text.split())
    assert main(["eval", str(run_dir), "--split", "train", "--threads", "1"]) == 0
    assert json.loads((run_dir / "metrics_train.json").read_text())["num_views"] == 6
    capsys.readouterr()
    assert "test" in error_line(capsys, "eval", run_dir, "--split", "val")


def test_export_and_render_of_the_file(run_dir: Path, tmp_path: Path, capsys: Capture) -> None:
    ply = tmp_path / "splats.ply"
    assert main(["export", str(run_dir), "--out", str(ply)]) == 0
    assert ply.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")
    for path in ("orbit", "spiral"):
        out = tmp_path / path
        words = ["--path", path, "--frames", "2", "--size", "24x24", "--up=-y"]
        assert main(["render", str(ply), "--out", str(out), *words]) == 0
        assert len(list(out.glob("*.png"))) == 2
    few = ("--max-gaussians-drawn", "1000")
    assert main(["render", str(ply), "--out", str(out), *words, *few]) == 0
    capsys.readouterr()
    assert "a number of Gaussians" in error_line(
        capsys, "render", ply, "--out", tmp_path, few[0], 0
    )
    assert "have no splits" in error_line(
        capsys, "render", ply, "--out", tmp_path, "--split", "test"
    )
    assert "unknown camera path 'circle'" in error_line(
        capsys, "render", ply, "--out", tmp_path, "--path", "circle"
    )


def test_eval_of_a_static_run_prints_no_scores_over_time(run_dir: Path, capsys: Capture) -> None:
    assert main(["eval", str(run_dir)]) == 0
    text = capsys.readouterr().out
    assert not any(word in text for word in ("moving", "deforming", "field"))


def test_inspect(capture: Path, tmp_path: Path, capsys: Capture) -> None:
    image = tmp_path / "cameras.png"
    assert main(["data", "inspect", str(capture), "--image", str(image), "--deep"]) == 0
    assert "blender" in capsys.readouterr().out
    assert image.stat().st_size > 0


def test_synth_leaves_a_used_folder_alone(capture: Path, capsys: Capture) -> None:
    assert "exists already" in error_line(capsys, "data", "synth", "still", capture)


@pytest.mark.parametrize("text", ["-1", "1.5", "x", "9" * 30, "²", "2000"])
@pytest.mark.parametrize(
    "command", [("render", "."), ("eval", "."), ("prune", ".", "--out", "x"), ("demo",)]
)
def test_threads_are_counted(
    capsys: pytest.CaptureFixture[str], command: tuple[str, ...], text: str
) -> None:
    assert "is not a number of threads" in error_line(capsys, *command, "--threads", text)


@pytest.mark.parametrize("text", ["a\0b", "\ud800"])
def test_words_that_can_name_nothing_are_refused(
    capsys: pytest.CaptureFixture[str], text: str
) -> None:
    for words in (("render", ".", "--out", text), ("export", text), ("train", f"run.dir={text}")):
        assert "contains a character that is invalid in names and paths" in error_line(
            capsys, *words
        )


def test_memory_that_torch_cannot_have_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("dyngs.cli.render.run", lambda _: torch.empty(2**60))
    assert "out of memory" in error_line(capsys, "render", ".")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_an_unprintable_error_keeps_its_exit_code() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "dyngs", "nothing"], env=ENVIRONMENT, stderr=full, check=False
        )
    assert done.returncode == 2


def test_long_words_are_cut_in_messages(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(error_line(capsys, "render", ".", "--time", "9" * 5000)) < 600


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize(
    "words",
    [
        ["train", "static", "data.root=nothing", "--device", "cuda"],
        ["train", "static", "data.root=nothing", "run.device=cuda"],
        ["render", "nothing.ply", "--out", "images", "--device", "cuda"],
        ["eval", "nothing", "--device", "cuda"],
    ],
)
def test_a_missing_gpu_is_reported_in_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("nothing.ply").touch()
    assert main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert re.fullmatch(
        r"dyngs: error: device cuda is not usable: .+: .+, or use device cpu\n", printed.err
    )
