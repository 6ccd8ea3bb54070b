"""Training of dynamic scenes.

Three phases: coarse (a static model), fine (the field moves all selected Gaussians), and frozen:
Gaussians without visible motion become static and are skipped by the field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, with_role
from dyngs.data.loader import Image
from dyngs.deform.bodies.paths import FrameStack
from dyngs.deform.bodies.rigid_bodies import Bodies, find_bodies
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import DeformationField, FieldSetup, Offsets, apply_offsets, innermost
from dyngs.deform.fields import WindowedField, create_field
from dyngs.deform.fixed_cameras import FixedCameraClip
from dyngs.deform.free import FreeInitialization, FreePrimitives, initialize_free
from dyngs.deform.gaussians_4d import Gaussians4D
from dyngs.deform.initial_motion import InitialMotion, find_initial_motion
from dyngs.deform.keys import TIMED_FIELDS, DynamicModel, MlpField
from dyngs.deform.random_gaussians import box_of, random_gaussians, with_gaussians
from dyngs.deform.scene import DynamicScene
from dyngs.deform.schedule import DeformSchedule, TimeWindow
from dyngs.deform.static_errors import StaticErrors, otsu_threshold
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.filters import FILTER_VARIANCE, FilterUpdate, filter_std
from dyngs.gaussians.model import SceneTraining
from dyngs.gaussians.scene import GaussianTimeStep
from dyngs.gaussians.visibility import row_positions
from dyngs.ops.adam import Count

PX_PER_OPACITY = 6.0
"""Pixels of motion that a change of opacity, or of an SH coefficient, by 1 counts as."""


@torch.no_grad()
def measure_motion(
    field: DeformationField, gaussians: Gaussians, times: Sequence[float], px_size: Tensor
) -> tuple[Tensor, Offsets]:
    """Return the motion (M,) of Gaussians in pixels over ``times``, and their mean offsets.

    At most 24 times are sampled. The score is max_t |x_t - mean| + s (2 |q_t - mean| + max_axis
    |log s_t - mean|) in pixels, where s is the longest standard deviation, plus ``PX_PER_OPACITY``
    times the change of opacity and colour. ``px_size`` (M,): world units per pixel in the nearest
    training view.
    """
    picked = torch.linspace(0, len(times) - 1, min(len(times), 24), device="cpu").round().long()
    samples = [field.offsets(gaussians.means, times[i]) for i in picked.tolist()]
    heads = [name for name, x in vars(samples[0]).items() if x is not None]
    mean = Offsets(
        **{name: torch.stack([getattr(x, name) for x in samples]).mean(0) for name in heads}
    )
    longest = gaussians.scales.amax(1)
    score = torch.zeros_like(longest)
    no_rotation = torch.zeros_like(gaussians.quats)
    for sample in samples:
        deviations: dict[str, Tensor] = {
            name: no_rotation if x is None else x - getattr(mean, name)
            for name, x in vars(sample).items()
        }
        displacement = deviations["means"].norm(dim=1) + 2 * longest * deviations["quats"][
            :, 1:
        ].norm(dim=1)
        displacement = displacement + longest * deviations["log_scales"].abs().amax(1)
        pixels = displacement / px_size + PX_PER_OPACITY * deviations["colors"].abs().amax(1)
        if sample.logit_opacities is not None and mean.logit_opacities is not None:
            now = (gaussians.logit_opacities + sample.logit_opacities).sigmoid()
            typical = (gaussians.logit_opacities + mean.logit_opacities).sigmoid()
            pixels = pixels + PX_PER_OPACITY * (now - typical).abs()
        score = torch.maximum(score, pixels)
    return score, mean


@torch.no_grad()
def bake_(gaussians: Gaussians, rows: Tensor, offsets: Offsets) -> None:
    """Add ``offsets`` to the ``rows`` (R,) of ``gaussians`` permanently, in place."""
    moved = apply_offsets(gaussians.detach(), offsets, rows).tensors()
    for name, x in gaussians.tensors().items():
        x.data.copy_(moved[name])


# multiple of ``motion_threshold`` above which an error always counts as motion
SURELY_MOVING = 1.5
SURELY_STATIC = 0.25
"""Multiple of ``motion_threshold`` below which Gaussians are frozen, with fixed cameras."""
# Fraction of surely moving Gaussians up to which the scene is static.
MIN_MOVING_FRACTION = 0.02


@dataclass(frozen=True)
class TrainingViews:
    """Training views of a dynamic scene."""

    # of the training views, in [0, 1], ascending; at least two distinct times
    times: tuple[float, ...]
    cameras: Sequence[Cameras]
    extent: float
    # Computes the errors of a static scene, given its Gaussians at a time.
    static_errors: Callable[[Callable[[float], Gaussians]], StaticErrors]
    has_fixed_cameras: bool = False  # fixed cameras show static parts unchanged
    # returns the clips of the fixed cameras
    fixed_clips: Callable[[], Sequence[FixedCameraClip]] = tuple
    # Returns the images of one moving camera and the renderings of N static Gaussians; None if no
    # single moving camera took the images.
    frame_stack: Callable[[Gaussians], FrameStack | None] = lambda _: None


class DynamicTraining(SceneTraining[DynamicScene]):
    """Training of a dynamic scene, see ``SceneTraining``."""

    deformation_name = ("field", "model.deform")

    def __init__(
        self,
        options: DynamicModel,
        schedule: DeformSchedule,
        capture: TrainingViews,
        update: FilterUpdate,
        generator: torch.Generator,
    ) -> None:
        self.options, self.schedule, self.capture = options, schedule, capture
        self._has_lifetimes = isinstance(options.deform, TIMED_FIELDS)
        self.means_decay_from = 0 if options.static_decay else schedule.coarse_end
        self.times = tuple(sorted(set(capture.times)))
        self._set_time_window(False)
        self._update, self._generator = update, generator

    def first_scene(self, gaussians: Gaussians) -> DynamicScene:
        return DynamicScene(
            gaussians=gaussians,
            training_times=self.times,
            filter_std=self._update.compute(gaussians),
        )

    def trains_on(self, time: float | None, step: int) -> bool:
        return self._window.contains(time or 0.0, step)

    def window(self, step: int) -> tuple[float, float]:
        return self._window.bounds(step)

    def extend(self, scene: DynamicScene, seen: tuple[float, float], step: int) -> None:
        if scene.field is not None:
            scene.field.extend(seen, self._window.bounds(step))

    def time_step(self, scene: DynamicScene, image: Image, step: int) -> GaussianTimeStep:
        if scene.field is None:
            return scene.time_step(image.time)
        time = (image.time or 0.0) + self._time_noise(step)
        detach = self._window.is_frontier_step(step)
        now = scene.in_training(time, detach=detach, eye=image.cameras.centers[0])
        penalties = now.penalties | self._sparsity(now.offsets)
        return GaussianTimeStep(now.gaussians, image.time, None, penalties)

    def optimize(self, scene: DynamicScene, step: int) -> Count:
        if scene.field is None:
            return 0
        scene.field.zero_gradients_outside_(self._window.bounds(step))
        progress = self.schedule.rates.progress(step, since=self.schedule.decay_from)
        return scene.field.step(step - self.schedule.coarse_end, progress)

    def skip_unseen_rows(self, scene: DynamicScene) -> Tensor | None:
        return scene.moving if scene.field is not None and scene.field.has_lifetime else None

    def time_gradient(self, scene: DynamicScene) -> Tensor | None:
        if not isinstance(scene.field, Gaussians4D):
            return None
        threshold = scene.field.options.time_grad_threshold
        if threshold is None:
            return None
        gradient = scene.gaussians.means.detach().new_zeros(len(scene))
        gradient[scene.moving] = scene.field.time_gradient / threshold
        return gradient

    def split_in_time(
        self, scene: DynamicScene, result: EditResult, generator: torch.Generator
    ) -> EditResult:
        field = scene.field
        if not isinstance(field, Gaussians4D) or result.edit is None:
            return result
        if "means" not in result.changes or scene.is_static:
            return result
        old = scene.gaussians.log_scales.detach()[result.edit.source]
        shrunk = (result.changes["log_scales"] != old).any(1)
        origin = row_positions(scene.moving, len(scene))[result.edit.source]
        children = torch.nonzero(shrunk & (origin >= 0))[:, 0]
        source = result.edit.source[children]
        gaussians = scene.gaussians.detach().select(source)
        means, changes = field.split(gaussians, origin[children], generator)
        moved = result.changes["means"].clone()
        moved[children] = means
        fill: dict[str, Tensor] = {}
        for name, values in changes.items():
            fill[name] = field.parameters[name].detach()[origin.clamp_min(0)]
            fill[name][children] = values
        return replace(result, changes=result.changes | {"means": moved}, motion_changes=fill)

    def with_motion(self, scene: DynamicScene, changes: Mapping[str, Tensor]) -> DynamicScene:
        if scene.field is not None:
            for name, values in changes.items():
                scene.field.parameters[name].data.copy_(values[scene.moving])
        return scene

    def leaves(self, scene: DynamicScene) -> list[Tensor]:
        return [] if scene.field is None else scene.field.leaves

    def after_step(self, scene: DynamicScene, step: int, edited: bool) -> DynamicScene:
        if self._update.is_due(step, edited):
            scene = replace(scene, filter_std=self._update.compute(scene.gaussians))
        if scene.field is None:
            return scene
        if edited:
            scene.field.invalidate()
        scene.field.extend(self._window.bounds(step), self._window.bounds(step + 1))
        scene = self._add_windows(scene, step)
        return self._freeze_static(scene) if step in self.schedule.freeze_steps else scene

    def finds_motion(self, scene: DynamicScene) -> bool:
        """Return whether the static ``scene`` leaves errors that motion may explain."""
        now = scene.gaussians
        return self._has_motion(self.capture.static_errors(lambda _: now))

    def edit_scene(self, scene: DynamicScene, step: int) -> tuple[DynamicScene, EditResult] | None:
        """Add the Gaussians that motion starts with; None if a static model explains all images."""
        if step != self.schedule.coarse_end:
            return None
        now = scene.gaussians.detach()
        errors = self.capture.static_errors(lambda _: now)
        floor = self.options.motion_threshold
        threshold = min(max(otsu_threshold(errors.typical), floor), SURELY_MOVING * floor)
        rows = torch.nonzero(errors.typical > threshold)[:, 0]
        first = self._find_initial_motion(now)
        has_motion = self._has_motion(errors) or bool(first.timed_gaussians)
        if self.options.select_moving and not has_motion:
            return None
        bodies = self._find_bodies(now)
        added, start = self._build_added(now, rows, first, bodies)
        message = first.message if bodies is None else bodies.message
        result = replace(with_gaussians(now, added), message=message)
        if start is not None:
            result.changes["logit_opacities"][rows] = start.logits.to(rows.device)
        gaussians = Gaussians(**result.changes)
        moving = torch.cat([rows, torch.arange(len(now), len(gaussians), device=rows.device)])
        if not self.options.select_moving:
            start = None if start is None else start.with_static(rows, len(now))
            moving = torch.arange(len(gaussians), device=rows.device)
        center, half_size = box_of(now, self.capture.extent)
        setup = FieldSetup(
            center,
            half_size,
            len(self.times),
            len(moving),
            self.capture.extent,
            now.sh.shape[1] if scene.colour is None else 0,
        )
        field = create_field(self.options.deform, setup, self._generator)
        if isinstance(field, FreePrimitives) and start is not None:
            field = field.with_initialization(start)
        if isinstance(field, Gaussians4D) and start is not None:
            field, tilted = field.with_initialization(start, gaussians.select(moving))
            for name in ("quats", "log_scales"):
                result.changes[name][moving] = getattr(tilted, name).to(moving.device)
        if bodies is not None:
            field = bodies.build_field(field)
            self._set_time_window(bodies.explains_all_motion)
        std = self._update.compute(gaussians)
        field = field.to(now.means.device)
        return replace(
            scene, gaussians=gaussians, field=field, moving=moving, filter_std=std
        ), result

    def _has_motion(self, errors: StaticErrors) -> bool:
        is_wrong = errors.peak > SURELY_MOVING * self.options.motion_threshold
        return bool(is_wrong.float().mean() > MIN_MOVING_FRACTION)

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> DynamicScene:
        self._set_time_window("all_times" in tensors)
        return DynamicScene.from_state(self.options, gaussians, tensors)

    def state(self) -> State:
        return (
            with_role({"all_times": torch.ones(1, device="cpu")}, Role.TRAINING)
            if self._all_times
            else {}
        )

    def _set_time_window(self, all_times: bool) -> None:
        """Set the time window: all times at once if ``all_times``, else growing from the middle."""
        first = 1.0 if all_times or self._has_lifetimes else self.options.time_window
        self._all_times = all_times
        self._window = TimeWindow(self.capture.times, first, self.schedule)

    def _find_bodies(self, static: Gaussians) -> Bodies | None:
        """Find rigid bodies in the images of one moving camera."""
        if self._has_lifetimes or not self.options.select_moving:
            return None
        frame_stack = self.capture.frame_stack(static)
        if frame_stack is None:
            return None
        return find_bodies(frame_stack, self.options.num_random_moving, static.sh.shape[1])

    def _build_added(
        self,
        now: Gaussians,
        rows: Tensor,
        first: InitialMotion,
        bodies: Bodies | None,
    ) -> tuple[Sequence[Gaussians], FreeInitialization | None]:
        """Return the Gaussians to add when motion starts, and the windows of free primitives."""
        is_explained = first.timed_gaussians or (bodies and bodies.explains_all_motion)
        count = 0 if is_explained else self.options.num_random_moving
        added = random_gaussians(now, count, self.capture.extent, self._generator)
        if not self._has_lifetimes:
            return [added, *(bodies.seeds if bodies else ())], None
        static, others = (x.to(device="cpu") for x in (now.select(rows), added))
        start = initialize_free(static, first.timed_gaussians, others, len(self.times))
        return start.added, start

    def _find_initial_motion(self, static: Gaussians) -> InitialMotion:
        """Find motion in front of fixed cameras, for Gaussians with a lifetime."""
        if not self._has_lifetimes:
            return InitialMotion()
        return find_initial_motion(
            self.capture.fixed_clips(),
            static,
            self.capture.extent,
            2 * self.options.num_random_moving,
        )

    def _add_windows(self, scene: DynamicScene, step: int) -> DynamicScene:
        """Add opacity windows around control nodes once all times are trained on."""
        field = scene.field
        if step != max(self.schedule.window_full_at, self.schedule.coarse_end + 1) or field is None:
            return scene
        if isinstance(field, WindowedField) or not isinstance(innermost(field), ControlNodes):
            return scene
        open_ = WindowedField(field, len(scene.moving)).to(scene.moving.device)
        return replace(scene, field=open_)

    def _freeze_static(self, scene: DynamicScene) -> DynamicScene:
        """Freeze the Gaussians whose motion is too small to be visible."""
        field = scene.field
        now = scene.gaussians.detach()
        if field is None or not field.can_freeze:
            return scene
        px_size = filter_std(now.means, self.capture.cameras)[scene.moving] / math.sqrt(
            FILTER_VARIANCE
        )
        pixels, mean = measure_motion(field, now.select(scene.moving), self.times, px_size)
        moves = pixels >= self.options.freeze_below_px
        if self.capture.has_fixed_cameras:
            means = now.means[scene.moving]
            errors = self.capture.static_errors(
                lambda time: apply_offsets(now, field.offsets(means, time), scene.moving)
            )
            moves &= errors.typical[scene.moving] > SURELY_STATIC * self.options.motion_threshold
        static = torch.nonzero(~moves)[:, 0]
        kept = torch.nonzero(moves)[:, 0]
        bake_(scene.gaussians, scene.moving[static], mean.select(static))
        if not len(kept):
            return replace(scene, field=None, moving=scene.moving[kept])
        left = field.apply_edit(TopologyEdit.select(kept))
        left.invalidate()
        return replace(scene, field=left, moving=scene.moving[kept])

    def _time_noise(self, step: int) -> float:
        """Return a random offset of the time of a training view (Deformable-3DGS)."""
        field = self.options.deform
        remaining = 1 - 2 * step / self.schedule.rates.steps
        if not isinstance(field, MlpField) or field.time_noise == 0 or remaining <= 0:
            return 0.0
        sample = torch.randn((), generator=self._generator, device="cpu")
        return field.time_noise * remaining / len(self.times) * float(sample)

    def _sparsity(self, offsets: Offsets | None) -> dict[str, Tensor]:
        """Return the mean displacement as a regularisation term; Gaussians with a lifetime have
        none."""
        is_off = self.options.motion_sparsity == 0 or self._has_lifetimes
        if is_off or offsets is None or not len(offsets.means):
            return {}
        tiny = 1e-6 * self.capture.extent
        length = (offsets.means.square().sum(1) + tiny**2).sqrt().mean()
        return {"motion sparsity": length * (self.options.motion_sparsity / self.capture.extent)}
