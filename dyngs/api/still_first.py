"""A static model beside a moving one: trained first, compared on held-out training views, kept where it is better.

Most of what a moving scene shows stands, and some scenes that have times do not move at all. So nothing moves before
the images say so, and what moves must be worth it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from dyngs.api.motion_check import motion_evidence
from dyngs.api.pilot_runs import with_choices
from dyngs.api.small_runs import FEWEST_VIEWS, drawn, held_out_scores, hold_out_every, is_gain, small_run
from dyngs.config import Config, DynamicModel
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.config.still import as_still
from dyngs.data.capture import View
from dyngs.data.images.images import area_downscale
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.deform.evidence import Verdict
from dyngs.deform.still_error import signed_errors
from dyngs.errors import DyngsError
from dyngs.gaussians.scene import Scene
from dyngs.kinds import GaussianTrainer, assemble
from dyngs.metrics import psnr
from dyngs.models.schedule import hold_out_until
from dyngs.models.views import background_colour
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.folder import STILL_FOLDER, begin
from dyngs.training.events import Event, Message, StepDone
from dyngs.training.loop import Loop

STILL_STEPS = 2000
"""Most steps of the static model that is compared with."""
ERRS, MIN_ERRING = 0.1, 0.01
"""Colour error from which a static model fails, and the fraction of held-out views where it does so if things move."""
CLEAR = 0.05
"""Opacity of what moves up to which a pixel shows what stands."""


def start(config: Config, folder: Path, train_still: Callable[[Config, Path], None]) -> Config:
    """Return the configuration to train in ``folder``: of a moving scene, or of a still one if nothing moves.

    Args:
        config: of a run that has not begun, or was stopped before its first checkpoint.
        folder: of the run.
        train_still: trains the static model in a folder, or goes on with it, to its end.

    Raises:
        DyngsError: a capture that cannot be read, or one without times.
    """
    match config.model:
        case DynamicModel():
            views = read_capture(config.data).splits["train"]
            _require_times(config, views)
        case _:
            return config
    if not config.model.compare_with_still:
        return config
    evidence = motion_evidence(config)
    if evidence.verdict is Verdict.STILL:
        print(f"nothing moves: {evidence.reason}; trained as a static scene", flush=True)
        return as_still(config)
    if len(views) < FEWEST_VIEWS:
        print(f"{len(views)} views are too few to compare with a static model on some of them", flush=True)
        return config
    every, moves = hold_out_every(views), evidence.verdict is Verdict.MOVES
    begin(folder, config)
    said = "moves" if moves else "may move"
    print(f"something {said}: {evidence.reason}; first a small static model, to compare with", flush=True)
    train_still(_still_config(config, every, folder / STILL_FOLDER), folder / STILL_FOLDER)
    failing, scores = _small_still_model(folder / STILL_FOLDER)
    if not moves:
        fails = f"a small static model fails in {failing:.1%} of held-out training views"
        if failing < MIN_ERRING:
            print(f"nothing moves: {fails}; trained as a static scene", flush=True)
            return still_instead(folder, config)
        print(f"{fails}: motion is tried", flush=True)
    chosen = with_choices(config, every, None if moves else scores)
    if chosen is None:
        print("motion does not pay; trained as a static scene", flush=True)
        return still_instead(folder, config)
    return chosen.model_copy(update={"train": config.train.model_copy(update={"hold_out_every": every})})


def _require_times(config: Config, views: Sequence[View]) -> None:
    """Raise an error unless the views were taken at two times or more."""
    if len({view.time for view in views}) < 2:
        raise DyngsError(
            f"{config.data.root}: the images have no times, so nothing can move; train configs/static.yaml, or add a "
            "time to each image (docs/formats.md), or give data.times=order if their names are in the order of time"
        )


def still_instead(folder: Path, config: Config) -> Config:
    """Remove what was trained in ``folder``, and return the configuration of the static scene to train instead.

    Its colours are those that were asked for, as the small static model has them: pilot runs choose for what moves.
    """
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    train = config.train.model_copy(update={"hold_out_every": 0})
    colour = load_resolved(folder / STILL_FOLDER).colour
    still = as_still(config.model_copy(update={"train": train, "colour": colour}))
    save_config(still, folder / RESOLVED_NAME)
    shutil.rmtree(folder / STILL_FOLDER, ignore_errors=True)
    return still


class StillComparison:
    """Listener that compares a moving model with its own static model once views are held out no more.

    Args:
        folder: of the run; the static model lies in it, and is removed when it has lost.
        trainer: returns the trainer of the moving model.
        loop: tells the result.

    Attributes:
        is_lost: the static model is better.
    """

    def __init__(self, folder: Path, trainer: Callable[[], GaussianTrainer], loop: Loop) -> None:
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
        run = load_run(source)
        still, small = run.scene.to(trainer.device), ImageLoader(trainer.images.views, run.config.data)
        small.device = trainer.device
        found = [_compared(trainer, still, trainer.images[i], small[i]) for i in sorted(trainer.held_out)]
        moving, standing = _means([x[0] for x in found]), [x[1] for x in found if x[1] is not None]
        self.is_lost = not is_gain([x[0][0] - x[0][1] for x in found])
        kept = "a static model is trained instead" if self.is_lost else "motion is kept"
        text = f"{len(found)} held-out training views: {moving[0]:.2f} dB with motion, {moving[1]:.2f} dB without"
        if standing:
            text += "; where nothing moves {:.2f} and {:.2f} dB".format(*_means(standing))
        self._loop.tell(Message(f"{text}; {kept}"))
        if not self.is_lost:
            shutil.rmtree(source, ignore_errors=True)


@torch.no_grad()
def _compared(
    trainer: GaussianTrainer, still: Scene, image: Image, small: Image
) -> tuple[tuple[float, float], tuple[float, float] | None]:
    """Return PSNR of a small image with motion and without, whole and where nothing that moves is in front."""
    background, options, fitted = (
        background_colour(trainer.background),
        trainer.model.options,
        trainer.exposures is not None,
    )
    size, truth = (small.cameras.width, small.cameras.height), small.composite(background)
    images = [
        area_downscale(drawn(trainer.model.scene, image, options, background, fitted=fitted), *size),
        drawn(still, small, options, background, fitted=fitted),
    ]
    alpha = trainer.model.scene.part("moving").render(image.cameras, image.time, options=options).alpha[0]
    stands = (area_downscale(alpha[..., None], *size)[..., 0] < CLEAR).float()
    stands = stands * (1.0 if small.mask is None else small.mask)
    whole = psnr(images[0], truth, small.mask), psnr(images[1], truth, small.mask)
    if not bool((stands > 0).any()):
        return whole, None
    return whole, (psnr(images[0], truth, stands), psnr(images[1], truth, stands))


def _means(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return fmean(x for x, _ in values), fmean(x for _, x in values)


def _still_config(config: Config, every: int, folder: Path) -> Config:
    """Return the configuration of the small static model, which never sees the views held out."""
    small = small_run(as_still(config), every, min(config.train.steps, STILL_STEPS))
    return small.model_copy(update={"run": config.run.model_copy(update={"dir": folder})})


def _small_still_model(folder: Path) -> tuple[float, list[float]]:
    """Return how the static model in ``folder`` does on the held-out training views.

    The error of a Gaussian is that of the pixels that show it, with its sign: detail that is not yet resolved cancels.

    Returns:
        the fraction of the views, by blending weights, where it fails; PSNR of each view, dB.
    """
    run = load_run(folder)
    trainer = assemble(run.config, restored=True)
    scene = run.scene.to(trainer.device)
    background = background_colour(trainer.background)
    fails = total = 0.0
    for index in sorted(trainer.held_out):
        image = trainer.images[index]
        shown = drawn(scene, image, trainer.model.options, background, fitted=trainer.exposures is not None)
        errors, weights = signed_errors(scene.gaussians, image, trainer.model.options, background, shown)
        mean: Tensor = errors.abs().mean(1) / weights.clamp_min(1e-6)
        fails += float(weights[mean > ERRS].sum())
        total += float(weights.sum())
    scores = held_out_scores(scene, trainer, background)
    return fails / max(total, 1e-9), scores
