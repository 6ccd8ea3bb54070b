"""Fields of people: training of the networks on captures of several, and the fields that they predict
of one, to draw and to store; they are not trained."""

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
from dyngs.data.read import list_captures
from dyngs.data.times import distinct_times
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template, read_body
from dyngs.human.fit.fitted_capture import ensure_fitted_body
from dyngs.human.predict.fields.eg_human_nerf import EgHumanNerf
from dyngs.human.predict.fields.keypoint_nerf import AROUND, KeypointNerf
from dyngs.human.predict.fields.network import EncodedPerson, FieldNetwork
from dyngs.human.predict.gps.rectification import (
    MIN_ANGLE,
    angle_between_views,
    moments,
    spread,
    spread_around_person,
)
from dyngs.human.predict.keys import FieldPredictorModel, PredictedFieldModel
from dyngs.human.predict.people import (
    MULTIPLE,
    Person,
    PosedBody,
    Sources,
    crop_source_images,
    metric,
    read_captured_person,
    window,
)
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.kind import StartContext
from dyngs.models.model import Model, RenderOutput, UpdateResult
from dyngs.models.prediction import (
    Example,
    Learner,
    Predictor,
    image_loss,
    keep_captures_open,
    load_weights,
    random_index,
)
from dyngs.models.renderable import (
    DrawOptions,
    Renderable,
    Rendering,
    TimeStep,
    composite_background,
    fixed_cameras,
)
from dyngs.models.views import evaluation_background
from dyngs.ops.device import CPU, select_device

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
        return add_prefix("field", with_role(tensors, Role.SHARED))

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
        return composite_background(rgb, through, depth, options, behind)


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

    def __init__(self, run: StartContext) -> None:
        assert isinstance(run.config.model, PredictedFieldModel)
        self._run_dir = run.config.run.dir
        self._section = run.config.model
        self._scene: PredictedField | None = None

    def start_from(self, scene: PredictedField) -> None:
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

    def draw(
        self, image: Image, step: int, background: Tensor, *, depth: bool = False
    ) -> RenderOutput:
        raise self._untrained()

    def update(self, step: int) -> UpdateResult:
        return UpdateResult(0)

    @property
    def leaves(self) -> Sequence[Tensor]:
        return []

    def state(self) -> State:
        return self.scene.state()

    def restore(self, checkpoint: Checkpoint) -> None:
        self._scene = restore(self._section, checkpoint)

    def place(self, device: torch.device) -> None:
        self._scene = None if self._scene is None else self._scene.to(device)


FEWEST_VIEWS = 2
PATCH = 32  # side of the part of an image that a step is about, px
_SOLID = 0.5  # Alpha of the pixels that parts of images are cut out around


class FieldPredictor(Predictor[FieldNetwork]):
    """Predicts a field."""

    def __init__(
        self, config: Config, network: FieldNetwork, person: Person, data: DataConfig
    ) -> None:
        super().__init__(config, network, person.views, data)
        self._person = person

    def chosen(self, count: int) -> list[int]:
        return spread_around_person(self.views, count)

    def predict(self, views: Sequence[int]) -> PredictedField:
        shown = [self.views[i] for i in views]
        first = shown[0]
        if len({(view.frame, view.time) for view in shown}) > 1 or all(
            angle_between_views(first, view) < MIN_ANGLE for view in shown
        ):
            raise DyngsError(
                f"{self.name}: a field is predicted from two views of one moment at least, that look from different "
                "directions; give --views A,B"
            )
        body, scale = self._person.body_in(first)
        sources = crop_source_images([self._person.images[i] for i in views], scale)
        return PredictedField(self.network, sources, body, scale, background=self.background)

    def run_config(self, views: Sequence[int]) -> Config:
        times = distinct_times(self.views).values()
        data = self.data_at_time(self.views[views[0]].time, times)
        model = PredictedFieldModel.model_validate({"network": self.config.model.kind})
        return self.config.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.start_from(scene)


