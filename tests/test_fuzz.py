"""Every reader under changed files: see ``python -m fuzz --help``."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

import dyngs
from dyngs.data.read import FORMATS

ROOT = Path(__file__).resolve().parents[1]
INPUTS = max(5, settings.default.max_examples // 20)
"""Changed inputs of a reader; fifty with HYPOTHESIS_PROFILE=long. ``python -m fuzz`` tries
more."""

pytestmark = pytest.mark.skipif(
    not Path("/proc/self/status").is_file(), reason="its limits are those of Linux"
)


FUZZ = """
import sys
from fuzz.__main__ import main

report, inputs, harm = sys.argv[1:]
sys.argv[1:] = ["all", "--no-keep", "--inputs", inputs, "--seed", "0", "--json", report]
main()
print("the corpus", flush=True)
sys.argv[1:] = ["all", "--no-keep", "--replay"]
code = main()
print("the harm", flush=True)
exec(harm)
sys.exit(code)
"""


@dataclass(frozen=True)
class Fuzzed:
    """Changed inputs for each reader, the corpus, and readers that do harm."""

    tried: dict[str, Any]  # counts, and failures with what is known of them, of each reader
    replayed: str  # what was printed of the corpus
    harms: str  # what was printed of those
    code: int


@pytest.fixture(scope="module")
def fuzzed(tmp_path_factory: pytest.TempPathFactory) -> Fuzzed:
    """By one process, which imports everything and is forked: threads of these tests would not
    survive that."""
    report = tmp_path_factory.mktemp("fuzz") / "report.json"
    environment = os.environ | {"PYTHONPATH": str(Path(dyngs.__file__).resolve().parents[1])}
    command = [sys.executable, "-c", FUZZ, str(report), str(INPUTS), HARM]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert "the harm" in done.stdout, done.stderr
    replayed, _, harms = done.stdout.partition("the corpus")[2].partition("the harm")
    return Fuzzed(json.loads(report.read_text()), replayed, harms, done.returncode)


def test_changed_inputs_are_read_or_refused(fuzzed: Fuzzed) -> None:
    tried = fuzzed.tried
    assert {name: own["failures"] for name, own in tried.items() if own["failures"]} == {}
    # Few inputs cannot be made; none of these counts.
    assert {
        name: own["inputs"] for name, own in tried.items() if own["inputs"] < 0.9 * INPUTS
    } == {}
    # Of a log, lines that are not whole are left out: hardly any is refused.
    assert [name for name, own in tried.items() if not own["refused"]] in ([], ["logs"])


def test_every_capture_format_is_fuzzed(fuzzed: Fuzzed) -> None:
    """If this fails, give ``fuzz.readers.CAPTURES`` seeds of the format."""
    optional = {"people_snapshot"} if find_spec("h5py") is None else set()
    assert {format.name for format in FORMATS} - fuzzed.tried.keys() == optional


def test_inputs_of_the_corpus_still_pass(fuzzed: Fuzzed) -> None:
    """The corpus: one small input for each kind of failure that was ever seen."""
    tried = [
        int(words[1])
        for words in map(str.split, fuzzed.replayed.splitlines())
        if words[2:3] == ["inputs"]
    ]
    assert fuzzed.code == 0, fuzzed.replayed
    assert sum(tried) >= 70


def test_faulty_readers_are_reported(fuzzed: Fuzzed) -> None:
    """Each kind of faulty reader is reported by its verdict."""
    assert json.loads(fuzzed.harms) == {
        "quiet": "accepted: ",
        "polite": "refused: ",
        "unnamed": "failed: the error names no file outside dyngs",
        "coloured": "failed: the error holds a control character outside dyngs",
        "two_lines": "failed: the error holds a line break outside dyngs",
        "traceback": "failed: KeyError outside dyngs",
        "not_finite": "failed: not finite: result.a[]",
        "writes": "failed: forbidden: open",
        "removes": "failed: forbidden: shutil.rmtree",
        "removes_below": "failed: outside the output folder: removed",
        "leaves": "failed: forbidden: os.system",
        "spins": "failed: takes too long",
        "dies": "failed: ends the process by SIGSEGV",
        "fills": "failed: MemoryError outside dyngs",
        "swells": "failed: took much memory",
        "never made": "None failed: hangs",
    }


HARM = """
import ctypes, json, math, os, shutil, subprocess, tempfile, time
from pathlib import Path
from dyngs.core.errors import DyngsError
from fuzz.campaign import run_cases, verdict_of
from fuzz.case import Case
from fuzz.readers import Reader
from fuzz.worker import Limits

class Raw(DyngsError): __str__ = Exception.__str__
def refuse(text): raise Raw(text)
def swell(root): return None if bytes([1]) * (240 << 20) else None
def unlink_in_c(root): ctypes.CDLL(None).unlink(str(root.parent / "precious/keep.txt").encode())
def spin(root):
    while True: pass

harms = {
    "quiet": lambda root: {"a": [1.0, (root / "a.txt").read_text()]},
    "polite": lambda root: refuse(f"{root}/a.txt: is not it"),
    "unnamed": lambda root: refuse("it is not it"),
    "coloured": lambda root: refuse(f"{root}: \\x1b[31m"),
    "two_lines": lambda root: refuse(f"{root}: a\\nb"),
    "traceback": lambda root: {}["a"],
    "not_finite": lambda root: {"a": [math.nan]},
    "writes": lambda root: (root / "new").write_text("x"),
    "removes": lambda root: shutil.rmtree(root.parent / "precious"),
    "removes_below": unlink_in_c,
    "leaves": lambda root: os.system("true"),
    "spins": spin,
    "dies": lambda root: ctypes.string_at(0),
    "fills": lambda root: bytearray(1 << 40),
    "swells": swell,
}
case = Case("seed", {"a.txt": b"text"})
# Only what spins is to meet the limit of time.
limits = {"spins": Limits(seconds=0.5)}
patient = Limits(seconds=120, memory_mb=256)
found = {}
for name, read in harms.items():
    verdict = verdict_of(Reader({}, read), case, limits.get(name, patient))
    reason = "" if verdict.outcome == "refused" else verdict.reason
    found[name] = f"{verdict.outcome.value}: {reason}"

def never_made():
    spin(None)
    yield 0, case

# Counted as no case of any number, or the campaign would begin with the same one again.
with tempfile.TemporaryDirectory() as folder:
    reader, soon = Reader({}, harms["quiet"]), Limits(seconds=0.1)
    [(number, verdict)] = run_cases(reader, never_made(), Path(folder), soon, time.monotonic() + 60)
found["never made"] = f"{number} {verdict.outcome.value}: {verdict.reason}"
print(json.dumps(found))
"""
