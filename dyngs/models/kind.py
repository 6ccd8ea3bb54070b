"""The kinds of model: one line each in ``KINDS``, of which the configuration makes the choices of
``model.kind``."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from dyngs.baselines.fields.keys import NerfModel, NgpModel
from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.core.errors import DyngsError
from dyngs.core.section import ModelSection
from dyngs.deform.keys import DynamicModel
from dyngs.human.keys import HumanModel, HumanPredictorModel
from dyngs.human.predict.fields.keys import EgHumanNerfModel, KeypointNerfModel, PredictedFieldModel
from dyngs.human.predict.gps.keys import GpsModel
from dyngs.static.keys import StaticModel

if TYPE_CHECKING:
    import torch

    from dyngs.config import Config, DataConfig
    from dyngs.data.capture import Capture
    from dyngs.data.loader import ImageLoader
    from dyngs.models.checkpoint import Checkpoint
    from dyngs.models.model import Model
    from dyngs.models.prediction import Learner, Predictor
    from dyngs.models.renderable import Renderable


@dataclass(frozen=True)
class RunStart:
    """What a model begins with."""

    config: Config
    # the same without limits: a run may begin with more Gaussians than it may end with
    asked: Config
    capture: Capture  # that is trained on, with its first points
    images: ImageLoader
    background: str
    extent: float
    generator: torch.Generator
    # ``FirstGaussians`` that it goes on from; None: it begins as ``config.init`` says
    first: Any = None


@dataclass(frozen=True)
class Kind:
    """A kind of model."""

    section: type[ModelSection]  # class of its configuration
    # module with its ``start`` and ``restore``, and ``refusal`` where it cannot take every capture;
    # that of a network has ``learner`` and ``predictor`` instead, see ``dyngs.models.prediction``.
    # It is imported when first needed, so that reading a configuration imports no model
    home: str

    def start(self, start: RunStart) -> Model[Any]:
        """Return the model before the first step."""
        return import_module(self.home).start(start)

    def restore(self, model: ModelSection, checkpoint: Checkpoint) -> Renderable:
        """Return the scene of a checkpoint. Raises KeyError or ValueError where its tensors do not
        fit."""
        if model.is_network:
            raise DyngsError(
                f"{checkpoint.name}: a network, not a scene; `dyngs predict RUN CAPTURE --out RUN` makes one"
            )
        return import_module(self.home).restore(model, checkpoint)

    def refusal(self, capture: Capture) -> str | None:
        """Return why it cannot be trained on ``capture``, to follow its folder and a colon; None:
        it can."""
        refusal = getattr(import_module(self.home), "refusal", None)
        return None if refusal is None else refusal(capture)

    def learner(self, config: Config, generator: torch.Generator) -> Learner[Any]:
        """Return a network in training, before the first step."""
        return import_module(self.home).learner(config, generator)

    def predictor(
        self, config: Config, checkpoint: Checkpoint, data: DataConfig, **told: Any
    ) -> Predictor:
        """Return a trained network with the capture of ``data``; ``told``: ``say``, ``report`` of
        what takes long."""
        return import_module(self.home).predictor(config, checkpoint, data, **told)


KINDS: tuple[Kind, ...] = (
    Kind(StaticModel, "dyngs.gaussians.static_training"),
    Kind(DynamicModel, "dyngs.deform.kind"),
    Kind(HumanModel, "dyngs.human.avatar.kind"),
    Kind(HumanPredictorModel, "dyngs.human.predict.ghg.learner"),
    Kind(GpsModel, "dyngs.human.predict.gps.learner"),
    Kind(KeypointNerfModel, "dyngs.human.predict.fields.learner"),
    Kind(EgHumanNerfModel, "dyngs.human.predict.fields.learner"),
    Kind(PredictedFieldModel, "dyngs.human.predict.fields.scene"),
    Kind(NgpModel, "dyngs.baselines.fields.kind"),
    Kind(NerfModel, "dyngs.baselines.fields.kind"),
    Kind(BgTriangleModel, "dyngs.baselines.triangles.kind"),
)


def kind_of(model: ModelSection) -> Kind:
    """Return the kind of a section of the configuration."""
    return next(kind for kind in KINDS if type(model) is kind.section)
