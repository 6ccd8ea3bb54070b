"""All sections together: ``Config``, everything that decides a run, and those of its sections that
are short."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import BeforeValidator, Field, SerializeAsAny
from pydantic_core import PydanticCustomError

from dyngs.config.keys.colour import AutoColour, NetworkColour, ShColour
from dyngs.config.keys.data import DataConfig
from dyngs.config.keys.start import PointsInit, RandomInit, SceneInit
from dyngs.config.keys.strategy import DefaultStrategy, OptimConfig, Strategy
from dyngs.config.keys.train import TrainConfig
from dyngs.config.kinds import section_of_kind
from dyngs.core.section import ModelSection, SceneModel, Section


def _model_section(value: object) -> object:
    """Return ``value`` as the section of the kind that it names; sections are returned unchanged."""
    if not isinstance(value, dict):
        return value
    given = cast("dict[str, Any]", value)
    try:
        section = section_of_kind(given.get("kind", "static"))
    except KeyError:
        raise PydanticCustomError("union_tag_invalid", "no such kind of model") from None
    return section.model_validate(given)


if TYPE_CHECKING:
    AnyModel = SceneModel
else:
    AnyModel = SerializeAsAny[ModelSection]


def _still() -> AnyModel:
    return cast(SceneModel, section_of_kind("static")())


class CameraConfig(Section):
    """Whether the cameras of a capture are taken as they are."""

    refine: Literal["never", "auto", "always"] = Field(
        default="never",
        description="correct poses, focal lengths and principal points of the training views while the scene is "
        "trained; of Gaussians alone, not of people; auto: where two small runs beforehand say that it pays",
    )


class PruneConfig(Section):
    """A last stage with fewer Gaussians, after ``train.steps``; off by default.

    Guide: docs/guides/smaller-and-faster.md.
    """

    fraction: float = Field(
        default=0.0, ge=0, lt=1, description="fraction of the Gaussians to remove; 0: none"
    )
    score: Literal["variation", "sensitivity", "contribution"] = Field(
        default="sensitivity",
        description="importance of a Gaussian (`dyngs docs smaller-and-faster`); the lowest are removed",
    )
    mask_times: int = Field(
        default=0,
        ge=0,
        description="key times of masks over time (4DGS-1K), which leave out what hardly shows then; 0, 1: none",
    )
    steps: int = Field(default=2000, ge=1, description="steps of fine-tuning after pruning")

    @property
    def is_enabled(self) -> bool:
        return self.fraction > 0 or self.mask_times > 1


class BudgetConfig(Section):
    """Limits that a run keeps (docs/reference/limits.md); null: none."""

    max_gaussians: int | None = Field(
        default=None, ge=1, description="most Gaussians at the end of the run"
    )
    max_mb: float | None = Field(
        default=None,
        gt=0,
        description="largest size of `export/scene.dyngs`, 1e6 bytes; the file is then written",
    )


class RunConfig(Section):
    """Where the run goes and how it is executed."""

    name: str = Field(default="static", description="name of the run; names its folder")
    dir: Path | None = Field(default=None, description="run folder; null: runs/NAME")
    seed: int = Field(default=42, ge=0, lt=2**63, description="seed of all random numbers")
    threads: int = Field(default=0, ge=0, le=1024, description="CPU threads; 0: one per core")
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto",
        description="what computes; auto: a CUDA GPU that can be used (`dyngs docs gpu`), else the CPU",
    )
    deterministic: bool = Field(
        default=True,
        description="on a GPU: the same bytes on every run; false may be faster (the CPU's always are)",
    )


class Config(Section):
    """Everything that decides a run."""

    data: DataConfig
    camera: CameraConfig = CameraConfig()
    model: Annotated[
        AnyModel, BeforeValidator(_model_section), Field(description="what is trained")
    ] = Field(default_factory=_still)
    init: Annotated[
        PointsInit | RandomInit | SceneInit,
        Field(discriminator="kind", description="where the first Gaussians come from"),
    ] = PointsInit()
    colour: Annotated[
        ShColour | NetworkColour | AutoColour,
        Field(discriminator="kind", description="what colours are made of"),
    ] = ShColour()
    strategy: Annotated[
        Strategy,
        Field(
            discriminator="kind", description="how Gaussians are added and removed during training"
        ),
    ] = DefaultStrategy()
    optim: OptimConfig = OptimConfig()
    train: TrainConfig = TrainConfig()
    prune: PruneConfig = PruneConfig()
    budget: BudgetConfig = BudgetConfig()
    run: RunConfig = RunConfig()

    @property
    def total_steps(self) -> int:
        return self.train.steps + (self.prune.steps if self.prune.is_enabled else 0)

    @property
    def stored_sh_degree(self) -> int:
        return self.colour.stored_degree(self.model.sh_degree)
