"""A still model beside a moving one: trained first, compared on held-out training views, kept where it is better.

Most of what a moving scene shows stands, and some scenes that have times do not move at all. So nothing moves before
the pictures say so, and what moves must be worth it.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from dyngs.api.motion_check import motion_evidence
from dyngs.build import assemble
from dyngs.config import Config, DynamicModel
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.config.still import as_still
from dyngs.data.capture import View
from dyngs.data.loader import Picture
from dyngs.data.read import read_capture
from dyngs.deform.evidence import Verdict
from dyngs.deform.still_error import signed_errors
from dyngs.files.write import write_text
from dyngs.metrics import psnr
from dyngs.runs.checkpoint import Checkpoint, checkpoint_paths, latest_checkpoint, load_run, step_of
from dyngs.runs.folder import STILL_FOLDER, begin
from dyngs.scene import Scene
from dyngs.training.background import background_colour
from dyngs.training.events import Event, Message, StepDone
from dyngs.training.loop import Loop
from dyngs.training.schedule import hold_out_until
from dyngs.training.trainer import Trainer

MAX_STILL_STEPS, STILL_SHARE = 3000, 1 / 3
"""Steps of the still model where something moves for sure, and share of the run's length that they are at most."""
CHECKED, LOOKED_BACK, GAINS = 0.05, 0.3, 0.3
"""Shares of a run after which a still model is measured, and over which it must gain so many dB to be trained on."""
MARGIN = 0.3
"""dB by which motion must be better where it was not sure that anything moves: two runs differ by chance, too."""
MEASURED_NAME = "held_out.json"
"""In the folder of a still model: PSNR of the views held out, by step."""
FEWEST_VIEWS = 8
"""With fewer training views none can be spared for a comparison."""
FEW_VIEWS, OFTEN, HELD_OUT = 24, 4, 10
"""Below so many views one in four is held out; from there on one in eight, and about ten in all."""
ERRS, MIN_ERRING = 0.1, 0.01
"""Colour error from which a still model fails, and the share of held-out views where it does so if things move."""
CLEAR = 0.05
"""Opacity of what moves up to which a pixel shows what stands."""


@dataclass(frozen=True)
class Start:
    """How a run begins.

    Attributes:
        config: of what is trained: the run's own, or that of a still scene.
        checkpoint: to go on from, or None.
    """

    config: Config
    checkpoint: Checkpoint | None = None


class Plateau:
    """Listener that finds out when a still model gains no more on the views held out.

    Args:
        folder: of its run; what was measured is kept there, so that a resumed run ends at the same step.
        trainer: returns its trainer.
        last: step after which it ends in any case.
        fixed: only the last step counts.
    """

    def __init__(self, folder: Path, trainer: Callable[[], Trainer], last: int, *, fixed: bool) -> None:
        self._path, self._trainer, self._last, self._fixed = folder / MEASURED_NAME, trainer, last, fixed
        self._measured = {} if fixed else _read_measured(self._path, trainer().done)

    @property
    def is_reached(self) -> bool:
        """Return whether the still model is trained."""
        done, steps = self._trainer().done, self._trainer().config.train.steps
        if done >= self._last:
            return True
        before = [x for step, x in self._measured.items() if step <= done - LOOKED_BACK * steps]
        since = [x for step, x in self._measured.items() if step > done - LOOKED_BACK * steps]
        return bool(before and since) and max(since) < max(before) + GAINS

    def __call__(self, event: Event) -> None:
        """Measure when it is time to."""
        match event:
            case StepDone() if not self._fixed and event.step % max(1, round(CHECKED * event.total)) == 0:
                self._measured[event.step] = _quality(self._trainer())
                write_text(self._path, json.dumps(self._measured) + "\n")


def start(config: Config, folder: Path, train_still: Callable[[Config, Path, bool], None]) -> Start:
    """Return how the run of ``config`` begins in ``folder``: as a moving scene, or as a still one if nothing moves.

    Args:
        config: of a run that has not begun, or was stopped before its first checkpoint.
        folder: of the run.
        train_still: trains a still model in a folder, or goes on with it, until ``Plateau`` says that it is trained;
            up to ``train.hold_out_until`` in any case, and always to there if told so.

    Raises:
        DyngsError: a capture that cannot be read.
    """
    match config.model:
        case DynamicModel() if config.model.compare_with_still:
            pass
        case _:
            return Start(config)
    views = read_capture(config.data).splits["train"]
    if len({view.time for view in views}) < 2:
        return Start(config)
    evidence = motion_evidence(config)
    if evidence.verdict is Verdict.STILL:
        print(f"nothing moves: {evidence.reason}; trained as a still scene", flush=True)
        return Start(as_still(config))
    if len(views) < FEWEST_VIEWS:
        print(f"{len(views)} views are too few to compare with a still model on some of them", flush=True)
        return Start(config)
    every, moves = hold_out_every(views), evidence.verdict is Verdict.MOVES
    still = _still_config(config, every, folder / STILL_FOLDER, moves=moves)
    print(f"something {'moves' if moves else 'may move'}: {evidence.reason}; first a still model", flush=True)
    begin(folder, config)
    train_still(still, folder / STILL_FOLDER, moves)
    if not moves:
        share = _erring_share(folder / STILL_FOLDER)
        fails = f"a still model fails in {share:.1%} of held-out training views"
        if share < MIN_ERRING:
            print(f"nothing moves: {fails}; it is trained on", flush=True)
            return still_instead(folder)
        print(f"{fails}: motion is tried", flush=True)
    train = config.train.model_copy(update={"hold_out_every": every})
    return Start(config.model_copy(update={"train": train}))


