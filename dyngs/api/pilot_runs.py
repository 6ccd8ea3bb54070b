"""Pilot runs: settings of a moving scene that are tried in small, short runs, and taken where held-out views gain.

Light that changes wants colours that a network makes from direction and time, texture wants its motion looked for,
bodies want to stay rigid. No capture says which it is. Small runs do, though not always: what pays in small images
need not pay in large ones (docs/benchmarks.md). Settings that only begin faster (``model.time_window=1``) cannot be
asked so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

from dyngs.api.small_runs import held_out_scores, is_gain, trained
from dyngs.config import Config, ControlNodesField, DynamicModel, NetworkColour
from dyngs.config.io import load_config, packaged_preset
from dyngs.models.views import background_colour

FRACTION, FEWEST_STEPS = 0.25, 1000
"""A pilot run has at most this fraction of the run's steps; with fewer steps than these it says nothing."""


@dataclass(frozen=True)
class Choice:
    """A setting that may be better than the preset's.

    Attributes:
        text: the keys and their values, as on the command line.
        applied: returns a configuration with it; None where it means nothing, or something else was asked for.
    """

    text: str
    applied: Callable[[Config], Config | None]


def with_choices(config: Config, every: int, still: Sequence[float] | None) -> Config | None:
    """Return ``config`` with the settings that win their pilot run; None if motion loses against a static model.

    Each choice is compared with the best of those before it. A line says what was found.

    Args:
        config: of a moving scene.
        every: of how many training views one is held out.
        still: PSNR of a small static model on those views, dB; None: something certainly moves.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    steps = pilot_steps(config)
    if not steps:
        return config
    print(f"pilot runs of {steps:,} steps in small images, compared on training views that are held out:", flush=True)
    scores = _told("the settings as they are", _scores(config, every, steps))
    if still is not None and not is_gain([a - b for a, b in zip(scores, still, strict=True)]):
        _told("a static model, which is no worse", still)
        return None
    for choice in CHOICES:
        changed = choice.applied(config)
        if changed is None:
            continue
        after = _scores(changed, every, steps)
        is_better = is_gain([a - b for a, b in zip(after, scores, strict=True)])
        _told(f"{choice.text}, {'taken' if is_better else 'not taken'}", after)
        if is_better:
            config, scores = changed, after
    return config


def _told(what: str, scores: Sequence[float]) -> Sequence[float]:
    print(f"  {fmean(scores):.2f} dB: {what}", flush=True)
    return scores


def pilot_steps(config: Config) -> int:
    """Return the steps of each pilot run; 0: none, as none were asked for, or the run is too short for them."""
    match config.model:
        case DynamicModel() if config.train.minutes is None:
            steps = min(config.model.pilot_steps, int(FRACTION * config.train.steps))
            return steps if steps >= min(FEWEST_STEPS, config.model.pilot_steps) else 0
        case _:
            return 0


def _scores(config: Config, every: int, steps: int) -> list[float]:
    """Return the PSNR of the held-out views after a pilot run, dB."""
    trainer = trained(config, every, steps)
    background = background_colour(trainer.background)
    return held_out_scores(trainer.model.scene, trainer, background)


def _colour_network(config: Config) -> Config | None:
    return config.model_copy(update={"colour": NetworkColour()}) if config.colour == _usual(config).colour else None


def _moving_opacities(config: Config) -> Config | None:
    match config.model:
        case DynamicModel() as model if not model.deform.move_opacities:
            return _with_field(config, model, move_opacities=True)
        case _:
            return None


def _block_matching(config: Config) -> Config | None:
    match config.model:
        case DynamicModel(deform=ControlNodesField(block_matching=False)) as model:
            return _with_field(config, model, block_matching=True)
        case _:
            return None


def _rigid_groups(config: Config) -> Config | None:
    match config.model:
        case DynamicModel(deform=ControlNodesField(rigid_groups=False)) as model:
            return _with_field(config, model, rigid_groups=True)
        case _:
            return None


def _with_field(config: Config, model: DynamicModel, **changes: object) -> Config:
    deform = model.deform.model_copy(update=changes)
    return config.model_copy(update={"model": model.model_copy(update={"deform": deform})})


def _usual(config: Config) -> Config:
    """Return the preset ``dynamic``: what differs from it was asked for."""
    return load_config(packaged_preset("dynamic"), [f"data.root={config.data.root}"])


CHOICES = (
    Choice("model.deform.block_matching=true", _block_matching),
    Choice("colour.kind=network", _colour_network),
    Choice("model.deform.move_opacities=true", _moving_opacities),
    Choice("model.deform.rigid_groups=true", _rigid_groups),
)
