"""Search for the strongest pruning within a given loss of PSNR, by bisection.

Every candidate is fine-tuned equally long from the same checkpoint, with the same views in the same
order. What it loses is the larger of two losses of mean PSNR: on views that the run and fine-tuning
see, against the run as it is (few other views may be kind to a candidate by chance), and

- on views that the run was never trained on, against the run as it is, where the capture has such
  views;
- else on training views that fine-tuning leaves out. The run was trained on them, so that it is
  fine-tuned like a candidate, too, before it is compared.

One kind of thing after the other is taken away, see ``Search.accepted``: of each the most, by
bisection, that keeps the loss below a fraction of what is allowed, with what was found for those
before.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from dyngs.compress.measure import find_coarsest_file
from dyngs.compress.stage import (
    PROBED_VIEWS,
    build_removal_edit,
    importance_scores,
    mean_psnr,
    probe_images,
)
from dyngs.config import AutoColour, Config
from dyngs.core.errors import DyngsError, format_count
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians.colour.training import HELD_OUT_EVERY
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.renderable import Posable
from dyngs.training.new_trainer import GaussianTrainer
from dyngs.training.trainer import TrainingEdit


@dataclass(frozen=True)
class PruneChoice:
    """A choice of parts to take away; the defaults take nothing."""

    fraction: float = 0.0  # of the Gaussians that is removed
    # pixels skip Gaussians with a lower alpha; None: as the run has it
    alpha_min: float | None = None
    # PSNR that view dependence may cost on training views before fine-tuning, dB; 0: all harmonics
    # stay
    harmonics: float = 0.0

    def __str__(self) -> str:
        words = [f"{self.fraction:.1%} of the Gaussians"] if self.fraction else []
        words += [f"alphas below {self.alpha_min:.3g}"] if self.alpha_min else []
        words += [f"harmonics worth {self.harmonics:g} dB"] if self.harmonics else []
        return ", ".join(words) or "nothing"


def apply_choice(trainer: GaussianTrainer, choice: PruneChoice, scores: Tensor) -> None:
    """Prune the scene of ``trainer``, after its last step, as ``choice`` specifies."""
    config: Config = trainer.config
    colour = config.colour
    if choice.harmonics:
        colour = AutoColour(opacity_entropy=colour.opacity_entropy)
    model = config.model
    if choice.alpha_min is not None:
        model = model.model_copy(update={"alpha_min": choice.alpha_min})
    prune = config.prune.model_copy(update={"fraction": choice.fraction})
    changed = {"model": model, "colour": colour, "prune": prune}
    trainer.apply(TrainingEdit(config=config.model_copy(update=changed)))
    trainer.apply(build_removal_edit(trainer, scores if choice.fraction else None))
    if choice.harmonics:
        usable = [i for i in range(len(trainer.images)) if i not in trainer.held_out]
        judged = usable[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY] or usable[:1]
        seen = [i for i in usable if i not in judged] or judged
        trainer.model.drop_harmonics(seen, judged, trainer.done, choice.harmonics)


HELD_OUT_FRACTION = 1 / 8
MOST_HELD_OUT = 32
"""Fraction and number of the training views that are held out; the number also limits those never
trained on."""
LEFT_GAUSSIANS = tuple(2 ** (-step / 2) for step in range(1, 13))
"""Fractions of the Gaussians that are left, tried by bisection."""
CUT_OFFS = (0.01, 0.02, 0.03)
# Losses of training images, dB, before fine-tuning, by dropping harmonics
HARMONIC_LOSSES = (0.01, 0.03, 0.1)

# Least loss of rounding that is allowed, dB: with 0 no file would be good enough
SMALLEST_FILE_LOSS = 0.01


@dataclass(frozen=True)
class Candidate:
    """A run after a choice and fine-tuning."""

    choice: PruneChoice
    config: Config
    checkpoint: Checkpoint  # at its end
    num_gaussians: int
    psnr: float  # mean on the views held out, dB
    loss: float  # that of what it is compared with, minus ``psnr``
    # of views that the run and fine-tuning see, against the run as it is, dB
    trained_loss: float = 0.0

    @property
    def worst(self) -> float:
        return max(self.loss, self.trained_loss)


@dataclass(frozen=True)
class PruneResult:
    """Scores of the candidate that a search chooses."""

    asked: float  # largest loss on the views held out, dB
    # mean PSNR on ``views`` of the run: as it is, where those are new to it; else fine-tuned like
    # the rest
    before: float
    after: float  # that of the file
    choice: PruneChoice
    views: str  # that losses were measured on, for people
    trials: int  # number of fine-tuned candidates, the run as it is included

    def __str__(self) -> str:
        kept = (
            f"{self.after - self.before:+.2f} dB on {self.views}, drawn from the file "
            f"({self.asked:g} dB may be lost)"
        )
        if self.choice == PruneChoice():
            return f"nothing can be taken away for {self.asked:g} dB: the run is as it was; {kept}"
        return f"taken away: {self.choice}; {kept}; {self.trials} trials"


def held_out_indices(count: int) -> tuple[int, ...]:
    """Return the indices of those of ``count`` training views that are held out, evenly spread;
    none of one view."""
    chosen = min(max(1, round(HELD_OUT_FRACTION * count)), MOST_HELD_OUT) if count > 1 else 0
    return tuple((2 * i + 1) * count // (2 * chosen) for i in range(chosen))


def validation_images(trainer: GaussianTrainer) -> list[Image]:
    """Return at most ``MOST_HELD_OUT`` images of the split `val`, which no training sees; of people
    none.

    They play other motions there, in which poses are not refined.
    """
    views = trainer.capture.splits.get("val", ())
    if not views or isinstance(trainer.model.scene, Posable):
        return []
    loader = ImageLoader(views, trainer.config.data)
    loader.device = trainer.device
    return [loader[i] for i in evenly_spaced(len(loader), MOST_HELD_OUT)]


class Search:
    """Candidates of a finished run.

    Args:
        trainer: of the run, restored from ``start``; it is changed.
        start: checkpoint at the end of the run.
        tell: is told what is tried and found.
        unseen: images that the run was never trained on; without any, training views are held out.
    """

    def __init__(
        self,
        trainer: GaussianTrainer,
        start: Checkpoint,
        tell: Callable[[str], None],
        unseen: Sequence[Image] = (),
    ) -> None:
        self.trainer, self.start, self.tell = trainer, start, tell
        self.held_out = () if unseen else held_out_indices(len(trainer.images))
        self.trials = 0
        self._config = trainer.config
        trainer.hold_out(self.held_out)
        self._scores = importance_scores(trainer, trainer.config.prune)
        self._truths = (
            list(unseen) or [trainer.images[i] for i in self.held_out] or probe_images(trainer)
        )
        others = [i for i in range(len(trainer.images)) if i not in self.held_out]
        self._others = [others[i] for i in evenly_spaced(len(others), PROBED_VIEWS)]
        self.views = "its only training view"
        if unseen:
            self.views = f"{format_count(len(unseen), 'view')} never trained on"
        elif self.held_out:
            self.views = f"{len(self.held_out)} training views held out"
        self._is_fair = bool(unseen)
        self._reference = 0.0
        self._exact_trained = 0.0

    def accepted(self, max_loss: float) -> list[Candidate]:
        """Return candidates that lose at most ``max_loss``, dB, each smaller than the one before.

        The first is the run as it is.
        """
        self._restart()
        exact, self._exact_trained = self._measured()
        whole = self.trainer.num_gaussians
        accepted = [Candidate(PruneChoice(), self._config, self.start, whole, exact, 0.0)]
        self._reference = exact
        if not self._is_fair:
            tuned = self._tried(PruneChoice())
            self._reference = tuned.psnr + max(tuned.trained_loss, 0.0)
            if tuned.trained_loss > 0:
                self.tell(
                    f"fine-tuning alone costs {tuned.trained_loss:.2f} dB, which counts as lost: "
                    "more --steps may cost less"
                )
        how = "" if self._is_fair else ", fine-tuned on the others"
        count = len(self._scores)
        self.tell(
            f"as it is{how}: {format_count(count, 'Gaussian')}, {self._reference:.2f} dB on {self.views}"
        )
        has_harmonics = bool(self.start.tensors["gaussians.sh"][:, 1:].any())
        alpha_min = self._config.model.alpha_min
        # Fractions of the loss up to which each kind is taken, those before it included (the rest
        # is for rounding), and what goes, the mildest first. A higher cut-off often gains, which
        # pays for fewer Gaussians.
        ladders = (
            (0.1, [{"alpha_min": x} for x in CUT_OFFS if x > alpha_min]),
            (0.65, [{"fraction": 1 - left} for left in LEFT_GAUSSIANS if left * count >= 1]),
            (0.85, [{"harmonics": x} for x in HARMONIC_LOSSES if has_harmonics]),
        )
        for share, changes in ladders:
            so_far = accepted[-1].choice
            found = self._bisected([replace(so_far, **x) for x in changes], share * max_loss)
            accepted += [] if found is None else [found]
        return accepted

    def run(self, max_loss: float) -> tuple[Candidate, bytes, PruneResult]:
        """Return the smallest accepted candidate whose file keeps the promise, and that file,
        rounded as far as it may.

        The last resort is the run as it is, whose file is compared with itself.
        """
        for candidate in reversed(self.accepted(max_loss)):
            least = candidate.psnr - max(max_loss - candidate.worst, SMALLEST_FILE_LOSS)
            file = find_coarsest_file(candidate.config, candidate.checkpoint, self._quality, least)
            if file is not None:
                before = candidate.psnr + candidate.loss
                choice = candidate.choice
                data, after = file
                promise = PruneResult(max_loss, before, after, choice, self.views, self.trials)
                return candidate, data, promise
            self.tell(f"without {candidate.choice}: the file loses more than {max_loss:g} dB")
        raise DyngsError(
            f"no file of it loses less than {max(max_loss, SMALLEST_FILE_LOSS):g} dB; allow more"
        )

    def _quality(self, scene: GaussianScene) -> float:
        return mean_psnr(self.trainer, scene, self._truths, alpha_min=scene.options.alpha_min)

    def _measured(self) -> tuple[float, float]:
        """Return the PSNR of the scene of the trainer on views held out, and on others."""
        scene = self.trainer.model.scene
        others = [self.trainer.images[i] for i in self._others]
        held_out = mean_psnr(self.trainer, scene, self._truths)
        return held_out, mean_psnr(self.trainer, scene, others)

    def _bisected(self, levels: Sequence[PruneChoice], allowed: float) -> Candidate | None:
        """Return the last of ``levels`` that loses at most ``allowed``, as if all before it did."""
        found = None

        def is_too_much(choice: PruneChoice) -> bool:
            nonlocal found
            tried = self._tried(choice)
            keeps = tried.worst <= allowed
            self.tell(
                f"trial {self.trials}: without {tried.choice}: {format_count(tried.num_gaussians, 'Gaussian')}, "
                f"{-tried.loss:+.2f} dB, {-tried.trained_loss:+.2f} on views trained on, "
                f"{'kept' if keeps else f'more than {allowed:.2f} dB lost'}"
            )
            found = tried if keeps else found
            return not keeps

        bisect_left(levels, True, key=is_too_much)
        return found

    def _tried(self, choice: PruneChoice) -> Candidate:
        self.trials += 1
        trainer = self.trainer
        self._restart()
        apply_choice(trainer, choice, self._scores)
        end = trainer.config.train.steps + trainer.config.prune.steps
        while trainer.done < end:
            trainer.step()
        psnr, trained = self._measured()
        return Candidate(
            choice,
            trainer.config,
            trainer.checkpoint(),
            len(trainer.model.scene),
            psnr,
            self._reference - psnr,
            self._exact_trained - trained,
        )

    def _restart(self) -> None:
        trainer = self.trainer
        trainer.restart(self._config, self.start)
        trainer.model.replace_scene(trainer.model.scene.without_masks())
