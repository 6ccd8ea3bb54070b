"""Training of radiance fields: random rays of one image per view, and Adam."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from dyngs.baselines.fields.scene import NEAR, FieldScene, RadianceField, restore_scene, space_of
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
    """Mean over unmasked pixels of a ``function`` of rendered and true colours."""

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor]) -> None:
        self._function = function

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        return {"image": masked_mean(self._function(look.rendered, look.truth), look.image.mask)}


def masked_mean(error: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of the errors (H, W, 3) over pixels where ``mask`` (H, W) is not 0."""
    each = error.mean(-1)
    return each.mean() if mask is None else (each * mask).sum() / mask.sum().clamp_min(1)


class FieldTraining(Model[FieldScene]):
    """A radiance field in training.

    Args:
        cells: along an axis of each cube; None: by the number of cubes.
        pixels: longest side of the images.

    Raises:
        DyngsError: the capture does not suit the field.
    """

    betas = (0.9, 0.999)  # decay rates of the Adam moments

    def __init__(
        self, run: StartContext, field_class: type[RadianceField], cells: int | None, pixels: int
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
                f"{root}: model.time=true needs images at several times; remove it, or set "
                "data.times=order if the file names are in temporal order"
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
        """Return the errors of rendered colours; their mean is minimised."""
        return (one - other).square()

    @property
    @abstractmethod
    def num_rays(self) -> int:
        """Rays per image in the next step."""

    @abstractmethod
    def learning_rate(self, step: int) -> float:
        """Return the learning rate at ``step``."""

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        generator = self._run.generator
        device = background.device
        field = self._scene.field
        camera = image.cameras.to(device=device)
        record_samples = camera.width * camera.height
        pixels = torch.randint(record_samples, (self.num_rays,), generator=generator, device="cpu")
        shifts = torch.rand(
            (len(pixels), field.num_random_values), generator=generator, device="cpu"
        )
        pixels = copy_async(pixels, device)
        rays, z = camera_rays(camera, pixels)
        near = self._scene.options.near
        seen = field.render_rays(
            rays, image.time or 0.0, near=near, shifts=copy_async(shifts, device)
        )
        self.record_samples(len(rays), seen.num_samples)
        part = select_pixels(image, pixels)
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

    def record_samples(self, num_rays: int, num_samples: int) -> None:
        """Record the number of samples that the rays of an image needed."""

    def update(self, step: int) -> UpdateResult:
        learning_rate = self.learning_rate(step)
        updates = []
        for name, x in self._scene.field.parameters.items():
            # rows of the hash grid without samples are not updated
            rows = seen_rows(x.grad) if name == "table" and x.grad is not None else None
            updates.append(self._adam.update(name, x, learning_rate, rows))
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


def select_pixels(image: Image, pixels: Tensor) -> Image:
    """Return the ``pixels`` (R,) of an image as a (1, R) image with the same camera."""

    def taken(x: Tensor | None) -> Tensor | None:
        return None if x is None else x.flatten(0, 1)[pixels][None]

    rgb = image.rgb_premultiplied.flatten(0, 1)[pixels][None]
    return replace(image, rgb_premultiplied=rgb, alpha=taken(image.alpha), mask=taken(image.mask))
