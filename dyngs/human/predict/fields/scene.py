"""What a network has predicted of a person, as something to draw and to store; it is not
trained."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
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
from dyngs.human.predict.fields.network import EncodedPerson, FieldNetwork
from dyngs.human.predict.keys import PredictedFieldModel
from dyngs.human.predict.people import MULTIPLE, PosedBody, Sources, metric
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import RunStart
from dyngs.models.model import Drawn, Model, Updated
from dyngs.models.prediction import load_weights
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
        points = self.body.key_points
        return self.scale * torch.stack([points.amin(0) - AROUND, points.amax(0) + AROUND])

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
        with torch.no_grad():
            views = [
                self.network.picture(self.known, metric(cameras.select(i), self.scale))
                for i in range(len(cameras))
            ]
        rgb = torch.stack([view.colour for view in views])
        through = torch.stack([view.transmittance for view in views])
        depth = self.scale * torch.stack([view.depth for view in views])
        return composited(rgb, through, depth, options, behind)


def restore(model: PredictedFieldModel, checkpoint: Checkpoint) -> PredictedField:
    """Return the field of a checkpoint. Raises KeyError or ValueError where tensors
    do not fit."""
    stored = checkpoint.part("field")
    # earlier versions stored sizes of the network behind the scale
    numbers = require_tensor("numbers", stored["numbers"][:1], (1,), torch.float64)
    require_positive("scale", numbers)
    network = NETWORKS[model.network](torch.Generator())
    load_weights(network, checkpoint, "field.network")
    rgba = require_tensor("rgba", stored["sources.rgba"], (None, 4, None, None))
    count, _, height, width = rgba.shape
    if not rgba.numel() or height % MULTIPLE or width % MULTIPLE:
        raise ValueError(f"'rgba' is no set of images: {tuple(rgba.shape)}")
    poses = require_tensor("cam_from_world", stored["sources.cam_from_world"], (count, 4, 4))
    intrinsics = require_tensor("intrinsics", stored["sources.intrinsics"], (count, 3, 3))
    points = require_tensor("key_points", stored["body.key_points"], (None, 3))
    vertices = require_tensor("vertices", stored["body.vertices"], (None, 3))
    faces = require_indices("faces", stored["body.faces"], (None, 3), len(vertices))
    return PredictedField(
        network,
        Sources(rgba, poses, intrinsics),
        PosedBody(points, vertices, faces),
        float(numbers[0]),
        background=evaluation_background(checkpoint.info.background, False)[1],
    )


class PredictedModel(Model[PredictedField]):
    """What was predicted, in the place of a model in training; to train it is refused."""

    def __init__(self, run: RunStart) -> None:
        assert isinstance(run.config.model, PredictedFieldModel)
        self._run_dir = run.config.run.dir
        self._section = run.config.model
        self._scene: PredictedField | None = None

    def begin_with(self, scene: PredictedField) -> None:
        self._scene = scene

    @property
    def scene(self) -> PredictedField:
        if self._scene is None:
            raise self._untrained()
        return self._scene

    def _untrained(self) -> DyngsError:
        return DyngsError(
            f"{self._run_dir}: a predicted field is not trained; predict it from other views, or train `ngp` or "
            "`human` on the capture"
        )

    def draw(self, image: Image, step: int, background: Tensor, *, depth: bool = False) -> Drawn:
        raise self._untrained()

    def update(self, step: int) -> Updated:
        return Updated(0)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return []

    def state(self) -> State:
        return self.scene.state()

    def restore(self, checkpoint: Checkpoint) -> None:
        self._scene = restore(self._section, checkpoint)

    def place(self, device: torch.device) -> None:
        self._scene = None if self._scene is None else self._scene.to(device)
