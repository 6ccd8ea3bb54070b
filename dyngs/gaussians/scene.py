"""Scenes of Gaussians: N Gaussians with their motion and colours.

Each kind of model has one class: ``gaussians.static_scene.StaticScene``,
``deform.scene.DynamicScene`` and ``human.avatar.scene.HumanScene``. It is the same class in
training, after loading and in the viewer. ``gaussians.model`` trains it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from dyngs.config import SceneModel
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.section import ModelSection
from dyngs.core.state import Role, State, add_prefix, with_role
from dyngs.core.tensor_checks import require_times
from dyngs.data.scene_space import TYPICAL_EXTENT
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import ColourNetwork, RestPose, restore_colour_network
from dyngs.gaussians.rendering import GaussianRendering, RenderOptions, Shader, render
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.models.checkpoint import Checkpoint, restore_model
from dyngs.models.renderable import (
    Renderable,
    TimeStep,
    concatenate_renderings,
    near_plane,
    single_views,
)
from dyngs.models.views import background_colour

S = TypeVar("S", bound="GaussianScene")


@dataclass(frozen=True)
class GaussianTimeStep(TimeStep):
    """Gaussians at one time."""

    gaussians: Gaussians
    time: float | None = None
    # pose that the colour network is evaluated in, if it follows a body
    rest_pose: RestPose | None = None
    # Differentiable weighted regularisation terms by name; empty outside training.
    penalties: dict[str, Tensor] = field(default_factory=dict)
    # returns the Gaussians seen from a camera centre (3,), if they depend on it; ``gaussians`` are
    # then those without a camera
    from_eye: Callable[[Tensor], Gaussians] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class GaussianScene(Renderable):
    """N Gaussians at any time.

    Example:

        import dyngs

        scene = dyngs.load("runs/lego")
        gaussians = scene.at(0.5)

    Attributes:
        gaussians: canonical or rest-pose Gaussians; in training, leaf tensors of the optimiser.
        colour: colour network; None: SH coefficients give the colours.
        masks: visibility over time, only with a deformation field; None: all are always visible.
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
    def device(self) -> torch.device:
        return self.gaussians.means.device

    @property
    def bounds(self) -> Tensor:
        """Box (2, 3) of the finite means at the first time; zero if there are none."""
        means = self.means_at(None)
        means = means[means.isfinite().all(1)]
        return torch.stack([means.amin(0), means.amax(0)]) if len(means) else means.new_zeros(2, 3)

    @property
    def rows(self) -> Tensor:
        """Ascending indices (M,) of the Gaussians that move."""
        return torch.zeros(0, dtype=torch.long, device=self.gaussians.means.device)

    @property
    def num_moving(self) -> int:
        return len(self.rows)

    @property
    def moving_fraction(self) -> float:
        return 0.0 if self.is_static else self.num_moving / max(len(self), 1)

    @property
    def offset_rows(self) -> Tensor:
        """Ascending indices (M',) of the Gaussians whose shape or attributes a field changes
        individually."""
        return self.rows[:0]

    @property
    def num_motion_values(self) -> int:
        """Number of stored values that describe motion."""
        return 0

    @property
    def num_colour_values(self) -> int:
        """Number of stored colour values: base colours, non-zero SH coefficients, the network."""
        sh = self.gaussians.sh
        with_rest = int((sh[:, 1:] != 0).flatten(1).any(1).sum())
        network = 0 if self.colour is None else self.colour.num_values
        return 3 * len(sh) + 3 * (sh.shape[1] - 1) * with_rest + network

    @property
    def num_mask_bytes(self) -> int:
        return 0 if self.masks is None else self.masks.bits.numel()

    @abstractmethod
    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the Gaussians at ``time``, clamped to [0, 1]; None is the first time."""

    def drawing_step(self, time: float | None) -> GaussianTimeStep:
        return self.time_step(time)

    def at(self, time: float | None) -> Gaussians:
        """Return the Gaussians of ``time_step`` without gradients."""
        with torch.no_grad():
            return self.time_step(time).gaussians

    def means_at(self, time: float | None) -> Tensor:
        """Return the means (K, 3) of the Gaussians that exist at ``time``; if there are none, of
        all."""
        now = self.at(time)
        exists = now.opacities > 0
        return now.means[exists] if bool(exists.any()) else now.means

    def shader(self, now: GaussianTimeStep) -> Shader | None:
        """Return the shader at a time step; None if SH coefficients give the colours."""
        return None if self.colour is None else self.colour.shader(now.time, now.rest_pose)

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: RenderOptions | None = None,
        background: Tensor | None = None,
        probe: Tensor | None = None,
    ) -> GaussianRendering:
        """Render the scene; differentiable where gradients are enabled.

        Args:
            cameras: V cameras, on any device.
            time: in [0, 1], or a time step of this scene, which avoids computing it again.
            options: render options; None: those of the scene.
            background: (3,) or (V, 3) colour; None: that of the scene.
            probe: (V, N, 4) zeros whose gradient is the densification signal.

        Raises:
            DyngsError: as ``dyngs.gaussians.rendering.render``.
        """
        now = time
        if not isinstance(now, GaussianTimeStep):
            now = self.drawing_step(now.time if isinstance(now, TimeStep) else now)
        behind = self.background if background is None else background
        how = self.options if options is None else options
        device = now.gaussians.means.device
        if cameras.cam_from_world.device != device:
            cameras = cameras.to(device=device)
        if now.from_eye is not None:
            renderings = []
            for i, (camera, own_behind) in enumerate(single_views(cameras, behind)):
                gaussians = now.from_eye(camera.centers[0])
                own = replace(now, gaussians=gaussians, from_eye=None)
                signal = None if probe is None else probe[i : i + 1]
                renderings.append(
                    self.render(camera, own, options=how, background=own_behind, probe=signal)
                )
            return concatenate_renderings(renderings)
        return render(
            now.gaussians, cameras, how, background=behind, probe=probe, shader=self.shader(now)
        )

    @abstractmethod
    def apply_edit(self: S, edit: TopologyEdit) -> S:
        """Return the scene after a topology edit, with all per-Gaussian state."""

    def select(self: S, index: Tensor) -> S:
        """Return the scene with only the Gaussians at ``index`` (long or bool)."""
        return self.apply_edit(TopologyEdit.select(index))

    def part(self, which: Literal["moving", "static"]) -> GaussianScene:
        """Return the scene with only the moving, or only the static Gaussians."""
        moves = torch.zeros(len(self), dtype=torch.bool, device=self.gaussians.means.device)
        if not self.is_static:
            moves[self.rows] = True
        return self.without_masks().select(moves if which == "moving" else ~moves)

    def without_masks(self: S) -> S:
        """Return the scene without visibility masks."""
        return replace(self, masks=None)

    def with_gaussians(self: S, gaussians: Gaussians) -> S:
        """Return the scene with new values, or new leaf tensors, of the same Gaussians."""
        return replace(self, gaussians=gaussians)

    def on_background(self: S, colour: Tensor) -> S:
        return replace(self, background=colour)

    def clear_caches(self) -> None:
        """Clear caches after tensors were changed in place."""
        self._derived.clear()

    def state(self) -> State:
        return add_prefix(
            "gaussians", with_role(self.gaussians.detach().tensors(), Role.PER_GAUSSIAN)
        ) | add_prefix(
            "model",
            self._model_state()
            | ({} if self.colour is None else add_prefix("colour", self.colour.state())),
        )

    @abstractmethod
    def _model_state(self) -> State:
        """Return the state of this kind of scene, except Gaussians and colours."""


def require_gaussians(scene: Renderable, what: str) -> GaussianScene:
    """Return ``scene`` if it is made of Gaussians; raise DyngsError otherwise."""
    if not isinstance(scene, GaussianScene):
        raise DyngsError(
            f"{what}: this needs a scene of Gaussians; other scenes can be evaluated, rendered and viewed"
        )
    return scene


def restore_scene(checkpoint: Checkpoint, model: ModelSection) -> GaussianScene:
    """Return the scene in a checkpoint of ``model``; see ``restore_model``."""
    return require_gaussians(restore_model(checkpoint, model), checkpoint.name)


def restore_appearance(scene: S, model: SceneModel, checkpoint: Checkpoint) -> S:
    """Add the colours, render options and background of the checkpoint to a restored scene."""
    info = checkpoint.info
    colour = restore_colour_network(checkpoint.part("model.colour"))
    options = render_options(model, info.extent, info.world_scale)
    return replace(
        scene, colour=colour, options=options, background=background_colour(info.background)
    )


def render_options(
    model: SceneModel, extent: float = TYPICAL_EXTENT, world_scale: float = 1.0
) -> RenderOptions:
    """Return how a model is drawn.

    Args:
        extent: of the scene, scene units.
        world_scale: as ``Capture.world_scale``.
    """
    return RenderOptions(
        near=near_plane(extent) if model.near == "auto" else model.near / world_scale,
        eps2d=model.eps2d,
        mode=model.rasterize_mode,
        alpha_min=model.alpha_min,
        transmittance_min=model.transmittance_min,
    )


def times_state(times: tuple[float, ...]) -> State:
    """Return the state of the training times, empty without any."""
    return with_role(
        {"times": torch.tensor(times, dtype=torch.float64, device="cpu")} if times else {},
        Role.SHARED,
    )


def restore_times(tensors: Mapping[str, Tensor]) -> tuple[float, ...]:
    """Return the training times of a state. Raises ValueError for times that do not ascend within
    [0, 1]."""
    return tuple(require_times("times", tensors["times"]).tolist()) if "times" in tensors else ()
