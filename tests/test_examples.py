"""Examples in the docstrings of the public names: each has one, and it runs."""

from __future__ import annotations

import inspect
import re
import runpy
import textwrap
from pathlib import Path

import pytest

import dyngs
from dyngs.api.train import train
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the capture and the run that the examples name."""
    here = tmp_path_factory.mktemp("examples")
    write_static_capture(here / "lego", StaticOptions(size=16, num_train=3, num_test=1, samples=1))
    overrides = [
        f"data.root={here / 'lego'}",
        f"run.dir={here / 'runs/lego'}",
        "train.steps=2",
        "init.num_random=50",
    ]
    train(dyngs.load_config("static", overrides))
    return here


@pytest.mark.parametrize("name", dyngs.__all__)
def test_every_public_name_has_an_example_that_runs(
    name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = inspect.getdoc(getattr(dyngs, name)) or ""
    examples = re.findall(r"Examples?:\n\n((?:(?:    .*)?\n)+)", text + "\n")
    assert examples, f"dyngs.{name} has no example"
    monkeypatch.chdir(folder)
    for example in examples:
        exec(
            compile(textwrap.dedent(example), f"example of dyngs.{name}", "exec"),
            {"__name__": name},
        )


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(
    ("script", "arguments", "printed"),
    [
        ("load_and_render", ["runs/lego"], "12 images in orbit"),
        ("train_in_memory", ["3"], "dB"),
        ("own_loss", ["lego", "2"], " 4\n"),
        ("evaluate_and_compare", ["runs/lego", "2"], "static_mcmc"),
        ("export", ["runs/lego"], "visible.ply StaticScene("),
    ],
)
def test_scripts_run(
    script: str,
    arguments: list[str],
    printed: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("sys.argv", [script, *arguments])
    runpy.run_path(str(Path(__file__).parents[1] / "examples" / f"{script}.py"))
    assert printed in capsys.readouterr().out
