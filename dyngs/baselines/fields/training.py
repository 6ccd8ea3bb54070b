"""Radiance fields in training: rays of one image per view of a step, and Adam."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyngs.baselines.fields.scene import NEAR, Field, FieldScene, restore_scene, space_of
from dyngs.core.errors import DyngsError
from dyngs.core.state import State, add_prefix
from dyngs.data.loader import Image
from dyngs.gaussians.optimizer import AdamState
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import Loss, LossInput, Model, RenderOutput, UpdateResult
from dyngs.models.renderable import DrawOptions, Rendering
from dyngs.models.views import evaluation_background, training_times
from dyngs.models.volume import camera_rays
from dyngs.ops.adam import seen_rows
from dyngs.ops.device import copy_async


class ColourLoss(Loss):
    """The mean over pixels that count of a ``function`` of rendered and true colours."""

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor]) -> None:
        self._function = function

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        return {"image": masked_mean(self._function(look.rendered, look.truth), look.image.mask)}


def masked_mean(error: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of (H, W, 3) errors over pixels where ``mask`` (H, W) is not 0."""
    each = error.mean(-1)
    return each.mean() if mask is None else (each * mask).sum() / mask.sum().clamp_min(1)


class FieldTraining(Model[FieldScene]):
    """A field in training.

    Args:
        cells: of each cube of its space along an axis; None: as suits their number.
        pixels: of the longest side of the images.

    Raises:
        DyngsError: a capture that the field cannot hold.
    """

    betas = (0.9, 0.999)  # How slowly Adam forgets

    def __init__(
        self, run: StartContext, field_class: type[Field], cells: int | None, pixels: int
    ) -> None:
        self._run = run
        model: Any = run.config.model
        self._model = model
        self._batch = run.config.train.batch_size
        root = run.config.data.root
        try:
            space = space_of(model, cells, run.capture)
        except DyngsError as error:
            raise DyngsError(f"{root}: {error}") from None
        field = field_class.new(model, space, run.generator, pixels)
        times = tuple(sorted(set(training_times(run.capture)))) if model.time else ()
        if model.time and len(times) < 2:
            raise DyngsError(
                f"{root}: model.time=true, but the images have no times, or only one: leave it out, or give "
                "data.times=order if their names are in the order of time"
            )
        behind = evaluation_background(run.config.data.background, run.capture.has_alpha)[1]
        self._scene = FieldScene(field, times, DrawOptions(near=NEAR * space.half), behind)
        self._learn(self._scene)
        self._adam = AdamState.zero(field.parameters)

    def _learn(self, scene: FieldScene) -> None:
        self._scene = scene
        for x in scene.field.parameters.values():
            x.detach_().requires_grad_()

    @property
    def scene(self) -> FieldScene:
        return self._scene

    @property
    def colour_loss(self) -> Loss:
        return ColourLoss(self.error)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return list(self._scene.field.parameters.values())

    def error(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the errors between rendered and true colours, whose mean is minimised."""
        return (one - other).square()

    @property
    @abstractmethod
    def num_rays(self) -> int:
        """Rays of the next image."""

    @abstractmethod
    def rate(self, step: int) -> float:
        """Return the learning rate in ``step``."""

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        generator = self._run.generator
        device = background.device
        field = self._scene.field
        camera = image.cameras.to(device=device)
        count = camera.width * camera.height
        pixels = torch.randint(count, (self.num_rays,), generator=generator, device="cpu")
        shifts = torch.rand(
            (len(pixels), field.num_random_values), generator=generator, device="cpu"
        )
        pixels = copy_async(pixels, device)
        rays, z = camera_rays(camera, pixels)
        near = self._scene.options.near
        seen = field.seen(rays, image.time or 0.0, near=near, shifts=copy_async(shifts, device))
        self.count(len(rays), seen.num_samples)
        part = part_of(image, pixels)
        rgb = seen.colour + seen.transmittance[:, None] * background
        penalties: dict[str, Tensor] = {}
        if seen.coarse is not None:
            coarse = seen.coarse.colour + seen.coarse.transmittance[:, None] * background
            error = self.error(coarse[None], part.composite(background))
            penalties["coarse"] = masked_mean(error, part.mask)
        far = None
        if depth:
            far = (seen.depth * z / (1 - seen.transmittance).clamp_min(1e-9))[None, None]
        rendering = Rendering(rgb[None, None], seen.transmittance[None, None], far)
        return RenderOutput(rendering, penalties, image=part)

    def count(self, num_rays: int, num_samples: int) -> None:
        """Note how many samples the rays of an image needed."""

    def update(self, step: int) -> UpdateResult:
        rate = self.rate(step)
        updates = []
        for name, x in self._scene.field.parameters.items():
            # rows of a hash grid that no sample touched stay as they are
            rows = seen_rows(x.grad) if name == "table" and x.grad is not None else None
            updates.append(self._adam.update(name, x, rate, rows))
        return UpdateResult(self._adam.steps_(updates, step=step, betas=self.betas))

    def state(self) -> State:
        return self._scene.state() | add_prefix("adam", self._adam.state())

    def restore(self, checkpoint: Checkpoint) -> None:
        self._learn(restore_scene(type(self._scene.field), self._model, checkpoint))
        parameters = self._scene.field.parameters
        self._adam = AdamState.from_state(checkpoint.part("adam"), parameters)

    def place(self, device: torch.device) -> None:
        self._learn(self._scene.to(device))
        self._adam = self._adam.to(device)


def part_of(image: Image, pixels: Tensor) -> Image:
    """Return ``pixels`` (R,) of an image alone, (1, R), with the camera of the whole."""

    def taken(x: Tensor | None) -> Tensor | None:
        return None if x is None else x.flatten(0, 1)[pixels][None]

    rgb = image.rgb_premultiplied.flatten(0, 1)[pixels][None]
    return replace(image, rgb_premultiplied=rgb, alpha=taken(image.alpha), mask=taken(image.mask))
