"""A comparison from its models to its results; after a kill the same call goes on."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress

from dyngs.api.train import num_cores
from dyngs.core.errors import DyngsError
from dyngs.ops.native import kernel_threads
from dyngs.study.compare.plan import Bench, Plan
from dyngs.study.compare.result import Measured, Result
from dyngs.study.runs import done_in_turn
from dyngs.study.speed import time_interleaved
from dyngs.study.stored import require_same_study

STUDY_NAME = "comparison.json"
TIMED_VIEWS, ROUNDS = 4, 3


def require_same_comparison(bench: Bench, plan: Plan) -> None:
    """Note what is compared in the folder, or raise DyngsError where something else is compared
    there."""
    limit = bench.limit
    facts = {
        "capture": str(bench.capture),
        "models": sorted([*(entry.name for entry in plan.entries), *plan.left_out]),
        "minutes": limit.minutes,
        "steps": limit.steps,
        "max_mb": limit.max_mb,
        "split": bench.split,
        "overrides": list(bench.overrides),
        "views": bench.num_shown,
        "device": bench.device,
        "threads": bench.threads,
        "settings": {entry.name: _digest(entry.config.model_dump_json()) for entry in plan.entries},
    }
    require_same_study(bench.out / STUDY_NAME, facts, [key for key in facts if key != "settings"])
    require_same_study(bench.out / STUDY_NAME, facts, ["settings"])


def is_finished(bench: Bench, plan: Plan) -> bool:
    """Return whether every model is measured that takes part."""
    return all(bench.result_path(entry.name).is_file() for entry in plan.entries)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def compare(
    bench: Bench, plan: Plan, say: Callable[[str], None], ray_cores: int | None = None
) -> tuple[list[Result], dict[str, str]]:
    """Return the results in the order of the models, and why others are left out; each is kept once
    it is there.

    ``say`` is told a line per model that is trained now.

    Raises:
        DyngsError: no model could be trained.
    """
    measured = Measured(bench)
    left_out = dict(plan.left_out)
    known = [entry for entry in plan.entries if bench.result_path(entry.name).is_file()]
    missing = [entry for entry in plan.entries if entry not in known]
    found = {entry.name: measured(entry) for entry in known}
    for number, (entry, result) in enumerate(
        done_in_turn(measured, missing, ray_cores), len(known) + 1
    ):
        place = f"{number} of {len(plan.entries)}"
        if isinstance(result, DyngsError):
            left_out[entry.name] = str(result)
            say(f"{entry.name} ({place}): left out: {result}")
            continue
        found[entry.name] = result
        say(
            f"{entry.name} ({place}): {result.psnr:.2f} dB, {result.steps:,} steps in {result.seconds:.0f} s"
        )
    if not found:
        _leave_nothing(bench, plan)
        name, problem = next(iter(left_out.items()))
        raise DyngsError(f"no model could be trained; {name}: {problem}")
    results = [found[entry.name] for entry in plan.entries if entry.name in found]
    return _timed(measured, results), left_out


def _leave_nothing(bench: Bench, plan: Plan) -> None:
    """Remove what a comparison that came to nothing has noted, so that another one can begin in its
    folder."""
    for path in (bench.out / STUDY_NAME, *(bench.said_path(entry.name) for entry in plan.entries)):
        path.unlink(missing_ok=True)
    for folder in (bench.out / "said", bench.out / "runs"):
        with suppress(OSError):  # it holds a run that began
            folder.rmdir()


def _timed(measured: Measured, results: list[Result]) -> list[Result]:
    """Return the results with the speeds of all models, measured in turn unless they are known."""
    if all(result.speed is not None for result in results):
        return results
    with kernel_threads(measured.bench.threads or num_cores()):
        shown = [measured.drawing(result.name, TIMED_VIEWS) for result in results]
        speeds = time_interleaved([drawing for drawing, _ in shown], shown[0][1], ROUNDS)
    return [
        measured.write_speed(result, speed) for result, speed in zip(results, speeds, strict=True)
    ]
