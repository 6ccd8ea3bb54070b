"""A setting that may pay or not, and that two small runs of the same length decide about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from dyngs.config import Config
from dyngs.kinds import GaussianTrainer

Choice = Literal["never", "always"]


@dataclass(frozen=True)
class Evidence:
    """What a small run without a setting says about it.

    Attributes:
        is_worth: a second small run, with it, is worth its time.
        text: what was found, for a line; empty: nothing to say.
    """

    is_worth: bool
    text: str = ""


@dataclass(frozen=True)
class Comparison:
    """Two small runs on the views held out.

    Attributes:
        scores: PSNR, dB, of each view by the run without a setting and by that with it: decide whether it pays.
        objection: why it is not taken even if those scores gain; empty: nothing speaks against it.
    """

    scores: list[tuple[float, float]]
    objection: str = ""


def no_evidence(plain: GaussianTrainer) -> Evidence:
    """Return that nothing can be said without a second run."""
    return Evidence(True)


@dataclass(frozen=True)
class Candidate:
    """A setting that is taken where held-out training views gain.

    Attributes:
        key: as on the command line, ``train.robust``.
        does: says in a line what a run with it does, "without what disagrees between views".
        asked: whether a configuration wants this to be found out (``auto``), for its kind of model.
        decided: returns a configuration with the setting on or off.
        compared: compares the small run without it with that with it, on the views held out.
        clear_gain: mean gain, dB, that it must bring at least.
        evidence: looks at the small run without it.
    """

    key: str
    does: str
    asked: Callable[[Config], bool]
    decided: Callable[[Config, Choice], Config]
    compared: Callable[[GaussianTrainer, GaussianTrainer], Comparison]
    clear_gain: float
    evidence: Callable[[GaussianTrainer], Evidence] = no_evidence
