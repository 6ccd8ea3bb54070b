"""Decide before a run which settings pay, by short trainings scored on held-out training views.

A setting is taken if the mean gain over these views, pair by pair, is above twice its standard
error, motion above three times. The simpler side wins a tie, and wherever nothing could be
compared. The winner is trained in full, on all training views. Settings that the user has requested
are never compared.

- Motion: one static model is trained for a while, and then twice as long, with motion and without.
- Other settings: small runs of the same images, steps and cap on Gaussians differ in one setting.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev

from dyngs.api.budget.time import refitted
from dyngs.api.from_scene import first_of
from dyngs.api.pair_scores import PairScore, after_colour_fit, after_pose_fit, explained, plain
from dyngs.config import BudgetConfig, Config, NetworkColour, PruneConfig, ShColour
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.errors import DyngsError, counted
from dyngs.core.section import Section
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.data.smaller_images import view_size
from dyngs.data.times import evenly_spaced
from dyngs.deform.keys import DeformField, DynamicModel, FieldSection, FreeField
from dyngs.deform.still_error import cameras_in_place, differing_fraction
from dyngs.io.write import write_text
from dyngs.models.kind import HasGaussians, capability, kind_of, motion_begins_after
from dyngs.models.schedule import image_divisor
from dyngs.models.views import evaluation_background
from dyngs.runs.folder import CHOICES_NAME
from dyngs.static.keys import StaticModel
from dyngs.training.loop import Interrupts
from dyngs.training.new_trainer import GaussianTrainer, assemble, with_points

# Of small runs: longest side of the images, px, and most Gaussians
SMALL_SIDE, SMALL_GAUSSIANS = 128, 15_000
# Most steps of a small run; with fewer than the latter it says nothing
STEPS, FEWEST_STEPS = 2000, 1000
SPENT = 0.1  # Most of a run's work that small runs may take
# Work of a step next to its images, and of a Gaussian in it, in pixels
STEP_COST, GAUSSIAN_COST = 20_000, 2
FEWEST_VIEWS, FEW_VIEWS, HELD_OUT = 8, 24, 24
"""With fewer views nothing is compared; with fewer than the second, small runs are made twice, each
without a fourth of the views; otherwise about so many are held out."""
TRIAL_STEPS, TRIAL_SIDE, TRIAL_GAUSSIANS, TRIAL_RANDOM = 600, 96, 5000, 1000
"""Of the trial of motion: steps of each model, of which the first third is shared; longest side of
the images, px; most Gaussians; most random ones that motion begins with. In 300 steps the motion of
a turning head is not found yet."""
TRIAL_COST = 1.4
"""Work of the trial, in steps of a moving scene, for each of its steps: a step with motion costs
two without."""
TRIAL_SPENT = 0.25  # Most of a run's work, or of its ``train.minutes``, that the trial may take
FEWEST_MOVING = 1500
"""Steps from which motion is followed in time: in 500 a moving scene loses up to 0.6 dB to a static
model of it, in 3,000 it gains."""
LEAST_GAIN = 0.05  # Mean gain, dB, up to which two settings tie
ERRORS, ERRORS_OF_MOTION = 2.0, 3.0
"""Standard errors that a gain must exceed. The preset ``static`` learns faster than a model at rest
of the trial, so motion needs more: on photos of a cup that stands still it gained 1.13 dB (0.56),
and ended 1.3 dB below ``static``. On captures that move the gain was 3.5 errors or more."""
FREE_VIEWS, MANY_VIEWS = 3.0, 6.0
"""Views of each time by fixed cameras, in the mean, from which free primitives may be used for what
moves, and from which they are the first choice: before four cameras a cloth loses 0.9 dB by them,
before eight a room gains 4.7."""
EARLY = {"resolution_grows_from": 0.3, "resolution_full_at": 0.5}
"""Fractions of a run with free primitives at which its images grow."""
MIN_DIFFERING = 0.001
"""Fraction of the pixels of fixed cameras that differ from their median from which something
moves."""
LOOK_SIDE, LOOK_CAMERAS, LOOK_TIMES = 96, 8, 24
"""Of the look at fixed cameras: longest side of the images, px; most cameras, and images of
each."""


@dataclass(frozen=True)
class OpenSetting:
    """A setting that small runs decide about."""

    text: str
    applied: Callable[[Config], Config | None]
    score: PairScore = plain


@dataclass(frozen=True)
class Choice:
    """What small runs said about a setting."""

    setting: str
    views: int
    # without, gain: mean PSNR without it, and mean gain by it, dB
    without: float
    gain: float
    error: float  # standard error of the gain, dB
    steps: int
    seconds: float
    taken: bool  # whether the setting is used

    def __str__(self) -> str:
        return (
            f"{self.setting} {'taken' if self.taken else 'not taken'}: {self.gain:+.2f} dB (standard error "
            f"{self.error:.2f}) to {self.without:.2f} dB on {counted(self.views, 'view')} ({self.seconds:.0f} s)"
        )


def choose(config: Config, capture: Capture) -> tuple[Config, list[Choice], Capture]:
    """Resolve every setting that is left open, by short trainings, and print what they found.

    Returns the resolved config, the figures, and the capture with the points that the scene begins
    with.

    Raises:
        DyngsError: images that cannot be read, or a capture that this kind of model cannot be
            trained on.
        KeyboardInterrupt: during short trainings; nothing has been written.
    """
    problem = kind_of(config.model).refusal(capture)
    if problem is not None:
        raise DyngsError(f"{config.data.root}: {problem}")
    settings = _settings(config)
    model = config.model
    if not isinstance(model, DynamicModel) or not model.choose:
        return _compared(_without_auto(config), settings, capture)
    moves = _motion_of_fixed_cameras(capture, config)
    if moves is False:
        return choose(as_static(config), capture)
    views = _views_at_once(capture)
    moving = _with(_without_auto(config), "model", choose=False)
    if moves and views >= FREE_VIEWS:
        moving = _bounded(moving)
        if not model.deform.model_fields_set:
            moving, other = _what_moves(moving, model.deform, views >= MANY_VIEWS)
            settings.insert(0, other)
    choice = _trial_of_motion(moving, capture)
    if choice is None:
        print(
            "model.kind=dynamic not taken: too short a run, or too few views, to compare it with a static model; "
            "training a static scene (model.choose=false trains a moving one)",
            flush=True,
        )
        return choose(as_static(config), capture)
    if not choice.taken:
        still, choices, capture = choose(as_static(config), capture)
        return still, [choice, *choices], capture
    if moving.model.filter_3d and not model.filter_3d:
        print(
            f"fixed cameras, {views:.0f} at a time: nothing is drawn thinner than they show (model.filter_3d)",
            flush=True,
        )
    best, choices, capture = _compared(moving, settings, capture)
    return best, [choice, *choices], capture


def _trial_of_motion(config: Config, capture: Capture) -> Choice | None:
    """Compare ``config`` with the same model at rest; None where the run is too short, or has too
    few views.

    Both begin as one static model, and train on the same views in the same order. That compares
    motion alone: at the rates of the preset ``static``, a still model would win by its faster
    learning.
    """
    views = capture.splits["train"]
    folds = _held_out(views)
    small = _trial_config(config)
    work = len(folds) * TRIAL_COST * TRIAL_STEPS * _work_of_step(small, views[0])
    affordable = work / (TRIAL_SPENT * _work_of_step(config, views[0]))
    if not folds or config.train.steps < max(affordable, FEWEST_MOVING):
        return None
    capture = with_points(capture, config, quiet=True)
    given = 60 * (config.train.minutes or math.inf)
    begun = time.monotonic()
    pairs = list[tuple[float, float]]()
    for held_out in folds:
        both = _with_and_without_motion(small, capture, held_out, begun + TRIAL_SPENT * given)
        if both is None:
            return None
        pairs += [plain(*both, index) for index in sorted(held_out)]
    seconds = max(time.monotonic() - begun, 1e-6)
    steps_that_fit = (given - seconds) / seconds * work / _work_of_step(config, views[0])
    if steps_that_fit < FEWEST_MOVING:
        return None
    choice = _choice("model.kind=dynamic", pairs, TRIAL_STEPS, seconds, ERRORS_OF_MOTION)
    steps = counted(TRIAL_STEPS, "step")
    print(f"trial of {steps}, compared on training views that are held out:", flush=True)
    print(f"  {choice}", flush=True)
    return choice


def _with_and_without_motion(
    config: Config, capture: Capture, held_out: frozenset[int], deadline: float
) -> tuple[GaussianTrainer, GaussianTrainer] | None:
    """Return trainers without and with motion after the trial ``config``; None where it takes too
    long."""
    moving = assemble(config, capture, held_out=held_out)
    begins = motion_begins_after(config.model, config.train.steps) or 1
    if not _trained(moving, begins - 1, deadline):
        return None
    still = refitted(moving, _with(config, "model", motion_from=1.0))
    # In the last step of its schedule the model at rest would begin to move.
    both = still, moving
    return (
        both
        if all(_trained(trainer, config.train.steps - 1, deadline) for trainer in both)
        else None
    )


def _compared(
    config: Config, settings: Sequence[OpenSetting], capture: Capture
) -> tuple[Config, list[Choice], Capture]:
    """Return ``config`` with the settings that win small runs, all figures, and the prepared
    capture."""
    settings = [x for x in settings if x.applied(config) is not None]
    capture = with_points(capture, config)
    plan = _Plan.of(config, capture, len(settings)) if settings else None
    if plan is None or len(plan.folds) * plan.runs < 2:
        if settings:
            keys = ", ".join(x.text for x in settings)
            print(
                f"{keys} not taken: too short a run, or too few views, to compare held-out PSNR",
                flush=True,
            )
        return config, [], capture
    found, choices = _decided(config, settings[: plan.runs - 1], plan, capture)
    return found, choices, capture


def _decided(
    config: Config, settings: Sequence[OpenSetting], plan: _Plan, capture: Capture
) -> tuple[Config, list[Choice]]:
    """Return ``config`` with the settings that win, each tried on top of those before it, and all
    figures."""
    print(
        f"small runs of {counted(plan.steps, 'step')}, compared on training views that are held out:",
        flush=True,
    )
    runs = plan.trained(config, capture)
    found = list[Choice]()
    for setting in settings:
        changed = setting.applied(config)
        begun = time.monotonic()
        if changed is None:
            continue
        others = plan.trained(changed, capture)
        pairs = [
            setting.score(one, other, index)
            for one, other in zip(runs, others, strict=True)
            for index in sorted(one.held_out)
        ]
        found.append(_choice(setting.text, pairs, plan.steps, time.monotonic() - begun))
        print(f"  {found[-1]}", flush=True)
        if found[-1].taken:
            config, runs = changed, others
    return config, found


def _choice(
    text: str,
    pairs: Sequence[tuple[float, float]],
    steps: int,
    seconds: float,
    errors: float = ERRORS,
) -> Choice:
    gains = [after - before for before, after in pairs]
    gain = fmean(gains)
    error = (stdev(gains) if len(gains) > 1 else math.inf) / math.sqrt(len(gains))
    without = fmean(before for before, _ in pairs)
    return Choice(
        text,
        len(pairs),
        without,
        gain,
        error,
        steps,
        seconds,
        gain > max(errors * error, LEAST_GAIN),
    )


def write_choices(folder: Path, choices: Sequence[Choice]) -> None:
    """Write what small runs said into a run folder; nothing where there were none."""
    if not choices:
        return
    write_text(
        folder / CHOICES_NAME, json.dumps([asdict(choice) for choice in choices], indent=2) + "\n"
    )


def as_static(config: Config) -> Config:
    """Return ``config`` as a static scene, as the preset ``static`` trains it: only what was
    requested is kept.

    That includes ``train.steps``, where a static scene has such a key.
    """
    usual = load_config(packaged_preset("static"), [f"data.root={config.data.root}"])
    names = ("model", "init", "strategy", "optim", "train")
    return config.model_copy(
        update={name: _requested(getattr(config, name), getattr(usual, name)) for name in names}
    )


def _requested(given: Section, usual: Section) -> Section:
    """Return ``usual`` with what was requested in ``given``; of another kind of init or strategy,
    that."""
    keys = given.model_fields_set
    if (
        not isinstance(given, DynamicModel)
        and type(given) is not type(usual)
        and (not keys or "kind" in keys)
    ):
        usual = type(given)()
    known = type(usual).model_fields
    return usual.model_copy(
        update={key: getattr(given, key) for key in keys if key in known and key != "kind"}
    )


@dataclass(frozen=True)
class _Plan:
    """Small runs that keep within their part of a run's work."""

    # sets of the training views held out; small runs are made once for each
    folds: Sequence[frozenset[int]]
    steps: int
    runs: int  # number of configurations that can be tried
    # longest side of the images that the run itself begins with, px; small runs begin with no less
    first_side: float

    @staticmethod
    def of(config: Config, capture: Capture, num_settings: int) -> _Plan:
        """Return the plan for a run of ``config`` in which so many settings are open; later ones
        may be left out."""
        folds = _held_out(capture.splits["train"])
        view = capture.splits["train"][0]
        first = _longest_side(config, view) / config.train.initial_downscale
        if config.train.minutes is not None:
            return _Plan(folds, 0, 0, first)
        small = _small(config, 1000, first)
        spent = (
            SPENT * config.train.steps * _work_of_step(config, view) / _work_of_step(small, view)
        )
        for runs in range(1 + num_settings, 1, -1):
            steps = min(STEPS, int(spent / max(runs * len(folds), 1)))
            if steps >= FEWEST_STEPS:
                return _Plan(folds, steps, runs, first)
        return _Plan(folds, 0, 0, first)

    def trained(self, config: Config, capture: Capture) -> list[GaussianTrainer]:
        """Return the trainers of ``config`` after a small run for each fold."""
        return [
            _small_run(_small(config, self.steps, self.first_side), capture, held_out)
            for held_out in self.folds
        ]


