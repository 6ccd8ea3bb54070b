"""Soak test: kills, full disks and too little memory must not lose or change a run, or leave files
behind.

    python benchmarks/soak.py [--kills 500] [--minutes 60] [--seed 0] [--jobs
    static,dynamic,prune,export]

Every round starts a tiny run (16 px; a static one, one with moving Gaussians, one with a size
limit, the pruning or the export of a finished one), and kills it with SIGKILL: at a random time,
right before one of its file operations, or within a few milliseconds of one, so that saves are hit.
It is then continued as a person would (`train --resume`, or the same command if there is nothing to
resume), killed again, and finally left to finish. Other rounds meet a full disk (a small tmpfs
where that can be mounted, otherwise a limit on the size of files), too little memory, or a second
process with the same command. After each interruption the run must load if it has a checkpoint; the
error of a failed command must be one line; in the end all files must have the bytes of an
uninterrupted run (the log: all but its seconds) and there must be no other files. Prints a table in
Markdown; exit code 1 if anything was lost.

One process imports everything and forks for every command. It uses one thread, so that the children
may use theirs. The same seed makes the same choices, but not the same timing. Linux and macOS.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch

import torch

from dyngs.cli import main as dyngs
from dyngs.config.io import RESOLVED_NAME
from dyngs.runs.checkpoint import checkpoint_paths, has_only_scene_file, load_run
from dyngs.runs.folder import EXPORT_FOLDER, REQUESTED_NAME

OPERATIONS = (
    "os.rename",
    "os.remove",
    "os.mkdir",
    "os.rmdir",
    "os.truncate",
    "fcntl.flock",
    "shutil.rmtree",
)
WRITES = os.O_WRONLY | os.O_RDWR
PATIENCE = 300.0
"""Seconds after which a command counts as hung."""
LOST_CODE = 70
COMMON = (
    "run.threads=1 run.seed=3 init.kind=random train.log_every=1 model.sh_degree=1 strategy.kind=default "
    "strategy.start=1 strategy.every=3 strategy.grad_threshold=1e-6 strategy.max_gaussians=300"
)
STATIC = (
    f"train static {COMMON} data.root=still init.num_random=150 train.steps=14 train.save_every=2"
)
DYNAMIC = (
    f"train dynamic {COMMON} data.root=moving init.num_random=150 model.num_random_moving=40 train.steps=18 "
    "train.save_every=3 train.initial_downscale=1"
)
JOBS = {
    "static": f"{STATIC} run.dir=OUT",
    "dynamic": f"{DYNAMIC} run.dir=OUT",
    "small file": f"{STATIC} run.dir=OUT train.steps=4 budget.max_mb=0.02",
    "prune": "prune whole --out OUT --prune 0.5 --steps 6 --threads 1 train.save_every=2",
    "prune dynamic": "prune whole_moving --out OUT --prune 0.5 --masks 3 --steps 4 --threads 1",
    "export": "export whole --format dyngs --out OUT",
}
SOURCES = {
    "still": "data synth still still --size 16 --views 4",
    "moving": "data synth spin moving --size 16 --views 8",
    "whole": f"{STATIC} run.dir=whole",
    "whole_moving": f"{DYNAMIC} run.dir=whole_moving",
}


@dataclass(frozen=True)
class End:
    """How a command ended.

    Attributes:
        code: exit code, or minus the signal.
        said: on stderr.
        seconds: that it took.
        operations: on files, as far as they were counted.
    """

    code: int
    said: str
    seconds: float
    operations: int = 0

    @property
    def problem(self) -> str | None:
        """Return what is wrong with a command that was not killed."""
        if self.code == LOST_CODE or "Traceback" in self.said:
            return f"exit code {self.code}: {self.said.strip()[-200:]}"
        errors = [line for line in self.said.splitlines() if line.startswith("dyngs: error")]
        if self.code == 2 and len(errors) != 1:
            return f"{len(errors)} lines of error: {self.said[-200:]}"
        return None if self.code in (0, 2) else f"ended with {self.code}: {self.said[-200:]}"


@dataclass
class Reference:
    """A run that was not disturbed."""

    folder: Path
    end: End


@dataclass
class Tally:
    """Counts of disturbances and results of one job."""

    counts: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)


class Trap:
    """Counts the file operations of this process below a folder and acts at one of them."""

    def __init__(self, folder: Path, at: int, act: Callable[[], None]) -> None:
        self.count, self._folder, self._at, self._act = 0, str(folder), at, act
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[object, ...]) -> None:
        if event == "open":
            flags = arguments[2]
            if not isinstance(flags, int) or not flags & WRITES:
                return
        elif event not in OPERATIONS:
            return
        if event != "fcntl.flock" and self._folder not in str(arguments[0]):
            return
        self.count += 1
        if self.count == self._at:
            self._act()


def forked(
    words: str, out: Path, prepare: Callable[[], Trap | None], meet: Callable[[int, int], None]
) -> End:
    """Run ``dyngs WORDS`` in a child process, with ``out`` for ``OUT``, and return how it ended.

    Args:
        words: of the command.
        out: a folder that must load before, if it holds a checkpoint.
        prepare: called in the child before it begins; it may write bytes to file 3, and return a
            trap whose count is wanted.
        meet: called in the parent with the child's number and the file at which those bytes arrive.
    """
    # not beside `out`, whose disk may be full
    opened, name = tempfile.mkstemp(prefix="soak-stderr-")
    os.close(opened)
    errors = Path(name)
    start = time.perf_counter()
    wrap_read_errors, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        _be_child(words, out, (errors, writing), prepare)
    os.close(writing)
    try:
        meet(pid, wrap_read_errors)
        status = _waited(pid)
        counted = (
            os.read(wrap_read_errors, 64)
            if select.select([wrap_read_errors], [], [], 0)[0]
            else b""
        )
    finally:
        os.close(wrap_read_errors)
    said = errors.read_text(errors="replace")
    errors.unlink()
    number = counted.rpartition(b"#")[2]
    operations = int(number) if number.isdigit() else 0
    return End(os.waitstatus_to_exitcode(status), said, time.perf_counter() - start, operations)


def _be_child(
    words: str, out: Path, files: tuple[Path, int], prepare: Callable[[], Trap | None]
) -> None:
    code = LOST_CODE
    try:
        error_file = os.open(files[0], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        nowhere = os.open(os.devnull, os.O_RDWR)
        for source, target in ((nowhere, 0), (nowhere, 1), (error_file, 2), (files[1], 3)):
            os.dup2(source, target)
        if checkpoint_paths(out) or has_only_scene_file(out):
            load_run(out)
        trap = prepare()
        code = dyngs([word.replace("OUT", str(out)) for word in words.split()])
        if trap is not None:
            os.write(3, f"#{trap.count}".encode())
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _waited(pid: int) -> int:
    """Return the status of a child, which is killed if it hangs."""
    deadline = time.perf_counter() + PATIENCE
    while time.perf_counter() < deadline:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return status
        time.sleep(0.002)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return LOST_CODE << 8


def nothing() -> None: ...


def alone(pid: int, arrived: int) -> None: ...


def left_alone(words: str, out: Path) -> End:
    """Run a command undisturbed and count its file operations."""
    return forked(words, out, lambda: Trap(out, 0, nothing), alone)


def killed(words: str, out: Path, kind: str, dice: random.Random, reference: Reference) -> End:
    """Run a command and kill it; return how it ended."""
    # the rest takes less than the whole
    fraction = dice.uniform(0, 0.6) if checkpoint_paths(out) else dice.random()
    at = 1 + int(fraction * reference.end.operations)
    after = fraction * reference.end.seconds if kind == "any moment" else dice.uniform(0, 0.004)

    def at_once() -> None:
        Trap(out, at, lambda: os.kill(os.getpid(), signal.SIGKILL))

    def soon() -> None:
        Trap(out, at, tell)

    def tell() -> None:
        os.write(3, b"x")

    def kill(pid: int, arrived: int) -> None:
        if kind == "around a file operation":
            select.select([arrived], [], [], PATIENCE)  # also when the child has ended
        if kind != "before a file operation":
            time.sleep(after)
            os.kill(pid, signal.SIGKILL)

    prepare = {
        "any moment": nothing,
        "before a file operation": at_once,
        "around a file operation": soon,
    }[kind]
    return forked(words, out, prepare, kill)


def limited(words: str, out: Path, kind: str, dice: random.Random) -> End:
    """Run a command with too little disk or memory; return how it ended."""

    def limit() -> None:
        if kind == "memory":
            used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            most = used + int(10 ** dice.uniform(4, 7))
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        elif kind == "file size":
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            most = dice.randrange(0, 60_000)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    return forked(words, out, limit, alone)


def next_command(job: str, out: Path, dice: random.Random) -> str:
    """Return the command that continues a run."""
    start = JOBS[job]
    if start.startswith("export") or not (out / RESOLVED_NAME).exists():
        return start
    if start.startswith("train") and not checkpoint_paths(out) and dice.random() < 0.5:
        return start
    return "train --resume OUT"


def differences(out: Path, reference: Path) -> list[str]:
    """Return what is wrong with a finished run; training times may differ."""
    problems = []
    there, wanted = (
        {str(f.relative_to(folder)) for folder in (root,) for f in folder.rglob("*")}
        for root in (out, reference)
    )
    problems += [f"left over: {name}" for name in sorted(there - wanted)]
    # The file of a pruned run comes at the end of `dyngs prune`; an interrupted one that is trained
    # on has none.
    missing = [name for name in sorted(wanted - there) if Path(name).parts[0] != EXPORT_FOLDER]
    problems += [f"missing: {name}" for name in missing]
    problems += [f"left over beside it: {f.name}" for f in out.parent.iterdir() if f != out]
    for name in sorted(there & wanted):
        if (out / name).is_file() and told(out / name) != told(reference / name):
            problems.append(f"differs: {name}")
    return problems


def told(file: Path) -> object:
    """Return the part of a file that must be equal in two runs."""
    if file.name == "log.jsonl":
        lines = [json.loads(line) for line in file.read_text().splitlines()]
        # time decides how many test views are scored, and a resumed mean is approximate
        steps = [line for line in lines if "split" not in line]
        varies = ("seconds", "mean_psnr")
        return [{key: x for key, x in line.items() if key not in varies} for line in steps]
    if file.name == "timing.json":
        return list(json.loads(file.read_text())["seconds_train"])
    if file.name in (RESOLVED_NAME, REQUESTED_NAME):
        return [
            line for line in file.read_text().splitlines() if not line.strip().startswith("dir:")
        ]
    return file.read_bytes()


class Soak:
    """Rounds over some jobs in one folder."""

    def __init__(self, folder: Path, jobs: list[str], dice: random.Random) -> None:
        self.folder, self.dice = folder, dice
        self.tallies = {job: Tally() for job in jobs}
        self.references: dict[str, Reference] = {}
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            moves = any("moving" in JOBS[job] for job in jobs)
            sources = [words for name, words in SOURCES.items() if moves or "moving" not in name]
            for words in (*sources, JOBS["export"].replace("OUT", "stored")):
                if dyngs(words.split()) != 0:
                    # in this process, which imports all that the children need
                    raise SystemExit(f"dyngs {words} failed")
        if Path("/proc/self/task").exists() and len(list(Path("/proc/self/task").iterdir())) > 1:
            raise SystemExit(
                "this process has several threads, which a child would wait for in vain"
            )
        for job in jobs:
            (folder / "reference").mkdir(exist_ok=True)
            out = folder / "reference" / job.replace(" ", "_")
            self.references[job] = Reference(out, self._made(JOBS[job], out))

    def _made(self, words: str, out: Path) -> End:
        end = left_alone(words, out)
        if end.code != 0:
            raise SystemExit(f"dyngs {words}: {end.said}")
        return end

    def kill_round(self, job: str, kills: int) -> None:
        """Kill a run up to so many times, then let it finish."""
        tally = self.tallies[job]
        out = self._new()
        for _ in range(kills):
            kind = self.dice.choice(
                ("any moment", "before a file operation", "around a file operation")
            )
            end = killed(
                next_command(job, out, self.dice), out, kind, self.dice, self.references[job]
            )
            if end.code == -signal.SIGKILL:
                tally.counts["kills"] += 1
                tally.counts[kind] += 1
            elif end.problem is not None or end.code != 0:
                tally.lost.append(f"{job}, {kind}: {end.problem or end.said}")
        self._finish(job, out)

    def limit_round(self, job: str, kind: str) -> None:
        """Run into a limit, then finish without it."""
        tally = self.tallies[job]
        out = self._new()
        if kind == "disk":
            self._on_full_disk(job, out)
            return
        end = limited(next_command(job, out, self.dice), out, kind, self.dice)
        tally.counts[kind] += end.code != 0
        self._judge(job, kind, end)
        self._finish(job, out)

    def _on_full_disk(self, job: str, out: Path) -> None:
        """Run into a full disk, then finish with more space."""
        disk = out.parent
        size = self.dice.randrange(8, 160)
        if subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", disk], check=False
        ).returncode:
            raise SystemExit("a tmpfs could be mounted before, and cannot now")
        try:
            end = forked(next_command(job, out, self.dice), out, nothing, alone)
            self.tallies[job].counts["disk"] += end.code != 0
            self._judge(job, "disk", end)
            subprocess.run(["mount", "-o", "remount,size=64m", disk], check=True)
            self._finish(job, out)
        finally:
            subprocess.run(["umount", disk], check=False)

    def pair_round(self, job: str) -> None:
        """Run the same command twice at once: one succeeds, the other is refused or has nothing to
        do."""
        tally = self.tallies[job]
        out = self._new()
        ends: list[End] = []

        def second(pid: int, arrived: int) -> None:
            time.sleep(self.dice.uniform(0, self.references[job].end.seconds))
            ends.append(forked(JOBS[job], out, nothing, alone))

        ends.append(forked(JOBS[job], out, nothing, second))
        tally.counts["pairs"] += 1
        for end in ends:
            self._judge(job, "pair", end)
        if 0 not in [end.code for end in ends]:
            tally.lost.append(f"{job}: both of a pair failed")
        self._finish(job, out)

    def _new(self) -> Path:
        shutil.rmtree(self.folder / "round", ignore_errors=True)
        (self.folder / "round").mkdir()
        return self.folder / "round" / "run"

    def _judge(self, job: str, kind: str, end: End) -> None:
        if end.problem is None:
            return
        if kind == "memory" and end.code != LOST_CODE:
            # a library may end the process; the run must survive it
            self.tallies[job].counts["ended by a library"] += 1
        else:
            self.tallies[job].lost.append(f"{job}, {kind}: {end.problem}")

    def _finish(self, job: str, out: Path) -> None:
        """Continue to the end and compare."""
        tally = self.tallies[job]
        tally.counts["runs"] += 1
        end = forked(next_command(job, out, self.dice), out, nothing, alone)
        if end.code != 0:
            tally.lost.append(f"{job}: cannot go on: {end.said.strip()}")
            return
        tally.lost += [
            f"{job}: {problem}" for problem in differences(out, self.references[job].folder)
        ]

    def rows(self) -> list[str]:
        """Return the table."""
        columns = (
            "runs",
            "kills",
            "any moment",
            "before a file operation",
            "around a file operation",
        )
        columns += ("disk", "file size", "memory", "ended by a library", "pairs")
        head = f"| job | {' | '.join(columns)} | lost |"
        rows = [head, "|---" * (len(columns) + 2) + "|"]
        total: Counter[str] = Counter()
        for job, tally in self.tallies.items():
            total += tally.counts
            rows.append(
                f"| {job} | {' | '.join(str(tally.counts[c]) for c in columns)} | {len(tally.lost)} |"
            )
        lost = sum(len(tally.lost) for tally in self.tallies.values())
        return [*rows, f"| all | {' | '.join(str(total[c]) for c in columns)} | {lost} |"]

    @property
    def kills(self) -> int:
        """Return a progress line."""
        return sum(tally.counts["kills"] for tally in self.tallies.values())


def can_mount(folder: Path) -> bool:
    """Return whether a small disk can be mounted."""
    if shutil.which("mount") is None or os.geteuid() != 0:
        return False
    disk = folder / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", disk]
    done = subprocess.run(mount, check=False, capture_output=True).returncode == 0
    if done:
        subprocess.run(["umount", disk], check=True)
    disk.rmdir()
    return done


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", default=",".join(JOBS))
    given = parser.parse_args()
    torch.set_num_threads(1)
    dice = random.Random(given.seed)
    start = time.perf_counter()
    jobs = [job for job in JOBS if job in given.jobs.split(",")]
    with tempfile.TemporaryDirectory(prefix="soak.") as name:
        os.chdir(name)
        soak = Soak(Path(name), jobs, dice)
        limits = ["disk" if can_mount(Path(name)) else "file size"]
        if limits == ["file size"]:
            print(
                "no tmpfs can be mounted here: a limit on the size of files stands for the full disk"
            )
        if Path("/proc/self/statm").exists():
            limits.append("memory")
        number = 0
        while soak.kills < given.kills and time.perf_counter() - start < 60 * given.minutes:
            job = jobs[number % len(jobs)]
            if number % 20 == 19:
                print(
                    f"{soak.kills} kills in {(time.perf_counter() - start) / 60:.1f} minutes",
                    flush=True,
                )
            soak.kill_round(job, min(dice.randint(1, 5), given.kills - soak.kills))
            if number // len(jobs) % 4 == 3 or number < len(jobs):
                soak.limit_round(job, limits[number % len(limits)])
                if "train" in JOBS[job]:
                    soak.pair_round(job)
            number += 1
        os.chdir("/")
    print("\n".join(soak.rows()))
    lost = [problem for tally in soak.tallies.values() for problem in tally.lost]
    print(
        f"{soak.kills} kills in {(time.perf_counter() - start) / 60:.1f} minutes, {len(lost)} lost"
    )
    for problem in lost[:50]:
        print(f"lost: {problem}")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
