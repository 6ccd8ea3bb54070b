"""Gaussians in training: the one owner of their values, of the state of Adam, and of what is stored
per Gaussian."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from dyngs.config import AutoColour, DefaultStrategy, SceneInit, SceneModel
from dyngs.core.conventions import SH_C0, RasterizeMode
from dyngs.core.gaussians import morton_order
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.data.loader import Image
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import restore_colour_network
from dyngs.gaussians.colour.training import (
    AutoTraining,
    ColourTraining,
    MeasuredView,
    MeasurementViews,
)
from dyngs.gaussians.densify import Densifier
from dyngs.gaussians.optimizer import FrozenMask, GaussianOptimizer
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, render_options
from dyngs.gaussians.schedule import active_sh_degree, learning_rates, means_rate, rate_schedule
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import Drawn, Loss, Model, UpdateResult
from dyngs.models.schedule import image_divisor
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.adam import Count

S = TypeVar("S", bound=GaussianScene)


class SceneTraining(Generic[S]):
    """Training of a kind of scene: of all that it learns next to the Gaussians and their colours,
    here nothing.

    Attributes:
        moves_by: name of what moves the Gaussians and the configuration section of its learning
            rates, for messages.
        colour_loss: how colours are compared with true ones; None: by L1 and D-SSIM.
    """

    deformation_name: tuple[str, str] = ("", "")
    colour_loss: Loss | None = None

    def trains_on(self, time: float | None, step: int) -> bool:
        return True

    def window(self, step: int) -> tuple[float, float]:
        return 0.0, 1.0

    def extend(self, scene: S, seen: tuple[float, float], step: int) -> None:
        """Continue motion learned for the times in ``seen`` to those that are trained on at
        ``step``."""

    def time_step(self, scene: S, image: Image, step: int) -> GaussianTimeStep:
        """Return the Gaussians drawn for ``image`` in ``step``, with the penalties."""
        return scene.time_step(image.time)

    def optimize(self, scene: S, step: int) -> Count:
        """Update, in place, what the scene learns; return the number of rows left out for bad
        gradients."""
        return 0

    def leaves(self, scene: S) -> Sequence[Tensor]:
        """Return what the scene learns next to the Gaussians and their colours."""
        return ()

    def skip_unseen_rows(self, scene: S) -> Tensor | None:
        """Return the indices of the Gaussians that stay as they are in steps that do not show them;
        None: of none."""
        return None

    def frozen_mask(self) -> FrozenMask | None:
        """Return what stays as it is, whatever the images say."""
        return None

    def after_step(self, scene: S, step: int, edited: bool) -> S:
        """Return the scene for the next step: filters brought up to date, motion extended, static
        Gaussians frozen."""
        return scene

    def edit_scene(self, scene: S, step: int) -> tuple[S, EditResult] | None:
        """Return the scene as its kind changes it after ``step``, and the edit of its Gaussians;
        None: it does not."""
        return None

    def follow(self, edit: TopologyEdit) -> None:
        """Let what the training itself keeps per Gaussian follow a change of the set."""

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> S:
        """Return the scene of a checkpoint, and take over the training's state."""
        raise NotImplementedError

    def state(self) -> State:
        return {}


