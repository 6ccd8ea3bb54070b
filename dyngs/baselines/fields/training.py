"""Radiance fields in training: rays of one image per view of a step, Adam with its schedule, and
the occupied cells.

``FieldTraining`` has the protocol of NeRF, ``NgpTraining`` that of Instant-NGP.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.baselines.fields.field import Field
from dyngs.baselines.fields.keys import FieldModel, NerfModel, NgpModel
from dyngs.baselines.fields.nerf import SIZES as NERF_SIZES
from dyngs.baselines.fields.nerf import NerfField
from dyngs.baselines.fields.ngp import NgpField, NgpSizes, Occupancy, seen_cells
from dyngs.baselines.fields.scene import FieldScene, space_of, stored_space, stored_times
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, moved_to, prefixed, with_role
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.loader import Image
from dyngs.gaussians.optimizer import AdamState
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.model import Drawn, Look, Loss, Model, Updated
from dyngs.models.renderable import DrawOptions, Rendering
from dyngs.models.views import evaluation_background, training_times
from dyngs.models.volume import rays_of
from dyngs.ops.adam import AdamUpdate, seen_rows
from dyngs.ops.device import sent

NEAR = 0.05  # Nearest distance that is drawn, in units of half the side of the innermost cube

LAST_RATE = 0.1  # Of the rate of NeRF at the end of the run, relative to the first
NGP_RATE = 1e-2
WEIGHT_DECAY = 1e-6  # L2 penalty of the networks' weights of Instant-NGP
FIRST_SAMPLES = 256  # Samples that a ray is taken to need before any was counted
MOST_RAYS = 1 << 15  # Of an image in a step
LOOKED_AT = 2  # Random cells looked at in an update of the occupied ones, per sample of a step
WARM_UP, FIRST_RATE = 100, 0.01  # Steps in which the rate rises from this fraction of itself
DROPS = (0.5, 0.75, 0.9)
DROP = 0.33  # Fractions of the run at which the rate falls by this factor


class ColourLoss(Loss):
    """The mean over pixels that count of a ``function`` of rendered and true colours."""

    def __init__(self, function: Callable[[Tensor, Tensor], Tensor]) -> None:
        self._function = function

    def __call__(self, look: Look) -> Mapping[str, Tensor]:
        return {"image": masked_mean(self._function(look.rendered, look.truth), look.image.mask)}


def masked_mean(error: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of (H, W, 3) errors over pixels where ``mask`` (H, W) is not 0."""
    each = error.mean(-1)
    return each.mean() if mask is None else (each * mask).sum() / mask.sum().clamp_min(1)


