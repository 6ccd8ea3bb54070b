"""The focal length of one fixed camera that was guessed: refined with the body, judged on frames left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from dyngs.gaussians.parameters import Parameters
from dyngs.human.fit.observed import ObservedFrame
from dyngs.human.fit.solve import Observations, PosePrior, Stage, frame_error, run_stage, with_lens
from dyngs.human.fit.surface import Surface
from dyngs.human.motion.clip import MotionClip

EVERY = 4
"""Each so many-th frame is left out: of those only poses are fitted."""
GAIN = 0.01
"""Share by which the error on frames left out must fall for a refined focal length to be taken."""


@dataclass(frozen=True)
class LensFit:
    """A focal length that was tried.

    Attributes:
        factor: on the guessed focal length.
        distance: from the camera at which the size in the images is kept, in units of the world.
        error: on the frames left out, with the focal length as guessed and as refined.
        taken: the refined one is better.
    """

    factor: float
    distance: float
    error: tuple[float, float]
    taken: bool

    def summary(self) -> str:
        """Return a line for people."""
        guessed, refined = self.error
        return (
            f"focal length: {self.factor:.2f} times the guess, error on frames left out {guessed:.4f} -> {refined:.4f}"
            + (", taken" if self.taken else ": the guess stays, as the images do not tell")
        )


@dataclass(frozen=True)
class _Task:
    """The frames of one camera, and how they are fitted."""

    clip: MotionClip
    surface: Surface
    observed: Observations
    expected: PosePrior
    steps: int
    tick: Callable[[], None]

    def run(self, start: Parameters, learned: Sequence[str], rows: Sequence[int]) -> Parameters:
        """Return the fit after a stage in which only ``rows`` are seen."""

        def some(row: int) -> ObservedFrame | None:
            return self.observed(row) if row in rows else None

        stage = Stage(self.steps, 3, tuple(learned))
        return run_stage(start, stage, self.clip, self.surface, some, self.expected, self.tick)

    @torch.no_grad()
    def error(self, learned: Parameters, rows: Sequence[int]) -> float:
        """Return the mean error of frames."""
        shown = [(row, seen) for row in rows if (seen := self.observed(row)) is not None]
        errors = [float(frame_error(learned, self.clip, self.surface, row, seen)) for row, seen in shown]
        return sum(errors) / max(len(errors), 1)


def num_ticks(steps: int) -> int:
    """Return how often ``fit_lens`` calls ``tick`` where a stage has so many steps."""
    return 5 * steps


def fit_lens(
    start: Parameters,
    shape: Sequence[str],
    clip: MotionClip,
    surface: Surface,
    observed: Observations,
    expected: PosePrior,
    steps: int,
    tick: Callable[[], None] = lambda: None,
) -> tuple[Parameters, LensFit]:
    """Return the fit of shape, poses and focal length to the frames of one camera at the origin; ``start`` if it stays.

    Both are fitted to three of four frames, with the focal length as guessed and refined. Then shape and focal length
    are kept, and poses of the other frames are fitted: where these agree better, the refined one is taken.

    Args:
        start: shape and poses that were found with the guessed focal length.
        shape: names of what is the same in all frames.
        clip: the given poses, F frames.
        surface: of the template.
        observed: observations of a row of the clip.
        expected: of the poses.
        steps: of a stage.
        tick: called after every step.
    """
    task = _Task(clip, surface, observed, expected, steps, tick)
    rows = list(range(len(clip)))
    apart = rows[EVERY // 2 :: EVERY] or rows
    rest = [row for row in rows if row not in apart] or rows
    own = ("poses", "trans")
    distance = float(-clip.trans[:, 2].mean())
    guessed = task.run(start, (*shape, *own), rest)
    refined = task.run(with_lens(start, distance), (*shape, *own, "log_focal"), rest)
    both = [task.run(found, own, apart) for found in (guessed, refined)]
    errors = (task.error(both[0], apart), task.error(both[1], apart))
    taken = errors[1] < (1 - GAIN) * errors[0]
    found = task.run(both[1], (*shape, *own, "log_focal"), rows) if taken else start
    last = found if taken else refined
    return found, LensFit(float(last["log_focal"].detach().exp()), distance, errors, taken)
