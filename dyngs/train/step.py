"""One training step. It knows parameters per Gaussian and pictures, not what kind of model lies between them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from dyngs.colour.colours import Colours
from dyngs.colour.thrift import Look, ThriftyColours, find_thrift
from dyngs.config import Config, HumanModel, SceneModel
from dyngs.conventions import SH_C0
from dyngs.data.loader import Picture, PictureLoader
from dyngs.errors import DyngsError, reading
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.ops.loss import l1_ssim_loss
from dyngs.rendering import RenderOptions, render
from dyngs.runs.checkpoint import OTHER_CONFIG, Checkpoint, CheckpointInfo, stored_scene
from dyngs.static.densify import Densifier, EditResult
from dyngs.static.fixed import FixedDensifier
from dyngs.static.model import Drawn
from dyngs.static.optimizer import GaussianOptimizer
from dyngs.tensor_checks import require_tensor
from dyngs.train.background import background_colour
from dyngs.train.sampler import ViewSampler
from dyngs.train.schedule import active_sh_degree, means_rate, picture_divisor, rates_of


class Model(Protocol):
    """What turns the parameters stored per Gaussian into the Gaussians of a picture."""

    def trains_on(self, time: float | None, step: int) -> bool:
        """Whether a picture of ``time`` may be trained on in ``step``; at each step some may."""
        ...

    def gaussians_at(self, parameters: Gaussians, batch: Picture, step: int) -> Drawn:
        """What is drawn for ``batch`` in ``step``; differentiable in ``parameters`` and in what the model learns."""
        ...

    def after_step(self, parameters: Gaussians, step: int, result: EditResult | None) -> int:
        """Optimize what is the model's own and follow ``result``, the change of the set of Gaussians if there was one.

        Returns:
            the number of rows left out because their gradient was not finite.
        """
        ...

    def edit(self, parameters: Gaussians, step: int) -> EditResult | None:
        """A change of the set of Gaussians that the model wants after ``step``; it has followed it already."""
        ...

    def num_moving(self, num_gaussians: int) -> int:
        """How many of the Gaussians depend on time."""
        ...

    def state(self) -> dict[str, Tensor]: ...

    def load_state(self, state: dict[str, Tensor]) -> None: ...


@dataclass(frozen=True)
class StepReport:
    """What one step did.

    Attributes:
        step: its number, from 1.
        loss: regularizers included.
        picture: what was trained on.
        rendered, truth: (H, W, 3) on the same background.
        finding: a line about what was found out after the step, or None.
    """

    step: int
    loss: float
    picture: Picture
    rendered: Tensor
    truth: Tensor
    finding: str | None = None


@dataclass
class Trainer:
    """A run in memory: everything that a step reads and changes.

    Attributes:
        background: "white", "black" or "random" (a new colour in each step, behind render and truth alike).
        generator: the only source of randomness, on the CPU.
        done: steps done.
        bad_gradients: how often a Gaussian was left out of a step because its gradient was not finite.
    """

    config: Config
    model: Model
    optimizer: GaussianOptimizer
    densifier: Densifier
    colours: Colours
    pictures: PictureLoader
    sampler: ViewSampler
    options: RenderOptions
    background: str
    extent: float
    world_offset: tuple[float, float, float]
    has_test_views: bool
    generator: torch.Generator
    done: int = 0
    bad_gradients: int = 0

    def step(self) -> StepReport:
        """Train on one picture.

        Raises:
            DyngsError: the loss is not finite; says which term, and leaves the parameters as they were.
        """
        config, step = self.config, self.done + 1
        divisor = picture_divisor(config.train, step)
        index = self.sampler.next(self.generator, self._wanted(step))
        picture = self.pictures[index].shrunk(divisor)
        background = background_colour(self.background, self.generator)
        parameters = self.optimizer.parameters
        drawn = self.model.gaussians_at(parameters, picture, step)
        probe = torch.zeros(1, len(parameters), 4, requires_grad=True) if self.densifier.wants_signal(step) else None
        if self.model.num_moving(len(parameters)):
            _require_finite(drawn.gaussians, step, picture, config.model)
        options = replace(self.options, sh_degree=active_sh_degree(config.train, step, parameters.sh_degree))
        shader = self.colours.shader(picture.time, drawn.frame)
        rendering = render(drawn.gaussians, picture.cameras, options, background=background, probe=probe, shader=shader)
        rendered, truth = rendering.rgb[0], picture.composite(background)
        terms = {"picture": l1_ssim_loss(rendered, truth, config.train.ssim_weight, picture.mask)}
        if config.train.alpha_weight > 0 and picture.alpha is not None:
            terms["alpha"] = config.train.alpha_weight * (rendering.alpha[0] - picture.alpha).abs().mean()
        terms |= drawn.penalties | self.densifier.regularizers(parameters) | self.colours.penalties(parameters)
        loss = _finite_sum(terms, step, picture)
        sum(terms.values(), torch.zeros(())).backward()
        if probe is not None and probe.grad is not None:
            size = (picture.cameras.width, picture.cameras.height)
            # Fewer Gaussians suit small pictures: a gradient counts for less there.
            self.densifier.after_backward(step, probe.grad / divisor, rendering.radii, size)
        finding = self._update(step)
        return StepReport(step, loss, picture, rendered.detach(), truth, finding)

    def _update(self, step: int) -> str | None:
        """Optimize, let the strategy act, and count the step; a line about what was found, or None."""
        lr_means = means_rate(self.config.optim, rates_of(self.config).progress(step), self.extent)
        frozen, dense = self.colours.frozen_rest(), self.densifier.touches_all
        self.bad_gradients += self.optimizer.step(step, lr_means, dense=dense, frozen_rest=frozen)
        self.bad_gradients += self.colours.after_step(step)
        result = self.densifier.edit(step, self.optimizer.parameters, self.generator)
        if result is not None:
            self._apply(result)
        self.densifier.perturb(self.optimizer.parameters, lr_means, self.generator)
        self.bad_gradients += self.model.after_step(self.optimizer.parameters, step, result)
        result = self.model.edit(self.optimizer.parameters, step)
        if result is not None:
            self._apply(result)
        self.done = step
        return self._spare_harmonics(step)

    def _apply(self, result: EditResult) -> None:
        self.optimizer.apply(result)
        if result.edit is not None:
            self.colours.follow(result.edit)

    def _spare_harmonics(self, step: int) -> str | None:
        """Measure whose harmonics pay if it is time to, drop the others, and say what was found."""
        colours, parameters = self.colours, self.optimizer.parameters.detach()
        if not isinstance(colours, ThriftyColours) or not colours.measures_after(step) or not parameters.sh_degree:
            return None
        colour = background_colour(self.background)

        def looks(views: Iterable[int]) -> Iterator[Look]:
            for picture in (self.pictures[i] for i in views):
                drawn = self.model.gaussians_at(parameters, picture, step).gaussians.detach()
                yield Look(drawn, picture.cameras, picture.composite(colour), picture.mask)

        may_train = [i for i, time in enumerate(self.pictures.times) if self.model.trains_on(time, step)]
        seen = [i for i in may_train if i not in colours.held_out]
        held_out = [i for i in may_train if i in colours.held_out]
        if not seen or not held_out:
            return "too few views are trained on as yet to measure where view dependence pays: all harmonics stay"
        options = replace(self.options, sh_degree=active_sh_degree(self.config.train, step, parameters.sh_degree))
        found = find_thrift(looks(seen), list(looks(held_out)), options, colour, colours.tolerance)
        self.optimizer.drop_rest(parameters.sh[:, 0] + found.offsets / SH_C0, ~found.keeps)
        colours.freeze(~found.keeps)
        return str(found)

    def _wanted(self, step: int) -> Callable[[int], bool]:
        """Which views may be trained on in ``step``."""
        times = self.pictures.times

        def may_train(index: int) -> bool:
            return self.model.trains_on(times[index], step)

        def is_wanted(index: int) -> bool:
            return may_train(index) and not self.colours.holds_out(index, step)

        return is_wanted if any(is_wanted(i) for i in range(len(self.pictures))) else may_train

    def keep(self, kept: Tensor) -> None:
        """Leave only the Gaussians where ``kept`` (N,) is true."""
        result = EditResult(TopologyEdit.keep(kept))
        self._apply(result)
        self.model.after_step(self.optimizer.parameters, self.done, result)

    def checkpoint(self) -> Checkpoint:
        """Everything that ``restore`` needs."""
        parts = {
            "model": self.model.state(),
            "model.colour": self.colours.state(),
            "strategy": self.densifier.state(),
            "sampler": self.sampler.state(),
        }
        tensors = {f"{part}.{name}": x for part, state in parts.items() for name, x in state.items()}
        tensors |= self.optimizer.state() | {"rng": self.generator.get_state()}
        mode = self.config.model.rasterize_mode.value
        return Checkpoint(CheckpointInfo(self.done, self.extent, self.world_offset, self.background, mode), tensors)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to where ``checkpoint`` was taken.

        Raises:
            DyngsError: it belongs to another model or strategy, or its tensors do not fit together.
        """
        stored_scene(checkpoint, self.config.model)  # what is drawn fits together
        with reading(checkpoint.name, OTHER_CONFIG):
            try:
                self.optimizer.load_state(checkpoint.tensors)
                self.model.load_state(checkpoint.part("model"))
                self.colours.load_state(checkpoint.part("model.colour"))
                _require_frozen(checkpoint.tensors, len(self.optimizer.parameters))
                if checkpoint.info.step >= self.config.train.steps:
                    self.densifier = FixedDensifier()
                self.densifier.load_state(checkpoint.part("strategy"))
                self.sampler.load_state(checkpoint.part("sampler"))
                self.generator.set_state(checkpoint.tensors["rng"])
            except KeyError as missing:
                raise DyngsError(f"{checkpoint.name} lacks {missing}; {OTHER_CONFIG}") from None
        self.done = checkpoint.info.step


