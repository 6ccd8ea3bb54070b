"""Training of the network that predicts people from a few images, on captures of several (GHG, Kwon et al. 2024)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, HumanModel, HumanPredictorModel
from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError, reading
from dyngs.gaussians.scene import render_options
from dyngs.gaussians.schedule import Rates
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.avatar.training import HumanTraining
from dyngs.human.prediction.network import AtlasNetwork, PredictedAvatar, num_input_channels, predict_gaussians
from dyngs.human.prediction.person import CapturedPerson, captured_person, spread_views
from dyngs.human.prediction.texel_maps import TexelMaps, observe_texels, to_atlas
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.body_reader import load_template
from dyngs.models.checkpoint import OTHER_CONFIG, Checkpoint, CheckpointInfo
from dyngs.models.model import Predictor
from dyngs.models.renderable import Renderable, Rendering
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.device import CPU, device_for, sent
from dyngs.ops.loss import l1_ssim_loss
from dyngs.state import fields_moved_to
from dyngs.tensor_checks import require_tensor
from dyngs.training.events import StepReport
from dyngs.training.trainer import ViewSampler

SQUARED_WEIGHT = 1.0  # Weight of the mean squared error in the loss, which counts edges more
WARM_UP = 0.05  # Fraction of the run in which the highest learning rate is reached
WEIGHT_DECAY = 1e-5  # Weight decay of AdamW
MAX_GRADIENT = 1.0  # Norm to which gradients are clipped
MEAN_VIEWS = 8  # Images of each person that the mean colours are taken from
ADAPTING_RATE = 1e-4
"""Highest learning rate of Adam per image of one person, which falls linearly: a single one says little about the other
sides."""

_LOWEST = 1e-3  # Ratio of the last to the highest learning rate


@dataclass
class Filmed:
    """A person to train on: images, and the choices of those that are predicted from, with their maps once known."""

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
        return observe_texels(self.sitter, ((self.images[i], self.sitter.pose_in(self.sitter.views[i])) for i in views))


@dataclass
class PersonPredictor(Predictor):
    """A network that predicts the person of a capture."""

    config: Config
    model: HumanPredictorModel
    network: AtlasNetwork  # may be trained on images of the person before, see ``adapt``
    mean: Tensor  # (3, S, S) colours of the people that it was trained on
    person: Filmed  # with images

    @torch.no_grad()
    def predict(self, views: Sequence[int]) -> HumanScene:
        return self._scene(self.person.look(views))

    def adapt(self, views: Sequence[int], steps: int, report: ReportProgress = report_nothing) -> None:
        """Train the network until its prediction shows the images better that it is predicted from."""
        options = replace(render_options(self.model), nonfinite="trust")
        background = evaluation_background(self.config.data.background, True)[1]
        images, maps = [self.person.images[i] for i in views], self.person.look(views)
        rate = ADAPTING_RATE * len(views)
        optimizer = torch.optim.Adam(self.network.parameters(), lr=rate)
        for step in range(steps):
            scene, total = self._scene(maps), torch.zeros((), device=self.mean.device)
            for image in images:
                moment = scene.time_step(image.time)
                rendering = scene.render(image.cameras, moment, options=options, background=background)
                total = total + image_loss(rendering, image, image.composite(background), self.config) / len(images)
            if not _updated(optimizer, self.network, total, rate * (1.0 - step / steps)):
                break
            report("training on the images", step + 1, steps)

    def _scene(self, maps: TexelMaps) -> HumanScene:
        fraction = self.model.min_silhouette_fraction
        avatar = predict_gaussians(self.person.sitter, maps, self.mean, self.network, fraction)
        return scene_of(human_options(self.model), avatar, Rates(1))[0]


@dataclass
class NetworkTrainer:
    """A run in memory, as ``Trainer``."""

    config: Config
    model: HumanPredictorModel
    people: list[Filmed]
    network: AtlasNetwork
    mean: Tensor
    optimizer: torch.optim.AdamW
    sampler: ViewSampler
    background: str
    generator: torch.Generator
    done: int = 0
    num_gaussians: int = 0  # of the last person
    bad_gradients: int = 0
    has_test_views: bool = False
    device: torch.device = CPU  # of the network and the scenes that it predicts

    @property
    def num_moving(self) -> int:
        return self.num_gaussians

    def step(self) -> StepReport:
        """Train on one person: predicted from one choice of images, compared with others of one time step."""
        step = self.done + 1
        person = self.people[self.sampler.next(self.generator, lambda _: True)]
        choice = self._draw(len(person.choices))
        targets = self._targets(person, person.choices[choice])
        background = sent(background_colour(self.background, self.generator), self.device)
        drawing = replace(render_options(self.model), nonfinite="trust")
        sitter, maps = person.sitter_on(self.device), person.maps(choice, self.device)
        avatar = predict_gaussians(sitter, maps, self.mean, self.network, self.model.min_silhouette_fraction)
        scene, training = scene_of(human_options(self.model), avatar, Rates(1))
        moment = training.time_step(scene, targets[0], step)
        total = torch.zeros((), device=self.mean.device)
        for image in targets:
            rendering = scene.render(image.cameras, moment, options=drawing, background=background)
            truth = image.composite(background)
            total = total + image_loss(rendering, image, truth, self.config) / len(targets)
        value = float(total.detach())
        if not math.isfinite(value):
            raise DyngsError(f"step {step}, {sitter.name}: the loss is {value}; lower model.lr")
        self._update(total, step)
        self.done, self.num_gaussians = step, len(avatar.gaussians)
        return StepReport(step, value, image, rendering.rgb[0].detach(), truth)

    def checkpoint(self) -> Checkpoint:
        tensors = {f"model.network.{name}": x for name, x in self.network.state_dict().items()}
        tensors |= {"model.mean": self.mean, "rng": self.generator.get_state()}
        tensors |= {f"sampler.{name}": x for name, x in self.sampler.state().items()}
        for name, parameter in self.network.named_parameters():
            moments = self.optimizer.state.get(parameter, {})
            tensors |= {f"optimizer.{key}.{name}": x for key, x in moments.items()}
        mode = self.model.rasterize_mode.value
        info = CheckpointInfo(self.done, 1.0, (0.0, 0.0, 0.0), self.background, mode)
        return Checkpoint(info, {name: x.detach().cpu() for name, x in tensors.items()})

    def restore(self, checkpoint: Checkpoint) -> None:
        self.mean = load_network(self.network, checkpoint, self.model.resolution).to(self.device)
        with reading(checkpoint.name, OTHER_CONFIG):
            self.sampler.load_state(checkpoint.part("sampler"))
            self.generator.set_state(checkpoint.tensors["rng"])
            for name, parameter in self.network.named_parameters():
                shapes = {"step": (), "exp_avg": tuple(parameter.shape), "exp_avg_sq": tuple(parameter.shape)}
                self.optimizer.state[parameter] = {
                    key: require_tensor(name, checkpoint.tensors[f"optimizer.{key}.{name}"], shape).to(
                        CPU if key == "step" else self.device, copy=True
                    )
                    for key, shape in shapes.items()
                }
        self.done = checkpoint.info.step

    def _targets(self, person: Filmed, inputs: list[int]) -> list[Image]:
        """Return images of one time step that were not predicted from, where there are any."""
        views = person.sitter.views
        others = [i for i in range(len(views)) if i not in inputs] or inputs
        frame = views[others[self._draw(len(others))]].frame
        shown = [i for i in others if views[i].frame == frame]
        order = torch.randperm(len(shown), generator=self.generator, device="cpu").tolist()
        return [person.images[shown[i]].to(self.device) for i in order[: self.model.target_views]]

    def _update(self, loss: Tensor, step: int) -> None:
        rate = rate_at(self.model, step, self.config.train.steps)
        self.bad_gradients += not _updated(self.optimizer, self.network, loss, rate)

    def _draw(self, count: int) -> int:
        return int(torch.randint(count, (1,), generator=self.generator, device="cpu"))


def _updated(optimizer: torch.optim.Optimizer, network: AtlasNetwork, loss: Tensor, rate: float) -> bool:
    """Do a step at the learning rate ``rate``; return False, and do none, for gradients that are not finite."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    if not bool(torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT).isfinite()):
        return False
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.step()
    return True


