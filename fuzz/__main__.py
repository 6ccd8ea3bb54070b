"""``python -m fuzz READER --minutes N``: fuzz readers, print one line for each, keep failures in
the corpus."""

from __future__ import annotations

import argparse
import json
import sys
from importlib.util import find_spec
from pathlib import Path

from fuzz.campaign import (
    CORPUS,
    Tally,
    campaign,
    cpu_seconds,
    keep,
    run_cases,
    seeds_of,
    stored_cases,
)
from fuzz.readers import READERS
from fuzz.verdict import Outcome, Verdict
from fuzz.worker import Limits, import_everything


def main() -> int:
    """Run the command line; return 0 if nothing failed, else 1."""
    arguments = _parser().parse_args()
    names = list(READERS) if "all" in arguments.readers else arguments.readers
    import_everything()
    result = {}
    for name in names:
        needed = READERS[name].needs
        if needed is not None and find_spec(needed) is None:
            print(f"{name:<16} not tried, needs {needed}", flush=True)
            continue
        tally = replayed(name) if arguments.replay else _tried(name, arguments, len(names))
        result[name] = _as_json(tally)
        print(tally.line, flush=True)
        _explain(tally, arguments.verbose)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1))
    return 1 if any(own["failures"] for own in result.values()) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument(
        "readers",
        nargs="+",
        choices=[*READERS, "all"],
        metavar="READER",
        help="or all: " + ", ".join(READERS),
    )
    parser.add_argument(
        "--minutes", type=float, default=60.0, metavar="N", help="all readers together (default 60)"
    )
    parser.add_argument(
        "--inputs", type=int, default=10**9, metavar="N", help="at most so many for each reader"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="S", help="of the changes (default 0)"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=5.0,
        metavar="N",
        help="of processor time for a case (default 5)",
    )
    parser.add_argument("--replay", action="store_true", help="only the corpus")
    parser.add_argument(
        "--no-keep", dest="keep", action="store_false", help="leave the corpus as it is"
    )
    parser.add_argument("--verbose", action="store_true", help="say where failures come from")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write counts and failures there")
    return parser


def _tried(name: str, arguments: argparse.Namespace, count: int) -> Tally:
    limits = Limits(seconds=arguments.seconds)
    tally = campaign(name, arguments.seed, arguments.inputs, 60 * arguments.minutes / count, limits)
    if arguments.keep and tally.failures:
        keep(tally, set(replayed(name).failures))
    return tally


def replayed(name: str) -> Tally:
    """Return the outcomes of the stored cases of a reader."""
    import tempfile
    import time

    reader = READERS[name]
    tally = Tally(name)
    begin = time.monotonic()
    before = cpu_seconds()
    left = list(enumerate(stored_cases(name, seeds_of(reader)).items()))
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        while left:
            numbered = iter([(i, case) for i, (_, case) in left])
            done = -1
            for i, verdict in run_cases(reader, numbered, Path(folder), Limits(), begin + 3600):
                done = left[0][0] if i is None else i
                tally.outcomes[verdict.outcome] += 1
                if verdict.outcome is Outcome.FAILED:
                    file, case = dict(left)[done]
                    named = Verdict(
                        verdict.outcome,
                        verdict.reason,
                        f"{CORPUS.name}/{name}/{file}: {verdict.detail}",
                    )
                    tally.failures.setdefault(verdict.reason, []).append((case, named))
            left = [pair for pair in left if pair[0] > done]
    tally.seconds = cpu_seconds() - before
    return tally


def _as_json(tally: Tally) -> dict[str, object]:
    failures = {
        reason: [verdict.detail for _, verdict in found] for reason, found in tally.failures.items()
    }
    return {
        "inputs": tally.inputs,
        **{o.value: tally.outcomes[o] for o in Outcome},
        "failures": failures,
    }


def _explain(tally: Tally, verbose: bool) -> None:
    for reason, found in sorted(tally.failures.items(), key=lambda pair: -len(pair[1])):
        print(f"    {len(found):>6} x {reason}", flush=True)
        if verbose:
            case, verdict = found[0]
            print(f"           {', '.join(case.steps)}\n{verdict.detail}", flush=True)
    for path in tally.kept:
        print(f"           kept {path.relative_to(CORPUS.parent.parent)}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
