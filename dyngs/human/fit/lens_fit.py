"""The focal length of one fixed camera that was guessed: refined with the body, judged on frames left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from dyngs.gaussians.parameters import Parameters
from dyngs.human.fit.solve import Fitting, Observations, frame_error, with_lens

EVERY = 4  # each so many-th frame is left out: of those only poses are fitted
GAIN = 0.01  # fraction by which the error on frames left out must fall for a refined focal length to be taken


@dataclass(frozen=True)
class LensFit:
    """A focal length that was tried."""

    factor: float  # on the guessed focal length
    distance: float  # from the camera at which the size in the images is kept, in units of the world
    error: tuple[float, float]  # on the frames left out, with the focal length as guessed and as refined
    taken: bool  # the refined one is better

    def summary(self) -> str:
        """Return a line for people."""
        guessed, refined = self.error
        return (
            f"focal length: {self.factor:.2f} times the guess, error on frames left out {guessed:.4f} -> {refined:.4f}"
            + (", taken" if self.taken else ": the guess stays, as the images do not tell")
        )


def num_ticks(steps: int) -> int:
    """Return how often ``fit_lens`` calls ``tick`` where a stage has so many steps."""
    return 5 * steps


def fit_lens(
    fitting: Fitting,
    start: Parameters,
    shape: Sequence[str],
    observed: Observations,
    steps: int,
    tick: Callable[[], None] = lambda: None,
) -> tuple[Parameters, LensFit]:
    """Return the fit of shape, poses and focal length to the frames of one camera at the origin; ``start`` if it stays.

    Both are fitted to three of four frames, with the focal length as guessed and refined. Then shape and focal length
    are kept, and poses of the other frames are fitted: where these agree better, the refined one is taken. ``start``
    was found with the guessed focal length; ``shape`` names what is the same in all frames.
    """
    rows = list(range(len(fitting.clip)))
    apart = rows[EVERY // 2 :: EVERY] or rows
    rest = [row for row in rows if row not in apart] or rows
    own = ("poses", "trans")

    def run(start: Parameters, learned: Sequence[str], seen: Sequence[int]) -> Parameters:
        return fitting.run(start, learned, steps, lambda row: observed(row) if row in seen else None, tick)

    distance = float(-fitting.clip.trans[:, 2].mean())
    guessed = run(start, (*shape, *own), rest)
    refined = run(with_lens(start, distance), (*shape, *own, "log_focal"), rest)
    both = [run(found, own, apart) for found in (guessed, refined)]
    errors = (_mean_error(fitting, both[0], observed, apart), _mean_error(fitting, both[1], observed, apart))
    taken = errors[1] < (1 - GAIN) * errors[0]
    found = run(both[1], (*shape, *own, "log_focal"), rows) if taken else start
    last = found if taken else refined
    return found, LensFit(float(last["log_focal"].detach().exp()), distance, errors, taken)


@torch.no_grad()
def _mean_error(fitting: Fitting, learned: Parameters, observed: Observations, rows: Sequence[int]) -> float:
    shown = [(row, seen) for row in rows if (seen := observed(row)) is not None]
    errors = [float(frame_error(learned, fitting.clip, fitting.surface, row, seen)) for row, seen in shown]
    return sum(errors) / max(len(errors), 1)
