"""What a network has predicted of a person, as something to draw and to store; it is not
trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, prefixed, with_role
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.data.loader import Image
from dyngs.human.predict.fields.eg_human_nerf import EgHumanNerf
from dyngs.human.predict.fields.keypoint_nerf import AROUND, KeypointNerf
from dyngs.human.predict.fields.keys import PredictedFieldModel
from dyngs.human.predict.fields.network import EncodedPerson, FieldNetwork
from dyngs.human.predict.people import MULTIPLE, PosedBody, Sources, metric
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.model import Drawn, Model, Updated
from dyngs.models.renderable import (
    DrawOptions,
    Renderable,
    Rendering,
    TimeStep,
    composited,
    fixed_cameras,
)
from dyngs.models.views import evaluation_background

NETWORKS: dict[str, Callable[[torch.Generator], FieldNetwork]] = {
    "keypoint_nerf": KeypointNerf,
    "eg_human_nerf": EgHumanNerf,
}
"""Untrained networks, by ``model.kind``."""
_MOST_VIEWS = 1024
_MOST_PIXELS = 1 << 26  # Of stored images


@dataclass(frozen=True)
class PredictedField(Renderable):
    """A field of a person in the images ``sources``; it looks the same at every time."""

    network: FieldNetwork
    sources: Sources
    body: PosedBody
    scale: float  # world units per metre
    options: DrawOptions = dataclasses.field(default_factory=lambda: DrawOptions(near=0.0))
    background: Tensor | None = None

    @property
    def times(self) -> tuple[float, ...]:
        return ()

    @property
    def bounds(self) -> Tensor:
        return self.scale * self._around

    @property
    def _around(self) -> Tensor:
        """(2, 3) of ``bounds``, m."""
        points = self.body.key_points
        return torch.stack([points.amin(0) - AROUND, points.amax(0) + AROUND])

    @property
    def device(self) -> torch.device:
        return self.sources.rgba.device

    @cached_property
    def known(self) -> EncodedPerson:
        """What the network knows of the person: the same for all pictures."""
        with torch.no_grad():
            return self.network.look(self.sources, self.body)

    def state(self) -> State:
        tensors = {f"network.{name}": x.detach() for name, x in self.network.state_dict().items()}
        tensors |= {f"sources.{name}": x for name, x in vars(self.sources).items()}
        tensors |= {f"body.{name}": x for name, x in vars(self.body).items()}
        tensors["numbers"] = torch.tensor([self.scale], dtype=torch.float64, device="cpu")
        return prefixed("field", with_role(tensors, Role.SHARED))

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
        cameras = fixed_cameras(cameras, behind, self.sources.rgba)
        views = [self._view(cameras.select(i)) for i in range(len(cameras))]
        rgb, through, depth = (torch.stack(x) for x in zip(*views, strict=True))
        return composited(rgb, through, depth, options, behind)

    @torch.no_grad()
    def _view(self, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
        """Return colours before black (H, W, 3), transmittance (H, W) and the sum of weight times z
        (H, W)."""
        shape = (camera.height, camera.width)
        like = self.sources.rgba
        colour = like.new_zeros(*shape, 3)
        depth = like.new_zeros(shape)
        through = like.new_ones(shape)
        part = around_in(metric(camera, self.scale), self._around)
        if part is not None:
            seen, (top, left) = self.network.picture(self.known, part.camera), part.corner
            own = slice(top, top + part.camera.height), slice(left, left + part.camera.width)
            colour[own] = seen.colour
            through[own] = seen.transmittance
            depth[own] = self.scale * seen.depth
        return colour, through, depth


@dataclass(frozen=True)
class ImagePart:
    """A part of a camera's image, with its own camera, and its first row and column."""

    camera: Cameras
    corner: tuple[int, int]


