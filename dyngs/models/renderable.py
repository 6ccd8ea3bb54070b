"""Scenes that can be rendered: their interface, renderings, and surfaces as flat triangles."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence, Sized
from copy import copy
from dataclasses import dataclass, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from dyngs.config import Config
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, format_count
from dyngs.core.state import Role, State, move_fields_to
from dyngs.data.capture import Capture, Split
from dyngs.io.write import to_uint8
from dyngs.ops.registration import check_choice, check_finite, check_number


@dataclass(frozen=True)
class Surface:
    """Triangles with colours, in the world of the scene."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3) int; anticlockwise from outside where there is an outside
    colours: np.ndarray  # (V, 3) in [0, 1], seen from straight ahead


@dataclass(frozen=True)
class SurfaceOptions:
    """How a surface is made from a scene; None: as usual.

    Attributes:
        level: density at the surface of a field, per unit of a world whose innermost cube has half
            side 1.5.
        cells: along the longest side of the space that a field or Gaussians are looked at in.
    """

    level: float | None = None
    cells: int | None = None


R = TypeVar("R", bound="Renderable")
T = TypeVar("T")
P = TypeVar("P", bound="Posable")
Images = TypeVar("Images", bound="Rendering")


NEAR_FRACTION = 0.01
"""Distance of the near plane, in extents of the scene, as in gsplat; 3DGS has 0.2 units, 0.04
extents of its scenes. Long walks show things at 0.02 extents. Held-out PSNR does not tell 0.01 from
0.04 (cup 29.6 and 29.1 dB, fox 32.2 and 32.0, lego 32.6 and 32.6; two seeds of the cup differ by
0.5)."""


def near_plane(extent: float) -> float:
    """Return the distance of the near plane of a scene of this extent, in the same unit."""
    return NEAR_FRACTION * extent


# Smallest and largest allowed, px; beyond them gradients leave the range of float32
FOCAL_LENGTHS = (1e-6, 1e12)
_TINY = 1e-9
ROTATION_TOLERANCE = 0.01
"""Largest entry of ``R^T R - I`` of a pose that is drawn; half precision rounds by a tenth of
that."""


@dataclass(frozen=True)
class DrawOptions:
    """How any scene is drawn. Raises DyngsError: a number beyond its range, or a choice that does
    not exist."""

    # what is nearer to the camera is not drawn, in the unit of the scene (3DGS: 0.2)
    near: float = 0.2
    # none, accumulated (sum of weight times depth) or expected (that, divided by the sum of
    # weights: alpha)
    depth: Literal["none", "accumulated", "expected"] = "none"

    def __post_init__(self) -> None:
        check_number("near", self.near, 0)
        check_choice("depth", self.depth, ("none", "accumulated", "expected"))


