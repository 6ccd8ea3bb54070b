"""Training of networks that predict fields of people on captures of several, and what they predict
of one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from dyngs.config import Config, DataConfig
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.core.state import fields_moved_to
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.data.people_set import captures_in
from dyngs.data.times import distinct_times
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template, read_body
from dyngs.human.fit.fitted_capture import with_fitted_body
from dyngs.human.predict.fields.keys import FieldPredictorModel, PredictedFieldModel
from dyngs.human.predict.fields.network import FieldNetwork
from dyngs.human.predict.fields.people import (
    Person,
    metric,
    moments,
    person_of,
    require_shown,
    sources_of,
    spread,
    window,
)
from dyngs.human.predict.fields.scene import PredictedField, network_of
from dyngs.human.predict.gps.pairs import MIN_ANGLE, angle
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.prediction import (
    Example,
    Learner,
    Predictor,
    image_loss,
    load_weights,
    of_moment,
    random_index,
)
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.device import CPU, device_for, sent

FEWEST_VIEWS = 2
_OPEN = 64  # People whose captures are kept open
_SOLID = 0.5  # Alpha of the pixels that parts of images are cut out around


@dataclass
class FieldPredictor:
    """See ``Predictor``; what is predicted is a field."""

    config: Config
    network: FieldNetwork
    person: Person
    data: DataConfig  # of the capture, with its body

    @property
    def name(self) -> str:
        return self.person.name

    @property
    def views(self) -> tuple[View, ...]:
        return self.person.views

    def chosen(self, count: int) -> list[int]:
        """See ``Predictor``: evenly around the person, at the first of the moments that most views
        show."""
        rings = moments(self.views)
        ring = max(rings.values(), key=len)
        return sorted(set(spread(ring, min(count, len(ring)))))

    def adapt(
        self,
        views: Sequence[int],
        steps: int | None = None,
        report: ReportProgress = report_nothing,
    ) -> int:
        if steps:
            kind = self.config.model.kind
            raise DyngsError(
                f"--steps {steps}: {kind} is not trained on the images of one person; leave it out"
            )
        return 0

    def predict(self, views: Sequence[int]) -> PredictedField:
        shown = [self.views[i] for i in views]
        if len(views) < FEWEST_VIEWS:
            raise DyngsError(
                f"{self.name}: a field is predicted from two views at least, not one; give --views A,B"
            )
        other = next(
            (x for x in shown if (x.frame, x.time) != (shown[0].frame, shown[0].time)), None
        )
        if other is not None:
            raise DyngsError(
                f"{self.name}: {shown[0].name} and {other.name} show two moments; give views of the same one"
            )
        if all(angle(shown[0], view) < MIN_ANGLE for view in shown[1:]):
            raise DyngsError(
                f"{self.name}: {shown[0].name} and the others look from the same direction; give other views"
            )
        body, scale = self.person.body_in(shown[0])
        images = [self.person.images[i] for i in views]
        for image in images:
            require_shown(self.name, image, body, scale)
        sources = sources_of(images, scale)
        background = evaluation_background(self.config.data.background, True)[1]
        return PredictedField(
            section_of(self.config), self.network, sources, body, scale, background=background
        )

    def run_config(self, views: Sequence[int]) -> Config:
        data = of_moment(self.data, self.views[views[0]].time, distinct_times(self.views).values())
        model = PredictedFieldModel.model_validate({"network": self.config.model.kind})
        return self.config.model_copy(update={"data": data, "model": model})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        model.begin_with(scene)


class FieldLearner(Learner[FieldNetwork]):
    """See ``Learner``: a part of an image of a person, predicted from others of the same moment."""

    def __init__(
        self,
        config: Config,
        network: FieldNetwork,
        people: Sequence[DataConfig],
        device: torch.device = CPU,
    ) -> None:
        self.config, self.network, self.device = config, network, device
        self.model = section_of(config)
        self._people = people
        self.lr = self.model.lr
        self.names = [person.root.name for person in people]
        self._template = template_of(self.model)
        chosen = config.data.background
        self.background = chosen if chosen == "random" else evaluation_background(chosen, True)[0]
        self._open: dict[int, Person] = {}
        self._open_person(0)  # so that captures of another kind fail at once

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        known = self._open_person(person)
        sources, target = self._views(known, generator)
        body, scale = known.body_in(known.views[target])
        body = fields_moved_to(body, self.device)
        given = fields_moved_to(sources_of([known.images[i] for i in sources], scale), self.device)
        image = self._part(known.images[target], generator).to(self.device)
        background = sent(background_colour(self.background, generator), self.device)
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
        most = min(self.model.source_views, len(ring) - 1)
        count = FEWEST_VIEWS + random_index(most - FEWEST_VIEWS + 1, generator)
        if random_index(2, generator):
            sources = spread(ring, count, random_index(len(ring), generator))
        else:
            order = torch.randperm(len(ring), generator=generator, device="cpu")[:count]
            sources = [ring[i] for i in order.tolist()]
        others = [i for i in ring if i not in sources]
        return sources, others[random_index(len(others), generator)]

    def _part(self, image: Image, generator: torch.Generator) -> Image:
        """Return the part of an image around a pixel of the person."""
        assert image.alpha is not None
        side = self.model.patch
        where = (image.alpha > _SOLID).nonzero()
        if not len(where):
            return window(image, 0, 0, side)
        row, column = where[random_index(len(where), generator)].tolist()
        return window(image, column - side // 2, row - side // 2, side)

    def _open_person(self, person: int) -> Person:
        """Return a person; the last ones are kept. Raises DyngsError: nobody to learn from."""
        if person not in self._open:
            while len(self._open) >= _OPEN:
                self._open.pop(next(iter(self._open)))
            found = person_of(self._people[person], self._template)
            if all(len(ring) <= FEWEST_VIEWS for ring in moments(found.views).values()):
                raise DyngsError(
                    f"{self._people[person].root}: shows no moment in three views or more to learn from"
                )
            if self.network.needs_depth and any(view.depth_path is None for view in found.views):
                raise DyngsError(
                    f"{self._people[person].root}: has no depth maps, from which {self.model.kind} learns where the "
                    "surface is; `dyngs data synth people` writes them, or give model.srdf_weight=0"
                )
            self._open[person] = found
        return self._open[person]


def learner(config: Config, generator: torch.Generator) -> FieldLearner:
    """Return a network before the first step."""
    device = device_for(config.run.device)
    network = network_of(section_of(config), generator).to(device)
    return FieldLearner(config, network, captures_in(config.data), device)


def predictor(
    config: Config,
    checkpoint: Checkpoint,
    data: DataConfig,
    say: Callable[[str], None],
    report: ReportProgress,
) -> Predictor:
    """Return the network of ``checkpoint`` with the person of ``data``; without body parameters a
    body is fitted.

    ``say`` and ``report`` are told of that fit.
    """
    model = section_of(config)
    network = network_of(model, torch.Generator())
    load_weights(network, checkpoint)
    if model.body is None:
        data = with_fitted_body(data, only_if_needed=True, say=say, report=report)
    return FieldPredictor(config, network, person_of(data, template_of(model)), data)


def section_of(config: Config) -> FieldPredictorModel:
    if not isinstance(config.model, FieldPredictorModel):
        raise TypeError(f"not a network that predicts fields: {config.model!r}")
    return config.model


def template_of(model: FieldPredictorModel) -> BodyTemplate:
    return default_template() if model.body is None else read_body(model.body)
