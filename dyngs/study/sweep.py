"""A run and its variants, measured: one setting at a time, then combinations; what each setting
costs, and the variant that meets requirements (``psnr>=30,mb<=5``)."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, printable, show
from dyngs.ops.device import device_for
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.runs.folder import inputs_of
from dyngs.study.measure import Bench, Measurement, Subject
from dyngs.study.runs import done_in_turn, require_same_study
from dyngs.study.variants import (
    SEVERAL,
    Variant,
    VariantRuns,
    Varied,
    is_change,
    run_settings,
    single_changes,
)

MIN_DOUBLINGS = 0.05
"""Smaller gains (3.5 %) count as none."""
MAX_LOSS_DB = 6.0
"""A single change that loses more is not combined with others."""
METRICS = ("psnr", "ssim", "lpips", "fps", "mb", "memory_mb", "gaussians")
"""Columns that a requirement or a goal may name."""
_CONDITION = re.compile(r"\s*([a-z_]+)\s*(>=|<=)\s*(\S+)\s*$")
Row = dict[str, Any]


@dataclass(frozen=True)
class Plan:
    """The measurements to take.

    Attributes:
        finetune: training steps after pruning and masking, for additional variants; 0: none.
        combine: combinations in each of three directions, see ``combinations``.
        rounds: renders of each timed view.
        ray_cores: of each variant that Ray makes and measures; None: all is done here.
    """

    settings: tuple[Varied, ...]
    finetune: int = 0
    combine: int = 4
    split: str = "test"
    rounds: int = 5
    ray_cores: int | None = None
    has_memory: bool = True


def sweep(runs: VariantRuns, plan: Plan) -> list[Measurement]:
    """Return the measurements of all variants, the run itself first.

    Each is kept as a file in ``runs.out / "points"`` and not made again.

    Raises:
        DyngsError: no such run or split, or the folder holds measurements of another run.
    """
    load_resolved(runs.run_dir)  # what is no run is refused before anything else
    inputs_of(runs.run_dir).require_output(runs.out)
    own = run_settings(runs.run_dir)  # refuses what cannot be varied before anything is written
    bench = Bench(
        runs.out,
        runs.folder_of,
        plan.split,
        runs.threads,
        runs.device,
        rounds=plan.rounds,
        has_memory=plan.has_memory,
    )
    bench.require_views(runs.run_dir)
    newest = checkpoint_paths(runs.run_dir)[-1]
    source = {
        "run": str(runs.run_dir.absolute()),
        "checkpoint": newest.name,
        "sha256": hashlib.sha256(newest.read_bytes()).hexdigest(),
        "split": plan.split,
        "device": device_for(runs.device).type,
    }
    require_same_study(runs.out, source, ("sha256", "split", "device"))
    idle = [s.name for s in plan.settings if not any(is_change(own, s, x) for x in s.values)]
    if idle:
        show(f"nothing to vary in this run: {', '.join(idle)}")

    def measured(variants: Sequence[Variant], ray_cores: int | None) -> list[Measurement]:
        subjects = [Subject(v.name, v.slug, runs.run_dir, v) for v in variants]
        missing = [subject for subject in subjects if not bench.point(subject.slug).is_file()]
        for subject, found in done_in_turn(bench.measured, missing, ray_cores):
            if isinstance(found, DyngsError):
                raise found
            show(f"{subject.name}: {found.psnr:.2f} dB, {found.mb:.2f} MB")
        return bench.with_speeds(subjects)

    singles = [Variant(), *single_changes(plan.settings, own, plan.finetune)]
    found = measured(singles, plan.ray_cores)
    # combinations share folders, so these are made one after another
    return measured([*singles, *combinations(found[0], found[1:], plan.combine)], None)


def pareto_mask(goals: Sequence[Sequence[float]]) -> list[bool]:
    """Return which points are on the Pareto front: no other is as good in all goals and better in
    one."""

    def dominates(a: Sequence[float], b: Sequence[float]) -> bool:
        return a != b and all(x >= y for x, y in zip(a, b, strict=True))

    return [not any(dominates(other, own) for other in goals) for own in goals]


def table_rows(measurements: Sequence[Measurement]) -> list[Row]:
    """Return a row per measurement, by column. ``fps`` is that of the first one times the gain, so
    that scenes timed at another hour compare; ``on_front``: on the Pareto front of PSNR, speed and
    size."""
    base = measurements[0].speed
    fps = 0.0 if base is None else 1e3 / base.ms.median
    front = pareto_mask([(m.psnr, m.gain, -m.mb) for m in measurements])
    rows = []
    for m, on_front in zip(measurements, front, strict=True):
        speed = m.speed
        row: Row = {
            "name": m.name,
            "psnr": m.psnr,
            "ssim": m.ssim,
            "lpips": m.lpips,
            "psnr_foreground": m.psnr_foreground,
            "psnr_moving": m.psnr_moving,
            "fps": fps * m.gain,
            "gain": m.gain,
            "gain_low": None if speed is None else speed.gain.low,
            "gain_high": None if speed is None else speed.gain.high,
            "ms": None if speed is None else speed.ms.median,
            "mb": m.mb,
            "memory_mb": m.memory_mb,
            "gaussians": m.gaussians,
            "steps": m.steps,
            "seconds": m.seconds,
            "on_front": on_front,
        }
        rows.append(row)
    return rows


# The cost of each setting, and combinations worth measuring


@dataclass(frozen=True)
class ExchangeRate:
    """PSNR lost per gain in speed and size by one setting.

    Attributes:
        setting: its name, "prune + finetune" if fine-tuned, "storage + field_step".
        db_per_speed, db_per_size: PSNR lost per doubled speed and per halved size; None where no
            value of the setting gains any. Negative: quality improves as well.
        speed, size: largest gains of its values, as factors.
    """

    setting: str
    db_per_speed: float | None
    db_per_size: float | None
    speed: float
    size: float


def slope(losses_and_factors: Iterable[tuple[float, float]]) -> float | None:
    """Return dB lost per factor 2: the least-squares line through no loss at factor 1; None if
    less than 3.5 % is gained."""
    pairs = [(loss, math.log2(factor)) for loss, factor in losses_and_factors]
    pairs = [(loss, doublings) for loss, doublings in pairs if doublings >= MIN_DOUBLINGS]
    return sum(loss * x for loss, x in pairs) / sum(x * x for _, x in pairs) if pairs else None


def exchange_rates(measurements: Sequence[Measurement]) -> list[ExchangeRate]:
    """Return the exchange rate of each setting, from the variants that change it alone, in order of
    appearance."""
    base = measurements[0]
    groups: dict[str, list[Measurement]] = {}
    for m in measurements:
        if m.variant.setting not in ("", SEVERAL):
            groups.setdefault(m.variant.setting, []).append(m)
    return [
        ExchangeRate(
            setting=setting,
            db_per_speed=slope((base.psnr - m.psnr, m.gain) for m in group),
            db_per_size=slope((base.psnr - m.psnr, base.mb / m.mb) for m in group),
            speed=max(m.gain for m in group),
            size=max(base.mb / m.mb for m in group),
        )
        for setting, group in groups.items()
    ]


def combinations(base: Measurement, singles: Sequence[Measurement], count: int) -> list[Variant]:
    """Return combinations of single changes worth measuring next.

    There are three greedy sequences, of ``count`` each: for speed, for size, and for both. Each
    starts at the run and adds the change that loses the least PSNR per factor 2, then the next; a
    stronger value of a setting, which comes later in ``singles``, replaces a weaker one.
    """
    known = {base.variant, *(m.variant for m in singles)}
    found: dict[Variant, None] = {}
    for gain_of in (
        lambda m: m.gain,
        lambda m: base.mb / m.mb,
        lambda m: m.gain * base.mb / m.mb,
    ):
        costs = []
        for strength, m in enumerate(singles):
            loss = base.psnr - m.psnr
            cost = slope([(loss, gain_of(m))])
            if loss <= MAX_LOSS_DB and cost is not None:
                costs.append((cost, m.slug, strength, m.variant))
        now = base.variant
        strongest: dict[str, int] = {}
        steps = []
        for _, _, strength, change in sorted(costs, key=lambda item: item[:2]):
            (setting,) = change.settings
            if strength > strongest.get(setting, -1):
                now = now.merged(change)
                strongest[setting] = strength
                if len(now.settings) > 1:
                    steps.append(now)
        found |= dict.fromkeys(variant for variant in steps[:count] if variant not in known)
    return list(found)


# The best variant that meets requirements


@dataclass(frozen=True)
class Requirement:
    """``name >= bound``, or ``name <= bound`` if ``at_most``; as a goal: the more, or the less, the
    better."""

    name: str
    at_most: bool
    bound: float = math.nan

    def __str__(self) -> str:
        return f"{self.name}{'<=' if self.at_most else '>='}{self.bound:g}"

    def is_met(self, row: Row) -> bool:
        """Whether the metric was measured and meets the bound."""
        value = row[self.name]
        return value is not None and (value <= self.bound if self.at_most else value >= self.bound)

    def cost(self, row: Row) -> float:
        """Return a value that is smaller for better rows, infinite where the metric was not
        measured."""
        value = row[self.name]
        if value is None:
            return math.inf
        return value if self.at_most else -value


def parse_requirements(text: str) -> tuple[Requirement, ...]:
    """Return the conditions of a list such as ``psnr>=30,fps>=20,mb<=5``."""
    found = []
    for part in text.split(","):
        match = _CONDITION.match(part)
        shown = printable(part.strip(), 60)
        if match is None:
            raise DyngsError(
                f"--require {shown!r} is no condition; write for instance psnr>=30,fps>=20,mb<=5"
            )
        name, sign, number = match.groups()
        _require_metric(name, f"--require {shown}")
        try:
            bound = float(number)
        except ValueError:
            bound = math.nan
        if not math.isfinite(bound):
            raise DyngsError(f"--require {shown}: {printable(number, 30)!r} is not a number")
        found.append(Requirement(name, sign == "<=", bound))
    return tuple(found)


def parse_goal(name: str, *, smallest: bool) -> Requirement:
    """Return the goal of ``--minimize`` or ``--maximize``."""
    _require_metric(name, f"--{'minimize' if smallest else 'maximize'} {name}")
    return Requirement(name, smallest)


def _require_metric(name: str, option: str) -> None:
    if name not in METRICS:
        raise DyngsError(f"{option}: no such metric; there are {', '.join(METRICS)}")


def choose(rows: Sequence[Row], requirements: Sequence[Requirement], goal: Requirement) -> int:
    """Return the number of the best row among those that meet all requirements; of equally good
    ones that with the higher PSNR."""
    fitting = [row for row in rows if all(r.is_met(row) for r in requirements)]
    if fitting:
        best = min(fitting, key=lambda row: (goal.cost(row), -row["psnr"], row["name"]))
        return next(i for i, row in enumerate(rows) if row is best)
    # the best value per requirement with the others met, or, if there is none, on its own
    relaxed = []
    for binding in requirements:
        others = [r for r in requirements if r is not binding]
        near = [
            row
            for row in rows
            if all(r.is_met(row) for r in others) and row[binding.name] is not None
        ]
        if near:
            best = min(near, key=lambda row: (binding.cost(row), goal.cost(row)))
            value = f"{best[binding.name]:.5g} ({best['name']})"
            relaxed.append(f"{binding} is too strict: with the others met the best is {value}")
    for r in () if relaxed else requirements:
        known = [row[r.name] for row in rows if row[r.name] is not None]
        best_known = f"the best is {(min if r.at_most else max)(known):.5g}" if known else ""
        relaxed.append(f"{r} alone: {best_known or 'not measured here'}")
    asked = ", ".join(map(str, requirements))
    raise DyngsError(f"no measured variant has {asked}; {'; '.join(relaxed)}")
