"""Training of the network over the atlas on captures of several people, and what it predicts of one
(GHG)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError, reading
from dyngs.core.state import fields_moved_to
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import captures_in, read_capture
from dyngs.gaussians.colour.network import RestFrame
from dyngs.gaussians.scene import GaussianTimeStep, render_options
from dyngs.gaussians.schedule import Rates
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import load_template
from dyngs.human.fit.fitted_capture import with_fitted_body
from dyngs.human.keys import HumanModel, HumanPredictorModel
from dyngs.human.predict.ghg.network import (
    WIDTHS,
    AtlasNetwork,
    AtlasPerson,
    TexelMaps,
    atlas_person,
    num_input_channels,
    predict_avatar,
    spread_views,
    to_atlas,
)
from dyngs.human.predict.people import Person, person_in
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
from dyngs.models.renderable import Renderable
from dyngs.ops.device import CPU, device_for

SOURCE_SETS = 6  # choices of source views per person in training; their maps are kept
TARGET_VIEWS = 2  # images of one time step that a prediction is compared with in each step
SQUARED_WEIGHT = 1.0  # Weight of the mean squared error in the loss, which counts edges more
MEAN_VIEWS = 8  # Images of each person that the mean colours are taken from
ADAPTING_STEPS = 10  # Steps of training on the images of one person before a prediction
ADAPTING_RATE = 1e-4
"""Highest learning rate of Adam per image of one person, which falls linearly: a single one says
little about the other sides."""
# Opacity below which a predicted Gaussian is left out, as the preset for one person has it
_FAINT = 0.02


class PersonPredictor(Predictor[AtlasNetwork]):
    """Predicts an avatar; ``adapt`` trains the network on images of the person before."""

    def __init__(
        self,
        config: Config,
        network: AtlasNetwork,
        mean: Tensor,
        person: AtlasPerson,
        data: DataConfig,
    ) -> None:
        """``mean`` (3, S, S) are colours of the people that the network was trained on."""
        super().__init__(config, network, person.person.views, data)
        self.mean = mean
        self._person = person

    def chosen(self, count: int) -> list[int]:
        return spread_views(self._person, count)

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> HumanScene:
        scene = self._scene(self._person.observe(views))
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
        images = [self._person.person.images[i] for i in views]
        maps = self._person.observe(views)
        rate = ADAPTING_RATE * len(views)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        for step in range(steps):
            scene = self._scene(maps)
            time_steps = [scene.time_step(image.time) for image in images]
            loss = _images_error(scene, time_steps, images, self.background, self.config)[0]
            if not updated(optimizer, self.network, loss, rate * (1.0 - step / steps)):
                break
            report("training on the images", step + 1, steps)
        return steps

    def run_config(self, views: Sequence[int]) -> Config:
        """Return the preset for one person, with the template of the network."""
        preset = load_config(packaged_preset("human"), ["data.root=."])
        same = ("body", "uv", "resolution", "near", "eps2d", "rasterize_mode", "sh_degree")
        given = human_options(self.section)
        human = preset.model.model_copy(update={name: getattr(given, name) for name in same})
        return preset.model_copy(update={"data": self.data, "model": human})

    def begin(self, model: Any, scene: Renderable, config: Config) -> None:
        assert isinstance(config.model, HumanModel)
        frames = self._person.person.motion.frames
        model.begin_with(scene, HumanTraining(config.model, frames, Rates(config.train.steps)))

    def _scene(self, maps: TexelMaps) -> HumanScene:
        return predict_avatar(self._person, maps, self.mean, self.network)


class AtlasLearner(Learner[AtlasNetwork]):
    """Predicted from one choice of images, compared with others of one time step."""

    def __init__(
        self,
        config: Config,
        network: AtlasNetwork,
        people: list[AtlasPerson],
        choices: list[list[list[int]]],
        mean: Tensor,
        device: torch.device = CPU,
    ) -> None:
        """``choices`` are views to predict each person from; their maps are kept."""
        super().__init__(config, network, [x.person.name for x in people], device)
        self.people = people
        self.choices = choices
        self.mean = mean
        self._moved = [fields_moved_to(x, device) for x in people]
        self._maps = cache(self._observed)

    def _observed(self, person: int, choice: int) -> TexelMaps:
        maps = self.people[person].observe(self.choices[person][choice])
        return fields_moved_to(maps, self.device)

    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        filmed = self.people[person].person
        choice = random_index(len(self.choices[person]), generator)
        targets = self._targets(filmed, self.choices[person][choice], generator)
        background = self.drawn_background(generator)
        maps = self._maps(person, choice)
        scene = predict_avatar(self._moved[person], maps, self.mean, self.network)
        row = filmed.motion.rows[-1 if targets[0].frame is None else targets[0].frame]
        gaussians, posing = scene.in_frame(row, scene.given_weights())
        frame = RestFrame(scene.gaussians.means, posing.rotations[0])
        moment = GaussianTimeStep(gaussians, targets[0].time, frame)
        loss, rendered, truth = _images_error(
            scene, [moment] * len(targets), targets, background, self.config
        )
        return Example(loss, targets[-1], rendered.detach(), truth, len(scene))

    def kept(self) -> dict[str, Tensor]:
        return {"mean": self.mean}

    def load(self, checkpoint: Checkpoint) -> None:
        mean = load_network(self.network, checkpoint, self.section.resolution)
        self.mean = mean.to(self.device)

    def _targets(
        self, person: Person, inputs: list[int], generator: torch.Generator
    ) -> list[Image]:
        """Return images of one time step that were not predicted from, where there are any."""
        views = person.views
        others = [i for i in range(len(views)) if i not in inputs] or inputs
        frame = views[others[random_index(len(others), generator)]].frame
        shown = [i for i in others if views[i].frame == frame]
        order = torch.randperm(len(shown), generator=generator, device="cpu").tolist()
        return [person.images[shown[i]].to(self.device) for i in order[:TARGET_VIEWS]]


def learner(config: Config, generator: torch.Generator) -> AtlasLearner:
    """Return the network of ``model.kind: human_predictor`` before the first step: captures read,
    nothing trained."""
    device = device_for(config.run.device)
    model: Any = config.model
    body = load_template(human_options(model))
    network = new_network(model, generator).to(device)
    people = [read_person(data, model, body) for data in captures_in(config.data)]
    choices = [_choices(person, model.source_views, generator) for person in people]
    mean = mean_colours(people, model.resolution).to(device)
    return AtlasLearner(config, network, people, choices, mean, device)


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
    network = new_network(model, torch.Generator())
    mean = load_network(network, checkpoint, model.resolution)
    data = with_fitted_body(data, human_options(model), only_if_needed=True, say=say, report=report)
    person = read_person(data, model, load_template(human_options(model)))
    return PersonPredictor(config, network, mean, person, data)


def new_network(model: HumanPredictorModel, generator: torch.Generator) -> AtlasNetwork:
    """Return the untrained network of ``model``."""
    factor = 2 ** len(WIDTHS)
    if model.resolution % factor:
        raise DyngsError(f"model.resolution={model.resolution} must be a multiple of {factor}")
    scaffolds = len(set(model.scaffold_heights))
    return AtlasNetwork(num_input_channels(scaffolds), scaffolds, generator)


def load_network(network: AtlasNetwork, checkpoint: Checkpoint, resolution: int) -> Tensor:
    """Return the mean colours (3, S, S) of a checkpoint, whose weights ``network`` takes; S is the
    ``resolution``."""
    load_weights(network, checkpoint)
    with reading(checkpoint.name, OTHER_CONFIG):
        mean = checkpoint.tensors["model.mean"]
        return require_tensor("mean", mean, (3, resolution, resolution))


def human_options(model: HumanPredictorModel) -> HumanModel:
    """Return the section of one person with the same template and texels; nothing of it is
    learned."""
    shared = ("body", "uv", "resolution")
    drawn = ("near", "eps2d", "rasterize_mode", "alpha_min", "transmittance_min")
    return HumanModel.model_validate(
        {"sh_degree": 0, "refine": False} | {name: getattr(model, name) for name in shared + drawn}
    )


def read_person(data: DataConfig, model: HumanPredictorModel, body: BodyTemplate) -> AtlasPerson:
    """Return the person of one capture."""
    capture = read_capture(data)
    images = ImageLoader(capture.splits["train"], data)
    return atlas_person(person_in(capture, body, images), model)


def mean_colours(people: list[AtlasPerson], resolution: int) -> Tensor:
    """Return (3, S, S) mean over people of the colours that their images show of the lowest
    scaffold.

    Where nobody is seen: the mean of all that is.
    """
    total = torch.zeros(3, resolution, resolution, device="cpu")
    count = torch.zeros(1, resolution, resolution, device="cpu")
    for person in people:
        maps = person.observe(spread_views(person, MEAN_VIEWS))
        is_seen = (maps.seen[0] > 0).float()[:, None]
        total += to_atlas(maps.rgb[0] * is_seen, person.texels)
        count += to_atlas(is_seen, person.texels)
    overall = total.sum((1, 2)) / count.sum().clamp_min(1)
    return torch.where(count > 0, total / count.clamp_min(1), overall[:, None, None])


def _choices(person: AtlasPerson, source_views: int, generator: torch.Generator) -> list[list[int]]:
    """Return views to predict from, of a random time step each: one at random, the others chosen to
    see much.

    Every other choice has fewer than ``source_views``, in turn each number from 1.
    """
    firsts = torch.randint(
        len(person.person.views), (SOURCE_SETS,), generator=generator, device="cpu"
    ).tolist()
    fewer = list(range(1, source_views)) or [source_views]
    counts = [fewer[i // 2 % len(fewer)] if i % 2 else source_views for i in range(SOURCE_SETS)]
    return [spread_views(person, count, first) for count, first in zip(counts, firsts, strict=True)]


def _images_error(
    scene: HumanScene,
    moments: Sequence[GaussianTimeStep],
    images: Sequence[Image],
    background: Tensor,
    config: Config,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the mean loss of renders of ``moments`` against images; the last render and its truth
    (H, W, 3)."""
    options = replace(render_options(config.model), nonfinite="trust")
    total = torch.zeros((), device=background.device)
    for image, moment in zip(images, moments, strict=True):
        drawn = scene.render(image.cameras, moment, options=options, background=background)
        rendered = drawn.rgb[0]
        truth = image.composite(background)
        difference = rendered - truth
        known = difference if image.mask is None else difference * image.mask[..., None]
        loss = image_loss(rendered, drawn.alpha[0], image, truth, config.train)
        total = total + (loss + SQUARED_WEIGHT * known.square().mean()) / len(images)
    return total, rendered, truth
