"""A still model beside a moving one: trained first, compared on held-out training views, kept where it is better.

Most of what a moving scene shows stands, and some scenes that have times do not move at all. So nothing moves before
the pictures say so, and what moves must be worth it.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean, stdev

import torch
from torch import Tensor
from typing_extensions import assert_never

from dyngs.api.motion_check import motion_evidence
from dyngs.build import assemble
from dyngs.config import (
    BudgetConfig,
    Config,
    DefaultStrategy,
    DynamicModel,
    FixedStrategy,
    McmcStrategy,
    PruneConfig,
    Strategy,
)
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.config.still import as_still
from dyngs.data.capture import View
from dyngs.data.loader import Picture, PictureLoader
from dyngs.data.pictures.images import area_downscale
from dyngs.data.read import read_capture
from dyngs.deform.evidence import Verdict
from dyngs.deform.still_error import signed_errors
from dyngs.metrics import psnr
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.folder import STILL_FOLDER, begin
from dyngs.scene import Scene
from dyngs.training.background import background_colour
from dyngs.training.events import Event, Message, StepDone
from dyngs.training.loop import Loop
from dyngs.training.schedule import hold_out_until
from dyngs.training.trainer import Trainer

STILL_STEPS, STILL_SIDE, STILL_GAUSSIANS = 2000, 192, 40_000
"""Most steps and Gaussians of the still model that is compared with, and longest side of its pictures, px.

A still model of what moves grows without end, to explain motion by viewpoint; a tenth of that is enough to fail by.
"""
FEWEST_VIEWS = 8
"""With fewer training views none can be spared for a comparison."""
FEW_VIEWS, OFTEN, HELD_OUT = 24, 4, 10
"""Below so many views one in four is held out; from there on one in eight, and about ten in all."""
ERRS, MIN_ERRING = 0.1, 0.01
"""Colour error from which a still model fails, and the share of held-out views where it does so if things move."""
CLEAR = 0.05
"""Opacity of what moves up to which a pixel shows what stands."""


def start(config: Config, folder: Path, train_still: Callable[[Config, Path], None]) -> Config:
    """Return the configuration to train in ``folder``: of a moving scene, or of a still one if nothing moves.

    Args:
        config: of a run that has not begun, or was stopped before its first checkpoint.
        folder: of the run.
        train_still: trains the still model in a folder, or goes on with it, to its end.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    match config.model:
        case DynamicModel() if config.model.compare_with_still:
            pass
        case _:
            return config
    views = read_capture(config.data).splits["train"]
    if len({view.time for view in views}) < 2:
        return config
    evidence = motion_evidence(config)
    if evidence.verdict is Verdict.STILL:
        print(f"nothing moves: {evidence.reason}; trained as a still scene", flush=True)
        return as_still(config)
    if len(views) < FEWEST_VIEWS:
        print(f"{len(views)} views are too few to compare with a still model on some of them", flush=True)
        return config
    every, moves = hold_out_every(views), evidence.verdict is Verdict.MOVES
    begin(folder, config)
    said = "moves" if moves else "may move"
    print(f"something {said}: {evidence.reason}; first a small still model, to compare with", flush=True)
    train_still(_still_config(config, every, folder / STILL_FOLDER), folder / STILL_FOLDER)
    if not moves:
        share = _erring_share(folder / STILL_FOLDER)
        fails = f"a small still model fails in {share:.1%} of held-out training views"
        if share < MIN_ERRING:
            print(f"nothing moves: {fails}; trained as a still scene", flush=True)
            return still_instead(folder, config)
        print(f"{fails}: motion is tried", flush=True)
    return config.model_copy(update={"train": config.train.model_copy(update={"hold_out_every": every})})


def still_instead(folder: Path, config: Config) -> Config:
    """Remove what was trained in ``folder``, and return the configuration of the still scene to train instead."""
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    train = config.train.model_copy(update={"hold_out_every": 0})
    still = as_still(config.model_copy(update={"train": train}))
    save_config(still, folder / RESOLVED_NAME)
    shutil.rmtree(folder / STILL_FOLDER, ignore_errors=True)
    return still


