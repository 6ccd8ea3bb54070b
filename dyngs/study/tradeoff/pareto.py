"""The PSNR cost of each setting per factor of two, and combinations worth measuring."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dyngs.study.tradeoff.measure import Measurement
from dyngs.study.tradeoff.variants import SEVERAL, Variant

MIN_DOUBLINGS = 0.05
"""Smaller gains (3.5 %) count as none."""
MAX_LOSS_DB = 6.0
"""A single change that loses more is not combined with others."""


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


def rate(loss: float, factor: float) -> float | None:
    """Return dB lost per factor 2; None if less than 3.5 % is gained."""
    doublings = math.log2(factor)
    return None if doublings < MIN_DOUBLINGS else loss / doublings


def slope(losses_and_factors: Iterable[tuple[float, float]]) -> float | None:
    """Return dB lost per factor 2: the least-squares line through no loss at factor 1; None if
    nothing is gained."""
    pairs = [
        (loss, math.log2(factor))
        for loss, factor in losses_and_factors
        if math.log2(factor) >= MIN_DOUBLINGS
    ]
    return sum(loss * x for loss, x in pairs) / sum(x * x for _, x in pairs) if pairs else None


def exchange_rates(base: Measurement, measurements: Iterable[Measurement]) -> list[ExchangeRate]:
    """Return the exchange rate of each setting, from the variants that change it alone, in order of
    appearance."""
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
    sequences: list[list[tuple[float, Measurement]]] = [[], [], []]
    for m in singles:
        loss = base.psnr - m.psnr
        smaller = base.mb / m.mb
        if loss > MAX_LOSS_DB:
            continue
        for sequence, gain in zip(sequences, (m.gain, smaller, m.gain * smaller), strict=True):
            cost = rate(loss, gain)
            if cost is not None:
                sequence.append((cost, m))
    order = [m.variant for m in singles]
    known = {base.variant, *order}
    found: dict[Variant, None] = {}
    for sequence in sequences:
        sequence.sort(key=lambda pair: (pair[0], pair[1].variant.slug))
        for variant in _accumulated(base.variant, [m.variant for _, m in sequence], order)[:count]:
            if variant not in known:
                found[variant] = None
    return list(found)


def _accumulated(
    start: Variant, changes: Iterable[Variant], order: Sequence[Variant]
) -> list[Variant]:
    """Return combinations of two and more changes, each with one change more than the one
    before."""
    steps = []
    now = start
    strongest: dict[str, int] = {}
    for change in changes:
        (setting,), strength = change.settings, order.index(change)
        if strength > strongest.get(setting, -1):
            now = now.merged(change)
            strongest[setting] = strength
            if len(now.settings) > 1:
                steps.append(now)
    return steps