def image_loss(rendering: Rendering, image: Image, truth: Tensor, config: Config) -> Tensor:
    """Return the loss of a rendering of one view against ``truth`` (H, W, 3), the image on the same background."""
    options, model = config.train, config.model
    loss = l1_ssim_loss(rendering.rgb[0], truth, options.ssim_weight, image.mask)
    if isinstance(model, HumanPredictorModel):
        difference = rendering.rgb[0] - truth
        known = difference if image.mask is None else difference * image.mask[..., None]
        loss = loss + SQUARED_WEIGHT * known.square().mean()
    if options.alpha_weight and image.alpha is not None:
        loss = loss + options.alpha_weight * (rendering.alpha[0] - image.alpha).abs().mean()
    return loss


def trainer(config: Config) -> NetworkTrainer:
    """Return the trainer of ``model.kind: human_predictor``: captures read, nothing trained."""
    device, model = device_for(config.run.device), config.model
    if not isinstance(model, HumanPredictorModel):
        raise TypeError(f"not a network: {model!r}")
    body, generator = load_template(human_options(model)), torch.Generator().manual_seed(config.run.seed)
    network = new_network(model, generator).to(device)
    people = [filmed(data, model, body) for data in captures_in(config.data)]
    for person in people:
        person.choices = _choices(person.sitter, model, generator)
    background = config.data.background
    return NetworkTrainer(
        config=config,
        model=model,
        people=people,
        network=network,
        mean=mean_colours(people, model.resolution).to(device),
        optimizer=torch.optim.AdamW(network.parameters(), lr=model.lr, weight_decay=WEIGHT_DECAY),
        sampler=ViewSampler(len(people)),
        background=background if background == "random" else evaluation_background(background, True)[0],
        generator=generator,
        device=device,
    )