class FieldTraining(Model[FieldScene]):
    """A field in training: a fixed number of rays, squared errors, a rate that falls
    exponentially."""

    def __init__(self, run: RunStart, field: Field, model: FieldModel) -> None:
        self._run, self._field, self._model = run, field, model
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
        return ColourLoss(self.error)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return list(self._field.parameters.values())

    def error(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the errors between rendered and true colours, whose mean is minimised."""
        return (one - other).square()

    @property
    def num_rays(self) -> int:
        """Rays of the next image."""
        return max(1, NERF_SIZES[self._model.sizes].rays // self._batch)

    def rate(self, step: int) -> float:
        """Return the learning rate in ``step``."""
        highest = self._model.lr or NERF_SIZES[self._model.sizes].lr
        return highest * LAST_RATE ** (step / self._run.config.train.steps)

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
                self.error(coarse[None], part.composite(background)), part.mask
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

    def restore(self, checkpoint: Checkpoint) -> None:
        field = restored_field(self._model, checkpoint)
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


class NgpTraining(FieldTraining):
    """Training of Instant-NGP: rays per step by the number of samples, and the occupancy grid."""

    _field: NgpField

    def __init__(self, run: RunStart, field: NgpField, model: NgpModel) -> None:
        super().__init__(run, field, model)
        self._num_samples = 1 << NgpSizes.of(model).log2_samples
        self._wanted = max(1, self._num_samples // self._batch)
        self._occupancy = self._new_occupancy(field)
        field.occupied.copy_(self._occupancy.seen)
        # rays and samples of this step
        self._counted = torch.zeros(2, dtype=torch.float64, device="cpu")
        self._rays = max(1, self._wanted // FIRST_SAMPLES)

    def _new_occupancy(self, field: NgpField) -> Occupancy:
        seen = seen_cells(field.space, self._run.capture.splits["train"])
        if not bool(seen.any()):
            raise DyngsError(
                f"{self._run.config.data.root}: no training camera sees anything of the cube that the field lies in: "
                "give model.half_extent, or model.surroundings=always"
            )
        return Occupancy(field.space, seen, LOOKED_AT * self._num_samples)

    def error(self, one: Tensor, other: Tensor) -> Tensor:
        return torch.nn.functional.smooth_l1_loss(one, other, reduction="none")

    @property
    def betas(self) -> tuple[float, float]:
        return 0.9, 0.99

    @property
    def num_rays(self) -> int:
        return self._rays

    def counted(self, num_rays: int, num_samples: int) -> None:
        self._counted += torch.tensor([num_rays, num_samples], dtype=torch.float64, device="cpu")

    def tallies(self, step: int) -> Sequence[Tensor]:
        return [self._counted]

    def rate(self, step: int) -> float:
        rising = min(1.0, FIRST_RATE + (1 - FIRST_RATE) * (step - 1) / WARM_UP)
        fallen = sum(step > fraction * self._run.config.train.steps for fraction in DROPS)
        return (self._model.lr or NGP_RATE) * rising * DROP**fallen

    def update(self, step: int) -> Updated:
        for name, x in self._field.parameters.items():
            if name != "table" and x.grad is not None:
                x.grad.add_(x.detach(), alpha=WEIGHT_DECAY)
        updated = super().update(step)
        if self._occupancy.is_due(step):
            occupied = self._occupancy.updated(
                self._field, step, self._like.seen_at, self._run.generator
            )
            self._field.occupied.copy_(occupied)
        rays, samples = self._counted.tolist()
        self._rays = max(1, min(MOST_RAYS, int(rays * self._wanted / max(samples, 1.0))))
        self._counted.zero_()
        return updated

    def _update_of(self, name: str, x: Tensor, rate: float) -> AdamUpdate | None:
        """Return the update; rows of the grid that no sample touched stay as they are."""
        rows = seen_rows(x.grad) if name == "table" and x.grad is not None else None
        return self._adam.update(name, x, rate, rows)

    def state(self) -> State:
        own = self._occupancy.state() | {"rays": torch.tensor([self._rays], device="cpu")}
        return super().state() | prefixed("occupancy", with_role(own, Role.TRAINING))

    def restore(self, checkpoint: Checkpoint) -> None:
        before = self._field.space
        super().restore(checkpoint)
        stored = checkpoint.part("occupancy")
        if self._field.space != before:  # to find what cameras see takes seconds
            self._occupancy = self._new_occupancy(self._field)
        self._occupancy.load_state(stored)
        self._rays = min(
            MOST_RAYS, max(1, int(require_tensor("rays", stored["rays"], (1,), torch.int64)))
        )

    def place(self, device: torch.device) -> None:
        super().place(device)
        self._occupancy.place(device)


def part_of(image: Image, pixels: Tensor) -> Image:
    """Return ``pixels`` (R,) of an image alone, (1, R), with the camera of the whole; without
    maps."""

    def taken(x: Tensor | None) -> Tensor | None:
        return None if x is None else x.flatten(0, 1)[pixels][None]

    rgb = image.rgb_premultiplied.flatten(0, 1)[pixels][None]
    return replace(
        image,
        rgb_premultiplied=rgb,
        alpha=taken(image.alpha),
        mask=taken(image.mask),
        moves=None,
        labels=None,
        depth=None,
        flow=None,
    )


def start(run: RunStart) -> FieldTraining:
    """Return the field of a capture before its first step. Raises DyngsError: a capture that it
    cannot hold."""
    model = run.config.model
    assert isinstance(model, (NgpModel, NerfModel))
    cells = NgpSizes.of(model).cells if isinstance(model, NgpModel) else 1
    try:
        space = space_of(model, cells, run.capture)
    except DyngsError as error:
        raise DyngsError(f"{run.config.data.root}: {error}") from None
    if isinstance(model, NerfModel):
        return FieldTraining(run, NerfField.new(model, space, run.generator), model)
    camera = run.images[0].cameras
    pixels = max(camera.width, camera.height)
    return NgpTraining(run, NgpField.new(model, space, run.generator, pixels), model)


def restored_field(model: FieldModel, checkpoint: Checkpoint) -> Field:
    """Return the field of a checkpoint. Raises KeyError or ValueError where its tensors do not
    fit."""
    space = stored_space(checkpoint.part("field"))
    if isinstance(model, NgpModel):
        return NgpField.restored(model, space, checkpoint)
    assert isinstance(model, NerfModel)
    return NerfField.restored(model, space, checkpoint)


def restore(model: FieldModel, checkpoint: Checkpoint) -> FieldScene:
    """Return the scene of a checkpoint."""
    field = restored_field(model, checkpoint)
    times = stored_times(checkpoint.part("field"))
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return FieldScene(field, times, DrawOptions(near=NEAR * field.space.half), behind)