@dataclass(frozen=True)
class Rendering:
    """V rendered images.

    Example:

        import torch

        import dyngs

        scene = dyngs.load("runs/lego")
        cameras = dyngs.Cameras(
            torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]]),
            torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]]), 64, 48
        )
        rendering = scene.render(cameras)
        rendering.rgb.shape, rendering.alpha.shape  # (1, 48, 64, 3), (1, 48, 64)

    Attributes:
        rgb: (V, H, W, 3), background composited; not clamped above 1.
        transmittance: (V, H, W) in [0, 1], the fraction of the background that is seen.
        depth: (V, H, W) view-space z in world units, or None; 0 where nothing is drawn.
    """

    rgb: Tensor
    transmittance: Tensor
    depth: Tensor | None

    def __repr__(self) -> str:
        count, height, width = self.transmittance.shape
        depth = "" if self.depth is None else ", with depth"
        size = f"{format_count(count, 'image')} of {width}x{height} px"
        return f"{type(self).__name__}({size}{depth}, {self.rgb.device})"

    def _repr_png_(self) -> bytes:
        """Return the first four images side by side as PNG, for notebooks."""
        from PIL import Image

        strip = torch.cat(list(self.rgb[:4].detach()), 1).float().cpu().numpy()
        stream = BytesIO()
        Image.fromarray(to_uint8(strip)).save(stream, "PNG")
        return stream.getvalue()

    @property
    def alpha(self) -> Tensor:
        """Return (V, H, W) opacities of the images, in [0, 1]."""
        return 1 - self.transmittance

    def to(
        self: T, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> T:
        """Return the same images on another device or in another precision; integers stay
        integers."""
        return move_fields_to(self, device, dtype)


def concatenate_renderings(found: Sequence[Images]) -> Images:
    """Return the images of renderings of the same size, of any number of views each, as one
    rendering."""
    first = found[0]
    parts = {f.name: [getattr(x, f.name) for x in found] for f in fields(first)}
    return replace(
        first, **{name: None if x[0] is None else torch.cat(x) for name, x in parts.items()}
    )


@dataclass(frozen=True)
class RunInfo:
    """The run folder or file that a scene was loaded from.

    Attributes:
        path: the folder or file.
        config: as saved with the run.
        step: of the checkpoint.
    """

    path: Path
    config: Config
    step: int


def run_path(run: Path | str | Renderable) -> Path:
    """Return the folder or file of a scene. Raises DyngsError: it was changed since it was read."""
    if not isinstance(run, Renderable):
        return Path(run)
    if run.run is None:
        raise DyngsError(
            "this scene was changed or made in memory; give a run folder, or use dyngs.save"
        )
    return run.run.path


class TimeStep:
    """A scene at one time, computed once for several images."""

    def __init__(self, time: float | None = None) -> None:
        self.time = time


class Renderable(ABC):
    """Interface of scenes for evaluation, rendering, viewer and videos.

    Attributes:
        options: ``DrawOptions``, or more than that: how it is drawn unless ``render`` is told
            otherwise.
        background: (3,) colour behind it unless ``render`` is told otherwise; None is black.
        surface_options: which ``SurfaceOptions`` have an effect.
        has_levels: it can be drawn in levels of detail.
        run: where ``dyngs.load`` found it; None: nowhere, or it was changed since.
    """

    surface_options: ClassVar[frozenset[str]] = frozenset({"cells"})
    has_levels: ClassVar[bool] = False
    options: Any
    background: Tensor | None
    run: ClassVar[RunInfo | None] = None

    def __repr__(self) -> str:
        count = f"{len(self):,} Gaussians, " if isinstance(self, Sized) else ""
        moves = "static" if self.is_static else "moving"
        path = "" if self.run is None else f", {self.run.path}"
        return f"{type(self).__name__}({count}{moves}, {self.device}{path})"

    @property
    @abstractmethod
    def times(self) -> tuple[float, ...]:
        """Distinct times of training, or of the motion that is played, in [0, 1], ascending; empty
        without times."""

    @property
    def is_static(self) -> bool:
        """Return whether it looks the same at every time."""
        return not self.times

    @property
    @abstractmethod
    def bounds(self) -> Tensor:
        """(2, 3) lowest and highest corner of what is to be seen, world units."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device that draws it."""

    @abstractmethod
    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: Any = None,
        background: Tensor | None = None,
    ) -> Rendering:
        """Return images; differentiable where gradients are enabled.

        Args:
            cameras: V cameras, on any device.
            time: in [0, 1], or what ``time_step`` returned; None is the first.

        Raises:
            DyngsError: as ``check_views``; or gradients by cameras, of a scene that is not made of
                Gaussians.
        """

    def time_step(self, time: float | None) -> TimeStep:
        """Return what drawing at ``time`` needs, clamped to [0, 1]; None is the first."""
        return TimeStep(clamp_time(time))

    def drawing_step(self, time: float | None) -> TimeStep:
        """Return ``time_step``, or an equivalent one without what is invisible at ``time``."""
        return self.time_step(time)

    @abstractmethod
    def state(self) -> State:
        """Return everything that is stored, by name, with its role."""

    def drawing_state(self) -> State:
        """Return the part of ``state`` that drawing needs, in an equivalent form where that is
        smaller."""
        return {name: x for name, x in self.state().items() if x.role is not Role.TRAINING}

    def own_surface(self, time: float, options: SurfaceOptions) -> Surface | None:
        """Return the surface that the scene itself states; None: it is fused from what cameras
        see."""
        return None

    def page_data(self) -> tuple[dict[str, Any], dict[str, tuple[Tensor, Literal[8, 16]]]] | None:
        """Return the page data of a scene without Gaussians: its header, and rows (R, D) by name
        with the bits of each number; None: it has no page."""
        return None

    def on_background(self: R, colour: Tensor) -> R:
        """Return the scene on a background (3,), with separate caches."""
        other = copy(self)
        object.__setattr__(other, "background", colour)  # scenes may be frozen
        return other

    def from_run(self: R, run: RunInfo) -> R:
        """Return the scene with the run that it was loaded from."""
        other = copy(self)
        object.__setattr__(other, "run", run)  # ``replace`` drops it, as a changed scene must
        return other

    def to(self: R, device: torch.device | str) -> R:
        """Return it with its tensors on ``device``."""
        return move_fields_to(self, device)


