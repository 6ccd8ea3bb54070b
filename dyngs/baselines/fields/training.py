"""Radiance fields in training: rays of one image per view of a step, Adam with its schedule, and
the occupied cells."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Generic, TypeVar

import torch
from torch import Tensor

from dyngs.baselines.fields.field import Field
from dyngs.baselines.fields.scene import FieldScene, stored_times
from dyngs.baselines.fields.space import part_of
from dyngs.core.errors import DyngsError
from dyngs.core.state import State, moved_to, prefixed
from dyngs.data.loader import Image
from dyngs.gaussians.parameters import AdamState
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.model import Drawn, Look, Loss, Model, Updated
from dyngs.models.renderable import DrawOptions, Rendering
from dyngs.models.views import evaluation_background, training_times
from dyngs.models.volume import rays_of
from dyngs.ops.adam import AdamUpdate
from dyngs.ops.device import sent

NEAR = 0.05  # Nearest distance that is drawn, in units of half the side of the innermost cube

F = TypeVar("F", bound=Field)


class ColourLoss(Loss):
    """The mean over pixels that count of a ``function`` of rendered and true colours."""

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor]) -> None:
        self._function = function

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        return {"image": masked_mean(self._function(look.rendered, look.truth), look.image.mask)}


def smooth_l1(one: Tensor, other: Tensor) -> Tensor:
    """Return half the square of the difference up to 1, elsewhere its size less a half."""
    return torch.nn.functional.smooth_l1_loss(one, other, reduction="none")


def masked_mean(error: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of (H, W, 3) errors over pixels where ``mask`` (H, W) is not 0."""
    each = error.mean(-1)
    return each.mean() if mask is None else (each * mask).sum() / mask.sum().clamp_min(1)


class FieldTraining(Model[FieldScene], Generic[F]):
    """A field in training.

    Args:
        function: of rendered and true colours, whose mean is minimised.
    """

    def __init__(
        self, run: RunStart, field: F, function: Callable[[Tensor, Tensor], Tensor]
    ) -> None:
        self._run, self._field, self._function = run, field, function
        self._adam = AdamState.zero(field.parameters)
        self._batch = run.config.train.batch_size
        times = tuple(sorted(set(training_times(run.capture))))
        if field.sees_time and len(times) < 2:
            raise DyngsError(
                f"{run.config.data.root}: model.time=true, but the images have no times, or only one: leave it out, or "
                "give data.times=order if their names are in the order of time"
            )
        behind = evaluation_background(run.config.data.background, run.capture.has_alpha)[1]
        options = DrawOptions(near=NEAR * field.space.half)
        self._like = FieldScene(field, times if field.sees_time else (), options, behind)

    @property
    def scene(self) -> FieldScene:
        return replace(self._like, field=self._field)

    @property
    def colour_loss(self) -> Loss:
        return ColourLoss(self._function)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return list(self._field.parameters.values())

    @property
    def num_rays(self) -> int:
        """Rays of the next image."""
        raise NotImplementedError

    def rate(self, step: int) -> float:
        """Return the learning rate in ``step``."""
        raise NotImplementedError

    @property
    def betas(self) -> tuple[float, float]:
        """How slowly Adam forgets."""
        return 0.9, 0.999

    def counted(self, num_rays: int, num_samples: int) -> None:
        """Take in how many samples the rays of an image needed."""

    def draw(self, image: Image, step: int, background: Tensor, *, depth: bool = False) -> Drawn:
        generator = self._run.generator
        device = background.device
        camera = image.cameras.to(device=device)
        pixels = torch.randint(
            camera.width * camera.height, (self.num_rays,), generator=generator, device="cpu"
        )
        shifts = torch.rand(
            (len(pixels), self._field.num_shifts), generator=generator, device="cpu"
        )
        pixels = sent(pixels, device)
        shifts = sent(shifts, device)
        rays, z = rays_of(camera, pixels)
        seen = self._field.seen(
            rays, image.time or 0.0, near=self._like.options.near, shifts=shifts
        )
        self.counted(len(rays), seen.num_samples)
        part = part_of(image, pixels)
        penalties: dict[str, Tensor] = {}
        if seen.coarse is not None:
            coarse = seen.coarse.colour + seen.coarse.transmittance[:, None] * background
            penalties["coarse"] = masked_mean(
                self._function(coarse[None], part.composite(background)), part.mask
            )
        rgb = seen.colour + seen.transmittance[:, None] * background
        far = (
            (seen.depth * z / (1 - seen.transmittance).clamp_min(1e-9))[None, None]
            if depth
            else None
        )
        return Drawn(
            Rendering(rgb[None, None], seen.transmittance[None, None], far), penalties, image=part
        )

    def update(self, step: int) -> Updated:
        updates = [
            self._update_of(name, x, self.rate(step)) for name, x in self._field.parameters.items()
        ]
        return Updated(self._adam.steps_(updates, step=step, betas=self.betas))

    def _update_of(self, name: str, x: Tensor, rate: float) -> AdamUpdate | None:
        return self._adam.update(name, x, rate)

    def state(self) -> State:
        return self.scene.state() | prefixed("adam", self._adam.state())

    def restored_field(self, checkpoint: Checkpoint) -> F:
        """Return the field of a checkpoint. Raises KeyError or ValueError where its tensors do not
        fit."""
        raise NotImplementedError

    def restore(self, checkpoint: Checkpoint) -> None:
        field = self.restored_field(checkpoint)
        for x in field.parameters.values():
            x.requires_grad_()
        self._field, stored = field, checkpoint.part("field")
        self._like = replace(self._like, field=field, seen_at=stored_times(stored))
        self._adam = AdamState.restored(checkpoint.part("adam"), field.parameters)

    def place(self, device: torch.device) -> None:
        field = moved_to(self._field, device)
        for x in field.parameters.values():
            x.detach_().requires_grad_()
        self._field, self._adam = field, self._adam.to(device)
        self._like = replace(self._like, field=field).to(device)
