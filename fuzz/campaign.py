"""Fuzzing of one reader with many cases: workers are started, watched and replaced; failures are
minimised and kept."""

from __future__ import annotations

import hashlib
import json
import os
import select
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random

from fuzz.case import Case, case_of, clear, from_json
from fuzz.mutate import changed_case
from fuzz.readers import READERS, Reader
from fuzz.verdict import Outcome, Verdict
from fuzz.worker import STANDARD, Limits, run_child

CORPUS = Path(__file__).resolve().parent / "corpus"
MOST_PER_PROCESS = 2000
LONGEST_WAIT = 300.0  # seconds in which a worker may report nothing, on a busy machine
"""Cases after which a worker is replaced, which bounds its leaks."""


@dataclass
class Tally:
    """Outcomes of the cases of a reader.

    Attributes:
        reader: name of the reader.
        outcomes: number of cases of each outcome.
        failures: reason to the cases that failed for it.
        seconds: processor time of the workers.
        kept: files written to the corpus.
    """

    reader: str
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    failures: dict[str, list[tuple[Case, Verdict]]] = field(default_factory=dict)
    seconds: float = 0.0
    kept: list[Path] = field(default_factory=list)

    @property
    def inputs(self) -> int:
        return sum(self.outcomes.values())

    @property
    def line(self) -> str:
        """The tally as one line of text."""
        counts = " ".join(f"{self.outcomes[o]:>7} {o.value}" for o in Outcome)
        kinds = f"{len(self.failures):>3} kinds" if self.failures else ""
        return f"{self.reader:<16} {self.inputs:>8} inputs {counts} {self.seconds:>6.1f} s of CPU {kinds}".rstrip()


def seeds_of(reader: Reader) -> dict[str, Case]:
    """Write the seeds of a reader and return them as cases."""
    found = {}
    for name, write in sorted(reader.seeds.items()):
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            found[name] = case_of(name, Path(folder))
    return found


def cases(
    seeds: dict[str, Case], name: str, seed: int, numbers: range
) -> Iterator[tuple[int, Case]]:
    """Yield the cases with these ``numbers``; they depend on the arguments only."""
    for number in numbers:
        yield number, changed_case(seeds, Random(f"{name}/{seed}/{number}"))


def cpu_seconds() -> float:
    """Return the processor time of this process and of the children it has waited for."""
    return sum(os.times()[:4])


