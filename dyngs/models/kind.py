"""Kinds of model: what the rest of dyngs may ask of one.

A kind is one object (``ModelKind``), named by an entry point (``dyngs.config.kinds``). What only
some kinds can do is a capability: a class below that the kind is derived from. Code outside a
kind's package asks for a capability (``capability(config.model, Predicts)``), never for a kind.

A module of a kind imports its section alone; its methods import models when they are called, so
that reading a configuration stays cheap.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

from dyngs.config.kinds import installed_kind
from dyngs.core.conventions import ProgressCallback
from dyngs.core.errors import DyngsError
from dyngs.core.section import ModelSection, SceneModel

if TYPE_CHECKING:
    from pathlib import Path

    import torch

    from dyngs.config import Config, DataConfig
    from dyngs.data.capture import Capture
    from dyngs.data.loader import ImageLoader
    from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
    from dyngs.models.model import Model
    from dyngs.models.prediction import Learner, Predictor
    from dyngs.models.renderable import Posable, Renderable
    from dyngs.models.schedule import LengthChange

    Start = Callable[["StartContext"], Model[Any]]
    Restore = Callable[[Any, Checkpoint], Renderable]
    MakeLearner = Callable[[Config, torch.Generator], Learner[Any]]
    MakePredictor = Callable[
        [Config, Checkpoint, DataConfig, Callable[[str], None], ProgressCallback], Predictor
    ]

C = TypeVar("C", bound="ModelKind")


@dataclass(frozen=True)
class StartContext:
    """Inputs from which a kind builds its model before the first step."""

    config: Config
    # config before limits are applied: a run may start with more Gaussians than it may end with
    uncapped: Config
    capture: Capture  # training capture with initial points
    images: ImageLoader
    background: str
    extent: float
    generator: torch.Generator
    # ``FirstGaussians`` that it goes on from; None: it begins as ``config.init`` says
    first: Any = None


class ModelKind(ABC):
    """A kind of model.

    Attributes:
        section: class of its config section.
        uses: keys of other sections, or whole sections, that affect this kind; a run that sets an
            unused one is refused.
    """

    uses: ClassVar[frozenset[str]] = frozenset(
        {"train.minutes", "train.batch_size", "train.image_every"}
    )

    def __init__(self, section: type[ModelSection]) -> None:
        self.section = section

    @property
    def name(self) -> str:
        return self.section.model_fields["kind"].default

    def refusal(self, capture: Capture) -> str | None:
        """Return why the kind cannot be trained on ``capture``; None if it can."""
        return None

    @abstractmethod
    def functions(self) -> tuple[Start, Restore]:
        """Import the model; return the functions behind ``start`` and ``restore``."""

    def start(self, run: StartContext) -> Model[Any]:
        """Return the model before the first step."""
        return self.functions()[0](run)

    def restore(self, section: ModelSection, checkpoint: Checkpoint) -> Renderable:
        """Restore the scene of a checkpoint. Raises KeyError or ValueError for invalid tensors."""
        return self.functions()[1](section, checkpoint)


class PredictsScenes(ModelKind):
    """Capability: a network that predicts scenes from images, trained on several captures."""

    uses: ClassVar[frozenset[str]] = frozenset()

    def functions(self) -> tuple[Start, Restore]:
        raise TypeError("a network has no scene; it is trained by its learner")

    def restore(self, section: ModelSection, checkpoint: Checkpoint) -> Renderable:
        raise DyngsError(
            f"{checkpoint.name}: a network, not a scene; use `dyngs predict RUN CAPTURE --out RUN`"
        )

    @abstractmethod
    def num_views(self, section: Any) -> int:
        """Return the default number of source images."""

    @abstractmethod
    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        """Import the network; return the factories of its learner and of its predictor."""


class HasGaussians(ModelKind):
    """Capability: made of Gaussians, with densification, pruning and limits."""

    uses: ClassVar[frozenset[str]] = ModelKind.uses | {
        "init",
        "camera.refine",
        "train.exposure",
        "train.robust",
        "train.priors",
        "budget.max_gaussians",
        "budget.max_mb",
        "prune.fraction",
        "prune.mask_times",
    }
    speeds_up_short_runs: ClassVar[bool] = False
    """Whether shorter runs use higher learning rates, see ``optim.rate_factor``."""

    def rate_factor(self, section: Any) -> float:
        """Return the factor on the published learning rates in runs of any length."""
        return 1.0

    def with_added_gaussians(self, section: SceneModel, most: int) -> SceneModel:
        """Return the section with at most ``most`` Gaussians added outside of the strategy."""
        return section


class HasSizeLimit(HasGaussians):
    """Capability: the file size follows from the number of Gaussians."""

    def num_shared(self, section: Any, num_times: int, num_moving: int = 0) -> int:
        """Return the number of learned values that are not per Gaussian."""
        return 0


class HasMotion(ModelKind):
    """Capability: moves over time, after a static first phase of training."""


class HasSchedules(ModelKind):
    """Capability: the section has schedules that depend on the length of the run."""

    @abstractmethod
    def extend_schedules(self, section: Any, length: LengthChange) -> ModelSection:
        """Return the section for an extended run. Raises DyngsError if it cannot be extended."""


class HasBody(ModelKind):
    """Capability: a person, whose body is detected, fitted and animated."""

    @abstractmethod
    def find_body(
        self,
        data: DataConfig,
        section: Any,
        log: Callable[[str], None],
        report: ProgressCallback,
    ) -> DataConfig:
        """Detect and fit the body if the capture has no body parameters; return its data config."""

    @abstractmethod
    def copy_pictures(self, data: DataConfig, folder: Path) -> None:
        """Copy the pictures of detection and fit to a new folder, if there are any."""

    @abstractmethod
    def write_avatar_picture(self, scene: Any, folder: Path) -> Path:
        """Write a picture of the trained person to a folder; return its path."""

    @abstractmethod
    def play_motion(
        self, section: Any, scene: Posable, info: CheckpointInfo, path: Path
    ) -> PlayedMotion:
        """Animate a person by a motion file (AMASS, SMPL-X, BVH, glTF or VRM animation).

        Motions are adapted to the size, position and up direction of the person, except files with
        ``scale``, which are fits in the world of the capture. Raises DyngsError: an unreadable
        file.
        """

    @abstractmethod
    def read_person(self, path: Path) -> tuple[SceneModel, Posable, CheckpointInfo]:
        """Load an avatar file: config section, person and metadata. Raises DyngsError."""


@dataclass(frozen=True)
class PlayedMotion:
    """A person animated by a motion file."""

    scene: Posable
    fps: float
    notes: tuple[str, ...]


def find_kind(section: ModelSection) -> ModelKind:
    """Return the kind of a section ``model``."""
    return cast(ModelKind, installed_kind(section.kind))


def capability(section: ModelSection, wanted: type[C]) -> C | None:
    """Return the kind of a section if it has the capability ``wanted``, else None."""
    kind = find_kind(section)
    return kind if isinstance(kind, wanted) else None
