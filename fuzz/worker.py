"""Worker process: runs cases of one reader, one after the other, with limits on time and memory.

It is forked from a process that has imported everything, and reports over a pipe each case that it
begins and its verdict; the reader of the pipe starts another worker when this one dies or hangs.
"""

from __future__ import annotations

import faulthandler
import importlib
import json
import os
import pkgutil
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NoReturn

from dyngs.core.errors import DyngsError
from fuzz.case import Case, clear
from fuzz.readers import Reader
from fuzz.verdict import (
    Forbidden,
    Guard,
    Outcome,
    Verdict,
    difference,
    fault_of_message,
    not_finite,
    snapshot,
)


@dataclass(frozen=True)
class Limits:
    """Limits of one case.

    Attributes:
        seconds: processor time.
        memory_mb: memory beyond that of the process before the case, of address space and of
            resident memory.
    """

    seconds: float = 5.0
    memory_mb: int = 1024


STANDARD = Limits()


def run_child(
    reader: Reader, cases: Iterable[tuple[int, Case]], folder: Path, pipe: int, limits: Limits
) -> NoReturn:
    """Run the cases and end the process; write lines of JSON to ``pipe``: the number of a case,
    then its verdict."""
    try:
        _prepare(folder, limits)
        own = (folder / "box" / "capture",) if reader.writes else ()
        guard = Guard((folder / "box" / "out", folder / "cache", folder / "tmp", *own))
        before: Case | None = None
        _tell(pipe, [None])
        for number, case in cases:
            _tell(pipe, [number])
            case.write(folder / "box" / "capture", before)
            verdict = judge(reader, case, folder, guard, limits)
            before = None if reader.writes or verdict.outcome is Outcome.FAILED else case
            _tell(pipe, [number, asdict(verdict)])
    except BaseException:  # a defect of the fuzzer itself
        traceback.print_exc()
        os._exit(70)
    os._exit(0)


def judge(reader: Reader, case: Case, folder: Path, guard: Guard, limits: Limits) -> Verdict:
    """Run the reader on a case, which lies in ``folder/box/capture``, and return the verdict."""
    box = folder / "box"
    capture = box / "capture"
    for own in (box / "out", folder / "cache", folder / "tmp"):
        clear(own)
    os.chdir(box / "out")
    before = snapshot(box)
    peak = _reset_peak()
    signal.setitimer(signal.ITIMER_PROF, limits.seconds)
    guard.tried, guard.active = None, True
    try:
        verdict = _run(reader, capture, case)
    finally:
        guard.active = False
        signal.setitimer(signal.ITIMER_PROF, 0)
    if guard.tried is not None:
        return Verdict(Outcome.FAILED, f"forbidden: {guard.tried.split()[0]}", guard.tried)
    after = snapshot(box)
    ours = tuple(str(path) for path in guard.given)
    changed = difference(
        *({p: s for p, s in x.items() if not p.startswith(ours)} for x in (before, after))
    )
    if changed is not None:
        return Verdict(Outcome.FAILED, f"outside the output folder: {changed.split()[0]}", changed)
    grown = (_peak() - peak) / 1024
    if verdict.outcome is not Outcome.FAILED and grown > 0.75 * limits.memory_mb:
        return Verdict(Outcome.FAILED, "took much memory", f"{grown:.0f} MB")
    return verdict


def _run(reader: Reader, capture: Path, case: Case) -> Verdict:
    try:
        found = reader.read(capture)
    except DyngsError as error:
        names = (
            {"data.root", *(name.rpartition("/")[2] for name in case.files)}
            if reader.names_file
            else None
        )
        fault = fault_of_message(str(error), capture, names)
        if fault is None:
            return Verdict(Outcome.REFUSED, str(error))
        return Verdict(Outcome.FAILED, f"{fault} {_place(error)}", repr(str(error))[:2000])
    except Forbidden as error:
        return Verdict(Outcome.FAILED, "forbidden", str(error))
    except BaseException as error:
        text = "".join(traceback.format_exception(error, limit=-12))
        return Verdict(Outcome.FAILED, f"{type(error).__name__} {_place(error)}", text[-3000:])
    where = not_finite(found)
    if where is None:
        return Verdict(Outcome.ACCEPTED)
    return Verdict(Outcome.FAILED, f"not finite: {where}", where)


def _place(error: BaseException) -> str:
    """Return the innermost function of dyngs in the traceback, by which failures are
    distinguished."""
    frames = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if f"{os.sep}dyngs{os.sep}" in f.filename
    ]
    return f"{Path(frames[-1].filename).stem}.{frames[-1].name}" if frames else "outside dyngs"


def _prepare(folder: Path, limits: Limits) -> None:
    """Set limits and redirect all output to folders of the worker."""
    errors = os.open(folder / "stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
    os.dup2(errors, 2)
    os.dup2(errors, 1)
    sys.stdout = sys.stderr = os.fdopen(
        2, "w", buffering=1, errors="backslashreplace", closefd=False
    )
    faulthandler.enable(sys.stderr)
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    faulthandler.register(signal.SIGPROF, sys.stderr, chain=True)
    warnings.simplefilter("ignore")
    sys.dont_write_bytecode = True
    os.environ |= {
        "HOME": str(folder / "cache"),
        "DYNGS_CACHE_DIR": str(folder / "cache"),
        "TMPDIR": str(folder / "tmp"),
    }
    tempfile.tempdir = str(folder / "tmp")
    size = limits.memory_mb * 2**20 + _status("VmSize") * 1024
    resource.setrlimit(resource.RLIMIT_AS, (size, size))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    shutil.rmtree(folder / "box", ignore_errors=True)
    for name in ("box/precious/documents", "box/out", "cache", "tmp"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "box/precious/keep.txt").write_text("not to be read into anything, let alone changed")
    (folder / "box/precious/documents/letter.txt").write_text("dear")
    (folder / "box/.ssh").mkdir()
    (folder / "box/.ssh/id").write_text("secret")


def _status(name: str) -> int:
    """Return a value of /proc/self/status in kB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1])
    return 0


def _reset_peak() -> int:
    """Reset the peak of memory and return the present use in kB."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return _status("VmHWM")
    return _status("VmRSS")


def _peak() -> int:
    return _status("VmHWM")


def _tell(pipe: int, what: object) -> None:
    os.write(pipe, json.dumps(what).encode() + b"\n")


def import_everything() -> None:
    """Import dyngs and the libraries that it imports on first use, so that forked workers share
    them; one thread."""
    import torch

    import dyngs

    torch.set_num_threads(1)
    own = [module.name for module in pkgutil.walk_packages(dyngs.__path__, "dyngs.")]
    for name in (*_LIBRARIES, *(name for name in own if not _RUNS_ON_IMPORT.search(name))):
        try:
            importlib.import_module(name)
        except ImportError:  # an optional package is missing
            continue


_LIBRARIES = (
    "OpenImageIO",
    "av",
    "pycolmap",
    "trimesh",
    "kornia",
    "scipy.sparse",
    "scipy.spatial.transform",
    "h5py",
)
_RUNS_ON_IMPORT = re.compile(r"__main__$|\._core")
"""The command line, and native cores of which only one may suit this processor."""
