"""Trainer of a scene, independent of the kind of model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import islice
from operator import add
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.core.state import Role, add_prefix, strip_roles, with_role
from dyngs.core.tensor_checks import require_indices
from dyngs.data.capture import Capture
from dyngs.data.loader import Image, ImageLoader
from dyngs.models.checkpoint import CONFIG_ADVICE, Checkpoint, CheckpointInfo, checkpoint_settings
from dyngs.models.model import Correction, Loss, LossInput, Model, RenderedView
from dyngs.models.renderable import Rendering
from dyngs.models.schedule import image_divisor
from dyngs.models.views import background_colour
from dyngs.ops.adam import Count
from dyngs.ops.device import CPU, copy_async
from dyngs.training.events import StepReport
from dyngs.training.losses import StepCheck
from dyngs.training.plan import with_steps
from dyngs.training.processes import Processes


class ViewSampler:
    """Samples every view once per epoch, in a new random order each epoch."""

    def __init__(self, num_views: int) -> None:
        self.num_views = num_views
        self._order = torch.zeros(0, dtype=torch.long, device="cpu")
        self._position = 0

    def next(self, generator: torch.Generator, is_eligible: Callable[[int], bool]) -> int:
        """Return the index of the next view for which ``is_eligible`` is true, skipping others.

        The generator is used once per epoch. At least one view must be eligible.
        """
        while True:
            if self._position >= len(self._order):
                self._order = torch.randperm(self.num_views, generator=generator, device="cpu")
                self._position = 0
            self._position += 1
            index = int(self._order[self._position - 1])
            if is_eligible(index):
                return index

    def peek(self, count: int, is_eligible: Callable[[int], bool]) -> list[int]:
        """Return up to ``count`` upcoming eligible views of this epoch, without advancing."""
        remaining = self._order[self._position :].tolist()
        return list(islice(filter(is_eligible, remaining), count))

    def state(self) -> dict[str, Tensor]:
        return {"order": self._order, "position": torch.tensor([self._position], device="cpu")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        order = require_indices("order", state["order"], (None,), self.num_views)
        position = require_indices("position", state["position"], (1,), len(order) + 1)
        self._order = order.clone()
        self._position = int(position)


@dataclass(frozen=True)
class TrainingEdit:
    """A change to a running training, requested by a limit or by the pruning stage.

    Attributes:
        message: logged description of the change.
        keep: (N,) bool, Gaussians to keep. None keeps all.
        masks: visibility masks over time. None makes all Gaussians always visible.
        stops_densification: no Gaussians are added or removed from now on.
        steps: new length of the run, to which all schedules scale. None keeps it.
        config: same run with other render or pruning options. None keeps it.
    """

    message: str = ""
    keep: Tensor | None = None
    masks: Any = None
    stops_densification: bool = False
    steps: int | None = None
    config: Config | None = None


M = TypeVar("M", bound=Model[Any])


class TrainerParts(NamedTuple):
    """Parts of a trainer that depend on the schedules of a run.

    The order of the losses determines the rounding of gradients.
    """

    model: Any
    losses: Sequence[Loss]
    corrections: Sequence[Correction]


@dataclass
class Trainer(Generic[M]):
    """State of a training run: model, losses, corrections, images and schedules.

    Attributes:
        build_parts: creates model, losses and corrections for the schedules of a config.
        background: "white", "black" or "random" (a new colour per step, behind rendering and
            image).
        start_message: lines that are logged with the first step.
        bad_gradients: number of parameter rows skipped because their gradient was not finite.
        held_out: indices of training views that are not trained on.
        processes: the processes that share the views of each step.
        device: device of the model, see ``place``.
    """

    config: Config
    build_parts: Callable[[Config], TrainerParts]
    capture: Capture
    images: ImageLoader
    background: str
    extent: float
    generator: torch.Generator
    start_message: str = ""
    device: torch.device = CPU
    processes: Processes = field(default_factory=Processes)
    held_out: frozenset[int] = field(default=frozenset(), init=False)
    done: int = field(default=0, init=False)
    bad_gradients: Count = field(default=0, init=False)
    sampler: ViewSampler = field(init=False)
    model: M = field(init=False)
    losses: Sequence[Loss] = field(init=False)
    corrections: Sequence[Correction] = field(init=False)

    def __post_init__(self) -> None:
        self.sampler = ViewSampler(len(self.images))
        self._begin(self.config)

    def _begin(self, config: Config) -> None:
        self.config = config
        self.model, self.losses, self.corrections = self.build_parts(config)
        self.place(self.device)

    @property
    def num_gaussians(self) -> int:
        return self.model.num_gaussians

    @property
    def num_moving(self) -> int:
        return self.model.num_moving

    def step(self) -> StepReport:
        """Run one training step on this process's part of the batch. The report is of its first
        view."""
        step = self.done + 1
        reports = []
        for index, seed in self._next_views(step):
            state = self.generator.get_state()
            if seed is not None:
                self.generator.manual_seed(seed)
            reports.append(self._backward(step, index))
            if seed is not None:
                self.generator.set_state(state)
        loss = self._average_gradients(step, [report.loss for report in reports])
        updated = self.model.update(step)
        self.bad_gradients = self.bad_gradients + updated.bad
        self.done = step
        if updated.topology_changed:
            self.processes.require_same(strip_roles(self.model.scene.state()), f"after step {step}")
        message = "\n".join(filter(None, [self.start_message, updated.finding]))
        self.start_message = ""
        return replace(reports[0], loss=loss, message=message or None)

    def _average_gradients(self, step: int, losses: Sequence[float]) -> float:
        """Average the gradients over the views of a step, and return the mean loss."""
        batch = self.config.train.batch_size
        if batch == 1:
            return losses[0]
        leaves = list(self.model.leaves)
        loss = torch.tensor([sum(losses)], device=leaves[0].device)
        self.processes.sum_gradients_(leaves, loss)
        self.processes.sum_(list(self.model.tallies(step)))
        for x in leaves:
            if x.grad is not None:
                x.grad /= batch
        return float(loss) / batch

    def _backward(self, step: int, index: int) -> StepReport:
        """Render view ``index``, accumulate its gradients, and return the report."""
        image = self._image(index, step)
        for correction in self.corrections:
            image = correction.before_render(image)
        background = copy_async(background_colour(self.background, self.generator), self.device)
        depth = any(loss.needs_depth(image) for loss in self.losses)
        drawn = self.model.draw(image, step, background, depth=depth)
        view = RenderedView(
            index,
            step,
            drawn.image or image,
            drawn.rendering,
            drawn.rendering.rgb[0],
            background,
            self._render_with_depth(background),
            self._eligible_views(step),
        )
        for correction in self.corrections:
            view = correction.after_render(view)
        image = view.image
        rendered = view.rendered
        truth = image.composite(background)
        look = LossInput(index, step, image, drawn, rendered, truth, self.model, self.generator)
        terms: dict[str, Tensor] = {}
        for loss in self.losses:
            terms |= loss(look)
        # Regularizers of the rendered Gaussians, and of the model parameters.
        terms |= drawn.penalties
        terms |= self.model.regularizers()
        check = StepCheck(terms, drawn.moved, self.device)
        with torch.autograd.set_multithreading_enabled(False):
            # Run GPU nodes in this thread, too, to avoid switching threads.
            reduce(add, terms.values()).backward()
        value = check.loss(step, image, self.model.deformation_name)
        drawn.after_backward()
        for correction in self.corrections:
            bad = correction.after_backward(index, step, image)
            self.bad_gradients = self.bad_gradients + bad
        return StepReport(step, value, image, rendered.detach(), truth)

    def apply(self, edit: TrainingEdit) -> None:
        """Apply an edit between two steps."""
        model: Any = self.model
        if edit.steps is not None:
            self._rescale(edit.steps)
        if edit.config is not None:
            self.config = edit.config
            model.set_render_options(edit.config.model)
        if edit.stops_densification:
            model.replace_scene(model.scene.without_masks())
            model.stop_growing()
        if edit.keep is not None:
            model.select_gaussians(edit.keep, self.done)
        if edit.masks is not None:
            model.replace_scene(replace(model.scene, masks=edit.masks))

    def _rescale(self, steps: int) -> None:
        config = with_steps(self.config, steps)
        if steps <= self.done:
            self.config = config
            return
        step = self.done + 1
        seen = self.model.window(step)
        self.restart(config, self.checkpoint())
        self.model.extend(seen, step)

    def restart(self, config: Config, checkpoint: Checkpoint) -> None:
        """Restore ``checkpoint`` with the schedules of ``config``."""
        self._begin(config)
        self.restore(checkpoint)

    def join(self, processes: Processes) -> None:
        """Train together with other processes from now on."""
        self.processes = processes

    def hold_out(self, indices: Iterable[int]) -> None:
        """Exclude these views from training from now on."""
        self.held_out = frozenset(indices)

    @property
    def info(self) -> CheckpointInfo:
        x, y, z = (float(value) for value in self.capture.world_offset)
        mode = self.model.rasterize_mode.value
        return CheckpointInfo(
            self.done, self.extent, (x, y, z), self.background, mode, self.capture.world_scale
        )

    def checkpoint(self) -> Checkpoint:
        state = self.model.state()
        for name, part in self._image_parts().items():
            state |= add_prefix(name, with_role(part.state(), Role.TRAINING))
        state |= with_role({"rng": self.generator.get_state()}, Role.TRAINING)
        tensors = {name: x.cpu() for name, x in strip_roles(state).items()}
        return Checkpoint(self.info, tensors, settings=checkpoint_settings(self.config))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the state of ``checkpoint``."""
        with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
            try:
                self.model.restore(checkpoint)
                for name, part in self._image_parts().items():
                    part.load_state(checkpoint.part(name))
                self.generator.set_state(checkpoint.tensors["rng"])
            except KeyError as missing:
                raise DyngsError(f"{checkpoint.name} lacks {missing}; {CONFIG_ADVICE}") from None
        self.done = checkpoint.info.step
        self.place(self.device)

    def place(self, device: torch.device) -> None:
        """Move the model and the images to ``device``.

        Corrections and random numbers stay on the CPU.
        """
        self.device = self.images.device = device
        self.model.place(device)

    def _image_parts(self) -> dict[str, ViewSampler | Correction]:
        """Return the per-image state, by its name in a checkpoint."""
        return {"sampler": self.sampler} | {x.name: x for x in self.corrections}

    def _render_with_depth(
        self, background: Tensor
    ) -> Callable[[Cameras, float | None], Rendering]:
        scene = self.model.scene
        return partial(
            scene.render, options=replace(scene.options, depth="expected"), background=background
        )

    def _next_views(self, step: int) -> list[tuple[int, int | None]]:
        """Return the view indices of this process for ``step``, each with a random seed.

        The seed is None for a batch of one, which uses the generator of the run. All processes draw
        the same views and seeds.
        """
        batch = self.config.train.batch_size
        is_eligible = self._eligible_views(step)
        drawn = [self.sampler.next(self.generator, is_eligible) for _ in range(batch)]
        own_views = self.processes.views_of_process(batch)
        if batch == 1:
            return [(drawn[0], None)]
        seeds = torch.randint(2**62, (batch,), generator=self.generator, device="cpu").tolist()
        return [(drawn[i], seeds[i]) for i in own_views]

    def _image(self, index: int, step: int) -> Image:
        """Return the image of view ``index`` for ``step``, and prefetch the following ones."""
        image = self.images.downscaled(index, image_divisor(self.config.train, step))
        if self.images.num_prefetched:
            batch = self.config.train.batch_size
            count = self.images.num_prefetched * self.processes.size
            own_views = self.processes.views_of_process(batch)
            upcoming = self.sampler.peek(count, self._eligible_views(step))
            self.images.prefetch(
                [view for i, view in enumerate(upcoming) if i % batch in own_views]
            )
        return image

    def _eligible_views(self, step: int) -> Callable[[int], bool]:
        times = self.images.times

        def may_train(index: int) -> bool:
            return self.model.trains_on(times[index], step)

        def is_eligible(index: int) -> bool:
            return (
                may_train(index)
                and not self.model.is_held_out(index, step)
                and index not in self.held_out
            )

        return is_eligible if any(is_eligible(i) for i in range(len(self.images))) else may_train