def single_views(
    cameras: Cameras, background: Tensor | None
) -> list[tuple[Cameras, Tensor | None]]:
    """Return each camera with its own background. Raises DyngsError: as ``check_views``."""
    check_views(cameras, background)
    each = (
        [background] * len(cameras)
        if background is None or background.ndim == 1
        else list(background)
    )
    return [(cameras.select(i), behind) for i, behind in enumerate(each)]


def check_views(cameras: Cameras, background: Tensor | None) -> None:
    """Validate the cameras and the background of a render call.

    Raises DyngsError: no cameras, poses that are not rigid, focal lengths that are not positive,
    NaN or infinity, or a background of another shape than (3,) or (V, 3).
    """
    if not len(cameras):
        raise DyngsError("cameras: there is none to render from; give at least one")
    check_background(background, len(cameras))
    check_poses(cameras.cam_from_world)
    few = {"intrinsics": cameras.intrinsics.detach().cpu()}
    if background is not None:
        few["background"] = background.detach().cpu().to(few["intrinsics"].dtype)
    check_finite(few)
    check_focal_lengths(few["intrinsics"])


def fixed_cameras(cameras: Cameras, background: Tensor | None, like: Tensor) -> Cameras:
    """Return the cameras of a scene without gradients by them, on the device and in the dtype of
    ``like``.

    Raises DyngsError: as ``check_views``; or the poses or intrinsics require gradients.
    """
    cameras = cameras.to(device=like.device, dtype=like.dtype)
    check_views(cameras, background)
    if torch.is_grad_enabled() and (
        cameras.cam_from_world.requires_grad or cameras.intrinsics.requires_grad
    ):
        raise DyngsError(
            "cameras: only scenes of Gaussians have gradients by poses and intrinsics; detach these"
        )
    return cameras


def composite_background(
    rgb: Tensor,
    transmittance: Tensor,
    depth: Tensor | None,
    options: DrawOptions,
    background: Tensor | None,
) -> Rendering:
    """Return images (V, H, W, 3) before a background, of colours before black and the sums of
    weight times depth."""
    if background is not None:
        rgb = rgb + transmittance[..., None] * background.to(rgb).view(-1, 1, 1, 3)
    if depth is not None and options.depth == "expected":
        depth = depth / (1 - transmittance).clamp_min(_TINY)
    return Rendering(rgb, transmittance, None if options.depth == "none" else depth)


