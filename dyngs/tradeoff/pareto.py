"""Which points no other beats, what each knob costs per factor of two, and what to put together next."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dyngs.tradeoff.measurements import Measurement
from dyngs.tradeoff.variants import SEVERAL, Variant

NO_GAIN = 0.05
"""Doublings below which nothing counts as gained: 3.5 %."""
TOO_MUCH_DB = 6.0
"""A single change that loses more is not put together with others."""


@dataclass(frozen=True)
class ExchangeRate:
    """What one knob costs and brings.

    Attributes:
        knob: its name, "prune + finetune" where fine-tuned, "storage + field_step".
        db_per_speed, db_per_size: PSNR lost per doubling of the speed, and per halving of the size; None where no value
            of the knob brings any. Negative: it brings both.
        speed, size: the most that a value brings, as factors.
    """

    knob: str
    db_per_speed: float | None
    db_per_size: float | None
    speed: float
    size: float


def pareto_mask(goals: Sequence[Sequence[float]]) -> list[bool]:
    """Whether each of some points is beaten by none: no other is as good in all goals and better in one.

    Args:
        goals: per point, all to be as large as possible.
    """
    return [not any(_beats(other, own) for other in goals) for own in goals]


def on_front(points: Sequence[Measurement]) -> list[bool]:
    """Whether each is beaten by none in PSNR, speed and size together."""
    return pareto_mask([(p.psnr, p.gain, -p.mb) for p in points])


def rate(loss: float, factor: float) -> float | None:
    """dB lost per factor 2; None where less than 3.5 % is gained."""
    doublings = math.log2(factor)
    return None if doublings < NO_GAIN else loss / doublings


def slope(losses_and_factors: Iterable[tuple[float, float]]) -> float | None:
    """dB lost per factor 2, the least-squares line through no loss at factor 1; None where nothing is gained."""
    pairs = [(loss, math.log2(factor)) for loss, factor in losses_and_factors if math.log2(factor) >= NO_GAIN]
    return sum(loss * x for loss, x in pairs) / sum(x * x for _, x in pairs) if pairs else None


def exchange_rates(base: Measurement, points: Iterable[Measurement]) -> list[ExchangeRate]:
    """For each knob what it costs and brings, from the points that turn it alone; in the order of their first points.

    Args:
        base: the run itself.
        points: any.
    """
    groups: dict[str, list[Measurement]] = {}
    for point in points:
        if point.variant.knob not in ("", SEVERAL):
            groups.setdefault(point.variant.knob, []).append(point)
    return [
        ExchangeRate(
            knob=knob,
            db_per_speed=slope((base.psnr - p.psnr, p.gain) for p in group),
            db_per_size=slope((base.psnr - p.psnr, base.mb / p.mb) for p in group),
            speed=max(p.gain for p in group),
            size=max(base.mb / p.mb for p in group),
        )
        for knob, group in groups.items()
    ]


def combinations(base: Measurement, singles: Sequence[Measurement], count: int) -> list[Variant]:
    """Variants worth measuring next: single changes put together, the cheapest first.

    Three ways are gone from the run on: for speed, for size, and for both. Each adds the change that loses least PSNR
    per factor 2, then the next; a stronger value of a knob takes the place of a weaker one. Ways end after ``count``
    steps.

    Args:
        base: the run itself.
        singles: points that turn one knob each; of one knob the stronger values come later.
        count: steps of each way.
    """
    ways: list[list[tuple[float, Measurement]]] = [[], [], []]
    for point in singles:
        loss, smaller = base.psnr - point.psnr, base.mb / point.mb
        if loss > TOO_MUCH_DB:
            continue
        for way, gain in zip(ways, (point.gain, smaller, point.gain * smaller), strict=True):
            price = rate(loss, gain)
            if price is not None:
                way.append((price, point))
    order = [point.variant for point in singles]
    known = {base.variant, *order}
    found: dict[Variant, None] = {}
    for way in ways:
        way.sort(key=lambda priced: (priced[0], priced[1].variant.slug))
        for variant in _way(base.variant, [point.variant for _, point in way], order)[:count]:
            if variant not in known:
                found[variant] = None
    return list(found)


def _way(start: Variant, changes: Iterable[Variant], order: Sequence[Variant]) -> list[Variant]:
    """Combinations of two changes and more, each with one more than that before."""
    steps, now = [], start
    strongest: dict[str, int] = {}
    for change in changes:
        (knob,), strength = change.knobs, order.index(change)
        if strength > strongest.get(knob, -1):
            now, strongest[knob] = now.merged(change), strength
            if len(now.knobs) > 1:
                steps.append(now)
    return steps


def _beats(a: Sequence[float], b: Sequence[float]) -> bool:
    return all(x >= y for x, y in zip(a, b, strict=True)) and any(x > y for x, y in zip(a, b, strict=True))
