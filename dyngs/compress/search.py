"""The most that can be taken from a run for a given loss, found by bisection.

Every candidate is fine-tuned equally long from the same checkpoint, with the same views in the same
order. What it loses is the larger of two losses of mean PSNR: on views that the run and fine-tuning
see, against the run as it is (few other views may be kind to a candidate by chance), and

- on views that the run was never trained on, against the run as it is, where the capture has such
  views;
- else on training views that fine-tuning leaves out. The run was trained on them, so that it is
  fine-tuned like a candidate, too, before it is compared.

One kind of thing after the other is taken away, as listed in ``ALLOWED``: of each the most, by
bisection, that keeps the loss below a fraction of what is allowed, with what was found for those
before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.compress.measure import CoarseFile, coarsest_file
from dyngs.compress.stage import PROBED_VIEWS, probe_images, quality_of, removal, scores_of
from dyngs.config import AutoColour, Config
from dyngs.core.errors import DyngsError, counted
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import innermost, with_innermost
from dyngs.deform.keys import ControlNodesField, DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.colour.training import HELD_OUT_EVERY, MeasuredView, find_view_dependent
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.renderable import Posable
from dyngs.models.views import background_colour
from dyngs.ops.device import sent
from dyngs.training.new_trainer import GaussianTrainer
from dyngs.training.trainer import Edit


@dataclass(frozen=True)
class FieldSize:
    """Size of a field of control nodes."""

    nodes: int
    pieces: int


@dataclass(frozen=True)
class Cut:
    """A choice of parts to take away; the defaults take nothing."""

    fraction: float = 0.0  # of the Gaussians that is removed
    # pixels skip Gaussians with a lower alpha; None: as the run has it
    alpha_min: float | None = None
    field: FieldSize | None = None  # size of the field of control nodes; None: as it is
    # PSNR that view dependence may cost on training views before fine-tuning, dB; 0: all harmonics
    # stay
    harmonics: float = 0.0

    def __str__(self) -> str:
        words = [f"{self.fraction:.1%} of the Gaussians"] if self.fraction else []
        words += [f"alphas below {self.alpha_min:.3g}"] if self.alpha_min else []
        words += (
            [f"all but {self.field.nodes} nodes of {self.field.pieces} pieces"]
            if self.field
            else []
        )
        words += [f"harmonics worth {self.harmonics:g} dB"] if self.harmonics else []
        return ", ".join(words) or "nothing"


def field_size(scene: GaussianScene) -> FieldSize | None:
    """Return the size of the field of ``scene``; None where no control nodes move anything."""
    nodes = _nodes_of(scene)
    return (
        FieldSize(nodes.num_nodes, nodes.num_pieces)
        if nodes is not None and nodes.num_nodes
        else None
    )


def with_field(scene: GaussianScene, size: FieldSize) -> GaussianScene:
    """Return ``scene`` with so many of its nodes and pieces; as it is where no control nodes move
    anything."""
    nodes = _nodes_of(scene)
    if nodes is None or not isinstance(scene, DynamicScene) or scene.field is None:
        return scene
    reduced = nodes.reduced(size.nodes, size.pieces, scene.gaussians.means.detach()[scene.moving])
    return replace(scene, field=with_innermost(scene.field, reduced))


def _nodes_of(scene: GaussianScene) -> ControlNodes | None:
    if not isinstance(scene, DynamicScene) or scene.field is None or scene.is_static:
        return None
    field = innermost(scene.field)
    return field if isinstance(field, ControlNodes) else None


def cut_config(config: Config, cut: Cut) -> Config:
    """Return the configuration of what ``apply_cut`` leaves."""
    model = config.model
    match model:
        case DynamicModel(deform=ControlNodesField() as deform) if cut.field is not None:
            size = {"nodes": cut.field.nodes, "pieces": cut.field.pieces}
            model = model.model_copy(update={"deform": deform.model_copy(update=size)})
        case _:
            pass
    if cut.alpha_min is not None:
        model = model.model_copy(update={"alpha_min": cut.alpha_min})
    colour = config.colour
    if cut.harmonics:
        colour = AutoColour(opacity_entropy=colour.opacity_entropy)
    prune = config.prune.model_copy(update={"fraction": cut.fraction})
    return config.model_copy(update={"model": model, "colour": colour, "prune": prune})


def apply_cut(trainer: GaussianTrainer, cut: Cut, scores: Tensor) -> None:
    """Take away what ``cut`` says from the scene of ``trainer``, which is at the end of its run."""
    trainer.apply(Edit(config=cut_config(trainer.config, replace(cut, field=None))))
    trainer.apply(removal(trainer, scores if cut.fraction else None))
    if cut.field is not None and _nodes_of(trainer.model.scene) is not None:
        # else nothing that moves is left
        trainer.apply(Edit(config=cut_config(trainer.config, cut)))
        trainer.model.exchange(with_field(trainer.model.scene, cut.field))
    if cut.harmonics:
        _drop_harmonics(trainer, cut.harmonics)


def _drop_harmonics(trainer: GaussianTrainer, tolerance: float) -> None:
    usable = [i for i in range(len(trainer.images)) if i not in trainer.held_out]
    judged = usable[HELD_OUT_EVERY // 2 :: HELD_OUT_EVERY] or usable[:1]
    seen = [i for i in usable if i not in judged] or judged
    background = sent(background_colour(trainer.background), trainer.device)
    looks = list(_looks(trainer, judged, background))
    found = find_view_dependent(
        _looks(trainer, seen, background), looks, trainer.model.options, background, tolerance
    )
    trainer.model.drop_harmonics(~found.keeps, found.offsets)
    trainer.model.keep_plain(
        ~found.keeps, AutoColour(opacity_entropy=trainer.config.colour.opacity_entropy)
    )


def _looks(
    trainer: GaussianTrainer, indices: Sequence[int], background: Tensor
) -> Iterator[MeasuredView]:
    for image in (trainer.images[i] for i in indices):
        with torch.no_grad():
            now = trainer.model.training.time_step(
                trainer.model.scene, image, trainer.done
            ).gaussians.detach()
        yield MeasuredView(now, image.cameras, image.composite(background), image.mask)


HELD_OUT_FRACTION = 1 / 8
MOST_HELD_OUT = 32
"""Fraction and number of the training views that are held out; the number also limits those never
trained on."""
LEFT_GAUSSIANS = tuple(2 ** (-step / 2) for step in range(1, 13))
"""Fractions of the Gaussians that are left, tried by bisection."""
CUT_OFFS = (0.01, 0.02, 0.03)
FIELD_LOSSES = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Losses of training images, dB, before fine-tuning, by fewer pieces and by fewer nodes each."""
# Losses of training images, dB, before fine-tuning, by dropping harmonics
HARMONIC_LOSSES = (0.01, 0.03, 0.1)
ALLOWED = {"cut-off": 0.1, "Gaussians": 0.65, "field": 0.8, "harmonics": 0.85}
"""Fraction of the allowed loss up to which each kind is taken, those before it included; the rest
is for rounding."""
FEWEST_NODES = 8

