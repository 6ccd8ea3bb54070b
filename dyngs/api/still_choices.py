"""Settings that are found out by small, short runs of a static scene, compared on training views that are held out.

All settings share one small run without any of them. Each is compared with the best of those before it, and a setting
of which that first run says that it cannot pay gets no run of its own.
"""

from __future__ import annotations

import time
from statistics import fmean

from dyngs.api import camera_choice, exposure_choice, robust_choice
from dyngs.api.candidate import Candidate
from dyngs.api.small_runs import FEWEST_VIEWS, hold_out_every, is_gain, trained
from dyngs.config import Config, DynamicModel
from dyngs.config.still import as_still
from dyngs.data.read import read_capture
from dyngs.kinds import GaussianTrainer

STEPS, FRACTION, FEWEST_STEPS = 1500, 0.2, 400
"""Steps of each small run; at most this fraction of the run's own. With fewer steps than these it says nothing."""
CANDIDATES: tuple[Candidate, ...] = (camera_choice.CANDIDATE, exposure_choice.CANDIDATE, robust_choice.CANDIDATE)


def decided(config: Config) -> Config:
    """Return ``config`` with all ``auto`` settings decided that small static runs decide; lines say what was found.

    A moving scene is stood in for by a still one.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    asked = [candidate for candidate in CANDIDATES if candidate.asked(config)]
    if not asked:
        return config
    best = config
    for candidate in asked:
        best = candidate.decided(best, "never")
    views, steps = read_capture(config.data).splits["train"], min(STEPS, int(FRACTION * config.train.steps))
    if config.train.minutes is not None or steps < FEWEST_STEPS or len(views) < FEWEST_VIEWS:
        keys = ", ".join(f"{candidate.key}=auto" for candidate in asked)
        print(f"{keys}: too short a run, or too few views, to find out whether it pays; not used", flush=True)
        return best
    every = hold_out_every(views)
    print(f"small runs of {steps:,} steps, compared on training views that are held out:", flush=True)
    plain = _trained(best, every, steps)
    for candidate in asked:
        found = _tried(candidate, best, plain, every, steps)
        if found is not None:
            best, plain = found
    return best


def _tried(
    candidate: Candidate, config: Config, plain: GaussianTrainer, every: int, steps: int
) -> tuple[Config, GaussianTrainer] | None:
    """Return the configuration with a setting and its small run, None where it does not pay; a line says why."""
    begun, evidence = time.monotonic(), candidate.evidence(plain)
    if not evidence.is_worth:
        print(f"  {evidence.text}: {candidate.key} not taken", flush=True)
        return None
    changed = candidate.decided(config, "always")
    other = _trained(changed, every, steps)
    found = candidate.compared(plain, other)
    gains = [b - a for a, b in found.scores]
    pays = is_gain(gains) and fmean(gains) >= candidate.clear_gain and not found.objection
    before, after = (fmean(x) for x in zip(*found.scores, strict=True))
    said = (evidence.text, f"{len(gains)} views: {before:.2f} dB as it is, {after:.2f} dB {candidate.does}")
    verdict = f"{candidate.key} {'taken' if pays else 'not taken'} ({time.monotonic() - begun:.0f} s)"
    print(f"  {'; '.join(text for text in (*said, found.objection) if text)}: {verdict}", flush=True)
    return (changed, other) if pays else None


def _trained(config: Config, every: int, steps: int) -> GaussianTrainer:
    match config.model:
        case DynamicModel():
            return trained(as_still(config), every, steps)
        case _:
            return trained(config, every, steps)
