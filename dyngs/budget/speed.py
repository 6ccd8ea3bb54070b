"""``budget.min_fps``: training views drawn fast enough on this machine, by fewer Gaussians, and what that costs.

A drawing of N Gaussians is taken to last T0 + c N seconds. T0 is measured before training, with a few of them. While
Gaussians are added, c is measured now and then and says how many there may be. Towards the end, and once more at the
end, those that matter least are removed where drawing is too slow. What was measured is kept in checkpoints.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from statistics import median

import torch
from torch import Tensor

from dyngs.budget.count import scene_now, scores_now, stage, training_quality
from dyngs.budget.limits import CLOSE
from dyngs.build import training_cameras
from dyngs.config import Config, DynamicModel
from dyngs.data.frame_selection import evenly_spaced
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import new_field
from dyngs.deform.trained import TrainedScene
from dyngs.errors import DyngsError
from dyngs.evaluate.metrics import flip, ssim
from dyngs.evaluate.report import render_options
from dyngs.evaluate.temporal import Drawing
from dyngs.prune.selection import best
from dyngs.scene import Scene
from dyngs.train.schedule import scaled
from dyngs.train.step import Trainer

FEW = 300
"""Gaussians that say how long drawing takes with hardly any."""
POSSIBLE = 0.8
"""Of the time that a drawing may take; where hardly any Gaussians take more, the run is refused."""
GOAL, ACCEPTED = 0.9, 0.95
"""Shares of that time: what removing aims at, and from which on it is needed. What is measured varies."""
CHECKS = 10
"""Of growth, over a run."""
VIEWS, GROWTH_VIEWS, ROUNDS = 10, 5, 3
"""Views that are drawn for a measurement, fewer while Gaussians are added, and how often each."""
ATTEMPTS = 2
"""Measurements of which one must be fast enough: other programs disturb."""
TRIALS = 5
"""Numbers of Gaussians that are tried in one removal."""
CLOSE_ENOUGH = 0.9
"""Of the time aimed at; more Gaussians than that are not looked for."""
JUDGED = 100
"""Sides of the part of a picture that is judged, px: larger ones only take longer."""
SCORING_DRAWINGS = 1000
"""That take about as long as finding out which Gaussians matter."""
SAFETY = 1.3
"""Factor on the time that is kept free for that: the load of the machine changes."""
MAYBE = 0.6
"""Of the time that a drawing may take: less will not be too slow in the end."""


@dataclass
class SpeedLimit:
    """The speed that a run owes, and what was measured and done for it.

    Attributes:
        fps: asked for.
        base: seconds of a drawing with hardly any Gaussians.
        seconds: of a drawing when that was measured last.
        cap: Gaussians that there may be by what was measured; 0: as many as are wanted.
        passed: stages at which Gaussians were removed where that was needed.
        before: number of Gaussians before the first removal; 0: there was none.
        quality: of training pictures then, dB.
        lost: dB of them by all removals, before anything was trained again.
        measuring: seconds that it took to measure ``base``.
        removing: seconds that the last removal took; 0: there was none.
    """

    fps: float
    base: float = 0.0
    seconds: float = 0.0
    cap: int = 0
    passed: int = 0
    before: int = 0
    quality: float = 0.0
    lost: float = 0.0
    measuring: float = 0.0
    removing: float = 0.0

    def begin(self, trainer: Trainer, stored: Mapping[str, Tensor]) -> None:
        """Go on from what ``state`` returned, or, without that, measure what is possible; ``trainer`` is as it was.

        Raises:
            DyngsError: even a few Gaussians take too long; says what is possible.
        """
        for name in self.state().keys() & stored.keys():
            setattr(self, name, stored[name].item())
        if not self.base:
            scene = _few(trainer)
            drawing_seconds(trainer, scene, 1)  # what is loaded at first does not count
            start = time.perf_counter()
            self.base = self.seconds = least_seconds(trainer, scene, POSSIBLE / self.fps)
            self.measuring = time.perf_counter() - start
            if self.base > POSSIBLE / self.fps:
                possible = _rounded_down(ACCEPTED * POSSIBLE / self.base)
                raise DyngsError(
                    f"budget.min_fps={self.fps:g}: {FEW} Gaussians alone are drawn at {1 / self.base:.3g} per second "
                    f"here; {possible:g} would be possible, more with smaller pictures (data.longest_side)"
                )
        self.hold(trainer)

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint must hold."""
        measured = {name: value for name, value in asdict(self).items() if name != "fps"}
        return {
            name: torch.tensor(x, dtype=torch.float64 if isinstance(x, float) else None) for name, x in measured.items()
        }

    def hold(self, trainer: Trainer) -> None:
        """Let ``trainer`` add no more Gaussians than measured before."""
        if self.cap:
            trainer.densifier.limit(self.cap)

    def reserve(self) -> float:
        """Seconds that measuring at the end, and removing Gaussians then, may take."""
        measuring = ATTEMPTS * (self.measuring + VIEWS * ROUNDS * (self.seconds - self.base))
        if self.seconds < MAYBE / self.fps:
            return measuring
        return SAFETY * (self.removing or (1 + TRIALS) * measuring + SCORING_DRAWINGS * self.seconds)

    def after_step(self, trainer: Trainer, used: float = 0.0, given: float = math.inf) -> str | None:
        """A line about what was done to ``trainer`` so that it is drawn fast enough; None: nothing.

        Args:
            trainer: after each step.
            used, given: seconds of the run; before its end nothing is removed if what is left is not enough to do it
                twice.
        """
        config, step, count = trainer.config, trainer.done, len(trainer.optimizer.parameters)
        steps, strategy = config.train.steps, config.strategy
        now = stage(config, step, used / given)
        if now > self.passed:
            self.passed, last = now, step == config.total_steps
            return self._slimmed(trainer) if last or given - used > 2 * self.reserve() else None
        grows = scaled(strategy.start, steps) <= step < scaled(strategy.stop, steps) and count < strategy.growth_limit
        if grows and (not self.cap or step % max(steps // CHECKS, 1) == 0):
            self.seconds = drawing_seconds(trainer, scene_now(trainer), GROWTH_VIEWS)
            self.cap = allowed(self, count, config)
            self.hold(trainer)
        return None

    def reached(self, trainer: Trainer) -> str:
        """The line about ``budget.min_fps`` after a run.

        Raises:
            DyngsError: it is too slow after all.
        """
        got, count = 1 / self.seconds, len(trainer.optimizer.parameters)
        if got < self.fps:
            raise DyngsError(
                f"budget.min_fps={self.fps:g}: drawn at {got:.3g} per second, and no fewer Gaussians were fast enough; "
                "the run itself is complete"
            )
        cost = "it cost nothing"
        if self.before:
            now = training_quality(trainer)
            cost = (
                f"{self.before:,} -> {count:,} Gaussians; {-self.lost:+.2f} dB on training views when that was done "
                f"({self.quality:.2f} before, {now:.2f} at the end)"
            )
        elif CLOSE * self.cap <= count and 0 < self.cap < trainer.config.strategy.growth_limit:
            cost = f"{count:,} Gaussians; it held growth back; what more would bring is not known"
        return f"budget.min_fps: asked {self.fps:g}, got {got:.3g}; {cost}"

    def _slimmed(self, trainer: Trainer) -> str | None:
        """A line about the Gaussians that were removed because drawing was too slow; None: it was not."""
        start, scene = time.perf_counter(), scene_now(trainer)
        count = len(scene)
        self.seconds = least_seconds(trainer, scene, ACCEPTED / self.fps)
        if self.seconds <= ACCEPTED / self.fps:
            return None
        quality = training_quality(trainer)
        found = self._fastest(trainer, scores_now(trainer))
        if found is None:
            return None
        kept, self.seconds = found
        if not self.before:
            self.before, self.quality = count, quality
        trainer.keep(kept)
        left = int(kept.sum())
        self.cap = min(left, trainer.config.strategy.growth_limit)
        self.hold(trainer)
        now = training_quality(trainer)
        self.lost += quality - now
        self.removing = time.perf_counter() - start
        return (
            f"step {trainer.done}: budget.min_fps: {count:,} -> {left:,} Gaussians, {1 / self.seconds:.3g} per "
            f"second; {now - quality:+.2f} dB on training views"
        )

    def _fastest(self, trainer: Trainer, scores: Tensor) -> tuple[Tensor, float] | None:
        """Which of the Gaussians (N,) may stay, those of highest score, and the seconds of a drawing; None: none found.

        Their number is looked for between one that is fast enough and one that is not, as if time were linear in it.
        """
        whole, goal = trainer.checkpoint(), GOAL / self.fps
        (fine, fine_seconds), (slow, slow_seconds) = (0, min(self.base, POSSIBLE * goal)), (len(scores), self.seconds)
        found = None
        for _ in range(TRIALS):
            wanted = (1 + CLOSE_ENOUGH) / 2 * goal
            share = max((wanted - fine_seconds) / (slow_seconds - fine_seconds), 0.0)
            count = min(fine + max(1, int(share * (slow - fine))), slow - 1)
            if count <= fine:
                break
            kept = best(scores, 1 - count / len(scores))
            trainer.keep(kept)
            seconds = least_seconds(trainer, scene_now(trainer), goal)
            trainer.restore(whole)
            if seconds > goal:
                slow, slow_seconds = count, seconds
                continue
            found, (fine, fine_seconds) = (kept, seconds), (count, seconds)
            if seconds > CLOSE_ENOUGH * goal:
                break
        return found


def allowed(limit: SpeedLimit, count: int, config: Config) -> int:
    """How many Gaussians there may be before ``prune.share``, if ``count`` are drawn in ``limit.seconds``."""
    most, left = config.strategy.growth_limit, GOAL / limit.fps - limit.base
    each = (limit.seconds - limit.base) / max(count, 1)
    if each <= 0:
        return most
    return max(1, min(most, int(left / each / (1 - config.prune.share))))


@torch.no_grad()
def drawing_seconds(trainer: Trainer, scene: Scene, views: int = VIEWS) -> float:
    """The median over training views of the least time in which one is drawn at its full size, deformation included.

    In between each picture is judged, as evaluation does: drawing is faster where caches still hold all it needs.
    """
    config = trainer.config
    chosen = [trainer.pictures.views[i] for i in evenly_spaced(len(trainer.pictures), views)]
    cameras = training_cameras(chosen, config.data)
    drawing = Drawing(scene, render_options(config.model), torch.zeros(3))
    drawing.picture(cameras[0], chosen[0].time)
    least = [math.inf] * len(chosen)
    for _ in range(ROUNDS):
        for i, view in enumerate(chosen):
            start = time.perf_counter()
            picture = drawing.picture(cameras[i], view.time)
            least[i] = min(least[i], time.perf_counter() - start)
            part = picture[:JUDGED, :JUDGED]
            ssim(part, part)
            flip(part, part)
    return median(least)


def least_seconds(trainer: Trainer, scene: Scene, limit: float) -> float:
    """``drawing_seconds``, or the least of several measurements if more than ``limit``."""
    least = math.inf
    for _ in range(ATTEMPTS):
        least = min(least, drawing_seconds(trainer, scene))
        if least <= limit:
            break
    return least


def _few(trainer: Trainer) -> Scene:
    """``FEW`` of the Gaussians of ``trainer``, which a new field moves where times differ."""
    whole, count = trainer.checkpoint(), len(trainer.optimizer.parameters)
    kept = torch.zeros(count, dtype=torch.bool)
    kept[list(evenly_spaced(count, FEW))] = True
    trainer.keep(kept)
    scene = scene_now(trainer)
    trainer.restore(whole)
    model = trainer.config.model
    if isinstance(scene, TrainedScene) and scene.is_still and isinstance(model, DynamicModel) and scene.times:
        moving = len(scene)
        center, size = scene.gaussians.means.mean(0), torch.full((3,), trainer.extent)
        setup = FieldSetup(center, size, len(scene.times), moving, trainer.extent)
        field = new_field(model.deform, setup, torch.Generator())
        scene = replace(scene, rows=torch.arange(moving), field=field)
    return scene


def _rounded_down(x: float) -> float:
    """Two digits."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return math.floor(x / unit) * unit