# Least loss of rounding that is allowed, dB: with 0 no file would be good enough
SMALLEST_FILE_LOSS = 0.01

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Candidate:
    """A run after a cut and fine-tuning."""

    cut: Cut
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
class SearchLimit:
    """Why no more of one kind of thing was taken."""

    kind: str  # of thing, a key of ``ALLOWED``
    taken: str  # what goes, of this kind
    # the next step, and its loss in dB; None where there is no next step
    refused: tuple[str, float] | None = None

    def __str__(self) -> str:
        if self.refused is None:
            return f"{self.kind}: {self.taken}; there was no more to try"
        step, loss = self.refused
        return f"{self.kind}: {self.taken}; {step} would cost {loss:.2f} dB"


@dataclass(frozen=True)
class Promise:
    """What is told of the candidate that a search chooses."""

    asked: float  # largest loss on the views held out, dB
    # mean PSNR on ``views`` of the run: as it is, where those are new to it; else fine-tuned like
    # the rest
    before: float
    after: float  # that of the file
    cut: str  # what was taken away, for people; "nothing" where nothing could be
    # why no more was taken, by kind of thing, and why the file is not rounded more
    limits: tuple[SearchLimit, ...]
    views: str  # that losses were measured on, for people
    trials: int  # number of fine-tuned candidates, the run as it is included

    def __str__(self) -> str:
        kept = (
            f"{self.after - self.before:+.2f} dB on {self.views}, drawn from the file "
            f"({self.asked:g} dB may be lost)"
        )
        if self.cut == "nothing":
            told = f"nothing can be taken away for {self.asked:g} dB: the run is as it was; {kept}"
        else:
            told = f"taken away: {self.cut}; {kept}; {self.trials} trials"
        return "\n".join([told, *(f"limit: {limit}" for limit in self.limits)])


