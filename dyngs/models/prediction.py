"""Networks that predict scenes: their training, their use, and parts that several share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from dyngs.config import Config, DataConfig, TrainConfig
from dyngs.core.conventions import ProgressCallback
from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.core.tensor_checks import require_tensor
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.data.read import list_captures
from dyngs.data.times import distinct_times
from dyngs.models.checkpoint import CONFIG_ADVICE, Checkpoint
from dyngs.models.model import Model
from dyngs.models.renderable import Renderable
from dyngs.models.views import background_colour, evaluation_background
from dyngs.ops.device import CPU, copy_async, select_device
from dyngs.ops.loss import l1_ssim_loss

GROUPS = 8
"""Groups of channels that are normalised together (Wu and He 2018)."""


class ResidualBlock(nn.Module):
    """Residual block of two convolutions (B, ``width``, H, W), normalised before each (He et al.
    2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.GroupNorm(GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)),
            *(nn.GroupNorm(GROUPS, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)),
        )

    def forward(self, features: Tensor) -> Tensor:
        return features + self.layers(features)


class Encoder(nn.Module):
    """Features (B, C, ...) of images at 1/2, 1/4, ... of their resolution."""

    def __init__(self, channels: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(before, width, 5 if i == 0 else 3, 2, 2 if i == 0 else 1),
                ResidualBlock(width),
            )
            for i, (before, width) in enumerate(zip((channels, *widths), widths, strict=False))
        )

    def levels(self, images: Tensor) -> list[Tensor]:
        """Return the images, and their features from fine to coarse."""
        found = [images]
        for layer in self.down:
            found.append(layer(found[-1]))
        return found

    def forward(self, images: Tensor) -> list[Tensor]:
        return self.levels(images)[1:]


def upsample(features: Tensor) -> Tensor:
    """Return features (B, C, H, W) at twice the resolution, bilinear."""
    return nn.functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)


def initialize_weights(network: nn.Module, generator: torch.Generator) -> None:
    """Draw the weights of all convolutions (He et al. 2015) from ``generator``, on the CPU; biases
    are 0."""
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)


N = TypeVar("N", bound=nn.Module)
P = TypeVar("P")

MAX_GRADIENT = 1.0  # Norm to which gradients are clipped
MOST_OPEN = 64  # People whose captures are kept open


class Predictor(ABC, Generic[N]):
    """A trained network with the capture of one person.

    Attributes:
        views: that can be predicted from.
        data: how the capture is read, with its body.
    """

    def __init__(self, config: Config, network: N, views: Sequence[View], data: DataConfig) -> None:
        self.config = config
        self.section: Any = config.model
        self.network = network
        self.views = tuple(views)
        self.data = data

    @property
    def name(self) -> str:
        """Name of the capture, for messages."""
        return self.data.root.name

    @property
    def background(self) -> Tensor:
        """(3,) colour behind predictions."""
        return evaluation_background(self.config.data.background, True)[1]

    @abstractmethod
    def chosen(self, count: int) -> list[int]:
        """Return the indices of ``count`` of the views that suit a prediction."""

    def adapt(self, views: Sequence[int], steps: int | None, report: ProgressCallback) -> int:
        """Train the network for ``steps`` on these images alone, None: as many as usual; return how
        many these were."""
        if steps:
            kind = self.config.model.kind
            raise DyngsError(
                f"--steps {steps}: {kind} is not trained on the images of one person; leave it out"
            )
        return 0

    @abstractmethod
    def predict(self, views: Sequence[int]) -> Renderable:
        """Return the scene that these views show. Raises DyngsError: they do not suit, one line
        that says why."""

    @abstractmethod
    def run_config(self, views: Sequence[int]) -> Config:
        """Return the configuration of the run that the scene becomes, which training can refine."""

    def data_at_time(self, time: float | None, views: Iterable[View]) -> DataConfig:
        """Return the options of the time step of all ``views`` that is nearest to ``time``; None:
        as given."""
        moments = sorted(set(distinct_times(views).values()))
        if time is None or len(moments) < 2:
            return self.data
        row = min(range(len(moments)), key=lambda i: abs(moments[i] - time))
        return self.data.model_copy(update={"frames": f"{row}:{row + 1}"})

    @abstractmethod
    def begin(self, model: Model[Any], scene: Renderable, config: Config) -> None:
        """Let training of ``model``, of that ``config``, begin with ``scene``."""


@dataclass(frozen=True)
class Example:
    """Prediction of a network in training and its ground truth."""

    loss: Tensor  # (), differentiable
    image: Image  # that the prediction was compared with last
    # rendered, truth: (H, W, 3) on the same background
    rendered: Tensor
    truth: Tensor
    num_gaussians: int = 0
    scores: dict[str, float] = field(default_factory=dict)  # further ones, for the log