def hold_out_every(views: Sequence[View]) -> int:
    """Return of how many views one is held out; odd, so that it is not always the same of several cameras."""
    if len(views) < FEW_VIEWS:
        return OFTEN
    return max(8, len(views) // HELD_OUT) | 1


class StillComparison:
    """Listener that compares a moving model with its own still model once views are held out no more.

    Args:
        folder: of the run; the still model lies in it, and is removed when it has lost.
        trainer: returns the trainer of the moving model.
        loop: tells the result.

    Attributes:
        is_lost: the still model is better.
    """

    def __init__(self, folder: Path, trainer: Callable[[], Trainer], loop: Loop) -> None:
        self._folder, self._trainer, self._loop = folder, trainer, loop
        self.is_lost = self._is_done = False

    def __call__(self, event: Event) -> None:
        """Compare after the last step that does without the views held out, or later where a limit has cut the run."""
        match event:
            case StepDone() if not self._is_done and event.step >= hold_out_until(self._trainer().config.train):
                self._is_done = True
                self._compare()

    def _compare(self) -> None:
        trainer, source = self._trainer(), self._folder / STILL_FOLDER
        if not trainer.held_out or not checkpoint_paths(source):
            return
        still = load_run(source)
        small = PictureLoader(trainer.pictures.views, still.config.data)
        found = [_compared(trainer, still.scene, trainer.pictures[i], small[i]) for i in sorted(trainer.held_out)]
        moving, standing = _means([x[0] for x in found]), [x[1] for x in found if x[1] is not None]
        self.is_lost = not _is_gain([x[0][0] - x[0][1] for x in found])
        kept = "a still model is trained instead" if self.is_lost else "motion is kept"
        text = f"{len(found)} held-out training views: {moving[0]:.2f} dB with motion, {moving[1]:.2f} dB without"
        if standing:
            text += "; where nothing moves {:.2f} and {:.2f} dB".format(*_means(standing))
        self._loop.tell(Message(f"{text}; {kept}"))
        if not self.is_lost:
            shutil.rmtree(source, ignore_errors=True)


@torch.no_grad()
def _compared(
    trainer: Trainer, still: Scene, picture: Picture, small: Picture
) -> tuple[tuple[float, float], tuple[float, float] | None]:
    """Return PSNR of a small picture with motion and without, whole and where nothing that moves is in front."""
    background, options = background_colour(trainer.background), trainer.options
    size, truth = (small.cameras.width, small.cameras.height), small.composite(background)
    drawn = trainer.scene.render(picture.cameras, picture.time, options=options, background=background).rgb[0]
    pictures = [
        area_downscale(drawn, *size),
        still.render(small.cameras, small.time, options=options, background=background).rgb[0],
    ]
    alpha = trainer.scene.part("moving").render(picture.cameras, picture.time, options=options).alpha[0]
    stands = (area_downscale(alpha[..., None], *size)[..., 0] < CLEAR).float()
    stands = stands * (1.0 if small.mask is None else small.mask)
    whole = psnr(pictures[0], truth, small.mask), psnr(pictures[1], truth, small.mask)
    if not bool((stands > 0).any()):
        return whole, None
    return whole, (psnr(pictures[0], truth, stands), psnr(pictures[1], truth, stands))


def _is_gain(gains: Sequence[float]) -> bool:
    """Return whether gains are positive by more than twice the standard error of their mean: runs differ by chance."""
    return fmean(gains) > 2 * (stdev(gains) if len(gains) > 1 else 0.0) / math.sqrt(len(gains))


def _means(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return fmean(x for x, _ in values), fmean(x for _, x in values)


def _still_config(config: Config, every: int, folder: Path) -> Config:
    """Return the configuration of the small still model, which never sees the views held out."""
    still = as_still(config)
    held_out = {"hold_out_every": every, "hold_out_until": 1.0, "steps": min(config.train.steps, STILL_STEPS)}
    side = min(config.data.longest_side or STILL_SIDE, STILL_SIDE)
    return still.model_copy(
        update={
            "data": still.data.model_copy(update={"longest_side": side}),
            "strategy": _limited(still.strategy),
            "train": still.train.model_copy(update=held_out),
            "budget": BudgetConfig(),
            "prune": PruneConfig(),
            "run": config.run.model_copy(update={"dir": folder}),
        }
    )


def _limited(strategy: Strategy) -> Strategy:
    match strategy:
        case DefaultStrategy() | McmcStrategy():
            most = min(strategy.max_gaussians, STILL_GAUSSIANS)
            return strategy.model_copy(update={"max_gaussians": most})
        case FixedStrategy():
            return strategy
        case _:
            assert_never(strategy)


def _erring_share(folder: Path) -> float:
    """Return the share of the held-out training views, by blending weights, where the still model in ``folder`` fails.

    The error of a Gaussian is that of the pixels that show it, with its sign: detail that is not yet resolved cancels.
    """
    run = load_run(folder)
    trainer = assemble(run.config, restored=True)
    background = background_colour(trainer.background)
    fails = total = 0.0
    for index in sorted(trainer.held_out):
        picture = trainer.pictures[index]
        with torch.no_grad():
            shown = run.scene.render(picture.cameras, options=trainer.options, background=background).rgb[0]
        errors, weights = signed_errors(run.scene.gaussians, picture, trainer.options, background, shown)
        mean: Tensor = errors.abs().mean(1) / weights.clamp_min(1e-6)
        fails += float(weights[mean > ERRS].sum())
        total += float(weights.sum())
    return fails / max(total, 1e-9)
