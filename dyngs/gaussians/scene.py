"""Scenes that can be trained and drawn: N Gaussians with their motion and colours.

There is one class per kind of model: ``static.scene.StaticScene``, ``deform.scene.DynamicScene`` and
``human.avatar.scene.HumanScene``. In training, loaded from a file or watched half-way it is the same class. How a kind
of scene is trained is the business of a ``SceneTraining``.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeVar

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import SceneModel
from dyngs.data.loader import Image
from dyngs.errors import DyngsError
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import ColourNetwork, Frame
from dyngs.gaussians.parameters import Parameters
from dyngs.gaussians.rendering import Rendering, RenderOptions, Shader, render
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.ops.adam import Count
from dyngs.state import Role, State, fields_moved_to, prefixed, with_role

S = TypeVar("S", bound="Scene")


@dataclass(frozen=True)
class Moment:
    """A scene at one time.

    Attributes:
        gaussians: as they are drawn; differentiable where gradients are enabled.
        time: in [0, 1], for colours that depend on it.
        frame: where the Gaussians are at rest, if colours follow a body.
        penalties: differentiable regularizers, weighted, by name; empty outside training.
    """

    gaussians: Gaussians
    time: float | None = None
    frame: Frame | None = None
    penalties: dict[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Scene(ABC):
    """N Gaussians at any time.

    Attributes:
        gaussians: as stored: canonical, or at rest. In training they are the optimizer's leaf tensors.
        colour: network that colours them; None: their harmonics do.
        options: how they are drawn unless ``render`` is told otherwise.
        background: (3,) colour behind them unless ``render`` is told otherwise; None is black.
        masks: which Gaussians are seen around a time; None: all may be, at all times. Only where a field moves some.
    """

    gaussians: Gaussians
    colour: ColourNetwork | None = None
    options: RenderOptions = field(default_factory=RenderOptions)
    background: Tensor | None = None
    masks: VisibilityMasks | None = None
    _derived: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    @abstractmethod
    def times(self) -> tuple[float, ...]:
        """Distinct times of training, or of the motion that is played, in [0, 1], ascending; empty without times."""

    @property
    @abstractmethod
    def is_static(self) -> bool:
        """Return whether ``at`` returns the same at every time."""

    @property
    @abstractmethod
    def rows(self) -> Tensor:
        """(M,) ascending indices of the Gaussians that move."""

    @property
    def num_moving(self) -> int:
        """M."""
        return len(self.rows)

    @property
    def moving_fraction(self) -> float:
        """M / N, 0 where nothing moves."""
        return 0.0 if self.is_static else self.num_moving / max(len(self), 1)

    @property
    def offset_rows(self) -> Tensor:
        """(M',) ascending indices of the Gaussians whose axes or attributes a field changes one by one."""
        return torch.zeros(0, dtype=torch.long, device=self.gaussians.means.device)

    @property
    def num_motion_values(self) -> int:
        """Number of values stored for motion, beside the Gaussians and their colours."""
        return 0

    @property
    def num_colour_values(self) -> int:
        """Number of values stored for colours: base, network, and the rest of Gaussians where it is not all zero."""
        sh = self.gaussians.sh
        with_rest = int((sh[:, 1:] != 0).flatten(1).any(1).sum())
        network = 0 if self.colour is None else self.colour.num_values
        return 3 * len(sh) + 3 * (sh.shape[1] - 1) * with_rest + network

    @property
    def num_mask_bytes(self) -> int:
        """Number of bytes of the masks; 0 without any."""
        return 0 if self.masks is None else self.masks.bits.numel()

    @abstractmethod
    def moment(self, time: float | None) -> Moment:
        """Return the scene at ``time``, clamped to [0, 1]; None is the first moment.

        Raises:
            DyngsError: the time is NaN.
        """

    def at(self, time: float | None) -> Gaussians:
        """Return the Gaussians at ``time``, as ``moment`` has them, without gradients."""
        with torch.no_grad():
            return self.moment(time).gaussians

    def shader(self, moment: Moment) -> Shader | None:
        """Return the shader of the Gaussians of ``moment``; None where harmonics give the colours."""
        return None if self.colour is None else self.colour.shader(moment.time, moment.frame)

    def render(
        self,
        cameras: Cameras,
        time: float | Moment | None = None,
        *,
        options: RenderOptions | None = None,
        background: Tensor | None = None,
        probe: Tensor | None = None,
    ) -> Rendering:
        """Return images of the scene; differentiable where gradients are enabled.

        Args:
            cameras: V cameras, on any device.
            time: in [0, 1], or the moment itself, so that it is not computed again.
            options: how to draw; None: as the scene wants to be drawn.
            background: (3,) or (V, 3) colour; None: that of the scene.
            probe: (V, N, 4) zeros whose gradient is the densification signal.

        Raises:
            DyngsError: as ``dyngs.gaussians.rendering.render``.
        """
        moment = time if isinstance(time, Moment) else self.moment(time)
        behind = self.background if background is None else background
        how, device = self.options if options is None else options, moment.gaussians.means.device
        if cameras.cam_from_world.device != device:
            cameras = cameras.to(device=device)
        return render(moment.gaussians, cameras, how, background=behind, probe=probe, shader=self.shader(moment))

    @abstractmethod
    def edited(self: S, edit: TopologyEdit) -> S:
        """Return the scene after a change of the set of Gaussians; everything stored per Gaussian follows it."""

    def select(self: S, index: Tensor) -> S:
        """Return the scene with only the Gaussians at ``index`` (long or bool)."""
        return self.edited(TopologyEdit.select(index))

    def part(self, which: Literal["moving", "still"]) -> Scene:
        """Return only the Gaussians that move, or only those that do not."""
        moves = torch.zeros(len(self), dtype=torch.bool, device=self.gaussians.means.device)
        if not self.is_static:
            moves[self.rows] = True
        return self.unmasked().select(moves if which == "moving" else ~moves)

    def unmasked(self: S) -> S:
        """Return the scene with all Gaussians drawn at all times."""
        return replace(self, masks=None)

    def with_gaussians(self: S, gaussians: Gaussians) -> S:
        """Return the scene with other values, or other leaf tensors, for the same Gaussians."""
        return replace(self, gaussians=gaussians)

    def changed(self) -> None:
        """Drop caches derived from tensors that have been changed in place."""
        self._derived.clear()

    def state(self) -> State:
        """Return everything that is stored, by name, with its role."""
        return prefixed("gaussians", with_role(self.gaussians.detach().tensors(), Role.PER_GAUSSIAN)) | prefixed(
            "model", self._model_state() | ({} if self.colour is None else prefixed("colour", self.colour.state()))
        )

    def drawing_state(self) -> State:
        """Return the part of ``state`` that drawing needs, in an equivalent form where that is smaller."""
        return {name: x for name, x in self.state().items() if x.role is not Role.TRAINING}

    def to(self: S, device: torch.device | str) -> S:
        """Return the scene with its tensors on ``device``."""
        return fields_moved_to(self, device)

    @abstractmethod
    def _model_state(self) -> State:
        """Return the state of this kind of scene beside its Gaussians and colours."""


def clamped_time(time: float | None) -> float:
    """Return ``time`` within [0, 1]; None is 0. Raises DyngsError for NaN."""
    if time is not None and math.isnan(time):
        raise DyngsError("the time to draw is not a number; give one from 0 to 1")
    return min(max(0.0 if time is None else time, 0.0), 1.0)


def render_options(model: SceneModel) -> RenderOptions:
    """Return how a model wants to be drawn."""
    return RenderOptions(
        near=model.near,
        eps2d=model.eps2d,
        mode=model.rasterize_mode,
        alpha_min=model.alpha_min,
        transmittance_min=model.transmittance_min,
    )


class SceneTraining(Protocol[S]):
    """Training of a kind of scene: its images, what it learns beside the Gaussians, and when motion is frozen."""

    @property
    def moves_by(self) -> tuple[str, str]:
        """Name of what moves the Gaussians and the configuration section of its learning rates, for messages."""
        ...

    def trains_on(self, time: float | None, step: int) -> bool:
        """Return whether an image of ``time`` may be trained on in ``step``; at each step some may."""
        ...

    def moment(self, scene: S, image: Image, step: int) -> Moment:
        """Return the moment drawn for ``image`` in ``step``, with the penalties."""
        ...

    def optimize(self, scene: S, step: int) -> Count:
        """Update, in place, what the scene learns beside its Gaussians and colours.

        Returns:
            the number of rows left out because their gradient was not finite.
        """
        ...

    def learned(self, scene: S) -> Parameters | None:
        """Return what the scene learns beside its Gaussians and colours; None: nothing."""
        ...

    def after_step(self, scene: S, step: int, edited: bool) -> S:
        """Return the scene for the next step: filters brought up to date, motion extended, static Gaussians frozen.

        Args:
            scene: after the optimizers and the strategy.
            step: that was done.
            edited: the set of Gaussians has just changed.
        """
        ...

    def revised(self, scene: S, step: int) -> tuple[S, EditResult] | None:
        """Return the scene as its kind changes it after ``step``, and the edit of its Gaussians; None: it does not."""
        ...

    def window(self, step: int) -> tuple[float, float]:
        """Return the first and last time that are trained on at ``step``."""
        ...

    def extend(self, scene: S, seen: tuple[float, float], step: int) -> None:
        """Continue motion learned for the times in ``seen`` to those that are trained on at ``step``."""
        ...

    def all_moving(self, scene: S, extent: float) -> S:
        """Return ``scene`` as expensive to draw as it may become: all Gaussians move, by an untrained field if need be.

        Args:
            scene: N Gaussians.
            extent: of the scene, world units.
        """
        ...

    def follow(self, edit: TopologyEdit) -> None:
        """Let what the training itself keeps per Gaussian follow a change of the set."""
        ...

    def restored(self, gaussians: Gaussians, tensors: Mapping[str, Tensor], like: Scene) -> S:
        """Return the scene of a checkpoint, with colours and options of ``like``, and take over the training's state.

        Raises:
            KeyError: a tensor is missing.
            ValueError: the tensors do not fit together.
        """
        ...

    def state(self) -> State:
        """Return the tensors that a checkpoint must hold beside the scene."""
        ...
