"""Training of a scene, step by step. It does not depend on the kind of scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import Config
from dyngs.conventions import SH_C0
from dyngs.data.loader import Image, ImageLoader
from dyngs.errors import DyngsError, reading
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import network_of
from dyngs.gaussians.colour.training import ColourTraining, TrainingLooks
from dyngs.gaussians.colour.view_dependence import MeasuredView
from dyngs.gaussians.rendering import Rendering, RenderOptions
from dyngs.gaussians.scene import Scene, SceneTraining
from dyngs.ops.adam import Count
from dyngs.ops.device import CPU
from dyngs.ops.loss import l1_ssim_loss
from dyngs.ops.transfer import sent
from dyngs.state import Role, State, prefixed, tensors_of, with_role
from dyngs.static.densify import Densifier
from dyngs.static.fixed import FixedDensifier
from dyngs.static.optimizer import GaussianOptimizer
from dyngs.training.background import AlphaWeight, background_colour
from dyngs.training.corrections.camera_refinement import CameraRefinement, watched
from dyngs.training.corrections.exposure import ViewExposures
from dyngs.training.corrections.robust import RobustMasks
from dyngs.training.events import StepReport
from dyngs.training.priors.used import StepView, UsedPriors
from dyngs.training.processes import Processes
from dyngs.training.sampler import ViewSampler
from dyngs.training.schedule import active_sh_degree, image_divisor, means_rate, rates_of
from dyngs.training.state import OTHER_CONFIG, Checkpoint, CheckpointInfo
from dyngs.training.step_check import StepCheck


@dataclass
class Trainer:
    """A run in memory: everything that a step reads and changes.

    Attributes:
        scene: what is trained; its Gaussians are the optimizer's parameters.
        training: how its kind is trained.
        densifier: the strategy, which adds and removes Gaussians.
        options: how training images are drawn.
        background: "white", "black" or "random" (a new colour in each step, behind render and truth alike).
        alpha: how much silhouettes count in the loss.
        generator: the only source of randomness, on the CPU.
        priors: what the user knows about the capture.
        robust: masks of what disagrees with the other views; None: all pixels count.
        exposures: affine colours of the training images; None: they agree.
        refinement: of the cameras; None: they stay as the capture has them.
        done: steps done.
        bad_gradients: how often a Gaussian was left out of a step because its gradient was not finite.
        held_out: indices of the training views that are not trained on.
        processes: that take a fraction of the views of each step; one: this.
        device: where the scene is trained; see ``place``.
    """

    config: Config
    scene: Scene
    training: SceneTraining[Any]
    optimizer: GaussianOptimizer
    densifier: Densifier
    colours: ColourTraining
    images: ImageLoader
    sampler: ViewSampler
    options: RenderOptions
    background: str
    extent: float
    world_offset: tuple[float, float, float]
    has_test_views: bool
    alpha: AlphaWeight
    generator: torch.Generator
    priors: UsedPriors = field(default_factory=UsedPriors)
    robust: RobustMasks | None = None
    exposures: ViewExposures | None = None
    refinement: CameraRefinement | None = None
    done: int = 0
    bad_gradients: Count = 0
    held_out: frozenset[int] = frozenset()
    processes: Processes = field(default_factory=Processes)
    device: torch.device = CPU

    @property
    def num_gaussians(self) -> int:
        return len(self.scene)

    @property
    def num_moving(self) -> int:
        return self.scene.num_moving

    def step(self) -> StepReport:
        """Train on this process's fraction of the images of a step; the report is of the first of them.

        Raises:
            DyngsError: the loss is not finite; says which term, and leaves the parameters as they were. Other processes
                have come to other Gaussians.
        """
        step, before = self.done + 1, self.optimizer.parameters
        reports = []
        for index, seed in self._next_views(step):
            with _random_numbers(self.generator, seed):
                reports.append(self._backward(step, index))
        loss = self._averaged(step, [report.loss for report in reports])
        found = (self.alpha.finding if step == 1 else None, self._update(step))
        if self.optimizer.parameters is not before:
            self.processes.require_same(tensors_of(self.scene.state()), f"after step {step}")
        finding = "; ".join(text for text in found if text is not None) or None
        return replace(reports[0], loss=loss, finding=finding)

    def _averaged(self, step: int, losses: Sequence[float]) -> float:
        """Return the mean loss over the views of a step, and average their gradients, too."""
        batch = self.config.train.batch_size
        if batch == 1:
            return losses[0]
        leaves = [*self.optimizer.parameters.tensors().values()]
        for learned in (self.colours.learned, self.training.learned(self.scene)):
            leaves += [] if learned is None else learned.leaves
        loss = torch.tensor([sum(losses)], device=leaves[0].device)
        self.processes.sum_gradients_(leaves, loss)
        self.processes.sum_(self.densifier.tallies(step, self.num_gaussians))
        for x in leaves:
            if x.grad is not None:
                x.grad /= batch
        return float(loss) / batch

    def _backward(self, step: int, index: int) -> StepReport:
        """Add the gradients of the image of view ``index`` to those that are there, and return how it was drawn."""
        config, scene = self.config, self.scene
        divisor = image_divisor(config.train, step)
        image = self._image(index, step, divisor)
        background = sent(background_colour(self.background, self.generator), self.device)
        moment = self.training.moment(scene, image, step)
        probe = (
            torch.zeros(1, len(scene), 4, requires_grad=True, device=scene.gaussians.means.device)
            if self.densifier.wants_signal(step)
            else None
        )
        options = self.priors.options(self._options(step), image)
        rendering = scene.render(image.cameras, moment, options=options, background=background, probe=probe)
        if self.robust is not None:
            coarse = replace(options, depth="expected", absgrad=False)
            with_depth = partial(scene.render, time=moment, options=coarse, background=background)
            image = self.robust.masked(index, step, image, rendering.rgb[0], background, with_depth)
        rendered, truth = rendering.rgb[0], image.composite(background)
        if self.exposures is not None:
            self.exposures.begin(step, self._wanted(step), self._drawn_with_depth(background))
            rendered = self.exposures.applied((index, step), image, rendering, background)
        terms = {"image": l1_ssim_loss(rendered, truth, config.train.ssim_weight, image.mask)}
        if self.alpha.weight > 0 and image.alpha is not None:
            error = (rendering.alpha[0] - image.alpha).abs()
            if self.robust is not None and image.mask is not None:
                error = error * image.mask
            terms["alpha"] = self.alpha.weight * error.mean()
        terms |= moment.penalties | ({} if self.exposures is None else self.exposures.penalties(index))
        first, last = self.training.window(step)
        view = StepView(index, lambda time: first <= time <= last, options)
        terms |= self.priors.terms(scene, image, rendering, view, self.generator)
        terms |= self.densifier.regularizers(scene.gaussians) | self.colours.penalties(scene.gaussians)
        check = StepCheck(terms, moment.gaussians if scene.num_moving else None, self.device)
        sum(terms.values(), torch.zeros((), device=self.device)).backward()
        loss = check.loss(step, image, self.training.moves_by)
        if probe is not None and probe.grad is not None:
            size = (image.cameras.width, image.cameras.height)
            # Fewer Gaussians suit small images: a gradient counts for less there.
            self.densifier.after_backward(step, probe.grad / divisor, rendering.radii, size)
        if self.exposures is not None:
            self.bad_gradients = self.bad_gradients + self.exposures.optimize(index, step)
        if self.refinement is not None:
            self.bad_gradients = self.bad_gradients + self.refinement.optimize(step, index, image.cameras)
        return StepReport(step, loss, image, rendered.detach(), truth)

    def keep(self, kept: Tensor) -> None:
        """Leave only the Gaussians where ``kept`` (N,) is true."""
        self._apply(EditResult(TopologyEdit.select(kept)))
        self.scene = self.training.after_step(self.scene, self.done, True)
        self.scene.changed()

    def state(self) -> State:
        """Return everything that training needs to go on, by name, with its role."""
        state = self.scene.state() | prefixed("model", self.training.state())
        state |= prefixed("model.colour", self.colours.state()) | self.optimizer.state()
        state |= prefixed("strategy", with_role(self.densifier.state(), Role.TRAINING))
        state |= prefixed("sampler", with_role(self.sampler.state(), Role.TRAINING))
        if self.robust is not None:
            state |= prefixed("robust", with_role(self.robust.state(), Role.TRAINING))
        if self.exposures is not None:
            state |= prefixed("exposures", with_role(self.exposures.state(), Role.TRAINING))
        if self.refinement is not None:
            state |= prefixed("cameras", with_role(self.refinement.state(), Role.TRAINING))
        return state | with_role({"rng": self.generator.get_state()}, Role.TRAINING)

    def checkpoint(self) -> Checkpoint:
        """Return everything that ``restore`` needs."""
        mode = self.config.model.rasterize_mode.value
        info = CheckpointInfo(self.done, self.extent, self.world_offset, self.background, mode)
        return Checkpoint(info, {name: x.cpu() for name, x in tensors_of(self.state()).items()})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to where ``checkpoint`` was taken.

        Raises:
            DyngsError: it belongs to another model or strategy, or its tensors do not fit together.
        """
        with reading(checkpoint.name, OTHER_CONFIG):
            try:
                gaussians = Gaussians.stored(checkpoint.part("gaussians"))
                optimizer = self.optimizer.restored(gaussians, checkpoint.tensors)
                colour = checkpoint.part("model.colour")
                network_of(colour)  # raises where its tensors do not fit together
                self.colours.restore(colour, len(gaussians))
                scene = self.training.restored(optimizer.parameters, checkpoint.part("model"), self.scene)
                if checkpoint.info.step >= self.config.train.steps:
                    self.densifier = FixedDensifier()
                self.densifier.load_state(checkpoint.part("strategy"))
                self.sampler.load_state(checkpoint.part("sampler"))
                if self.robust is not None:
                    self.robust.load_state(checkpoint.part("robust"))
                if self.exposures is not None:
                    self.exposures.load_state(checkpoint.part("exposures"))
                if self.refinement is not None:
                    self.refinement.load_state(checkpoint.part("cameras"))
                self.generator.set_state(checkpoint.tensors["rng"])
            except KeyError as missing:
                raise DyngsError(f"{checkpoint.name} lacks {missing}; {OTHER_CONFIG}") from None
        self.optimizer, self.scene = optimizer, replace(scene, colour=self.colours.network)
        self.done = checkpoint.info.step
        self.place(self.device)

    def place(self, device: torch.device) -> None:
        """Go on on ``device``: with the scene, its optimizers and images, and the strategy.

        What belongs to single images stays on the CPU: exposures, corrections of cameras, random numbers.
        """
        self.device = self.images.device = device
        if self.scene.gaussians.means.device == device:
            return
        self.optimizer = self.optimizer.to(device)
        self.colours.place(device)
        self.densifier.place(device)
        scene = self.scene.to(device).with_gaussians(self.optimizer.parameters)
        self.scene = replace(scene, colour=self.colours.network)

    def _drawn_with_depth(self, background: Tensor) -> Callable[[Cameras, float | None], Rendering]:
        """Return what draws the scene with its expected depth."""
        options = replace(self.options, depth="expected", absgrad=False)
        return partial(self.scene.render, options=options, background=background)

    def _next_views(self, step: int) -> list[tuple[int, int | None]]:
        """Return the indices of the views that ``step`` trains on here, each with the seed of its random numbers.

        Without a seed they are those of the run. All processes draw the same views and seeds, and take their share.
        """
        batch, wanted = self.config.train.batch_size, self._wanted(step)
        drawn = [self.sampler.next(self.generator, wanted) for _ in range(batch)]
        fraction = self.processes.share(batch)
        if batch == 1:
            return [(drawn[0], None)]
        seeds = torch.randint(2**62, (batch,), generator=self.generator, device="cpu").tolist()
        return [(drawn[i], seeds[i]) for i in fraction]

    def _image(self, index: int, step: int, divisor: int) -> Image:
        """Return the image of view ``index`` for ``step``; those after it begin to be decoded."""
        image = self.images.shrunk(index, divisor)
        if self.images.decoded_ahead:
            batch, count = self.config.train.batch_size, self.images.decoded_ahead * self.processes.size
            fraction, coming = self.processes.share(batch), self.sampler.coming(count, self._wanted(step))
            self.images.expect([view for i, view in enumerate(coming) if i % batch in fraction])
        if self.refinement is not None:
            image = replace(image, cameras=watched(image.cameras))
        return image

    def _options(self, step: int) -> RenderOptions:
        """Return how images are drawn in ``step``."""
        degree = active_sh_degree(self.config.train, step, self.scene.gaussians.sh_degree)
        return replace(self.options, sh_degree=degree)

    def _update(self, step: int) -> str | None:
        """Optimize, let the strategy act, and count the step; return a line about what was found, or None."""
        lr_means = means_rate(self.config.optim, rates_of(self.config).progress(step), self.extent)
        frozen, dense = self.colours.frozen_rest(), self.densifier.touches_all
        bad = self.optimizer.step(step, lr_means, dense=dense, frozen_rest=frozen)
        bad = bad + self.colours.optimize(step) + self.training.optimize(self.scene, step)
        self.bad_gradients = self.bad_gradients + bad
        result = self.densifier.edit(step, self.optimizer.parameters, self.generator)
        if result is not None:
            self._apply(result)
        self.densifier.perturb(self.optimizer.parameters, lr_means, self.generator)
        self.scene = self.training.after_step(self.scene, step, result is not None)
        revised = self.training.revised(self.scene, step)
        if revised is not None:
            self.scene, result = revised
            self.optimizer.apply(result)
            self.scene = self.scene.with_gaussians(self.optimizer.parameters)
            self._follow(result)
        self.done = step
        findings = (self._drop_harmonics(step), None if revised is None else revised[1].finding)
        self.scene.changed()
        return self.priors.told("; ".join(text for text in findings if text) or None)

    def _apply(self, result: EditResult) -> None:
        """Change the set of Gaussians, and everything that is stored per Gaussian with it."""
        self.optimizer.apply(result)
        if result.edit is not None:
            self.scene = self.scene.edited(result.edit)
        self.scene = self.scene.with_gaussians(self.optimizer.parameters)
        self._follow(result)

    def _follow(self, result: EditResult) -> None:
        if result.edit is not None:
            self.colours.follow(result.edit)
            self.training.follow(result.edit)

    def _drop_harmonics(self, step: int) -> str | None:
        """Drop harmonics that do not pay, if it is time to measure that; return a line about what was found."""
        if not self.scene.gaussians.sh_degree:
            return None
        found = self.colours.measured(step, lambda: self._looks(step))
        if found is not None and found.rows is not None and found.offsets is not None:
            base = self.scene.gaussians.sh.detach()[:, 0] + found.offsets / SH_C0
            self.optimizer.drop_rest(base, found.rows)
            self.scene = self.scene.with_gaussians(self.optimizer.parameters)
        return None if found is None else found.text

    def _looks(self, step: int) -> TrainingLooks:
        """Return the training views as they are drawn after ``step``."""
        colour = background_colour(self.background).to(self.device)

        def views(indices: Sequence[int]) -> Iterator[MeasuredView]:
            for image in (self.images[i] for i in indices):
                gaussians = self.training.moment(self.scene, image, step).gaussians.detach()
                yield MeasuredView(gaussians, image.cameras, image.composite(colour), image.mask)

        may_train = [i for i, time in enumerate(self.images.times) if self.training.trains_on(time, step)]
        return TrainingLooks(may_train, views, self._options(step), colour)

    def _wanted(self, step: int) -> Callable[[int], bool]:
        """Return which views may be trained on in ``step``."""
        times = self.images.times

        def may_train(index: int) -> bool:
            return self.training.trains_on(times[index], step)

        def is_wanted(index: int) -> bool:
            return may_train(index) and not self.colours.holds_out(index, step) and index not in self.held_out

        return is_wanted if any(is_wanted(i) for i in range(len(self.images))) else may_train


@contextmanager
def _random_numbers(generator: torch.Generator, seed: int | None) -> Iterator[None]:
    """Let ``generator`` draw the numbers of ``seed`` for a while; None: its own."""
    if seed is None:
        yield
        return
    own = generator.get_state()
    generator.manual_seed(seed)
    try:
        yield
    finally:
        generator.set_state(own)