class FieldLearner(Learner[FieldNetwork]):
    """A part of an image of a person, predicted from others of the same moment."""

    def __init__(
        self,
        config: Config,
        network: FieldNetwork,
        people: Sequence[DataConfig],
        device: torch.device = CPU,
    ) -> None:
        super().__init__(config, network, [person.root.name for person in people], device)
        self._template = template_of(self.section)
        self._opened = keep_captures_open(self._open, people)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        known = self._opened(person)
        sources, target = self._views(known, generator)
        body, scale = known.body_in(known.views[target])
        body = move_fields_to(body, self.device)
        given = move_fields_to(
            crop_source_images([known.images[i] for i in sources], scale), self.device
        )
        image = _part(known.images[target], generator).to(self.device)
        background = self.sample_background(generator)
        seen = self.network.look(given, body)
        picture = self.network.picture(seen, metric(image.cameras, scale), generator)
        rendered = picture.colour + picture.transmittance[..., None] * background
        truth = image.composite(background)
        loss = image_loss(rendered, 1 - picture.transmittance, image, truth, self.config.train)
        loss = loss + self.network.penalty(picture, image, scale)
        return Example(loss, image, rendered.detach(), truth)

    def _views(self, person: Person, generator: torch.Generator) -> tuple[list[int], int]:
        """Return views of a moment to predict from, every other time evenly around the person, and
        another view."""
        rings = [ring for ring in moments(person.views).values() if len(ring) > FEWEST_VIEWS]
        ring = rings[random_index(len(rings), generator)]
        most = min(self.section.source_views, len(ring) - 1)
        count = FEWEST_VIEWS + random_index(most - FEWEST_VIEWS + 1, generator)
        if random_index(2, generator):
            sources = spread(ring, count, random_index(len(ring), generator))
        else:
            order = torch.randperm(len(ring), generator=generator, device="cpu")[:count]
            sources = [ring[i] for i in order.tolist()]
        others = [i for i in ring if i not in sources]
        return sources, others[random_index(len(others), generator)]

    def _open(self, data: DataConfig) -> Person:
        """Return a person. Raises DyngsError: nobody to learn from."""
        found = read_captured_person(data, self._template)
        if all(len(ring) <= FEWEST_VIEWS for ring in moments(found.views).values()):
            raise DyngsError(f"{data.root}: shows no moment in three views or more to learn from")
        if self.network.needs_depth and any(view.depth_path is None for view in found.views):
            raise DyngsError(
                f"{data.root}: has no depth maps, from which {self.config.model.kind} learns where the surface is; "
                "`dyngs data synth people` writes them"
            )
        return found


def _part(image: Image, generator: torch.Generator) -> Image:
    """Return the part of an image around a pixel of the person."""
    assert image.alpha is not None
    where = (image.alpha > _SOLID).nonzero()
    if not len(where):
        return window(image, 0, 0, PATCH)
    row, column = where[random_index(len(where), generator)].tolist()
    return window(image, column - PATCH // 2, row - PATCH // 2, PATCH)


def learner(config: Config, generator: torch.Generator) -> FieldLearner:
    """Return a network before the first step."""
    device = select_device(config.run.device)
    network = NETWORKS[config.model.kind](generator).to(device)
    return FieldLearner(config, network, list_captures(config.data), device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    log: Callable[[str], None],
    report: ProgressCallback,
) -> Predictor[Any]:
    """Return the network of ``checkpoint`` with the person of ``data``; without body parameters a
    body is fitted.

    ``say`` and ``report`` receive the messages and the progress of that fit.
    """
    model: Any = config.model
    network = NETWORKS[model.kind](torch.Generator())
    load_weights(network, checkpoint)
    if model.body is None:
        data = ensure_fitted_body(data, only_if_needed=True, log=log, report=report)
    return FieldPredictor(config, network, read_captured_person(data, template_of(model)), data)


def template_of(model: FieldPredictorModel) -> BodyTemplate:
    return default_template() if model.body is None else read_body(model.body)
