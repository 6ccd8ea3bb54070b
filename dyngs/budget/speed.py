"""``budget.min_fps``: training views drawn fast enough on this machine, by fewer Gaussians, and what that costs.

A drawing of N Gaussians is taken to last T0 + c N seconds. T0 is measured before training, with a few of them. While
Gaussians are added, c is measured now and then and says how many there may be. Towards the end, and once more at the
end, those that matter least are removed where drawing is too slow. What was measured is kept in checkpoints.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from statistics import median

import torch
from torch import Tensor

from dyngs.budget.run import LimitedRun, stage, two_digits
from dyngs.config import Config
from dyngs.data.times import evenly_spaced
from dyngs.errors import DyngsError, counted
from dyngs.evaluate.view_scores import Drawing
from dyngs.gaussians.scene import GaussianScene, render_options
from dyngs.kinds import GaussianTrainer
from dyngs.metrics import flip, ssim
from dyngs.models.schedule import scaled
from dyngs.models.views import training_cameras
from dyngs.ops.device import finish
from dyngs.prune.stage import highest, quality_of, scores_of
from dyngs.training.events import Event, StepDone
from dyngs.training.limits import CLOSE

FEW = 300
"""Number of Gaussians with which the fixed cost of drawing is measured."""
POSSIBLE = 0.8
"""Fraction of the allowed drawing time; a run whose fixed cost is higher is refused."""
GOAL, ACCEPTED = 0.9, 0.95
"""Fractions of the allowed time: the aim of a removal, and the least that needs one. Measurements vary."""
CHECKS = 10
"""Number of measurements during growth, over a run."""
VIEWS, GROWTH_VIEWS, ROUNDS = 10, 5, 3
"""Views that are drawn for a measurement, fewer while Gaussians are added, and how often each."""
ATTEMPTS = 2
"""Measurements of which one must be fast enough: other programs disturb."""
TRIALS = 5
"""Number of trials in one removal."""
CLOSE_ENOUGH = 0.9
"""Fraction of the time aimed at from which the search ends."""
JUDGED = 100
"""Side of the part of an image that is compared, px; larger parts only take longer."""
SCORING_DRAWINGS = 1000
"""Number of drawings that take about as long as scoring the Gaussians."""
SAFETY = 1.3
"""Factor on the time that is kept free for that: the load of the machine changes."""
MAYBE = 0.6
"""Fraction of the allowed time; a faster scene will not be too slow at the end."""


@dataclass
class Measured:
    """Measurements and removals for a speed.

    Attributes:
        base, seconds: of a drawing with hardly any Gaussians, and when that was measured last.
        cap: Gaussians that there may be by what was measured; 0: any number.
        passed: stages at which Gaussians were removed where that was needed.
        before, quality: number of Gaussians before the first removal, 0 without one, and dB of training images then.
        lost: dB of them by all removals, before anything was trained again.
        measuring, removing: seconds that it took to measure ``base``, and that the last removal took.
    """

    base: float = 0.0
    seconds: float = 0.0
    cap: int = 0
    passed: int = 0
    before: int = 0
    quality: float = 0.0
    lost: float = 0.0
    measuring: float = 0.0
    removing: float = 0.0


class SpeedLimit:
    """Listener that keeps drawing fast enough."""

    def __init__(self, run: LimitedRun, fps: float) -> None:
        self.run, self.fps, self.found = run, fps, Measured()

    def begin(self) -> None:
        """Measure what is possible, unless a checkpoint says it; the trainer may add no more Gaussians than that."""
        found, trainer = self.found, self.run.trainer
        if not found.base:
            scene = _few(trainer)
            drawing_seconds(trainer, scene, 1)  # what is loaded at first does not count
            start = time.perf_counter()
            found.base = found.seconds = least_seconds(trainer, scene, POSSIBLE / self.fps)
            found.measuring = time.perf_counter() - start
            if found.base > POSSIBLE / self.fps:
                possible = two_digits(ACCEPTED * POSSIBLE / found.base, math.floor)
                raise DyngsError(
                    f"budget.min_fps={self.fps:g}: {FEW} Gaussians alone are drawn at {1 / found.base:.3g} per second "
                    f"here; {possible:g} would be possible, more with smaller images (data.longest_side)"
                )
        self.hold()

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint."""
        return {
            name: torch.tensor(x, dtype=torch.float64 if isinstance(x, float) else None, device="cpu")
            for name, x in asdict(self.found).items()
        }

    def restore(self, stored: Mapping[str, Tensor]) -> None:
        """Restore the state that ``state`` returned."""
        for name in self.state().keys() & stored.keys():
            setattr(self.found, name, stored[name].item())
        config = self.run.config
        if config.train.minutes is None:  # a run that has become longer comes to its last stages again
            self.found.passed = min(self.found.passed, stage(config, self.run.trainer.done))

    def hold(self) -> None:
        """Let the trainer add no more Gaussians than measured before."""
        if self.found.cap:
            self.run.trainer.model.densifier.limit(self.found.cap)
        self.run.reserve = self._reserve()

    def __call__(self, event: Event) -> None:
        """Measure the speed while Gaussians are added; remove some in a late stage, if drawing is too slow."""
        if not isinstance(event, StepDone):
            return
        now, trainer = self.run.stage, self.run.trainer
        if now > self.found.passed:
            self.found.passed = now
            # Before the end nothing is removed if the time that is left is not enough to do it twice.
            if event.is_last or self.run.given - self.run.used > 2 * self._reserve():
                self._remove()
        elif self._is_growing(event.step):
            self.found.seconds = drawing_seconds(trainer, trainer.model.scene, GROWTH_VIEWS)
            self.found.cap = allowed(self.found, self.fps, trainer.num_gaussians, trainer.config)
            self.hold()

    def reached(self) -> str:
        """Return the line about ``budget.min_fps`` after a run. Raises DyngsError: it is too slow after all."""
        found, trainer = self.found, self.run.trainer
        got, count = 1 / found.seconds, trainer.num_gaussians
        if got < self.fps:
            raise DyngsError(
                f"budget.min_fps={self.fps:g}: drawn at {got:.3g} per second, and no fewer Gaussians were fast enough; "
                "the run itself is complete"
            )
        cost = "it cost nothing"
        if found.before:
            now = quality_of(trainer, trainer.model.scene)
            cost = (
                f"{found.before:,} -> {counted(count, 'Gaussian')}; {-found.lost:+.2f} dB on training views when that "
                f"was done ({found.quality:.2f} before, {now:.2f} at the end)"
            )
        elif CLOSE * found.cap <= count and 0 < found.cap < self.run.trainer.config.strategy.growth_limit:
            cost = f"{counted(count, 'Gaussian')}; it held growth back; what more would bring is not known"
        return f"budget.min_fps: asked {self.fps:g}, got {got:.3g}; {cost}"

    def _is_growing(self, step: int) -> bool:
        """Return whether the speed is to be measured after ``step`` because Gaussians are being added."""
        steps, strategy = self.run.trainer.config.train.steps, self.run.trainer.config.strategy
        grows = scaled(strategy.start, steps) <= step < scaled(strategy.stop, steps)
        due = not self.found.cap or step % max(steps // CHECKS, 1) == 0
        return grows and due and self.run.trainer.num_gaussians < strategy.growth_limit

    def _reserve(self) -> float:
        """Return the seconds that measuring at the end, and removing Gaussians then, may take."""
        found = self.found
        measuring = ATTEMPTS * (found.measuring + VIEWS * ROUNDS * (found.seconds - found.base))
        if found.seconds < MAYBE / self.fps:
            return measuring
        return SAFETY * (found.removing or (1 + TRIALS) * measuring + SCORING_DRAWINGS * found.seconds)

    def _remove(self) -> None:
        """Remove Gaussians if drawing is too slow."""
        found, trainer, start = self.found, self.run.trainer, time.perf_counter()
        count = trainer.num_gaussians
        found.seconds = least_seconds(trainer, trainer.model.scene, ACCEPTED / self.fps)
        self.run.reserve = self._reserve()
        if found.seconds <= ACCEPTED / self.fps:
            return
        fastest = self._fastest(scores_of(trainer))
        if fastest is None:
            return
        kept, found.seconds = fastest
        before, after = self.run.remove(kept)
        if not found.before:
            found.before, found.quality = count, before
        left = trainer.num_gaussians
        found.cap = min(left, self.run.trainer.config.strategy.growth_limit)
        found.lost += before - after
        found.removing = time.perf_counter() - start
        self.hold()
        self.run.say(
            f"step {trainer.done}: budget.min_fps: {count:,} -> {counted(left, 'Gaussian')}, {1 / found.seconds:.3g} "
            f"per second; {after - before:+.2f} dB on training views"
        )

    def _fastest(self, scores: Tensor) -> tuple[Tensor, float] | None:
        """Return which of the Gaussians (N,) may stay, those of highest score, and the seconds of a drawing.

        Their number is looked for between one that is fast enough and one that is not, as if time were linear in it.
        None: no number is fast enough.
        """
        trainer, goal = self.run.trainer, GOAL / self.fps
        fine, fine_seconds = 0, min(self.found.base, POSSIBLE * goal)
        slow, slow_seconds = len(scores), self.found.seconds
        found = None
        for _ in range(TRIALS):
            wanted = (1 + CLOSE_ENOUGH) / 2 * goal
            fraction = max((wanted - fine_seconds) / (slow_seconds - fine_seconds), 0.0)
            count = min(fine + max(1, int(fraction * (slow - fine))), slow - 1)
            if count <= fine:
                break
            kept = highest(scores, 1 - count / len(scores))
            seconds = least_seconds(trainer, trainer.model.scene.select(kept), goal)
            if seconds > goal:
                slow, slow_seconds = count, seconds
                continue
            found, (fine, fine_seconds) = (kept, seconds), (count, seconds)
            if seconds > CLOSE_ENOUGH * goal:
                break
        return found


def allowed(found: Measured, fps: float, count: int, config: Config) -> int:
    """Return how many Gaussians there may be before pruning, if ``count`` are drawn in ``found.seconds``."""
    most, left = config.strategy.growth_limit, GOAL / fps - found.base
    each = (found.seconds - found.base) / max(count, 1)
    if each <= 0:
        return most
    return max(1, min(most, int(left / each / (1 - config.prune.fraction))))


@torch.no_grad()
def drawing_seconds(trainer: GaussianTrainer, scene: GaussianScene, views: int = VIEWS) -> float:
    """Return the median over training views of the least time to draw one at full size, deformation included.

    In between each image is judged, as evaluation does: drawing is faster where caches still hold all it needs.
    """
    config = trainer.config
    chosen = [trainer.images.views[i] for i in evenly_spaced(len(trainer.images), views)]
    cameras = training_cameras(chosen, config.data)
    options = render_options(config.model, trainer.extent, trainer.capture.world_scale)
    drawing = Drawing(scene, options, torch.zeros(3, device=scene.gaussians.means.device))
    drawing.image(cameras[0], chosen[0].time)
    least = [math.inf] * len(chosen)
    for _ in range(ROUNDS):
        for i, view in enumerate(chosen):
            start = time.perf_counter()
            image = drawing.image(cameras[i], view.time)
            finish(image.device)
            least[i] = min(least[i], time.perf_counter() - start)
            part = image[:JUDGED, :JUDGED]
            ssim(part, part)
            flip(part, part)
    return median(least)


def least_seconds(trainer: GaussianTrainer, scene: GaussianScene, limit: float) -> float:
    """Return ``drawing_seconds``, or the least of several measurements if more than ``limit``."""
    least = math.inf
    for _ in range(ATTEMPTS):
        least = min(least, drawing_seconds(trainer, scene))
        if least <= limit:
            break
    return least


def _few(trainer: GaussianTrainer) -> GaussianScene:
    """Return ``FEW`` of the Gaussians of ``trainer``, all of them moving if any will move."""
    kept = torch.tensor(evenly_spaced(trainer.num_gaussians, FEW), device="cpu")
    return trainer.model.training.all_moving(trainer.model.scene.select(kept), trainer.extent)