def _small_run(config: Config, capture: Capture, held_out: frozenset[int]) -> GaussianTrainer:
    trainer = assemble(config, capture, held_out=held_out, first=first_of(config, capture))
    _trained(trainer, config.train.steps)
    return trainer


def _trained(trainer: GaussianTrainer, steps: int, deadline: float = math.inf) -> bool:
    """Train up to ``steps``, and return True; False where that takes until ``deadline``."""
    with Interrupts() as interrupts:
        while trainer.done < steps and time.monotonic() < deadline:
            if interrupts.requested:
                raise KeyboardInterrupt(
                    "stopped before training began: nothing is written, give the command again"
                )
            trainer.step()
    trainer.images.rest()
    return trainer.done >= steps


def _work_of_step(config: Config, view: View) -> float:
    width, height = view_size(view, config.data)
    times = range(0, config.train.steps, max(1, config.train.steps // 50))
    drawn = fmean(image_divisor(config.train, step) ** -2 for step in times)
    return (
        STEP_COST
        + width * height * drawn
        + GAUSSIAN_COST * min(config.strategy.growth_limit, width * height)
    )


def _longest_side(config: Config, view: View) -> int:
    return max(view_size(view, config.data))


def _trial_config(config: Config) -> Config:
    small = _small(config, TRIAL_STEPS, math.inf, TRIAL_SIDE, TRIAL_GAUSSIANS)
    small = _with(small, "init", num_random=min(config.init.num_random, TRIAL_GAUSSIANS))
    made_of = capability(config.model, HasGaussians)
    if made_of is None:
        return small
    return small.model_copy(update={"model": made_of.adding(config.model, TRIAL_RANDOM)})


def _small(
    config: Config,
    steps: int,
    first_side: float,
    side: int = SMALL_SIDE,
    most_gaussians: int = SMALL_GAUSSIANS,
) -> Config:
    """Return ``config`` for ``steps`` in small images, with few Gaussians and without limits.

    They begin with no smaller images than the run itself, ``first_side`` px: in smaller ones motion
    is lost that it follows.
    """
    side = min(config.data.longest_side or side, side)
    divisors = (
        n for n in (16, 8, 4, 2) if n <= config.train.initial_downscale and side / n >= first_side
    )
    first = next(divisors, 1)
    length = {
        "steps": steps,
        "minutes": None,
        "save_every": 0,
        "eval_every": 0,
        "initial_downscale": first,
    }
    return config.model_copy(
        update={
            "data": config.data.model_copy(update={"longest_side": side}),
            "strategy": config.strategy.limited(most_gaussians),
            "train": config.train.model_copy(update=length),
            "budget": BudgetConfig(),
            "prune": PruneConfig(),
        }
    )


def _held_out(views: Sequence[View]) -> list[frozenset[int]]:
    """Return the sets of views that small runs hold out, in order of time; none where views are too
    few."""
    order = sorted(range(len(views)), key=lambda i: (views[i].time or 0.0, views[i].name))
    if len(order) < FEWEST_VIEWS:
        return []
    if len(order) < FEW_VIEWS:
        return [frozenset(order[1::4]), frozenset(order[3::4])]
    # odd, so that it is not always the same of several cameras
    every = max(3, len(order) // HELD_OUT | 1)
    return [frozenset(order[every // 2 :: every])]


def _settings(config: Config) -> list[OpenSetting]:
    """Return what is open in ``config``, by what it was worth in the past, the most first."""
    model = config.model
    found = list[OpenSetting]()
    if not isinstance(model, (StaticModel, DynamicModel)):
        return found
    if config.camera.refine == "auto":
        found.append(
            OpenSetting(
                "camera.refine=always",
                lambda c: _with(c, "camera", refine="always"),
                after_pose_fit,
            )
        )
    if config.train.exposure == "auto":
        found.append(
            OpenSetting(
                "train.exposure=always",
                lambda c: _with(c, "train", exposure="always"),
                after_colour_fit,
            )
        )
    if config.train.robust == "auto":
        found.append(OpenSetting("train.robust=always", _robust, explained))
    if isinstance(model, DynamicModel) and model.choose:
        if config.colour == ShColour() and not config.colour.model_fields_set:
            found.append(OpenSetting("colour.kind=network", _network))
        if "move_opacities" not in model.deform.model_fields_set:
            found.append(OpenSetting("model.deform.move_opacities=true", _moving_opacities))
    return found


def _without_auto(config: Config) -> Config:
    if not isinstance(config.model, (StaticModel, DynamicModel)):
        return config
    for section, name in (("camera", "refine"), ("train", "exposure"), ("train", "robust")):
        if getattr(getattr(config, section), name) == "auto":
            config = _with(config, section, **{name: "never"})
    return config


def _robust(config: Config) -> Config | None:
    return (
        _with(config, "train", robust="always") if isinstance(config.model, StaticModel) else None
    )


def _views_at_once(capture: Capture) -> float:
    """Return the mean number of training views of a time."""
    views = capture.splits["train"]
    return len(views) / len({view.time for view in views})


def _what_moves(given: Config, field: DeformField, free: bool) -> tuple[Config, OpenSetting]:
    """Return ``given`` with free primitives or, if not ``free``, with ``field``, and the setting of
    the other one.

    Images of free primitives grow early where nothing else was requested: nothing is followed
    through a clip, so that small ones save less than they lose.
    """
    early = {name: x for name, x in EARLY.items() if name not in given.train.model_fields_set}
    usual = {name: getattr(given.train, name) for name in EARLY}

    def primitives(config: Config) -> Config:
        return _with(_with(config, "model", deform=FreeField()), "train", **early)

    def nodes(config: Config) -> Config:
        return _with(_with(config, "model", deform=field), "train", **usual)

    first, other, kind = (primitives, nodes, field.kind) if free else (nodes, primitives, "free")
    return first(given), OpenSetting(f"model.deform.kind={kind}", other)


def _bounded(config: Config) -> Config:
    """Return the configuration for fixed cameras, with the filter in space unless that was
    requested.

    What is thinner than few cameras show fits these alone. Before eight, against 3DGS's wider
    filter in the image, a room has -1.4 dB on other cameras without the filter in space and +0.7
    with it, a die +0.9 and +2.2. Small runs cannot tell: a camera whose image is held out is
    trained on at other times.
    """
    return (
        config
        if "filter_3d" in config.model.model_fields_set
        else _with(config, "model", filter_3d=True)
    )


def _network(config: Config) -> Config | None:
    return (
        config.model_copy(update={"colour": NetworkColour()})
        if isinstance(config.model, DynamicModel)
        else None
    )


def _moving_opacities(config: Config) -> Config | None:
    match config.model:
        case DynamicModel(deform=FieldSection() as field):
            return _with(config, "model", deform=field.model_copy(update={"move_opacities": True}))
        case _:
            return None


def _with(config: Config, section: str, **values: object) -> Config:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})


def _motion_of_fixed_cameras(capture: Capture, config: Config) -> bool | None:
    """Return whether anything moves, where all cameras are fixed, and say so; None: they do not
    tell."""
    views = capture.splits["train"]
    cameras = cameras_in_place(views)
    if sum(map(len, cameras)) <= 0.9 * len(views):
        return None
    side = min(config.data.longest_side or LOOK_SIDE, LOOK_SIDE)
    loader = ImageLoader(views, config.data.model_copy(update={"longest_side": side}))
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    used = [cameras[i] for i in evenly_spaced(len(cameras), LOOK_CAMERAS)]
    images = [
        [loader[seen[i]].composite(background) for i in evenly_spaced(len(seen), LOOK_TIMES)]
        for seen in used
    ]
    fraction = differing_fraction(images)
    moves = fraction > MIN_DIFFERING
    said = "something moves" if moves else "nothing moves, trained as a static scene"
    print(
        f"{said}: {fraction:.2%} of the pixels of fixed cameras differ from their median",
        flush=True,
    )
    return moves