def around_in(camera: Cameras, box: Tensor) -> ImagePart | None:
    """Return the part of an image that shows a box, of corners (2, 3); None: no part does.

    Its sides are multiples of ``MULTIPLE`` where the image is as large. All of the image where the
    box reaches behind the camera.
    """
    corners = torch.cartesian_prod(*box.T)
    pose = camera.cam_from_world[0]
    k = camera.intrinsics[0]
    local = corners @ pose[:3, :3].T + pose[:3, 3]
    if bool((local[:, 2] <= 0).all()):
        return None
    if bool((local[:, 2] <= 1e-3).any()):
        return ImagePart(camera, (0, 0))
    pixels = local[:, :2] / local[:, 2:] * torch.stack([k[0, 0], k[1, 1]]) + k[:2, 2]
    first = pixels.amin(0).floor().tolist()
    last = pixels.amax(0).ceil().tolist()
    (left, width), (top, height) = (
        _within(int(begin), int(end), size)
        for begin, end, size in zip(first, last, (camera.width, camera.height), strict=True)
    )
    if width <= 0 or height <= 0:
        return None
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top
    return ImagePart(Cameras(camera.cam_from_world, intrinsics, width, height), (top, left))


def _within(begin: int, end: int, size: int) -> tuple[int, int]:
    """Return where a part of an image's side begins, and how long it is."""
    begin = max(begin, 0)
    end = min(end, size)
    length = min(-(-(end - begin) // MULTIPLE) * MULTIPLE, size)
    return min(begin, size - length), length


def stored_field(name: str, checkpoint: Checkpoint) -> PredictedField:
    """Return what the network ``name`` has predicted. Raises KeyError or ValueError where tensors
    do not fit."""
    stored = checkpoint.part("field")
    # earlier versions stored sizes of the network behind the scale
    numbers = require_tensor("numbers", stored["numbers"][:1], (1,), torch.float64)
    require_positive("scale", numbers)
    network = NETWORKS[name](torch.Generator())
    own = network.state_dict()
    weights = {
        key: require_tensor(key, stored[f"network.{key}"], tuple(x.shape), x.dtype).clone()
        for key, x in own.items()
    }
    network.load_state_dict(weights)
    behind = evaluation_background(checkpoint.info.background, False)[1]
    return PredictedField(
        network, _sources(stored), _body(stored), float(numbers[0]), background=behind
    )


def _sources(stored: Mapping[str, Tensor]) -> Sources:
    rgba = require_tensor("rgba", stored["sources.rgba"], (None, 4, None, None))
    count, _, height, width = rgba.shape
    if (
        not 1 <= count <= _MOST_VIEWS
        or height % MULTIPLE
        or width % MULTIPLE
        or not 0 < height * width <= _MOST_PIXELS
    ):
        raise ValueError(f"'rgba' is no set of images: {tuple(rgba.shape)}")
    poses = require_tensor("cam_from_world", stored["sources.cam_from_world"], (count, 4, 4))
    return Sources(
        rgba, poses, require_tensor("intrinsics", stored["sources.intrinsics"], (count, 3, 3))
    )


def _body(stored: Mapping[str, Tensor]) -> PosedBody:
    points = require_tensor("key_points", stored["body.key_points"], (None, 3))
    vertices = require_tensor("vertices", stored["body.vertices"], (None, 3))
    faces = require_indices("faces", stored["body.faces"], (None, 3), len(vertices))
    return PosedBody(points, vertices, faces)


class PredictedModel(Model[PredictedField]):
    """What was predicted, in the place of a model in training; to train it is refused."""

    def __init__(self, run: RunStart) -> None:
        self._run, self._scene = run, None
        assert isinstance(run.config.model, PredictedFieldModel)
        self._name = run.config.model.network

    def begin_with(self, scene: PredictedField) -> None:
        self._scene = scene

    @property
    def scene(self) -> PredictedField:
        if self._scene is None:
            raise _untrained(self._run.config.run.dir)
        return self._scene

    def draw(self, image: Image, step: int, background: Tensor, *, depth: bool = False) -> Drawn:
        raise _untrained(self._run.config.run.dir)

    def update(self, step: int) -> Updated:
        return Updated(0)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return []

    def state(self) -> State:
        return self.scene.state()

    def restore(self, checkpoint: Checkpoint) -> None:
        self._scene = stored_field(self._name, checkpoint)

    def place(self, device: torch.device) -> None:
        self._scene = None if self._scene is None else self._scene.to(device)


def _untrained(where: object) -> DyngsError:
    return DyngsError(
        f"{where}: a predicted field is not trained; predict it from other views, or train `ngp` or `human` on the "
        "capture"
    )


def restore(model: PredictedFieldModel, checkpoint: Checkpoint) -> PredictedField:
    """Return the scene of a checkpoint."""
    return stored_field(model.network, checkpoint)
