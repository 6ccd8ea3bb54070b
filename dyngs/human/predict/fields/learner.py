"""Training of networks that predict fields of people on captures of several, and what they predict
of one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from dyngs.config import Config, DataConfig
from dyngs.core.conventions import ReportProgress
from dyngs.core.errors import DyngsError
from dyngs.core.state import fields_moved_to
from dyngs.data.loader import Image
from dyngs.data.read import captures_in
from dyngs.data.times import distinct_times
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template, read_body
from dyngs.human.fit.fitted_capture import with_fitted_body
from dyngs.human.predict.fields.network import FieldNetwork
from dyngs.human.predict.fields.scene import NETWORKS, PredictedField
from dyngs.human.predict.gps.rectification import MIN_ANGLE, angle, moments, spread, well_spread
from dyngs.human.predict.keys import FieldPredictorModel, PredictedFieldModel
from dyngs.human.predict.people import (
    Person,
    metric,
    person_of,
    sources_of,
    window,
)
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.prediction import (
    Example,
    Learner,
    Predictor,
    image_loss,
    kept_open,
    load_weights,
    random_index,
)
from dyngs.models.renderable import Renderable
from dyngs.ops.device import CPU, device_for

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
        return well_spread(self.views, count)

    def predict(self, views: Sequence[int]) -> PredictedField:
        shown = [self.views[i] for i in views]
        first = shown[0]
        if len({(view.frame, view.time) for view in shown}) > 1 or all(
            angle(first, view) < MIN_ANGLE for view in shown
        ):
            raise DyngsError(
                f"{self.name}: a field is predicted from two views of one moment at least, that look from different "
                "directions; give --views A,B"
            )
        body, scale = self._person.body_in(first)
        sources = sources_of([self._person.images[i] for i in views], scale)
        return PredictedField(self.network, sources, body, scale, background=self.background)

    def run_config(self, views: Sequence[int]) -> Config:
        times = distinct_times(self.views).values()
        data = self.data_of_moment(self.views[views[0]].time, times)
        model = PredictedFieldModel.model_validate({"network": self.config.model.kind})
        return self.config.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.begin_with(scene)


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
        self._opened = kept_open(self._open, people)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        known = self._opened(person)
        sources, target = self._views(known, generator)
        body, scale = known.body_in(known.views[target])
        body = fields_moved_to(body, self.device)
        given = fields_moved_to(sources_of([known.images[i] for i in sources], scale), self.device)
        image = _part(known.images[target], generator).to(self.device)
        background = self.drawn_background(generator)
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
        found = person_of(data, self._template)
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
    device = device_for(config.run.device)
    network = NETWORKS[config.model.kind](generator).to(device)
    return FieldLearner(config, network, captures_in(config.data), device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    say: Callable[[str], None],
    report: ReportProgress,
) -> Predictor[Any]:
    """Return the network of ``checkpoint`` with the person of ``data``; without body parameters a
    body is fitted.

    ``say`` and ``report`` are told of that fit.
    """
    model: Any = config.model
    network = NETWORKS[model.kind](torch.Generator())
    load_weights(network, checkpoint)
    if model.body is None:
        data = with_fitted_body(data, only_if_needed=True, say=say, report=report)
    return FieldPredictor(config, network, person_of(data, template_of(model)), data)


def template_of(model: FieldPredictorModel) -> BodyTemplate:
    return default_template() if model.body is None else read_body(model.body)