def evenly_held_out(count: int) -> tuple[int, ...]:
    """Return the indices of those of ``count`` training views that are held out, evenly spread;
    none of one view."""
    chosen = min(max(1, round(HELD_OUT_FRACTION * count)), MOST_HELD_OUT) if count > 1 else 0
    return tuple((2 * i + 1) * count // (2 * chosen) for i in range(chosen))


def unseen_images(trainer: GaussianTrainer) -> list[Image]:
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
        self, trainer: GaussianTrainer, start: Checkpoint, tell: Tell, unseen: Sequence[Image] = ()
    ) -> None:
        self.trainer, self.start, self.tell = trainer, start, tell
        self.held_out = () if unseen else evenly_held_out(len(trainer.images))
        self.trials = 0
        self._config = trainer.config
        trainer.hold_out(self.held_out)
        self._scores = scores_of(trainer, trainer.config.prune)
        self._truths = (
            list(unseen) or [trainer.images[i] for i in self.held_out] or probe_images(trainer)
        )
        self.views = (
            f"{len(self._truths)} training views held out"
            if self.held_out
            else "its only training view"
        )
        if unseen:
            self.views = f"{counted(len(self._truths), 'view')} never trained on"
        self._is_fair = bool(unseen)
        self._reference = 0.0
        self._exact_trained = 0.0

    def accepted(self, max_loss: float) -> tuple[list[Candidate], list[SearchLimit]]:
        """Return candidates that lose at most ``max_loss``, dB, each smaller than the one before;
        and why no more.

        The first is the run as it is.
        """
        self._restart()
        config = self._config
        exact = quality_of(self.trainer, self.trainer.model.scene, self._truths)
        self._exact_trained = quality_of(self.trainer, self.trainer.model.scene, self._others())
        accepted = [Candidate(Cut(), config, self.start, self.trainer.num_gaussians, exact, 0.0)]
        limits = []
        self._reference = exact if self._is_fair else self._fine_tuned()
        how = "" if self._is_fair else ", fine-tuned on the others"
        self.tell(
            f"as it is{how}: {counted(len(self._scores), 'Gaussian')}, {self._reference:.2f} dB on {self.views}"
        )
        for kind, knob in self._knobs().items():
            levels = knob(accepted[-1].cut)
            if not levels:
                continue
            found, limit = self._bisected(kind, levels, ALLOWED[kind] * max_loss)
            limits.append(limit)
            accepted += [] if found is None else [found]
        return accepted, limits

    def _fine_tuned(self) -> float:
        """Return the PSNR of the run as it is, fine-tuned; what fine-tuning costs views that it
        trains on is added."""
        trainer = self.trainer
        probes = self._others()
        before = quality_of(trainer, trainer.model.scene, probes)
        psnr = self._tried(Cut()).psnr
        cost = before - quality_of(trainer, trainer.model.scene, probes)
        if cost > 0:
            self.tell(
                f"fine-tuning alone costs {cost:.2f} dB, which counts as lost: more --steps may cost less"
            )
        return psnr + max(cost, 0.0)

    def _others(self) -> list[Image]:
        others = [i for i in range(len(self.trainer.images)) if i not in self.held_out]
        return [self.trainer.images[others[i]] for i in evenly_spaced(len(others), PROBED_VIEWS)]

    def run(self, max_loss: float) -> tuple[Candidate, CoarseFile, Promise]:
        """Return the smallest accepted candidate whose file keeps the promise, and that file,
        rounded as far as it may.

        The last resort is the run as it is, whose file is compared with itself.
        """
        accepted, limits = self.accepted(max_loss)
        for candidate in reversed(accepted):
            least = candidate.psnr - max(max_loss - candidate.worst, SMALLEST_FILE_LOSS)
            file = coarsest_file(candidate.config, candidate.checkpoint, self._quality, least)
            if file is None:
                self.tell(f"without {candidate.cut}: the file loses more than {max_loss:g} dB")
                continue
            loss = None if file.refused is None else candidate.psnr + candidate.loss - file.refused
            refused = None if loss is None else ("the next step", loss)
            limits.append(
                SearchLimit("precision", f"steps {file.factor:.2g} times the usual", refused)
            )
            before = candidate.psnr + candidate.loss
            cut = str(candidate.cut)
            return (
                candidate,
                file,
                Promise(
                    max_loss, before, file.quality, cut, tuple(limits), self.views, self.trials
                ),
            )
        raise DyngsError(
            f"no file of it loses less than {max(max_loss, SMALLEST_FILE_LOSS):g} dB; allow more"
        )

    def _quality(self, scene: GaussianScene) -> float:
        return quality_of(self.trainer, scene, self._truths, alpha_min=scene.options.alpha_min)

    def _knobs(self) -> dict[str, Callable[[Cut], Sequence[tuple[str, Cut]]]]:
        """Return for each kind of thing the steps of taking it away, beyond a cut, the mildest
        first."""
        return {
            # first: it often gains, which pays for fewer Gaussians
            "cut-off": self._higher_cut_offs,
            "Gaussians": self._fewer_gaussians,
            "field": self._smaller_fields,
            "harmonics": self._fewer_harmonics,
        }

    def _bisected(
        self, kind: str, levels: Sequence[tuple[str, Cut]], allowed: float
    ) -> tuple[Candidate | None, SearchLimit]:
        """Return the last of ``levels`` that loses at most ``allowed``, as if all before it did;
        and why no more."""
        found = None
        refused = None
        low = 0
        high = len(levels)
        while low < high:
            middle = (low + high) // 2
            name, cut = levels[middle]
            tried = self._tried(cut)
            keeps = tried.worst <= allowed
            self.tell(
                f"trial {self.trials}: without {cut}: {counted(tried.num_gaussians, 'Gaussian')}, "
                f"{-tried.loss:+.2f} dB, {-tried.trained_loss:+.2f} on views trained on, "
                f"{'kept' if keeps else f'more than {allowed:.2f} dB lost'}"
            )
            if keeps:
                found = tried
                low = middle + 1
            else:
                refused = (name, tried.worst)
                high = middle
        return found, SearchLimit(kind, levels[low - 1][0] if low else "nothing", refused)

    def _tried(self, cut: Cut) -> Candidate:
        self.trials += 1
        trainer = self.trainer
        self._restart()
        apply_cut(trainer, cut, self._scores)
        end = trainer.config.train.steps + trainer.config.prune.steps
        while trainer.done < end:
            trainer.step()
        psnr = quality_of(trainer, trainer.model.scene, self._truths)
        trained_loss = self._exact_trained - quality_of(
            trainer, trainer.model.scene, self._others()
        )
        end_state = trainer.checkpoint()
        return Candidate(
            cut,
            trainer.config,
            end_state,
            len(trainer.model.scene),
            psnr,
            self._reference - psnr,
            trained_loss,
        )

    def _restart(self) -> None:
        trainer = self.trainer
        trainer.begin_again(self._config, self.start)
        trainer.model.exchange(trainer.model.scene.unmasked())

    def _fewer_gaussians(self, so_far: Cut) -> Sequence[tuple[str, Cut]]:
        count = len(self._scores)
        return [
            (f"{1 - left:.1%}", replace(so_far, fraction=1 - left))
            for left in LEFT_GAUSSIANS
            if left * count >= 1
        ]

    def _higher_cut_offs(self, so_far: Cut) -> Sequence[tuple[str, Cut]]:
        own = self._config.model
        values = [x for x in CUT_OFFS if x > own.alpha_min]
        return [(f"alphas below {x:g}", replace(so_far, alpha_min=x)) for x in values]

    @torch.no_grad()
    def _smaller_fields(self, so_far: Cut) -> Sequence[tuple[str, Cut]]:
        """Return sizes at which fewer pieces, and fewer nodes, cost as much each before
        fine-tuning."""
        self._restart()
        trainer = self.trainer
        whole = field_size(trainer.model.scene)
        if whole is None:
            return []
        images = self._others()
        at_most: list[FieldSize] = []
        exact = quality_of(trainer, trainer.model.scene, images)

        def loss(size: FieldSize) -> float:
            return exact - quality_of(trainer, with_field(trainer.model.scene, size), images)

        pieces = {n: loss(FieldSize(whole.nodes, n)) for n in _halved(whole.pieces, 1)}
        nodes = {n: loss(FieldSize(n, whole.pieces)) for n in _halved(whole.nodes, FEWEST_NODES)}
        for most in FIELD_LOSSES:
            size = FieldSize(_fewest(nodes, most, whole.nodes), _fewest(pieces, most, whole.pieces))
            if size not in [*at_most, whole]:
                at_most.append(size)
        return [
            (f"all but {x.nodes} nodes of {x.pieces} pieces", replace(so_far, field=x))
            for x in at_most
        ]

    def _fewer_harmonics(self, so_far: Cut) -> Sequence[tuple[str, Cut]]:
        if not bool(self.start.tensors["gaussians.sh"][:, 1:].any()):
            return []
        return [
            (f"harmonics worth {x:g} dB", replace(so_far, harmonics=x)) for x in HARMONIC_LOSSES
        ]


def _halved(count: int, least: int) -> list[int]:
    """Return smaller numbers, each over the root of two of the one before, down to ``least``."""
    found = []
    while (count := round(count / 2**0.5)) >= least and count not in found:
        found.append(count)
    return found


def _fewest(losses: dict[int, float], most: float, whole: int) -> int:
    """Return the smallest number up to which, from the largest on, no loss exceeds ``most``; else
    ``whole``."""
    for count, loss in losses.items():
        if loss > most:
            break
        whole = count
    return whole