class GaussianModel(Model[GaussianScene]):
    """A scene of Gaussians in training.

    Args:
        scene: before the first step, or predicted; its Gaussians become leaf tensors.
        training: how its kind is trained.
        densifier: the strategy, which adds and removes Gaussians.
        colours: how they are trained.

    Attributes:
        options: how training images are drawn.
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
        self._rates, self._course = learning_rates(config), rate_schedule(config)
        self.options = training_options(run)
        self.start_from(scene, training)

    def start_from(self, scene: GaussianScene, training: SceneTraining[Any]) -> None:
        """Begin with this scene, a predicted one for instance, and learn it so; nothing is learned
        yet."""
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
        found = [*self._optimizer.parameters.tensors().values()]
        found += (
            []
            if self.colours.network_parameters is None
            else self.colours.network_parameters.leaves
        )
        return [*found, *self.training.leaves(self._scene)]

    def draw(self, image: Image, step: int, background: Tensor, *, depth: bool = False) -> Drawn:
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
                # Fewer Gaussians suit small images: a gradient counts for less there.
                signal = probe.grad / image_divisor(self._config.train, step)
                densifier.after_backward(step, signal, rendering.radii, size)

        moved = now.gaussians.tensors() if scene.num_moving else {}
        return Drawn(rendering, now.penalties, moved, after_backward)

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
        lr_means = means_rate(self._rates, self._course.progress(step), self._run.extent)
        frozen = self.colours.frozen_harmonics()
        skip_unseen_rows = self.training.skip_unseen_rows(self._scene)
        frozen_mask = self.training.frozen_mask()
        bad = self._optimizer.step(
            step,
            lr_means,
            frozen_harmonics=frozen,
            skip_unseen_rows=skip_unseen_rows,
            frozen_mask=frozen_mask,
        )
        bad = bad + self.colours.optimize(step) + self.training.optimize(self._scene, step)
        result = self.densifier.edit(step, self._optimizer.parameters, generator)
        if result is not None:
            if frozen_mask is not None:
                result = frozen_mask.exclude_from_edit(result, self._optimizer.parameters)
            self._apply(self._in_memory_order(result))
        self._perturb(lr_means)
        self._scene = self.training.after_step(self._scene, step, result is not None)
        scene_edit = self.training.edit_scene(self._scene, step)
        if scene_edit is not None:
            scene, result = scene_edit
            self._apply(result, scene)
        findings = (
            self._measured_harmonics(step),
            None if scene_edit is None else scene_edit[1].message,
        )
        self._scene.changed()
        text = "; ".join(text for text in findings if text) or None
        return UpdateResult(bad, text, self._optimizer.parameters is not before)

    def _perturb(self, lr_means: float) -> None:
        """Let the strategy shake the Gaussians, but for those that stay as they are."""
        frozen_mask = self.training.frozen_mask()
        means = self._optimizer.parameters.means
        kept = (
            None
            if frozen_mask is None or frozen_mask.rows is None
            else means.detach()[frozen_mask.rows]
        )
        self.densifier.perturb(self._optimizer.parameters, lr_means, self._generator)
        if frozen_mask is not None and kept is not None:
            means.detach()[frozen_mask.rows] = kept

    def replace_scene(self, scene: GaussianScene) -> None:
        """Go on with ``scene``: the same Gaussians, moved, masked or drawn in another way."""
        self._scene = scene.with_gaussians(self._optimizer.parameters)
        self._scene.changed()

    def keep(self, kept: Tensor, done: int) -> None:
        """Leave only the Gaussians where ``kept`` (N,) is true, after step ``done``."""
        self._apply(EditResult(TopologyEdit.select(kept)))
        self._scene = self.training.after_step(self._scene, done, True)
        self._scene.changed()

    def stop_growing(self) -> None:
        """Leave the set of Gaussians as it is from now on."""
        self.densifier = Densifier()

    def drop_harmonics(self, dropped: Tensor, offsets: Tensor) -> None:
        """Replace the harmonics of the Gaussians ``dropped`` (N,) for good by their base, with
        ``offsets`` (N, 3)."""
        base = self._scene.gaussians.sh.detach()[:, 0] + offsets / SH_C0
        self._optimizer.drop_harmonics(base, dropped)
        self.replace_scene(self._scene)

    def freeze_plain_harmonics(self, plain: Tensor, colour: AutoColour) -> None:
        """Leave the harmonics of the Gaussians ``plain`` (N,) zero from now on."""
        colours = AutoTraining(colour, self._config.train.steps, len(self._run.images))
        colours.freeze(plain)
        self.colours = colours

    def set_render_options(self, model: SceneModel) -> None:
        """Draw with the settings of another section of the same kind from now on."""
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
        restore_colour_network(colour)  # raises where its tensors do not fit together
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
        self.colours.place(device)
        self.densifier.place(device)
        scene: GaussianScene = self._scene.to(device)
        scene = scene.with_gaussians(self._optimizer.parameters)
        self._scene = replace(scene, colour=self.colours.network)

    def _options(self, step: int) -> RenderOptions:
        degree = self._scene.gaussians.sh_degree
        if not isinstance(self._config.init, SceneInit):  # whose harmonics are there already
            degree = active_sh_degree(self._config.train, step, degree)
        return replace(self.options, sh_degree=degree)

    def _apply(self, result: EditResult, edited: GaussianScene | None = None) -> None:
        """Change the set of Gaussians, and everything that is stored per Gaussian with it;
        ``edited``: is already."""
        self._optimizer.apply(result)
        if edited is None:
            edited = self._scene if result.edit is None else self._scene.apply_edit(result.edit)
        self._scene = edited.with_gaussians(self._optimizer.parameters)
        if result.edit is not None:
            self.colours.follow(result.edit)
            self.training.follow(result.edit)

    def _in_memory_order(self, result: EditResult) -> EditResult:
        """Return the same change with neighbours in space next to each other: kernels read rows
        that are in a cache."""
        edit = result.edit
        if edit is None:
            return result
        means = result.changes.get("means", edit.apply(self._optimizer.parameters.means.detach()))
        order = torch.from_numpy(morton_order(means.cpu().numpy())).to(means.device)
        changes = {name: x[order] for name, x in result.changes.items()}
        return replace(result, edit=edit.in_order(order), changes=changes)

    def _measured_harmonics(self, step: int) -> str | None:
        """Drop harmonics that do not pay, if it is time to measure that; return a line about what
        was found."""
        if not self._scene.gaussians.sh_degree:
            return None
        found = self.colours.measure_harmonics(step, lambda: self._looks(step))
        if found is None:
            return None
        self.drop_harmonics(~found.kept_harmonics, found.offsets)
        return str(found)

    def _looks(self, step: int) -> MeasurementViews:
        images = self._run.images
        colour = background_colour(self._run.background).to(self._scene.device)

        def views(indices: Sequence[int]) -> Iterator[MeasuredView]:
            for image in (images[i] for i in indices):
                gaussians = self.training.time_step(self._scene, image, step).gaussians.detach()
                yield MeasuredView(gaussians, image.cameras, image.composite(colour), image.mask)

        may_train = [
            i for i, time in enumerate(images.times) if self.training.trains_on(time, step)
        ]
        return MeasurementViews(may_train, views, self._options(step), colour)

    def _render_options(self, model: SceneModel) -> RenderOptions:
        return render_options(model, self._run.extent, self._run.capture.world_scale)


def training_options(run: StartContext) -> RenderOptions:
    """Return how the training images of a run are drawn."""
    strategy = run.config.strategy
    absgrad = isinstance(strategy, DefaultStrategy) and strategy.absgrad
    options = render_options(run.config.model, run.extent, run.capture.world_scale)
    return replace(options, absgrad=absgrad, nonfinite="trust")
