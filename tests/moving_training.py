"""A dynamic scene and its training strategy, driven like the trainer does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from moving_scene import Lines
from scenes import look_around
from tiny_fields import cloud
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.state import select_prefix, strip_roles
from dyngs.data.loader import Image
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import create_field
from dyngs.deform.keys import ControlNodesField, DynamicModel
from dyngs.deform.random_gaussians import box_of
from dyngs.deform.scene import DynamicScene
from dyngs.deform.schedule import DeformSchedule
from dyngs.deform.static_errors import StaticErrors
from dyngs.deform.training import DynamicTraining, TrainingViews
from dyngs.gaussians import EditResult, Gaussians
from dyngs.gaussians.filters import FilterUpdate
from dyngs.gaussians.scene import GaussianTimeStep
from dyngs.gaussians.schedule import RateSchedule

FINE, FULL, SPLIT, STEPS = 2, 4, 6, 20
FOCAL, DISTANCE = 100.0, 3.0
TIMES = tuple(i / 20 for i in range(21))


THRESHOLD = 0.3


def camera() -> Cameras:
    intrinsics = torch.tensor([[FOCAL, 0, 50], [0, FOCAL, 50], [0, 0, 1]])
    return Cameras(look_around(1, torch.float32), intrinsics[None], 100, 100)


def image(time: float | None) -> Image:
    return Image("view", camera(), torch.zeros(100, 100, 3), None, None, time)


def flat_cloud(count: int = 9) -> Gaussians:
    """Gaussians at depth 3 of ``camera``, where a pixel covers 0.03 units."""
    means = torch.rand((count, 3), generator=torch.Generator().manual_seed(1)) - 0.5
    means[:, 2] = 0.0
    gaussians = cloud(count).replace(means=means)
    return leaves(gaussians)


def leaves(gaussians: Gaussians) -> Gaussians:
    return Gaussians(
        **{name: x.clone().requires_grad_() for name, x in gaussians.tensors().items()}
    )


def alike(errors: Tensor) -> StaticErrors:
    return StaticErrors(errors, errors)


def unmeasured(gaussians_at: Callable[[float], Gaussians]) -> StaticErrors:
    return alike(torch.zeros(len(gaussians_at(0.0))))


@dataclass
class Run:
    """A scene and its training strategy."""

    training: DynamicTraining
    scene: DynamicScene

    def time_step(self, time: float | None, step: int) -> GaussianTimeStep:
        return self.training.time_step(self.scene, image(time), step)

    def drawn_at(self, time: float) -> Gaussians:
        """Rendered at the end of the run."""
        return self.time_step(time, STEPS).gaussians.detach()

    def after_step(self, step: int, result: EditResult | None = None) -> int:
        """Run optimizer and strategy after ``result``; return the number of rows with bad
        gradients.
        """
        left_out = self.training.optimize(self.scene, step)
        if result is not None and result.edit is not None:
            edited = self.scene.apply_edit(result.edit)
            self.scene = edited.with_gaussians(leaves(edited.gaussians))
        self.scene = self.training.after_step(self.scene, step, result is not None)
        return int(left_out)

    def grow(self, step: int) -> EditResult | None:
        grown = self.training.edit_scene(self.scene, step)
        if grown is None:
            return None
        self.scene, result = grown
        return result

    @property
    def model_state(self) -> dict[str, Tensor]:
        """Checkpoint entries other than the Gaussians."""
        return select_prefix(strip_roles(self.scene.state()), "model")


def new_run(
    gaussians: Gaussians,
    times: tuple[float, ...] = TIMES,
    static_errors: Callable[[Callable[[float], Gaussians]], StaticErrors] = unmeasured,
    update: FilterUpdate | None = None,
    has_fixed_cameras: bool = False,
    full: int = FULL,
    **options: object,
) -> Run:
    """A run before its first step."""
    defaults = {
        "deform": ControlNodesField(nodes=4),
        "num_random_moving": 0,
        "motion_sparsity": 0.0,
        "freeze_below_px": THRESHOLD,
    }
    capture = TrainingViews(times, [camera()], 1.0, static_errors, has_fixed_cameras)
    schedule = DeformSchedule(FINE, FINE, full, FINE, (SPLIT,), RateSchedule(STEPS))
    model = DynamicModel.model_validate(defaults | options)
    training = DynamicTraining(
        model, schedule, capture, update or FilterUpdate(), torch.Generator()
    )
    return Run(training, training.first_scene(gaussians))


def begun(gaussians: Gaussians, **options: object) -> Run:
    """A run after the coarse phase in which all Gaussians were marked as moving.

    By default each moves along a straight line.
    """
    run = new_run(gaussians, **options)  # type: ignore[arg-type]
    setup = FieldSetup(*box_of(gaussians, 1.0), len(run.scene.times), len(gaussians), 1.0)
    made = create_field(run.training.options.deform, setup, torch.Generator().manual_seed(0))
    field = made if "deform" in options else Lines(setup)
    run.scene = replace(run.scene, field=field, moving=torch.arange(len(gaussians)))
    return run


def move(run: Run, speeds: Tensor) -> None:
    """Move Gaussian i from -speeds[i] to speeds[i] along x, in world units."""
    assert run.scene.field is not None
    run.scene.field.parameters["means"].data[:, 0, 0] = speeds


def speeds_of(run: Run) -> Tensor:
    assert run.scene.field is not None
    return run.scene.field.parameters["means"].detach()[:, 0, 0]
