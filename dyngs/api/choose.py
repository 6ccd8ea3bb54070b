"""Pilot runs: short trainings before a run that decide on motion.

Two trainings of the same images, steps and cap on Gaussians differ in whether anything moves.
Motion is taken if its mean gain on held-out training views, pair by pair, exceeds three times its
standard error. The static scene wins a tie, and wherever nothing could be compared. The winner is
trained in full, on all training views.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import torch

from dyngs.api.first_scene import load_initial_gaussians
from dyngs.config import BudgetConfig, Config, PruneConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.core.errors import DyngsError, format_count, log_info
from dyngs.core.metrics import psnr
from dyngs.core.section import ModelSection, Section
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.data.read import view_size
from dyngs.data.times import evenly_spaced
from dyngs.deform.keys import FreeField
from dyngs.deform.static_errors import changed_fraction, group_fixed_cameras
from dyngs.evaluate.motion_masks import MotionMasks
from dyngs.evaluate.view_scores import FEWEST_PIXELS
from dyngs.gaussians.colour.network import apply_affine_colour, fit_affine_colour
from dyngs.io.write import write_text
from dyngs.models.kind import HasGaussians, HasMotion, capability, find_kind
from dyngs.models.schedule import image_divisor
from dyngs.models.views import background_colour, evaluation_background
from dyngs.runs.folder import CHOICES_NAME
from dyngs.training.loop import Interrupts
from dyngs.training.new_trainer import GaussianTrainer, add_initial_points, build_trainer


@dataclass(frozen=True)
class _Size:
    """Size of pilot runs.

    Attributes:
        side: longest side of the images, px.
        gaussians: most of them.
        steps: number of steps.
        spent: most of the work of the run that they may take together.
    """

    side: int
    gaussians: int
    steps: int
    spent: float


MOTION = _Size(side=96, gaussians=5000, steps=600, spent=0.25)
"""In 300 steps the motion of a turning head is not found yet."""
MOTION_RANDOM = 1000  # Most random Gaussians that motion begins with in a pilot run
STATIC_CHECK_FRACTION = 0.08
"""Largest fraction of ``train.minutes`` for the search for motion."""
FEWEST_MOVING = 1500
"""Steps from which motion is followed in time: in 500 a moving scene loses up to 0.6 dB to a static
model of it, in 3,000 it gains."""
STEP_COST, GAUSSIAN_COST = 60_000, 0.5
"""Work of a step next to its images, and of a Gaussian in it, in pixels. Pilot runs of a clip took 22
ms a step, its full run 60 ms, that of ``rig`` 90 ms."""
FEWEST_VIEWS, FEW_VIEWS, HELD_OUT = 8, 24, 24
"""With fewer views nothing is compared; with fewer than the second, pilot runs are made twice, each
without a fourth of the views; otherwise about so many are held out."""
LEAST_GAIN = 0.05  # Mean gain, dB, up to which two settings tie
ERRORS = 3.0
"""Standard errors that a gain must exceed. The preset ``static`` learns faster than the static
model of a pilot run: on photos of a static cup motion gained 1.13 dB (0.56), and ended 1.3 dB below
``static``. On captures that move the gain was 3.5 errors or more."""
FILTERED_VIEWS, FREE_VIEWS = 3.0, 3.5
"""Mean number of views per time by fixed cameras from which the 3D filter is used (a room gains 2.1
dB on other cameras), and from which free primitives replace control nodes: four cameras, some of
whose images are held out. ``rig``, four real cameras, gains 1.4 and 2.5 dB (two seeds) and 3.9 dB
on what moves; a synthetic cloth before four cameras loses 0.9."""
EARLY = {"resolution_grows_from": 0.3, "resolution_full_at": 0.5}
"""Fractions of a run with free primitives at which its images grow: nothing is followed through a
clip, so that small ones save less than they lose."""
MIN_DIFFERING = 0.001
"""Fraction of the pixels of fixed cameras that differ from their median from which something
moves."""
LOOK_CAMERAS, LOOK_TIMES = 8, 24  # Fixed cameras, and images of each, in which that is looked for

_TOO_SHORT = "not used: the run is too short, or has too few views, for pilot runs"


@dataclass(frozen=True)
class Choice:
    """Result of pilot runs about a setting.

    Attributes:
        without, gain, error: mean PSNR without it, mean gain by it and its standard error, dB.
        taken: whether the setting is used.
    """

    setting: str
    views: int
    without: float
    gain: float
    error: float
    steps: int
    seconds: float
    taken: bool

    def __str__(self) -> str:
        return (
            f"{self.setting} {'used' if self.taken else 'not used'}: {self.gain:+.2f} dB (standard error "
            f"{self.error:.2f}) to {self.without:.2f} dB on {format_count(self.views, 'view')} ({self.seconds:.0f} s)"
        )


def resolve_by_pilot_runs(
    config: Config, capture: Capture, on_progress: ProgressCallback = ignore_progress
) -> tuple[Config, Choice | None]:
    """Resolve motion by pilot runs, where it was not requested.

    Returns the resolved config, and the result where there were pilot runs.

    Raises:
        DyngsError: images that cannot be read, or a capture that this kind of model cannot be
            trained on.
        KeyboardInterrupt: during pilot runs; nothing has been written.
    """
    problem = find_kind(config.model).refusal(capture)
    if problem is not None:
        raise DyngsError(f"{config.data.root}: {problem}")
    model: Any = config.model
    if capability(model, HasMotion) is None or not model.pilot_runs:
        return config, None
    moves = _motion_of_fixed_cameras(capture, config)
    if moves is False:
        return as_static(config), None
    moving = _with(config, "model", pilot_runs=False)
    views = capture.splits["train"]
    at_once = len(views) / len({view.time for view in views})
    if moves and at_once >= FILTERED_VIEWS:
        moving = _before_fixed_cameras(moving, at_once)
    masks = MotionMasks(capture, config.data) if moves else None
    if moves is None and not _finds_motion(moving, capture, on_progress):
        log_info("nothing moves: a static model explains all images, trained as a static scene")
        return as_static(config), None
    choice = _motion(moving, capture, on_progress, masks)
    if choice is None:
        log_info(f"model.kind=dynamic {_TOO_SHORT}; model.pilot_runs=false trains a moving scene")
        return as_static(config), None
    log_info(f"  {choice}")
    return moving if choice.taken else as_static(config), choice


def write_choice(folder: Path, choice: Choice | None) -> None:
    """Write the result of pilot runs into a run folder; nothing where there was none."""
    if choice is not None:
        write_text(folder / CHOICES_NAME, json.dumps([asdict(choice)], indent=2) + "\n")


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
    is_other_kind = type(given) is not type(usual) and (not keys or "kind" in keys)
    if is_other_kind and not isinstance(given, ModelSection):
        usual = type(given)()
    known = type(usual).model_fields
    return usual.model_copy(
        update={key: getattr(given, key) for key in keys if key in known and key != "kind"}
    )


def _before_fixed_cameras(config: Config, views: float) -> Config:
    """Return the config for a scene before fixed cameras, ``views`` of each time, where nothing
    else was requested.

    What is thinner than few cameras show fits these alone. Pilot runs cannot tell: a camera whose
    image is held out is trained on at other times.
    """
    requested: Any = config.model
    if "filter_3d" not in requested.model_fields_set:
        config = _with(config, "model", filter_3d=True)
    if views >= FREE_VIEWS and not requested.deform.model_fields_set:
        early = {k: x for k, x in EARLY.items() if k not in config.train.model_fields_set}
        config = _with(_with(config, "model", deform=FreeField()), "train", **early)
    return config


def _finds_motion(config: Config, capture: Capture, on_progress: ProgressCallback) -> bool:
    """Return whether the static stage of the run leaves errors that motion may explain.

    The static stage of a pilot run is too short to decide this: motion gained 1.5 dB in pilot runs
    on photos of a static scene, and lost 1.2 dB in full runs. True without a test where all
    Gaussians are to move, or the run is too short for motion.
    """
    model: Any = config.model
    if not model.select_moving or config.train.steps < FEWEST_MOVING:
        return True
    last = model.motion_start_step(config.train.steps) - 1
    seconds = 60 * (config.train.minutes or math.inf) * STATIC_CHECK_FRACTION
    done = 0

    def on_step() -> None:
        nonlocal done
        done += 1
        on_progress("search for motion, steps", done, last)

    capture = add_initial_points(capture, config, log_messages=False, on_progress=on_progress)
    deadline = time.monotonic() + seconds
    trainer = _trained(config, capture, frozenset(), deadline, on_step, last=last)
    if trainer is None:
        return True
    training: Any = trainer.model.training
    return bool(training.finds_motion(trainer.model.scene))


def _motion(
    config: Config, capture: Capture, on_progress: ProgressCallback, masks: MotionMasks | None
) -> Choice | None:
    """Compare ``config`` with the same model at rest, on the pixels of ``masks``; None where the
    run is too short, or has too few views.

    Both begin as the same static model, and train on the same views in the same order: at the rates
    of the preset ``static``, a model at rest would win by its faster learning.
    """
    views = capture.splits["train"]
    folds = _held_out(views)
    small = _small(config)
    small = _with(small, "init", num_random=min(config.init.num_random, MOTION.gaussians))
    made_of = capability(config.model, HasGaussians)
    assert made_of is not None
    small = small.model_copy(
        update={"model": made_of.with_added_gaussians(config.model, MOTION_RANDOM)}
    )
    step = _work_of_step(config, views[0])
    # a step with motion costs two without
    work = len(folds) * 1.4 * MOTION.steps * _work_of_step(small, views[0])
    if not folds or config.train.steps < max(work / (MOTION.spent * step), FEWEST_MOVING):
        return None
    given = 60 * (config.train.minutes or math.inf)
    begun = time.monotonic()
    capture = add_initial_points(capture, config, log_messages=False, on_progress=on_progress)
    log_info(
        f"pilot runs of {format_count(MOTION.steps, 'step')}, compared on held-out training views:"
    )
    choice = _compared(
        [_with(small, "model", motion_from=1.0), small],
        capture,
        folds,
        on_progress,
        masks,
        begun + MOTION.spent * given,
    )
    seconds = max(time.monotonic() - begun, 1e-6)
    if (given - seconds) / seconds * work / step < FEWEST_MOVING:
        return None
    return choice


def _compared(
    both: Sequence[Config],
    capture: Capture,
    folds: Sequence[frozenset[int]],
    on_progress: ProgressCallback,
    masks: MotionMasks | None,
    deadline: float,
) -> Choice | None:
    """Train both configs, without and with motion, without each fold of the training views, and
    compare them on it; None where that takes until ``deadline``."""
    begun = time.monotonic()
    before = list[float]()
    after = list[float]()
    steps = both[0].train.steps - 1
    done = 0

    def on_step() -> None:
        nonlocal done
        done += 1
        on_progress("pilot runs, steps", done, 2 * len(folds) * steps)

    for held_out in folds:
        one, other = (_trained(config, capture, held_out, deadline, on_step) for config in both)
        if one is None or other is None:
            return None
        for index in sorted(held_out):
            before.append(view_psnr(one, index, masks))
            after.append(view_psnr(other, index, masks))
    gains = [now - then for then, now in zip(before, after, strict=True)]
    gain = fmean(gains)
    error = (stdev(gains) if len(gains) > 1 else math.inf) / math.sqrt(len(gains))
    return Choice(
        setting="model.kind=dynamic",
        views=len(gains),
        without=fmean(before),
        gain=gain,
        error=error,
        steps=both[0].train.steps,
        seconds=time.monotonic() - begun,
        taken=gain > max(ERRORS * error, LEAST_GAIN),
    )


def _trained(
    config: Config,
    capture: Capture,
    held_out: frozenset[int],
    deadline: float,
    on_step: Callable[[], None],
    last: int | None = None,
) -> GaussianTrainer | None:
    """Return the trainer of a pilot run after step ``last``; None where that takes until
    ``deadline``.

    By default the last step is left out: in it, a model at rest would begin to move.
    """
    trainer = build_trainer(config, capture, first=load_initial_gaussians(config, capture))
    trainer.hold_out(held_out)
    last = config.train.steps - 1 if last is None else last
    with Interrupts() as interrupts:
        while trainer.done < last and time.monotonic() < deadline:
            if interrupts.requested:
                raise KeyboardInterrupt(
                    "stopped before training began: nothing is written, give the command again"
                )
            trainer.step()
            on_step()
    trainer.images.stop_prefetching()
    return trainer if trainer.done >= last else None


def _work_of_step(config: Config, view: View) -> float:
    width, height = view_size(view, config.data)
    times = range(0, config.train.steps, max(1, config.train.steps // 50))
    drawn = fmean(image_divisor(config.train, step) ** -2 for step in times)
    gaussians = min(config.strategy.growth_limit, width * height)
    return STEP_COST + width * height * drawn + GAUSSIAN_COST * gaussians


def _small(config: Config) -> Config:
    """Return ``config`` as a pilot run: in small images, with few Gaussians and without limits."""
    side = min(config.data.longest_side or MOTION.side, MOTION.side)
    length = {
        "steps": MOTION.steps,
        "minutes": None,
        "save_every": 0,
        "eval_every": 0,
        "initial_downscale": 1,
    }
    return config.model_copy(
        update={
            "data": config.data.model_copy(update={"longest_side": side}),
            "strategy": config.strategy.limited(MOTION.gaussians),
            "train": config.train.model_copy(update=length),
            "budget": BudgetConfig(),
            "prune": PruneConfig(),
        }
    )


def _held_out(views: Sequence[View]) -> list[frozenset[int]]:
    """Return the sets of views that pilot runs hold out, in order of time; none where views are too
    few."""
    order = sorted(range(len(views)), key=lambda i: (views[i].time or 0.0, views[i].name))
    if len(order) < FEWEST_VIEWS:
        return []
    if len(order) < FEW_VIEWS:
        return [frozenset(order[1::4]), frozenset(order[3::4])]
    # odd, so that it is not always the same of several cameras
    every = max(3, len(order) // HELD_OUT | 1)
    return [frozenset(order[every // 2 :: every])]


def _with(config: Config, section: str, **values: object) -> Config:
    return config.model_copy(update={section: getattr(config, section).model_copy(update=values)})


def _motion_of_fixed_cameras(capture: Capture, config: Config) -> bool | None:
    """Return whether anything moves before fixed cameras; None where the cameras are not fixed."""
    views = capture.splits["train"]
    cameras = group_fixed_cameras(views)
    if sum(map(len, cameras)) <= 0.9 * len(views):
        return None
    side = min(config.data.longest_side or MOTION.side, MOTION.side)
    loader = ImageLoader(views, config.data.model_copy(update={"longest_side": side}))
    _, background = evaluation_background(config.data.background, capture.has_alpha)
    used = [cameras[i] for i in evenly_spaced(len(cameras), LOOK_CAMERAS)]
    images = [
        [loader[seen[i]].composite(background) for i in evenly_spaced(len(seen), LOOK_TIMES)]
        for seen in used
    ]
    fraction = changed_fraction(images)
    moves = fraction > MIN_DIFFERING
    found = "something moves" if moves else "nothing moves, trained as a static scene"
    log_info(f"{found}: {fraction:.2%} of the pixels of fixed cameras differ from their median")
    return moves


@torch.no_grad()
def view_psnr(trainer: GaussianTrainer, index: int, masks: MotionMasks | None = None) -> float:
    """Return the PSNR, dB, of a training view by a model that was not trained on it.

    With exposures, after an affine colour that is fitted to the view.

    Args:
        masks: score moving pixels only, in views with enough of them.
    """
    image = trainer.images[index]
    model = trainer.model
    background = background_colour(trainer.background)
    truth = image.composite(background)
    weights = image.mask
    if masks is not None:
        size = (image.cameras.width, image.cameras.height)
        moving = masks.mask(trainer.images.views[index], *size)
        if moving is not None and int(moving.sum()) >= FEWEST_PIXELS:
            weights = moving.to(truth.device).float() * (1 if weights is None else weights)
    rendering = model.scene.render(
        image.cameras, image.time, options=model.options, background=background
    )
    rgb = rendering.rgb[0]
    if trainer.config.train.exposure == "always":
        affine = fit_affine_colour([(image, rendering)], background)
        rgb = apply_affine_colour(affine, image, rendering, background)
    return psnr(rgb, truth, weights)