class RayScene(Renderable):
    """Scene that is rendered one camera at a time, without gradients by cameras."""

    @property
    @abstractmethod
    def example(self) -> Tensor:
        """Any tensor of the scene; cameras are moved to its device and dtype."""

    @property
    def device(self) -> torch.device:
        return self.example.device

    @abstractmethod
    def render_camera(
        self, camera: Cameras, time: float, options: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return colours on black (H, W, 3), transmittance (H, W) and the sum of weight times depth
        (H, W) of one camera."""

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: Any = None,
        background: Tensor | None = None,
    ) -> Rendering:
        options = self.options if options is None else options
        behind = self.background if background is None else background
        now = time if isinstance(time, TimeStep) else self.time_step(time)
        cameras = fixed_cameras(cameras, behind, self.example)
        views = [self.render_camera(camera, now.time or 0.0, options) for camera in cameras]
        rgb, through, depth = (torch.stack(x) for x in zip(*views, strict=True))
        return composite_background(rgb, through, depth, options, behind)


def check_background(background: Tensor | None, views: int) -> None:
    """Check the shape of a background: (3,) or (V, 3)."""
    if background is not None and tuple(background.shape) not in ((3,), (views, 3)):
        raise DyngsError(f"background must be (3,) or ({views}, 3), got {tuple(background.shape)}")


def check_focal_lengths(intrinsics: Tensor, name: str = "intrinsics") -> None:
    """Raise an error unless fx and fy of all matrices (V, 3, 3) lie within ``FOCAL_LENGTHS``."""
    focal, (shortest, longest) = _numbers(intrinsics)[:, (0, 1), (0, 1)], FOCAL_LENGTHS
    bad = np.flatnonzero(~((focal >= shortest) & (focal <= longest)).all(1))
    if len(bad):
        fx, fy = focal[bad[0]]
        wanted = f"{name}: focal lengths must be positive, from {shortest:g} to {longest:g} px"
        raise DyngsError(f"{wanted}, but camera {bad[0]} has {fx:g} and {fy:g}")


def check_poses(cam_from_world: Tensor, name: str = "cam_from_world") -> None:
    """Raise an error unless all poses (V, 4, 4) are finite and rigid, within
    ``ROTATION_TOLERANCE``."""
    poses: NDArray[np.float64] = _numbers(cam_from_world).astype(np.float64)
    rotations = poses[:, :3, :3]
    with np.errstate(all="ignore"):  # NaN and infinity are what is looked for
        error: NDArray[np.float64] = np.abs(
            np.swapaxes(rotations, 1, 2) @ rotations - np.eye(3)
        ).max((1, 2))
        is_mirrored = np.linalg.det(rotations) < 0
    bad = np.flatnonzero(
        ~((error <= ROTATION_TOLERANCE) & ~is_mirrored & np.isfinite(poses).all((1, 2)))
    )
    if not len(bad):
        return
    check_finite({name: cam_from_world})
    row = bad[0]
    fault = (
        "is mirrored"
        if is_mirrored[row]
        else f"differs from a rotation by {error[row]:.2g} (R^T R - I)"
    )
    raise DyngsError(
        f"{name}: the matrix of camera {row} {fault}; only the position may be scaled: export it again"
    )


def _numbers(x: Tensor) -> NDArray[Any]:
    """Return a few numbers for NumPy, whose operators take a seventh of the time of torch's on the
    CPU."""
    return x.detach().cpu().numpy()


def clamp_time(time: float | None) -> float:
    """Return ``time`` within [0, 1]; None is 0. Raises DyngsError for NaN."""
    if time is not None and math.isnan(time):
        raise DyngsError("the time to draw is not a number; give one from 0 to 1")
    return min(max(0.0 if time is None else time, 0.0), 1.0)


class Posable(Renderable):
    """A person, whose body can play other motions than that of training."""

    @abstractmethod
    def body_up_direction(self) -> Tensor:
        """Return the direction (3,) that is up for the body at rest."""

    @abstractmethod
    def at_rest(self: P) -> P:
        """Return it in the rest pose of its template, upright on the floor."""

    @abstractmethod
    def placed(self: P, rotation: Tensor, scale: float, shift: Tensor) -> P:
        """Return it moved by a similarity: rotation (3, 3), then scale, then shift (3,)."""

    @abstractmethod
    def for_split(self: P, capture: Capture, split: Split) -> P:
        """Return it as the views of a split of its capture show it."""