def _require_frozen(tensors: Mapping[str, Tensor], count: int) -> None:
    """Raises ValueError where the harmonics that stay zero are not those of so many Gaussians."""
    if "model.colour.frozen" in tensors:
        require_tensor("frozen", tensors["model.colour.frozen"], (count,), torch.bool)


def _finite_sum(terms: dict[str, Tensor], step: int, picture: Picture) -> float:
    values = {name: float(term.detach()) for name, term in terms.items()}
    for name, value in values.items():
        if not math.isfinite(value):
            what = "look at that picture; lower the rates in optim" if name == "picture" else "lower its weight or rate"
            raise DyngsError(f"step {step}, view {picture.name!r}: the loss term {name!r} is {value}; {what}")
    return sum(values.values())


def _require_finite(gaussians: Gaussians, step: int, picture: Picture, model: SceneModel) -> None:
    """A field may explode unseen, because Gaussians that are not finite are not drawn."""
    broken = [name for name, x in gaussians.tensors().items() if not bool(x.detach().isfinite().all())]
    if broken:
        what, rates = ("pose", "model") if isinstance(model, HumanModel) else ("field", "model.deform")
        raise DyngsError(
            f"step {step}, view {picture.name!r}: the {what} makes {', '.join(broken)} at {picture.time or 0:g} not "
            f"finite; lower the rates in {rates}"
        )
