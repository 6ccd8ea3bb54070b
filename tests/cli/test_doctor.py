"""``dyngs doctor``: installed components, broken ones, and possible speed-ups."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import dyngs
from dyngs.cli import doctor, main

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(dyngs.__file__).resolve().parents[1])}
Capture = pytest.CaptureFixture[str]


def test_doctor(capsys: Capture) -> None:
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"instruction set v\d \(\S+\), compiled: v\d", text)
    assert "broken" not in text


def test_doctor_names_the_extras_of_optional_packages() -> None:
    project = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    for name, extra in doctor._OPTIONAL.items():
        assert re.search(rf'^{extra} = \[.*"{name}>', project, re.MULTILINE), name


def test_doctor_reports_kernels_that_this_processor_cannot_run() -> None:
    environment = ENVIRONMENT | {"DYNGS_ISA": "v9"}
    command = [sys.executable, "-m", "dyngs", "doctor"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.search(r"native core +broken +DYNGS_ISA=v9", done.stdout)
    assert done.stderr.startswith("dyngs: error: the installation is broken: native core")


def test_doctor_reports_a_faster_instruction_set(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr("dyngs.ops.native.built_isas", lambda: ("v2",))
    monkeypatch.setattr("dyngs.ops.native.core", SimpleNamespace(best_isa=lambda: "v4"))
    assert main(["doctor"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert (
        "compiled: v2; this CPU supports v4 (AVX-512): reinstall dyngs from source for more speed"
        in text
    )