class Learner(ABC, Generic[N]):
    """A network in training and the people that it is trained on.

    Attributes:
        network: its weights are learned.
        lr: highest learning rate of AdamW.
        names: of the people.
        background: "white", "black" or "random".
    """

    def __init__(
        self,
        config: Config,
        network: N,
        names: Sequence[str],
        device: torch.device = CPU,
    ) -> None:
        self.config = config
        self.section: Any = config.model
        self.network = network
        self.names = names
        self.device = device
        self.lr: float = self.section.lr
        chosen = config.data.background
        self.background = chosen if chosen == "random" else evaluation_background(chosen, True)[0]

    def sample_background(self, generator: torch.Generator) -> Tensor:
        """Return the colour (3,) behind an example."""
        return copy_async(background_colour(self.background, generator), self.device)

    @abstractmethod
    def example(self, person: int, step: int, generator: torch.Generator) -> Example:
        """Return a prediction of a person; random numbers come from ``generator``, on the CPU."""

    def kept(self) -> dict[str, Tensor]:
        """Return what is stored next to the weights."""
        return {}

    def load(self, checkpoint: Checkpoint) -> None:
        """Take over weights, and what is stored next to them. Raises DyngsError."""
        load_weights(self.network, checkpoint)


class CaptureLearner(Learner[N], Generic[N, P]):
    """Learner on captures that stay open: the last ``MOST_OPEN`` that were used."""

    def __init__(self, config: Config, network: N) -> None:
        people = list_captures(config.data)
        device = select_device(config.run.device)
        names = [person.root.name for person in people]
        super().__init__(config, network.to(device), names, device)
        self.opened = lru_cache(MOST_OPEN)(lambda person: self.open_person(people[person]))
        self.opened(0)  # captures of another kind fail before training

    @abstractmethod
    def open_person(self, data: DataConfig) -> P:
        """Read a capture. Raises DyngsError: it does not suit."""


def random_index(count: int, generator: torch.Generator) -> int:
    """Return a random whole number below ``count``, the same on every device; ``generator`` is of
    the CPU."""
    return int(torch.randint(count, (1,), generator=generator, device="cpu"))


def random_item(items: Sequence[P], generator: torch.Generator) -> P:
    """Return one of ``items``, see ``random_index``."""
    return items[random_index(len(items), generator)]


def load_weights(network: nn.Module, checkpoint: Checkpoint, part: str = "model.network") -> None:
    """Let ``network`` take the weights in a part of a checkpoint. Raises DyngsError: of another
    network, or damaged."""
    weights = checkpoint.part(part)
    own = network.state_dict()
    if {k: x.shape for k, x in weights.items()} != {k: x.shape for k, x in own.items()}:
        raise DyngsError(f"{checkpoint.name} is not of this network; was its config changed?")
    with wrap_read_errors(checkpoint.name, CONFIG_ADVICE):
        for name, x in weights.items():
            require_tensor(name, x, tuple(x.shape), own[name].dtype)
        network.load_state_dict(weights)


def image_loss(
    rendered: Tensor, alpha: Tensor, image: Image, truth: Tensor, options: TrainConfig
) -> Tensor:
    """Return L1 and D-SSIM of ``rendered`` (H, W, 3) against ``truth``, and the weighted error of
    ``alpha`` (H, W)."""
    loss = l1_ssim_loss(rendered, truth, options.ssim_weight, image.mask)
    if options.alpha_weight and image.alpha is not None:
        loss = loss + options.alpha_weight * (alpha - image.alpha).abs().mean()
    return loss


def optimizer_step(
    optimizer: torch.optim.Optimizer, network: nn.Module, loss: Tensor, rate: float
) -> bool:
    """Do a step at the learning rate ``rate``; return False, and do none, for gradients that are
    not finite."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    if not bool(torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT).isfinite()):
        return False
    for group in optimizer.param_groups:
        group["lr"] = rate
    optimizer.step()
    return True


def optimizer_state(optimizer: torch.optim.Optimizer, network: nn.Module) -> dict[str, Tensor]:
    """Return the moments of Adam by parameter; one that had no gradient yet has none."""
    states = {name: optimizer.state.get(x, {}) for name, x in network.named_parameters()}
    return {f"{key}.{name}": x for name, state in states.items() for key, x in state.items()}


def load_optimizer(
    optimizer: torch.optim.Optimizer, network: nn.Module, state: dict[str, Tensor]
) -> None:
    """Take over the moments of Adam. Raises KeyError or ValueError: a state that does not fit."""
    for name, parameter in network.named_parameters():
        shapes = {
            "step": (),
            "exp_avg": tuple(parameter.shape),
            "exp_avg_sq": tuple(parameter.shape),
        }
        if not any(f"{key}.{name}" in state for key in shapes):
            continue
        optimizer.state[parameter] = {
            key: require_tensor(name, state[f"{key}.{name}"], shape).to(
                CPU if key == "step" else parameter.device, copy=True
            )
            for key, shape in shapes.items()
        }


def find_views(capture: str, views: Sequence[View], names: Sequence[str]) -> list[int]:
    """Return the indices of the views with these names, or with images of these file names.

    Raises DyngsError: an unknown name, or the same view twice.
    """
    files = [view.image_path.name for view in views]
    known = {name: i for i, name in enumerate(files) if files.count(name) == 1}
    known |= {view.name: i for i, view in enumerate(views)}
    for name in names:
        if name not in known:
            raise DyngsError(
                f"{capture}: no training view is named {name!r}; the first is {views[0].name!r}"
            )
    found = [known[name] for name in names]
    if len(set(found)) < len(found):
        raise DyngsError(f"{capture}: a view is named twice; name each once")
    return found