def cpu_seconds_of(worker: int) -> float:
    """Return the processor time of a running process."""
    fields = Path(f"/proc/{worker}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def stored_cases(name: str, seeds: dict[str, Case]) -> dict[str, Case]:
    """Read the corpus of a reader: file name to case."""
    folder = CORPUS / name
    return {path.name: from_json(path.read_text(), seeds) for path in sorted(folder.glob("*.json"))}


def campaign(name: str, seed: int, inputs: int, seconds: float, limits: Limits = STANDARD) -> Tally:
    """Run ``inputs`` cases, or as many as ``seconds`` allow, and return their outcomes."""
    reader = READERS[name]
    seeds = seeds_of(reader)
    tally = Tally(name)
    begin = time.monotonic()
    number = 0
    before = cpu_seconds()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        judged = dict(
            run_cases(reader, iter(enumerate(seeds.values())), Path(folder), limits, begin + 600)
        )
    for i, case in enumerate(seeds.values()):
        # alone, if one before it ended the process
        verdict = judged.get(i) or verdict_of(reader, case, limits)
        if verdict.outcome is not Outcome.ACCEPTED:
            text = f"{verdict.reason} {verdict.detail}"
            tally.failures.setdefault(f"the seed {case.seed} is not accepted", []).append(
                (case, Verdict(Outcome.FAILED, text, text))
            )
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        while number < inputs and time.monotonic() - begin < seconds:
            count = min(inputs - number, MOST_PER_PROCESS)
            own = cases(seeds, name, seed, range(number, number + count))
            for i, verdict in run_cases(reader, own, Path(folder), limits, begin + seconds):
                if i is None:  # the case could not be made
                    number += 1
                    break
                number = i + 1
                tally.outcomes[verdict.outcome] += 1
                if verdict.outcome is Outcome.FAILED:
                    case = changed_case(seeds, Random(f"{name}/{seed}/{i}"))
                    tally.failures.setdefault(verdict.reason, []).append((case, verdict))
    tally.seconds = cpu_seconds() - before
    return tally


def verdict_of(reader: Reader, case: Case, limits: Limits = STANDARD) -> Verdict:
    """Run one case in a process of its own and return its verdict."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        verdicts = list(
            run_cases(reader, iter([(0, case)]), Path(folder), limits, time.monotonic() + 600)
        )
    return verdicts[0][1]


def run_cases(
    reader: Reader, numbered: Iterator[tuple[int, Case]], folder: Path, limits: Limits, until: float
) -> Iterator[tuple[int | None, Verdict]]:
    """Yield numbers and verdicts up to the first case that ends the worker process, or the time
    ``until``.

    A case that ends the process, or hangs, is a failure; call again with the cases after it. If the
    process ends or hangs between two cases, which is while the next is made, the number is None.
    """
    out, pipe = os.pipe()
    clear(folder)
    worker = os.fork()
    if worker == 0:
        os.close(out)
        run_child(reader, numbered, folder, pipe, limits)
    os.close(pipe)
    try:
        yield from _verdicts(out, worker, folder, limits, until)
    finally:
        os.close(out)
        _end(worker)


def _verdicts(
    out: int, worker: int, folder: Path, limits: Limits, until: float
) -> Iterator[tuple[int | None, Verdict]]:
    begun, rest = None, b""
    is_ready = False
    processor = cpu_seconds_of(worker)
    since = time.monotonic()
    while True:
        ready, _, _ = select.select([out], [], [], min(1.0, limits.seconds))
        if not ready:
            # The start of the worker counts for no case, however long it takes.
            used = cpu_seconds_of(worker) - processor if is_ready else 0.0
            waited = time.monotonic() - since
            if used > 2 * limits.seconds or waited > LONGEST_WAIT:
                os.kill(worker, signal.SIGKILL)
                yield begun, Verdict(Outcome.FAILED, "hangs", _tail(folder))
                return
            continue
        is_ready = True
        processor = cpu_seconds_of(worker)
        since = time.monotonic()
        data = os.read(out, 1 << 16)
        if not data:
            _, status = os.waitpid(worker, 0)
            if begun is not None or status:
                yield begun, _death(status, folder)
            return
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            told = json.loads(line)
            begun = told[0]
            if len(told) > 1:
                yield (
                    begun,
                    Verdict(Outcome(told[1]["outcome"]), told[1]["reason"], told[1]["detail"]),
                )
                begun = None
                if time.monotonic() > until:
                    return


def _death(status: int, folder: Path) -> Verdict:
    """Return the verdict on a case during which the process ended."""
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        what = "takes too long" if name == "SIGPROF" else f"ends the process by {name}"
    else:
        what = f"ends the process with {os.WEXITSTATUS(status)}"
    detail = _tail(folder)
    own = [
        line
        for line in detail.splitlines()
        if line.startswith("  File") and f"{os.sep}dyngs{os.sep}" in line
    ]
    where = own[0].rpartition("dyngs" + os.sep)[2].replace('"', "") if own else ""
    return Verdict(
        Outcome.FAILED,
        f"{what} {where.split(',')[0]} {where.rpartition(' in ')[2]}".strip(),
        detail,
    )


def _tail(folder: Path) -> str:
    path = folder / "stderr"
    return path.read_bytes()[-3000:].decode("utf-8", "replace") if path.is_file() else ""


def _end(worker: int) -> None:
    try:
        os.kill(worker, signal.SIGKILL)
        os.waitpid(worker, 0)
    except (ProcessLookupError, ChildProcessError):
        return


def minimised(reader: Reader, case: Case, reason: str, seed: Case, tries: int = 60) -> Case:
    """Minimise a case: undo changes to its seed as long as it fails for the same reason."""
    for name in sorted(case.files.keys() | seed.files.keys()):
        if case.files.get(name) == seed.files.get(name):
            continue
        files = (
            {**case.files, name: seed.files[name]}
            if name in seed.files
            else _without(case.files, name)
        )
        smaller = replace(case, files=files)
        if verdict_of(reader, smaller).reason == reason:
            case = smaller
    if case.links and verdict_of(reader, replace(case, links={})).reason == reason:
        case = replace(case, links={})
    for name in sorted(case.files):
        if case.files[name] != seed.files.get(name):
            case, tries = _nearer(reader, case, reason, (name, seed.files.get(name, b"")), tries)
    return case


def _nearer(
    reader: Reader, case: Case, reason: str, to: tuple[str, bytes], tries: int
) -> tuple[Case, int]:
    """Restore ranges of a file, if its length is unchanged, or else cut them out, as long as the
    case still fails."""
    name, original = to
    size = len(case.files[name])
    step = size // 2
    while step and tries > 0:
        for begin in range(0, size, step):
            data = case.files[name]
            other = original[begin : begin + step] if len(original) == size else b""
            trial = data[:begin] + other + data[begin + step :]
            if trial == data or (len(original) != size and size - step < 1):
                continue
            tries -= 1
            smaller = replace(case, files={**case.files, name: trial})
            if verdict_of(reader, smaller).reason == reason:
                case = smaller
            if tries <= 0 or len(case.files[name]) != size:
                break
        size = len(case.files[name])
        step //= 2
    return case, tries


def _without(files: dict[str, bytes], name: str) -> dict[str, bytes]:
    return {other: data for other, data in files.items() if other != name}


def keep(tally: Tally, known: set[str]) -> None:
    """Add one minimised case of each kind of failure to the corpus, except for the reasons
    ``known``."""
    reader = READERS[tally.reader]
    seeds = seeds_of(reader)
    for reason, failures in sorted(tally.failures.items()):
        if reason in known:
            continue
        case, _ = min(
            failures, key=lambda failure: sum(len(data) for data in failure[0].files.values())
        )
        small = minimised(reader, case, reason, seeds[case.seed])
        text = small.to_json(seeds[case.seed])
        path = CORPUS / tally.reader / f"{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        tally.kept.append(path)
