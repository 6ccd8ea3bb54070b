"""The notebook of ``examples/`` runs from top to bottom."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import dyngs
from dyngs.cli import main

NOTEBOOK = Path(__file__).parents[2] / "examples" / "first_scene.ipynb"


@pytest.mark.usefixtures("one_thread")
def test_notebook_trains_evaluates_and_exports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] != "code":
            continue
        source = "".join(cell["source"]).replace("--size 160", "--size 24 --views 8")
        lines = source.replace("STEPS = 1500", "STEPS = 20").splitlines()
        for line in lines:
            if line.startswith("!"):
                command, *arguments = line[1:].split()
                assert (command, main(arguments)) == ("dyngs", 0)
        exec("\n".join(line for line in lines if not line.startswith("!")), names)
    assert isinstance(dyngs.load("runs/notebook"), dyngs.GaussianScene)
    assert b"<html" in Path("notebook.html").read_bytes()[:200]
