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


class ModelKind(ABC):
    """A kind of model.

    Attributes:
        section: class of its configuration.
        uses: keys of other sections, and sections, that have an effect on it; where one of these is
            given and not used, the run is refused. "init": it begins at the points of the capture.
    """

    uses: ClassVar[frozenset[str]] = frozenset({"train.minutes", "train.batch_size"})

    def __init__(self, section: type[ModelSection]) -> None:
        self.section = section

    @property
    def name(self) -> str:
        return self.section.model_fields["kind"].default

    def refusal(self, capture: Capture) -> str | None:
        """Return why it cannot be trained on ``capture``, to follow its folder and a colon; None:
        it can."""
        return None

    @abstractmethod
    def functions(self) -> tuple[Start, Restore]:
        """Import the model; return the function that returns it before the first step, and the one
        that returns the scene of a checkpoint (KeyError or ValueError: its tensors do not fit)."""

    def start(self, run: StartContext) -> Model[Any]:
        """Return the model before the first step."""
        return self.functions()[0](run)

    def restore(self, section: ModelSection, checkpoint: Checkpoint) -> Renderable:
        """Return the scene of a checkpoint. Raises KeyError or ValueError where its tensors do not
        fit."""
        return self.functions()[1](section, checkpoint)


class PredictsScenes(ModelKind):
    """A network that predicts scenes from a few images, and is trained on several captures."""

    uses: ClassVar[frozenset[str]] = frozenset()

    def functions(self) -> tuple[Start, Restore]:
        raise TypeError("a network has no scene; it is trained by its learner")

    def restore(self, section: ModelSection, checkpoint: Checkpoint) -> Renderable:
        raise DyngsError(
            f"{checkpoint.name}: a network, not a scene; `dyngs predict RUN CAPTURE --out RUN` makes one"
        )

    @abstractmethod
    def num_views(self, section: Any) -> int:
        """Return the number of images that it usually predicts from."""

    @abstractmethod
    def networks(self) -> tuple[MakeLearner, MakePredictor]:
        """Import the network; return the function that returns it in training before the first
        step, and the one that returns it with the weights of a checkpoint and with a capture."""


class HasGaussians(ModelKind):
    """Made of Gaussians, which a strategy adds and limits remove."""

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
    """Learning rates are higher in shorter runs, see ``optim.rate_factor``."""

    def with_added_gaussians(self, section: SceneModel, most: int) -> SceneModel:
        """Return the section with at most ``most`` Gaussians added beside the strategy."""
        return section


class HasSizeLimit(HasGaussians):
    """The size of its file follows from the number of its Gaussians."""

    def num_shared(self, section: Any, num_times: int, num_moving: int = 0) -> int:
        """Return the number of values that it learns next to those of its Gaussians."""
        return 0


class HasMotion(ModelKind):
    """Moves over the times of the capture, after a while as a static model."""


class HasSchedules(ModelKind):
    """A kind whose section has schedules that depend on the length of the run."""

    @abstractmethod
    def extend_schedules(self, section: Any, length: LengthChange) -> ModelSection:
        """Return the section for a run that goes on to another length. Raises DyngsError: it
        cannot."""


class HasBody(ModelKind):
    """A person, whose body is found and fitted in place of camera poses, and plays motions."""

    @abstractmethod
    def find_body(
        self,
        data: DataConfig,
        section: Any,
        log: Callable[[str], None],
        report: ProgressCallback,
    ) -> DataConfig:
        """Return the options of a capture with body parameters: found, and fitted to the
        silhouettes."""

    @abstractmethod
    def play_motion(
        self, section: Any, scene: Posable, info: CheckpointInfo, path: Path, *, keep_feet: bool
    ) -> PlayedMotion:
        """Return a person in the motion of a file (AMASS, SMPL-X, BVH, glTF or VRM animation).

        A file with ``scale`` is a fit to this person in the world of the capture; any other motion
        is adapted to the size, position and up direction of the person. With ``keep_feet`` the root
        moves so that feet on the floor stay where they are; a note says by how much they slide
        before and after. Raises DyngsError: the file cannot be read.
        """

    @abstractmethod
    def read_person(self, path: Path) -> tuple[SceneModel, Posable, CheckpointInfo]:
        """Return the person of an avatar file, with its section and its metadata. Raises
        DyngsError."""


@dataclass(frozen=True)
class PlayedMotion:
    """A person who plays the motion of a file."""

    scene: Posable
    fps: float
    notes: tuple[str, ...]


def find_kind(section: ModelSection) -> ModelKind:
    """Return the kind of a section of the configuration."""
    return cast(ModelKind, installed_kind(section.kind))


def capability(section: ModelSection, wanted: type[C]) -> C | None:
    """Return the kind of a section if it has a capability, else None."""
    kind = find_kind(section)
    return kind if isinstance(kind, wanted) else None