def still_instead(folder: Path) -> Start:
    """Put the still model of a run in its place, and return how it goes on.

    Raises:
        DyngsError: there is none.
    """
    source = folder / STILL_FOLDER
    still = load_resolved(source)
    step = step_of(checkpoint_paths(source)[-1])
    train = still.train.model_copy(update={"hold_out_until": step / still.train.steps})
    config = still.model_copy(update={"train": train, "run": still.run.model_copy(update={"dir": folder})})
    save_config(config, folder / RESOLVED_NAME)
    shutil.rmtree(folder / "checkpoints", ignore_errors=True)
    (source / "checkpoints").rename(folder / "checkpoints")
    shutil.rmtree(source, ignore_errors=True)
    return Start(config, latest_checkpoint(folder))


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
        self.is_lost = False

    def __call__(self, event: Event) -> None:
        """Compare after the last step that does without the views held out."""
        match event:
            case StepDone() if event.step == hold_out_until(self._trainer().config.train):
                self._compare()

    def _compare(self) -> None:
        trainer, source = self._trainer(), self._folder / STILL_FOLDER
        if not trainer.held_out or not checkpoint_paths(source):
            return
        still = load_run(source)
        pictures = [trainer.pictures[i] for i in sorted(trainer.held_out)]
        found = [_compared(trainer, still.scene, picture) for picture in pictures]
        moving, standing = _means([x[0] for x in found]), [x[1] for x in found if x[1] is not None]
        is_sure = still.config.train.hold_out_until < trainer.config.train.hold_out_until
        self.is_lost = not moving[0] > moving[1] + (0.0 if is_sure else MARGIN)
        kept = f"the still model of {still.step} steps is kept and trained on" if self.is_lost else "motion is kept"
        text = f"{len(found)} held-out training views: {moving[0]:.2f} dB with motion, {moving[1]:.2f} dB without"
        if standing:
            text += "; where nothing moves {:.2f} and {:.2f} dB".format(*_means(standing))
        self._loop.tell(Message(f"{text}; {kept}"))
        if not self.is_lost:
            shutil.rmtree(source, ignore_errors=True)


@torch.no_grad()
def _compared(
    trainer: Trainer, still: Scene, picture: Picture
) -> tuple[tuple[float, float], tuple[float, float] | None]:
    """Return PSNR of a picture with motion and without, whole and where nothing that moves is in front."""
    background, options = background_colour(trainer.background), trainer.options
    truth = picture.composite(background)
    drawn = [
        scene.render(picture.cameras, picture.time, options=options, background=background).rgb[0]
        for scene in (trainer.scene, still)
    ]
    moving = trainer.scene.part("moving").render(picture.cameras, picture.time, options=options).alpha[0]
    stands = (moving < CLEAR).float() * (1.0 if picture.mask is None else picture.mask)
    whole = psnr(drawn[0], truth, picture.mask), psnr(drawn[1], truth, picture.mask)
    if not bool((stands > 0).any()):
        return whole, None
    return whole, (psnr(drawn[0], truth, stands), psnr(drawn[1], truth, stands))


def _means(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return fmean(x for x, _ in values), fmean(x for _, x in values)


def _still_config(config: Config, every: int, folder: Path, *, moves: bool) -> Config:
    """Return the configuration of the still model."""
    still = as_still(config)
    steps = min(MAX_STILL_STEPS, max(1, round(STILL_SHARE * config.train.steps)))
    until = steps / config.train.steps if moves else config.train.hold_out_until
    train = still.train.model_copy(update={"hold_out_every": every, "hold_out_until": until})
    return still.model_copy(update={"train": train, "run": config.run.model_copy(update={"dir": folder})})


def _read_measured(path: Path, done: int) -> dict[int, float]:
    """Return held-out PSNR by step, up to step ``done``; nothing where the file is lost or damaged."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {int(step): float(x) for step, x in stored.items() if int(step) <= done}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}


@torch.no_grad()
def _quality(trainer: Trainer) -> float:
    """Return the mean PSNR of the views held out, dB."""
    background, values = background_colour(trainer.background), list[float]()
    for index in sorted(trainer.held_out):
        picture = trainer.pictures[index]
        shown = trainer.scene.render(picture.cameras, picture.time, options=trainer.options, background=background)
        values.append(psnr(shown.rgb[0], picture.composite(background), picture.mask))
    return fmean(values)


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
