"""`dyngs tradeoff` of many runs in parallel, on this machine or on a Ray cluster with a shared file
system.

    pip install 'dyngs[ray]'
    python examples/tradeoff_ray.py runs/* --cpus 4 -- --vary prune=0.5,0.8 --vary storage
    RAY_ADDRESS=auto python examples/tradeoff_ray.py ...        on a running cluster

Arguments after `--` are passed to every `dyngs tradeoff`. Each writes RUN/tradeoff and continues
there when restarted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from functools import partial
from pathlib import Path

from dyngs.study.runs import run_tasks


def measured(words: list[str], run: str) -> tuple[int, str]:
    """Return the exit code of the sweep of a run, and its last line of output."""
    command = [sys.executable, "-m", "dyngs", "tradeoff", run, *words]
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return done.returncode, (done.stdout.strip().splitlines() or [""])[-1]


def main() -> int:
    """Run all sweeps; return 1 if any failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument(
        "--cpus", type=int, default=1, help="threads of each, and cores that Ray sets aside for it"
    )
    split = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    arguments = parser.parse_args(sys.argv[1:split])
    words = [*sys.argv[split + 1 :]]
    words += ["--threads", str(arguments.cpus)]
    runs = [str(run.absolute()) for run in arguments.runs]
    failed = False
    for run, result in run_tasks(partial(measured, words), runs, arguments.cpus):
        code, said = result if isinstance(result, tuple) else (2, str(result))
        failed |= code != 0
        print(f"{run}: {said}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
