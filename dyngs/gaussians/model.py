"""Training of Gaussian scenes: owns the Gaussians, the Adam state and all per-Gaussian state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar, cast

import torch
from torch import Tensor

from dyngs.config import DefaultStrategy, SceneInit, SceneModel
from dyngs.core.conventions import SH_C0, RasterizeMode
from dyngs.core.gaussians import morton_order
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.data.loader import Image
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import restore_colour_network
from dyngs.gaussians.colour.training import (
    ColourTraining,
    MeasuredView,
    ViewDependence,
    find_view_dependent,
)
from dyngs.gaussians.densify import Densifier
from dyngs.gaussians.optimizer import FrozenMask, GaussianOptimizer
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, render_options
from dyngs.gaussians.schedule import active_sh_degree, learning_rates, means_rate, rate_schedule
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import Loss, Model, RenderOutput, UpdateResult
from dyngs.models.schedule import image_divisor
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.adam import Count

S = TypeVar("S", bound=GaussianScene)


class SceneTraining(Generic[S]):
    """Training of one kind of Gaussian scene: its parameters other than Gaussians and colours.

    This base class has no such parameters.

    Attributes:
        moves_by: name of the part that moves Gaussians, and the config section of its learning
            rates.
        colour_loss: image loss; None: L1 and D-SSIM.
        means_decay_from: step from which the learning rate of positions decays.
    """

    means_decay_from = 0
    deformation_name: tuple[str, str] = ("", "")
    colour_loss: Loss | None = None

    def trains_on(self, time: float | None, step: int) -> bool:
        return True

    def window(self, step: int) -> tuple[float, float]:
        return 0.0, 1.0

    def extend(self, scene: S, seen: tuple[float, float], step: int) -> None:
        """Extrapolate motion trained on the times in ``seen`` to the window of ``step``."""

    def time_step(self, scene: S, image: Image, step: int) -> GaussianTimeStep:
        """Return the Gaussians at the time of ``image``, with regularisers."""
        return scene.time_step(image.time)

    def optimize(self, scene: S, step: int) -> Count:
        """Update the parameters in place; return the number of skipped rows (bad gradients)."""
        return 0

    def leaves(self, scene: S) -> Sequence[Tensor]:
        """Return the trained tensors other than Gaussians and colours."""
        return ()

    def skip_unseen_rows(self, scene: S) -> Tensor | None:
        """Return indices of Gaussians that are updated only in steps that render them; None: no
        Gaussian."""
        return None

    def frozen_mask(self) -> FrozenMask:
        """Return the parameters that are frozen during training."""
        return FrozenMask()

    def after_step(self, scene: S, step: int, edited: bool) -> S:
        """Return the scene for the next step: 3D filter updated, motion extrapolated, Gaussians
        frozen."""
        return scene

    def time_gradient(self, scene: S) -> Tensor | None:
        """Return the loss gradient (N,) by the mean times of the Gaussians, in units of the
        threshold of densification; None without times."""
        return None

    def split_in_time(self, scene: S, result: EditResult, generator: torch.Generator) -> EditResult:
        """Return the edit with the halves of split Gaussians also spread over time."""
        return result

    def with_motion(self, scene: S, changes: Mapping[str, Tensor]) -> S:
        """Return the scene after an edit with new values of the motion, see ``EditResult``."""
        return scene

    def edit_scene(self, scene: S, step: int) -> tuple[S, EditResult] | None:
        """Return the scene and the edit of its Gaussians after ``step``; None if unchanged."""
        return None

    def apply_edit(self, edit: TopologyEdit) -> None:
        """Update per-Gaussian training state after a topology edit."""

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> S:
        """Return the scene in a checkpoint and restore the training state."""
        raise NotImplementedError

    def state(self) -> State:
        return {}


class GaussianModel(Model[GaussianScene]):
    """A Gaussian scene in training.

    Args:
        scene: initial or predicted scene; its Gaussians become leaf tensors.
        training: training of this kind of scene.
        densifier: densification strategy.
        colours: training of the colours.

    Attributes:
        options: render options of training images.
    """

    def __init__(
        self,
        run: StartContext,
        scene: GaussianScene,
        training: SceneTraining[Any],
        densifier: Densifier,
        colours: ColourTraining,
    ) -> None:
        config = run.config
        self._config, self.densifier, self.colours = config, densifier, colours
        self._run = run
        self._generator = run.generator
        self._rates, self._rate_schedule = learning_rates(config), rate_schedule(config)
        self.options = training_options(run)
        self.start_from(scene, training)

    def start_from(self, scene: GaussianScene, training: SceneTraining[Any]) -> None:
        """Replace the scene before the first step, for example with a predicted one; reset the
        optimiser."""
        config = self._config
        self.training, self._optimizer = training, GaussianOptimizer(scene.gaussians, self._rates)
        behind = evaluation_background(config.data.background, self._run.capture.has_alpha)[1]
        self._scene = replace(
            scene.with_gaussians(self._optimizer.parameters),
            colour=self.colours.network,
            options=self._render_options(config.model),
            background=behind,
        )

    @property
    def scene(self) -> GaussianScene:
        return self._scene

    @property
    def deformation_name(self) -> tuple[str, str]:  # type: ignore[override]
        return self.training.deformation_name

    @property
    def rasterize_mode(self) -> RasterizeMode:
        return self.options.mode

    @property
    def num_gaussians(self) -> int:
        return len(self._scene)

    @property
    def num_moving(self) -> int:
        return self._scene.num_moving

    @property
    def leaves(self) -> Sequence[Tensor]:
        leaves = [*self._optimizer.parameters.tensors().values()]
        leaves += [] if self.colours.parameters is None else self.colours.parameters.leaves
        return [*leaves, *self.training.leaves(self._scene)]

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        scene = self._scene
        densifier = self.densifier
        now = self.training.time_step(scene, image, step)
        probe = (
            torch.zeros(1, len(scene), 4, requires_grad=True, device=scene.device)
            if densifier.needs_gradient(step)
            else None
        )
        options = self._options(step)
        options = replace(options, depth="expected") if depth else options
        rendering = scene.render(
            image.cameras, now, options=options, background=background, probe=probe
        )

        def after_backward() -> None:
            if probe is not None and probe.grad is not None:
                size = (image.cameras.width, image.cameras.height)
                # Small images need fewer Gaussians, so their gradients count less.
                signal = probe.grad / image_divisor(self._config.train, step)
                densifier.after_backward(step, signal, rendering.radii, size)

        moved = now.gaussians.tensors() if scene.num_moving else {}
        return RenderOutput(rendering, now.penalties, moved, after_backward)

    @property
    def colour_loss(self) -> Loss | None:
        return self.training.colour_loss

    def regularizers(self) -> Mapping[str, Tensor]:
        now = self._scene.gaussians
        return self.densifier.regularizers(now) | self.colours.penalties(now)

    def tallies(self, step: int) -> Sequence[Tensor]:
        return self.densifier.tallies(step, len(self._scene))

    def trains_on(self, time: float | None, step: int) -> bool:
        return self.training.trains_on(time, step)

    def is_held_out(self, index: int, step: int) -> bool:
        return self.colours.is_held_out(index, step)

    def window(self, step: int) -> tuple[float, float]:
        return self.training.window(step)

    def extend(self, seen: tuple[float, float], step: int) -> None:
        self.training.extend(self._scene, seen, step)

    def update(self, step: int) -> UpdateResult:
        before = self._optimizer.parameters
        generator = self._generator
        progress = self._rate_schedule.progress(step, since=self.training.means_decay_from)
        lr_means = means_rate(self._rates, progress, self._run.extent)
        frozen_mask = self.training.frozen_mask()
        self.densifier.add_time_gradient(step, self.training.time_gradient(self._scene))
        bad = self._optimizer.step(
            step,
            lr_means,
            frozen_harmonics=self.colours.frozen_harmonics,
            skip_unseen_rows=self.training.skip_unseen_rows(self._scene),
            frozen_mask=frozen_mask,
        )
        bad = bad + self.colours.optimize(step) + self.training.optimize(self._scene, step)
        result = self.densifier.edit(step, self._optimizer.parameters, generator)
        if result is not None:
            result = frozen_mask.exclude_from_edit(result, self._optimizer.parameters)
            result = self.training.split_in_time(self._scene, result, generator)
            self._apply(self._sort_by_morton_code(result))
        means = self._optimizer.parameters.means.detach()
        frozen = self.training.frozen_mask().rows
        frozen_means = None if frozen is None else means[frozen]
        self.densifier.perturb(self._optimizer.parameters, lr_means, generator)
        if frozen_means is not None:
            means[frozen] = frozen_means
        self._scene = self.training.after_step(self._scene, step, result is not None)
        scene_edit = self.training.edit_scene(self._scene, step)
        if scene_edit is not None:
            scene, result = scene_edit
            self._apply(result, scene)
        messages = (
            self._measure_harmonics(step),
            None if scene_edit is None else scene_edit[1].message,
        )
        self._scene.clear_caches()
        text = "; ".join(text for text in messages if text) or None
        return UpdateResult(bad, text, self._optimizer.parameters is not before)

    def replace_scene(self, scene: GaussianScene) -> None:
        """Continue with ``scene``: same Gaussians with other motion, masks or render options."""
        self._scene = scene.with_gaussians(self._optimizer.parameters)
        self._scene.clear_caches()

    def select_gaussians(self, kept: Tensor, done: int) -> None:
        """Keep only the Gaussians where ``kept`` (N,) is true, after step ``done``."""
        self._apply(EditResult(TopologyEdit.select(kept)))
        self._scene = self.training.after_step(self._scene, done, True)
        self._scene.clear_caches()

    def stop_growing(self) -> None:
        """Stop densification and pruning."""
        self.densifier = Densifier()

    def drop_harmonics(
        self, seen: Sequence[int], held_out: Sequence[int], step: int, tolerance: float
    ) -> ViewDependence:
        """Drop SH of Gaussians that do not improve the training views ``held_out``, for good.

        See ``find_view_dependent``. ``seen``: training views that colours are measured on.
        """
        colour = background_colour(self._run.background).to(self._scene.device)

        def views(indices: Sequence[int]) -> Iterator[MeasuredView]:
            for image in (self._run.images[i] for i in indices):
                gaussians = self.training.time_step(self._scene, image, step).gaussians.detach()
                yield MeasuredView(gaussians, image.cameras, image.composite(colour), image.mask)

        options = self._options(step)
        found = find_view_dependent(views(seen), list(views(held_out)), options, colour, tolerance)
        base = self._scene.gaussians.sh.detach()[:, 0] + found.offsets / SH_C0
        self._optimizer.drop_harmonics(base, ~found.kept_harmonics)
        self.colours.freeze(~found.kept_harmonics)
        self.replace_scene(self._scene)
        return found

    def set_render_options(self, model: SceneModel) -> None:
        """Use the render options of another config section of the same kind."""
        options = self._render_options(model)
        self.options = replace(self.options, alpha_min=options.alpha_min)
        self._scene = replace(self._scene, options=options)

    def state(self) -> State:
        state = self._scene.state() | add_prefix("model", self.training.state())
        state |= add_prefix("model.colour", self.colours.state()) | self._optimizer.state()
        return state | add_prefix("strategy", with_role(self.densifier.state(), Role.TRAINING))

    def restore(self, checkpoint: Checkpoint) -> None:
        gaussians = Gaussians.stored(checkpoint.part("gaussians"))
        optimizer = self._optimizer.with_state(gaussians, checkpoint.tensors)
        colour = checkpoint.part("model.colour")
        restore_colour_network(colour)  # raises for inconsistent tensors
        self.colours.restore(colour, len(gaussians))
        scene = self.training.restore(optimizer.parameters, checkpoint.part("model"))
        if checkpoint.info.step >= self._config.train.steps:
            self.stop_growing()
        self.densifier.load_state(checkpoint.part("strategy"))
        like = self._scene
        self._optimizer = optimizer
        self._scene = replace(
            scene, colour=self.colours.network, options=like.options, background=like.background
        )

    def place(self, device: torch.device) -> None:
        if self._scene.device == device:
            return
        self._optimizer = self._optimizer.to(device)
        self.colours.move_to(device)
        self.densifier.move_to(device)
        scene: GaussianScene = self._scene.to(device)
        scene = scene.with_gaussians(self._optimizer.parameters)
        self._scene = replace(scene, colour=self.colours.network)

    def _options(self, step: int) -> RenderOptions:
        degree = self._scene.gaussians.sh_degree
        # an existing scene already has trained SH
        if not isinstance(self._config.init, SceneInit):
            degree = active_sh_degree(self._config.train, step, degree)
        return replace(self.options, sh_degree=degree)

    def _apply(self, result: EditResult, edited: GaussianScene | None = None) -> None:
        """Apply an edit to the Gaussians, the optimiser and all per-Gaussian state.

        ``edited``: the scene after the edit, if it already exists.
        """
        self._optimizer.apply(result)
        scene = edited
        if scene is None:
            unmoved = self._scene if result.edit is None else self._scene.apply_edit(result.edit)
            scene = cast(GaussianScene, self.training.with_motion(unmoved, result.motion_changes))
        self._scene = scene.with_gaussians(self._optimizer.parameters)
        if result.edit is not None:
            self.colours.apply_edit(result.edit)
            self.training.apply_edit(result.edit)

    def _sort_by_morton_code(self, result: EditResult) -> EditResult:
        """Sort the rows of an edit in Morton order, so that kernels read neighbours from the
        cache."""
        edit = result.edit
        if edit is None:
            return result
        means = result.changes.get("means", edit.apply(self._optimizer.parameters.means.detach()))
        order = torch.from_numpy(morton_order(means.cpu().numpy())).to(means.device)
        changes = {name: x[order] for name, x in result.changes.items()}
        motion = {name: x[order] for name, x in result.motion_changes.items()}
        return replace(result, edit=edit.in_order(order), changes=changes, motion_changes=motion)

    def _measure_harmonics(self, step: int) -> str | None:
        """Drop SH that do not improve held-out views if due at this step; return a message."""
        colours = self.colours
        if step != colours.measurement_step or not self._scene.gaussians.sh_degree:
            return None
        times = enumerate(self._run.images.times)
        may_train = [i for i, time in times if self.training.trains_on(time, step)]
        seen = [i for i in may_train if i not in colours.held_out]
        held_out = [i for i in may_train if i in colours.held_out]
        if not seen or not held_out:
            return None
        return str(self.drop_harmonics(seen, held_out, step, colours.tolerance))

    def _render_options(self, model: SceneModel) -> RenderOptions:
        return render_options(model, self._run.extent, self._run.capture.world_scale)


def training_options(run: StartContext) -> RenderOptions:
    """Return the render options for training images."""
    strategy = run.config.strategy
    absgrad = isinstance(strategy, DefaultStrategy) and strategy.absgrad
    options = render_options(run.config.model, run.extent, run.capture.world_scale)
    return replace(options, absgrad=absgrad, nonfinite="trust")
