"""Training of the network over the atlas on captures of several people, and what it predicts of one
(GHG)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError, reading
from dyngs.core.state import fields_moved_to
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.people_set import captures_in
from dyngs.data.read import read_capture
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.schedule import Rates
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import load_template
from dyngs.human.fit.fitted_capture import with_fitted_body
from dyngs.human.keys import HumanModel, HumanPredictorModel
from dyngs.human.predict.ghg.network import (
    AtlasNetwork,
    PredictedAvatar,
    num_input_channels,
    predict_gaussians,
)
from dyngs.human.predict.ghg.person import CapturedPerson, captured_person, spread_views
from dyngs.human.predict.ghg.texel_maps import TexelMaps, observe_texels, to_atlas
from dyngs.models.checkpoint import OTHER_CONFIG, Checkpoint
from dyngs.models.prediction import (
    Example,
    Learner,
    Predictor,
    image_loss,
    load_weights,
    random_index,
    updated,
)
from dyngs.models.renderable import Renderable, Rendering
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.device import CPU, device_for, sent

SQUARED_WEIGHT = 1.0  # Weight of the mean squared error in the loss, which counts edges more
MEAN_VIEWS = 8  # Images of each person that the mean colours are taken from
ADAPTING_STEPS = 10  # Steps of training on the images of one person before a prediction
ADAPTING_RATE = 1e-4
"""Highest learning rate of Adam per image of one person, which falls linearly: a single one says
little about the other sides."""
# Opacity below which a predicted Gaussian is left out, as the preset for one person has it
_FAINT = 0.02


@dataclass
class Filmed:
    """A person to train on: images, and the choices of those that are predicted from, with their
    maps once known."""

    sitter: CapturedPerson
    images: ImageLoader
    choices: list[list[int]]
    _maps: dict[int, TexelMaps] = field(default_factory=dict)
    _there: CapturedPerson | None = None

    def maps(self, choice: int, device: torch.device) -> TexelMaps:
        """Return the maps of the images of a choice on ``device``; kept."""
        if choice not in self._maps:
            self._maps[choice] = fields_moved_to(self.look(self.choices[choice]), device)
        return self._maps[choice]

    def sitter_on(self, device: torch.device) -> CapturedPerson:
        if self._there is None:
            self._there = fields_moved_to(self.sitter, device)
        return self._there

    def look(self, views: Sequence[int]) -> TexelMaps:
        return observe_texels(
            self.sitter,
            ((self.images[i], self.sitter.pose_in(self.sitter.views[i])) for i in views),
        )


@dataclass
class PersonPredictor:
    """See ``Predictor``; what is predicted is an avatar."""

    config: Config
    model: HumanPredictorModel
    network: AtlasNetwork  # may be trained on images of the person before, see ``adapt``
    mean: Tensor  # (3, S, S) colours of the people that it was trained on
    person: Filmed  # with images
    data: DataConfig  # of the capture, with its body

    @property
    def name(self) -> str:
        return self.person.sitter.name

    @property
    def views(self) -> tuple[View, ...]:
        return self.person.sitter.views

    def chosen(self, count: int) -> list[int]:
        return spread_views(self.person.sitter, count)

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> HumanScene:
        scene = self._scene(self.person.look(views))
        return scene.select(scene.gaussians.opacities >= _FAINT)

    def adapt(
        self,
        views: Sequence[int],
        steps: int | None = None,
        report: ReportProgress = report_nothing,
    ) -> int:
        """Train the network until its prediction shows the images better that it is predicted
        from."""
        steps = ADAPTING_STEPS if steps is None else steps
        options = replace(render_options(self.model), nonfinite="trust")
        background = evaluation_background(self.config.data.background, True)[1]
        images = [self.person.images[i] for i in views]
        maps = self.person.look(views)
        rate = ADAPTING_RATE * len(views)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        for step in range(steps):
            scene = self._scene(maps)
            total = torch.zeros((), device=self.mean.device)
            for image in images:
                moment = scene.time_step(image.time)
                rendering = scene.render(
                    image.cameras, moment, options=options, background=background
                )
                total = total + _error(
                    rendering, image, image.composite(background), self.config
                ) / len(images)
            if not updated(optimizer, self.network, total, rate * (1.0 - step / steps)):
                break
            report("training on the images", step + 1, steps)
        return steps

    def run_config(self, views: Sequence[int]) -> Config:
        return person_config(self.data, self.model)

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        if not isinstance(config.model, HumanModel):
            raise TypeError(f"not the section of one person: {config.model!r}")
        frames = self.person.sitter.subject.motion.frames
        model.begin_with(scene, HumanTraining(config.model, frames, Rates(config.train.steps)))

    def _scene(self, maps: TexelMaps) -> HumanScene:
        fraction = self.model.min_silhouette_fraction
        avatar = predict_gaussians(self.person.sitter, maps, self.mean, self.network, fraction)
        return scene_of(human_options(self.model), avatar, Rates(1))[0]


class AtlasLearner(Learner[AtlasNetwork]):
    """See ``Learner``: predicted from one choice of images, compared with others of one time
    step."""

    def __init__(
        self,
        config: Config,
        network: AtlasNetwork,
        people: list[Filmed],
        mean: Tensor,
        device: torch.device = CPU,
    ) -> None:
        self.config, self.network, self.people, self.mean, self.device = (
            config,
            network,
            people,
            mean,
            device,
        )
        self.model = _section(config)
        self.lr = self.model.lr
        self.names = [person.sitter.name for person in people]
        chosen = config.data.background
        self.background = chosen if chosen == "random" else evaluation_background(chosen, True)[0]

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        filmed = self.people[person]
        choice = random_index(len(filmed.choices), generator)
        targets = self._targets(filmed, filmed.choices[choice], generator)
        background = sent(background_colour(self.background, generator), self.device)
        drawing = replace(render_options(self.model), nonfinite="trust")
        sitter = filmed.sitter_on(self.device)
        maps = filmed.maps(choice, self.device)
        avatar = predict_gaussians(
            sitter, maps, self.mean, self.network, self.model.min_silhouette_fraction
        )
        scene, training = scene_of(human_options(self.model), avatar, Rates(1))
        moment = training.time_step(scene, targets[0], step)
        total = torch.zeros((), device=self.mean.device)
        for image in targets:
            rendering = scene.render(image.cameras, moment, options=drawing, background=background)
            truth = image.composite(background)
            total = total + _error(rendering, image, truth, self.config) / len(targets)
        return Example(total, image, rendering.rgb[0].detach(), truth, len(avatar.gaussians))

    def kept(self) -> dict[str, Tensor]:
        return {"mean": self.mean}

    def load(self, checkpoint: Checkpoint) -> None:
        self.mean = load_network(self.network, checkpoint, self.model.resolution).to(self.device)

    def _targets(
        self, person: Filmed, inputs: list[int], generator: torch.Generator
    ) -> list[Image]:
        """Return images of one time step that were not predicted from, where there are any."""
        views = person.sitter.views
        others = [i for i in range(len(views)) if i not in inputs] or inputs
        frame = views[others[random_index(len(others), generator)]].frame
        shown = [i for i in others if views[i].frame == frame]
        order = torch.randperm(len(shown), generator=generator, device="cpu").tolist()
        return [person.images[shown[i]].to(self.device) for i in order[: self.model.target_views]]


def learner(config: Config, generator: torch.Generator) -> AtlasLearner:
    """Return the network of ``model.kind: human_predictor`` before the first step: captures read,
    nothing trained."""
    device = device_for(config.run.device)
    model = _section(config)
    body = load_template(human_options(model))
    network = new_network(model, generator).to(device)
    people = [filmed(data, model, body) for data in captures_in(config.data)]
    for person in people:
        person.choices = _choices(person.sitter, model, generator)
    return AtlasLearner(
        config, network, people, mean_colours(people, model.resolution).to(device), device
    )


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
    model = _section(config)
    network = new_network(model, torch.Generator())
    mean = load_network(network, checkpoint, model.resolution)
    data = with_fitted_body(data, human_options(model), only_if_needed=True, say=say, report=report)
    person = filmed(data, model, load_template(human_options(model)))
    return PersonPredictor(config, model, network, mean, person, data)


def new_network(model: HumanPredictorModel, generator: torch.Generator) -> AtlasNetwork:
    """Return the untrained network of ``model``."""
    factor = 2 ** len(model.widths)
    if model.resolution % factor:
        raise DyngsError(
            f"model.resolution={model.resolution} must be a multiple of {factor} for {len(model.widths)} model.widths"
        )
    scaffolds = len(set(model.scaffold_heights))
    return AtlasNetwork(num_input_channels(scaffolds), scaffolds, model.widths, generator)


def load_network(network: AtlasNetwork, checkpoint: Checkpoint, resolution: int) -> Tensor:
    """Return the mean colours (3, S, S) of a checkpoint, whose weights ``network`` takes; S is the
    ``resolution``."""
    mean = checkpoint.tensors.get("model.mean")
    load_weights(network, checkpoint)
    if mean is None:
        raise DyngsError(f"{checkpoint.name} is not of this network; was its config changed?")
    with reading(checkpoint.name, OTHER_CONFIG):
        return require_tensor("mean", mean, (3, resolution, resolution))


def human_options(model: HumanPredictorModel) -> HumanModel:
    """Return the section of one person with the same template and texels; nothing of it is
    learned."""
    shared = ("body", "uv", "resolution")
    drawn = ("near", "eps2d", "rasterize_mode", "alpha_min", "transmittance_min")
    none = {"refine": False, "offset_weight": 0, "scale_weight": 0, "rigidity": 0, "smoothness": 0}
    return HumanModel.model_validate(
        {"sh_degree": 0, **none} | {name: getattr(model, name) for name in shared + drawn}
    )


def person_config(data: DataConfig, model: HumanPredictorModel) -> Config:
    """Return the preset for one person, for a scene that a network of ``model`` predicts of the
    capture ``data``."""
    preset = load_config(packaged_preset("human"), ["data.root=."])
    same = ("body", "uv", "resolution", "near", "eps2d", "rasterize_mode", "sh_degree")
    given = human_options(model)
    human = preset.model.model_copy(update={name: getattr(given, name) for name in same})
    return preset.model_copy(update={"data": data, "model": human})


def filmed(data: DataConfig, model: HumanPredictorModel, body: BodyTemplate) -> Filmed:
    """Return the person of one capture, without choices of images."""
    capture = read_capture(data)
    return Filmed(
        captured_person(capture, model, body), ImageLoader(capture.splits["train"], data), []
    )


def mean_colours(people: list[Filmed], resolution: int) -> Tensor:
    """Return (3, S, S) mean over people of the colours that their images show of the lowest
    scaffold.

    Where nobody is seen: the mean of all that is.
    """
    total = torch.zeros(3, resolution, resolution, device="cpu")
    count = torch.zeros(1, resolution, resolution, device="cpu")
    for person in people:
        sitter = person.sitter
        maps = person.look(spread_views(sitter, MEAN_VIEWS))
        is_seen = (maps.seen[0] > 0).float()[:, None]
        total += to_atlas(maps.rgb[0] * is_seen, sitter.texels)
        count += to_atlas(is_seen, sitter.texels)
    overall = total.sum((1, 2)) / count.sum().clamp_min(1)
    return torch.where(count > 0, total / count.clamp_min(1), overall[:, None, None])


def _choices(
    sitter: CapturedPerson, model: HumanPredictorModel, generator: torch.Generator
) -> list[list[int]]:
    """Return views to predict from, of a random time step each: one at random, the others chosen to
    see much.

    Every other choice has fewer than ``model.source_views``, in turn each number from 1.
    """
    firsts = torch.randint(
        len(sitter.views), (model.source_sets,), generator=generator, device="cpu"
    ).tolist()
    fewer = list(range(1, model.source_views)) or [model.source_views]
    counts = [
        fewer[i // 2 % len(fewer)] if i % 2 else model.source_views for i in range(len(firsts))
    ]
    return [spread_views(sitter, count, first) for count, first in zip(counts, firsts, strict=True)]


def scene_of(
    model: HumanModel, avatar: PredictedAvatar, rates: Rates
) -> tuple[HumanScene, HumanTraining]:
    """Return a predicted avatar as a scene, and how it is trained on."""
    training = HumanTraining(model, avatar.subject.motion.frames, rates)
    return training.first_scene(avatar.gaussians, avatar.subject), training


def _error(rendering: Rendering, image: Image, truth: Tensor, config: Config) -> Tensor:
    """Return the loss of a rendering of one view against ``truth`` (H, W, 3), the image on the same
    background."""
    difference = rendering.rgb[0] - truth
    known = difference if image.mask is None else difference * image.mask[..., None]
    squared = SQUARED_WEIGHT * known.square().mean()
    return image_loss(rendering.rgb[0], rendering.alpha[0], image, truth, config.train) + squared


def _section(config: Config) -> HumanPredictorModel:
    if not isinstance(config.model, HumanPredictorModel):
        raise TypeError(f"not a network: {config.model!r}")
    return config.model