def restore(_: HumanPredictorModel, checkpoint: Checkpoint) -> Renderable:
    """Raise DyngsError: a network is no scene."""
    raise DyngsError(f"{checkpoint.name}: a network, not a scene; `dyngs predict RUN CAPTURE --out RUN` makes one")


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
    """Return the mean colours (3, S, S) of a checkpoint, whose weights ``network`` takes; S is the ``resolution``."""
    weights, mean = checkpoint.part("model.network"), checkpoint.tensors.get("model.mean")
    own = network.state_dict()
    if mean is None or {k: x.shape for k, x in weights.items()} != {k: x.shape for k, x in own.items()}:
        raise DyngsError(f"{checkpoint.name} is not of this network; was its config changed?")
    with reading(checkpoint.name, OTHER_CONFIG):
        for name, x in weights.items():
            require_tensor(name, x, tuple(x.shape), own[name].dtype)
        network.load_state_dict(weights)
        return require_tensor("mean", mean, (3, resolution, resolution))


def human_options(model: HumanPredictorModel) -> HumanModel:
    """Return the section of one person with the same template and texels; nothing of it is learned."""
    shared = ("body", "uv", "resolution")
    drawn = ("near", "eps2d", "rasterize_mode", "alpha_min", "transmittance_min")
    none = {"refine": False, "offset_weight": 0, "scale_weight": 0, "rigidity": 0, "smoothness": 0}
    return HumanModel.model_validate({"sh_degree": 0, **none} | {name: getattr(model, name) for name in shared + drawn})


def captures_in(data: DataConfig) -> list[DataConfig]:
    """Return the paths of the captures in the folders of ``data.root``, by name."""
    root = data.root
    folders = sorted(f for f in root.iterdir() if f.is_dir() and not f.name.startswith(".")) if root.is_dir() else []
    if not folders:
        raise DyngsError(f"{root}: holds no folders; give one that holds a capture of a person in each of its folders")
    return [data.model_copy(update={"root": folder}) for folder in folders]


def filmed(data: DataConfig, model: HumanPredictorModel, body: BodyTemplate) -> Filmed:
    """Return the person of one capture, without choices of images."""
    capture = read_capture(data)
    return Filmed(captured_person(capture, model, body), ImageLoader(capture.splits["train"], data), [])


def mean_colours(people: list[Filmed], resolution: int) -> Tensor:
    """Return (3, S, S) mean over people of the colours that their images show of the lowest scaffold.

    Where nobody is seen: the mean of all that is.
    """
    total, count = (
        torch.zeros(3, resolution, resolution, device="cpu"),
        torch.zeros(1, resolution, resolution, device="cpu"),
    )
    for person in people:
        sitter = person.sitter
        maps = person.look(spread_views(sitter, MEAN_VIEWS))
        is_seen = (maps.seen[0] > 0).float()[:, None]
        total += to_atlas(maps.rgb[0] * is_seen, sitter.texels)
        count += to_atlas(is_seen, sitter.texels)
    overall = total.sum((1, 2)) / count.sum().clamp_min(1)
    return torch.where(count > 0, total / count.clamp_min(1), overall[:, None, None])


def rate_at(model: HumanPredictorModel, step: int, steps: int) -> float:
    """Return the learning rate of AdamW: a linear rise, then a linear fall (one cycle; Smith and Topin 2017)."""
    top = max(1, round(WARM_UP * steps))
    fraction = step / top if step <= top else (steps - step) / max(steps - top, 1)
    return model.lr * max(fraction, _LOWEST)


def _choices(sitter: CapturedPerson, model: HumanPredictorModel, generator: torch.Generator) -> list[list[int]]:
    """Return views to predict from, of a random time step each: one at random, the others chosen to see much.

    Every other choice has fewer than ``model.source_views``, in turn each number from 1.
    """
    firsts = torch.randint(len(sitter.views), (model.source_sets,), generator=generator, device="cpu").tolist()
    fewer = list(range(1, model.source_views)) or [model.source_views]
    counts = [fewer[i // 2 % len(fewer)] if i % 2 else model.source_views for i in range(len(firsts))]
    return [spread_views(sitter, count, first) for count, first in zip(counts, firsts, strict=True)]


def scene_of(model: HumanModel, avatar: PredictedAvatar, rates: Rates) -> tuple[HumanScene, HumanTraining]:
    """Return a predicted avatar as a scene, and how it is trained on."""
    training = HumanTraining(model, avatar.subject.motion.frames, rates)
    return training.first_scene(avatar.gaussians, avatar.subject), training
