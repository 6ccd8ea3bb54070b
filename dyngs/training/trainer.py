"""Training of a model, step by step. It does not depend on what the model is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from operator import add
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from dyngs.config import Config
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, reading
from dyngs.core.state import Role, prefixed, tensors_of, with_role
from dyngs.core.tensor_checks import require_indices
from dyngs.data.capture import Capture
from dyngs.data.loader import Image, ImageLoader
from dyngs.models.checkpoint import OTHER_CONFIG, Checkpoint, CheckpointInfo, settings_of
from dyngs.models.model import Look, Loss, Model
from dyngs.models.renderable import Rendering
from dyngs.models.schedule import image_divisor
from dyngs.models.views import background_colour
from dyngs.ops.adam import Count
from dyngs.ops.device import CPU, sent
from dyngs.training.corrections.camera_refinement import CameraRefinement, watched
from dyngs.training.corrections.exposure import ViewExposures
from dyngs.training.corrections.robust import RobustMasks
from dyngs.training.events import StepReport
from dyngs.training.losses import StepCheck
from dyngs.training.processes import Processes


class ViewSampler:
    """Every view once per epoch, in a new random order each time."""

    def __init__(self, num_views: int) -> None:
        self.num_views = num_views
        self._order = torch.zeros(0, dtype=torch.long, device="cpu")
        self._position = 0

    def next(self, generator: torch.Generator, wanted: Callable[[int], bool]) -> int:
        """Return the index of the next view that is ``wanted``, of which there must be one; others
        are passed over.

        ``generator`` is drawn from once per epoch.
        """
        while True:
            if self._position >= len(self._order):
                self._order = torch.randperm(self.num_views, generator=generator, device="cpu")
                self._position = 0
            self._position += 1
            index = int(self._order[self._position - 1])
            if wanted(index):
                return index

    def coming(self, count: int, wanted: Callable[[int], bool]) -> list[int]:
        """Return up to ``count`` views of this epoch that come next, by what is ``wanted`` now;
        nothing is drawn."""
        found: list[int] = []
        for index in self._order[self._position :].tolist():
            if len(found) == count:
                break
            if wanted(index):
                found.append(index)
        return found

    def state(self) -> dict[str, Tensor]:
        return {"order": self._order, "position": torch.tensor([self._position], device="cpu")}

    def load_state(self, state: dict[str, Tensor]) -> None:
        order = require_indices("order", state["order"], (None,), self.num_views)
        position = require_indices("position", state["position"], (1,), len(order) + 1)
        self._order, self._position = order.clone(), int(position)


M = TypeVar("M", bound=Model[Any])


@dataclass
class Trainer(Generic[M]):
    """A run in memory: everything that a step reads and changes."""

    config: Config
    model: M
    capture: Capture
    images: ImageLoader
    sampler: ViewSampler
    # "white", "black" or "random" (a new colour in each step, behind render and truth alike)
    background: str
    extent: float
    # terms of the loss, in an order that decides the last bits of its gradients
    losses: Sequence[Loss]
    generator: torch.Generator
    findings: list[str] = field(default_factory=list)  # lines that are told with the next step
    # masks of what disagrees with the other views; None: all pixels count
    robust: RobustMasks | None = None
    # affine colours of the training images; None: they agree
    exposures: ViewExposures | None = None
    # of the cameras; None: they stay as the capture has them
    refinement: CameraRefinement | None = None
    done: int = 0
    # how often something was left out of a step because its gradient was not finite
    bad_gradients: Count = 0
    held_out: frozenset[int] = frozenset()  # indices of the training views that are not trained on
    # that take a fraction of the views of each step; one: this
    processes: Processes = field(default_factory=Processes)
    device: torch.device = CPU  # where the model is trained; see ``place``

    @property
    def has_test_views(self) -> bool:
        return bool(self.capture.splits.get("test"))

    @property
    def num_gaussians(self) -> int:
        return self.model.num_gaussians

    @property
    def num_moving(self) -> int:
        return self.model.num_moving

    def step(self) -> StepReport:
        """Train on this process's fraction of the images of a step; the report is of the first of
        them."""
        step = self.done + 1
        reports = []
        for index, seed in self._next_views(step):
            with _random_numbers(self.generator, seed):
                reports.append(self._backward(step, index))
        loss = self._averaged(step, [report.loss for report in reports])
        updated = self.model.update(step)
        self.bad_gradients = self.bad_gradients + updated.bad
        self.done = step
        if updated.is_rearranged:
            self.processes.require_same(tensors_of(self.model.scene.state()), f"after step {step}")
        finding = (
            "\n".join([*self.findings, *([] if updated.finding is None else [updated.finding])])
            or None
        )
        self.findings.clear()
        return replace(reports[0], loss=loss, finding=finding)

    def _averaged(self, step: int, losses: Sequence[float]) -> float:
        """Return the mean loss over the views of a step, and average their gradients, too."""
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
        """Add the gradients of the image of view ``index`` to those that are there, and return how
        it was drawn."""
        image = self._image(index, step)
        background = sent(background_colour(self.background, self.generator), self.device)
        depth = any(loss.needs_depth(image) for loss in self.losses)
        drawn = self.model.draw(image, step, background, depth=depth)
        rendering = drawn.rendering
        image = drawn.image or image
        if self.robust is not None:
            draw = self._drawn_with_depth(background)
            time = image.time
            image = self.robust.masked(
                index,
                step,
                image,
                rendering.rgb[0],
                background,
                lambda cameras: draw(cameras, time),
            )
        rendered = rendering.rgb[0]
        truth = image.composite(background)
        if self.exposures is not None:
            self.exposures.begin(step, self._wanted(step), self._drawn_with_depth(background))
            rendered = self.exposures.applied((index, step), image, rendering, background)
        look = Look(index, step, image, drawn, rendered, truth, self.model, self.generator)
        terms: dict[str, Tensor] = {}
        for loss in self.losses:
            terms |= loss(look)
        check = StepCheck(terms, drawn.moved, self.device)
        with torch.autograd.set_multithreading_enabled(False):
            # a GPU's nodes in this thread, too: no handing over
            reduce(add, terms.values()).backward()
        value = check.loss(step, image, self.model.moves_by)
        drawn.after_backward()
        if self.exposures is not None:
            self.bad_gradients = self.bad_gradients + self.exposures.optimize(index, step)
        if self.refinement is not None:
            self.bad_gradients = self.bad_gradients + self.refinement.optimize(
                step, index, image.cameras
            )
        return StepReport(step, value, image, rendered.detach(), truth)

    @property
    def info(self) -> CheckpointInfo:
        x, y, z = (float(value) for value in self.capture.world_offset)
        mode = self.model.rasterize_mode.value
        return CheckpointInfo(
            self.done, self.extent, (x, y, z), self.background, mode, self.capture.world_scale
        )

    def checkpoint(self) -> Checkpoint:
        state = self.model.state()
        for name, part in self._parts().items():
            state |= prefixed(name, with_role(part.state(), Role.TRAINING))
        state |= with_role({"rng": self.generator.get_state()}, Role.TRAINING)
        tensors = {name: x.cpu() for name, x in tensors_of(state).items()}
        return Checkpoint(self.info, tensors, settings=settings_of(self.config))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to where ``checkpoint`` was taken."""
        with reading(checkpoint.name, OTHER_CONFIG):
            try:
                self.model.restore(checkpoint)
                for name, part in self._parts().items():
                    part.load_state(checkpoint.part(name))
                self.generator.set_state(checkpoint.tensors["rng"])
            except KeyError as missing:
                raise DyngsError(f"{checkpoint.name} lacks {missing}; {OTHER_CONFIG}") from None
        self.done = checkpoint.info.step
        self.place(self.device)

    def place(self, device: torch.device) -> None:
        """Go on on ``device``: with the model and the images.

        What belongs to single images stays on the CPU: exposures, corrections of cameras, random
        numbers.
        """
        self.device = self.images.device = device
        self.model.place(device)

    def _parts(self) -> dict[str, ViewSampler | RobustMasks | ViewExposures | CameraRefinement]:
        """Return what belongs to images and has a state of its own, by its name in a checkpoint."""
        parts = {
            "sampler": self.sampler,
            "robust": self.robust,
            "exposures": self.exposures,
            "cameras": self.refinement,
        }
        return {name: part for name, part in parts.items() if part is not None}

    def _drawn_with_depth(self, background: Tensor) -> Callable[[Cameras, float | None], Rendering]:
        scene = self.model.scene
        return partial(
            scene.render, options=replace(scene.options, depth="expected"), background=background
        )

    def _next_views(self, step: int) -> list[tuple[int, int | None]]:
        """Return the indices of the views that ``step`` trains on here, each with the seed of its
        random numbers.

        Without a seed they are those of the run. All processes draw the same views and seeds, and
        take their share.
        """
        batch = self.config.train.batch_size
        wanted = self._wanted(step)
        drawn = [self.sampler.next(self.generator, wanted) for _ in range(batch)]
        fraction = self.processes.share(batch)
        if batch == 1:
            return [(drawn[0], None)]
        seeds = torch.randint(2**62, (batch,), generator=self.generator, device="cpu").tolist()
        return [(drawn[i], seeds[i]) for i in fraction]

    def _image(self, index: int, step: int) -> Image:
        """Return the image of view ``index`` for ``step``; those after it begin to be decoded."""
        image = self.images.shrunk(index, image_divisor(self.config.train, step))
        if self.images.decoded_ahead:
            batch = self.config.train.batch_size
            count = self.images.decoded_ahead * self.processes.size
            fraction = self.processes.share(batch)
            coming = self.sampler.coming(count, self._wanted(step))
            self.images.expect([view for i, view in enumerate(coming) if i % batch in fraction])
        if self.refinement is not None:
            image = replace(image, cameras=watched(image.cameras))
        return image

    def _wanted(self, step: int) -> Callable[[int], bool]:
        times = self.images.times

        def may_train(index: int) -> bool:
            return self.model.trains_on(times[index], step)

        def is_wanted(index: int) -> bool:
            return (
                may_train(index)
                and not self.model.holds_out(index, step)
                and index not in self.held_out
            )

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
