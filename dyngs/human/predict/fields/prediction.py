"""Training of networks that predict radiance fields of people, prediction, and the predicted
scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.conventions import ProgressCallback
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, add_prefix, move_fields_to, with_role
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.data.loader import Image
from dyngs.human.body.body_reader import load_template
from dyngs.human.fit.fitted_capture import ensure_fitted_body
from dyngs.human.keys import HumanModel
from dyngs.human.predict.fields.eg_human_nerf import EgHumanNerf
from dyngs.human.predict.fields.keypoint_nerf import AROUND, KeypointNerf
from dyngs.human.predict.fields.network import EncodedPerson, FieldNetwork
from dyngs.human.predict.gps.rectification import (
    MIN_ANGLE,
    angle_between_views,
    rings_of_views,
    spread,
    spread_around_person,
)
from dyngs.human.predict.kind import PredictedFieldModel
from dyngs.human.predict.people import (
    MULTIPLE,
    Person,
    PosedBody,
    Sources,
    cameras_in_metres,
    crop_source_images,
    crop_window,
    read_captured_person,
)
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import Model, RenderOutput, UpdateResult
from dyngs.models.prediction import (
    CaptureLearner,
    Example,
    Predictor,
    image_loss,
    load_weights,
    random_index,
    random_item,
)
from dyngs.models.renderable import (
    DrawOptions,
    RayScene,
    Renderable,
)
from dyngs.models.views import evaluation_background

NETWORKS: dict[str, Callable[..., FieldNetwork]] = {
    "keypoint_nerf": KeypointNerf,
    "eg_human_nerf": EgHumanNerf,
}
"""Untrained networks of a generator and keys, by ``model.kind``."""


@dataclass(frozen=True, repr=False)
class PredictedField(RayScene):
    """Radiance field of a person, predicted from ``sources``; static."""

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
    def example(self) -> Tensor:
        return self.sources.rgba

    @cached_property
    def encoded(self) -> EncodedPerson:
        """The encoded person, which all renders share."""
        with torch.no_grad():
            return self.network.encode(self.sources, self.body)

    def state(self) -> State:
        parts = {
            "network": self.network.state_dict(),
            "sources": vars(self.sources),
            "body": vars(dataclasses.replace(self.body)),  # without what it keeps
        }
        scale = torch.tensor([self.scale], dtype=torch.float64, device="cpu")
        state = with_role({"numbers": scale}, Role.SHARED)
        for name, tensors in parts.items():
            state |= add_prefix(name, with_role(tensors, Role.SHARED))
        return add_prefix("field", state)

    def render_camera(
        self, camera: Cameras, time: float, options: Any
    ) -> tuple[Tensor, Tensor, Tensor]:
        with torch.no_grad():
            found = self.network.render(self.encoded, cameras_in_metres(camera, self.scale))
        return found.colour, found.transmittance, self.scale * found.depth


def restore(model: PredictedFieldModel, checkpoint: Checkpoint) -> PredictedField:
    """Restore the field of a checkpoint. Raises KeyError or ValueError: tensors do not fit."""
    stored = checkpoint.part("field")

    def tensor(name: str, *shape: int | None) -> Tensor:
        return require_tensor(name, stored[name], shape)

    # Earlier versions also stored network sizes, after the scale.
    numbers = require_tensor("numbers", stored["numbers"][:1], (1,), torch.float64)
    require_positive("scale", numbers)
    network = NETWORKS[model.network](torch.Generator(), model)
    load_weights(network, checkpoint, "field.network")
    rgba = tensor("sources.rgba", None, 4, None, None)
    count, _, height, width = rgba.shape
    if not rgba.numel() or height % MULTIPLE or width % MULTIPLE:
        raise ValueError(f"'rgba' has an invalid shape: {tuple(rgba.shape)}")
    poses = tensor("sources.cam_from_world", count, 4, 4)
    vertices = tensor("body.vertices", None, 3)
    faces = require_indices("faces", stored["body.faces"], (None, 3), len(vertices))
    return PredictedField(
        network,
        Sources(rgba, poses, tensor("sources.intrinsics", count, 3, 3)),
        PosedBody(tensor("body.key_points", None, 3), vertices, faces),
        float(numbers[0]),
        background=evaluation_background(checkpoint.info.background, False)[1],
    )


class PredictedModel(Model[PredictedField]):
    """Stands in for a trainable model; predicted fields cannot be trained."""

    scene: Any = None  # set by ``FieldPredictor.begin`` or ``restore``
    leaves: Any = ()

    def __init__(self, run: StartContext) -> None:
        self._config = run.config

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        raise DyngsError(
            f"{self._config.run.dir}: predicted fields cannot be trained; predict from other "
            "views, or train `ngp` or `human` on the capture"
        )

    def update(self, step: int) -> UpdateResult:
        return UpdateResult(0)

    def state(self) -> State:
        return self.scene.state()

    def restore(self, checkpoint: Checkpoint) -> None:
        model: Any = self._config.model
        self.scene = restore(model, checkpoint)

    def place(self, device: torch.device) -> None:
        self.scene = self.scene and self.scene.to(device)


FEWEST_VIEWS = 2
_MIN_ALPHA = 0.5  # alpha of pixels that patches are centred on


class FieldPredictor(Predictor[FieldNetwork]):
    """Predicts the radiance field of one person."""

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint,
        data: DataConfig,
        log: Callable[[str], None],
        on_progress: ProgressCallback,
    ) -> None:
        """Load the network of ``checkpoint`` and the person of ``data``; fit the body if needed.

        ``log`` and ``on_progress`` receive messages and progress of that fit.
        """
        model: Any = config.model
        network = NETWORKS[model.kind](torch.Generator(), model)
        load_weights(network, checkpoint)
        if model.body is None:
            data = ensure_fitted_body(data, only_if_needed=True, log=log, on_progress=on_progress)
        self._person = read_captured_person(data, load_template(HumanModel(body=model.body)))
        super().__init__(config, network, self._person.views, data)

    def chosen(self, count: int) -> list[int]:
        return spread_around_person(self.views, count)

    def predict(self, views: Sequence[int]) -> PredictedField:
        chosen = [self.views[i] for i in views]
        first = chosen[0]
        if len({(view.frame, view.time) for view in chosen}) > 1 or all(
            angle_between_views(first, view) < MIN_ANGLE for view in chosen
        ):
            raise DyngsError(
                f"{self.name}: needs at least two views of one time step from different "
                "directions; pass --views A,B"
            )
        body, scale = self._person.body_in(first)
        sources = crop_source_images([self._person.images[i] for i in views], scale)
        return PredictedField(self.network, sources, body, scale, background=self.background)

    def run_config(self, views: Sequence[int]) -> Config:
        data = self.data_at_time(self.views[views[0]].time, self.views)
        section = self.section
        model = PredictedFieldModel(network=section.kind, supersampling=section.supersampling)
        return self.config.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.scene = scene


class FieldLearner(CaptureLearner[FieldNetwork, Person]):
    """Trains on patches of images, predicted from other images of the same time step."""

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        captured = self.opened(person)
        sources, target = self._views(captured, generator)
        body, scale = captured.body_in(captured.views[target], self.device)
        crops = crop_source_images([captured.images[i] for i in sources], scale)
        encoded = self.network.encode(move_fields_to(crops, self.device), body)
        patch = _random_patch(captured.images[target], self.section.patch, generator)
        image = patch.to(self.device)
        background = self.sample_background(generator)
        camera = cameras_in_metres(image.cameras, scale)
        picture = self.network.render(encoded, camera, generator)
        rendered = picture.colour + picture.transmittance[..., None] * background
        truth = image.composite(background)
        loss = image_loss(rendered, 1 - picture.transmittance, image, truth, self.config.train)
        loss = loss + self.network.penalty(picture, image, scale)
        return Example(loss, image, rendered.detach(), truth)

    def _views(self, person: Person, generator: torch.Generator) -> tuple[list[int], int]:
        """Choose source views of one time step, every other time evenly around the person, and a
        target view."""
        rings = [ring for ring in rings_of_views(person.views) if len(ring) > FEWEST_VIEWS]
        ring = random_item(rings, generator)
        max_count = min(self.section.source_views, len(ring) - 1)
        count = FEWEST_VIEWS + random_index(max_count - FEWEST_VIEWS + 1, generator)
        if random_index(2, generator):
            sources = spread(ring, count, random_index(len(ring), generator))
        else:
            order = torch.randperm(len(ring), generator=generator, device="cpu")[:count]
            sources = [ring[i] for i in order.tolist()]
        others = [i for i in ring if i not in sources]
        return sources, random_item(others, generator)

    def open_person(self, data: DataConfig) -> Person:
        """Return a person to train on. Raises DyngsError: too few views, or no depth maps."""
        captured = read_captured_person(data, load_template(HumanModel(body=self.section.body)))
        if all(len(ring) <= FEWEST_VIEWS for ring in rings_of_views(captured.views)):
            raise DyngsError(f"{data.root}: training needs a time step with three or more views")
        if self.network.needs_depth and any(view.depth_path is None for view in captured.views):
            raise DyngsError(
                f"{data.root}: no depth maps, which {self.config.model.kind} is trained on; "
                "`dyngs data synth people` writes them"
            )
        return captured


def _random_patch(image: Image, side: int, generator: torch.Generator) -> Image:
    """Return a patch around a random pixel of the person."""
    assert image.alpha is not None
    where = (image.alpha > _MIN_ALPHA).nonzero()
    row, column = random_item(where.tolist() or [[0, 0]], generator)
    return crop_window(image, column - side // 2, row - side // 2, side)


def learner(config: Config, generator: torch.Generator) -> FieldLearner:
    """Return the network in training, before the first step."""
    return FieldLearner(config, NETWORKS[config.model.kind](generator, config.model))


predictor = FieldPredictor
