"""``Config``, the complete configuration of a run, and its short sections."""

from __future__ import annotations

from collections.abc import Mapping
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
    """Validate a mapping as the section of its ``kind``; return sections unchanged."""
    if not isinstance(value, dict):
        return value
    given = cast("dict[str, Any]", value)
    try:
        section = section_of_kind(given.get("kind", "static"))
    except KeyError:
        raise PydanticCustomError("union_tag_invalid", "unknown kind of model") from None
    return section.model_validate(given)


if TYPE_CHECKING:
    AnyModel = SceneModel
else:
    AnyModel = SerializeAsAny[ModelSection]


def _default_model() -> AnyModel:
    return cast(SceneModel, section_of_kind("static")())


class CameraConfig(Section):
    """Refinement of the cameras."""

    refine: Literal["never", "always"] = Field(
        default="never",
        description="whether to refine poses, focal lengths and principal points of the training "
        "views during training; only for scenes of Gaussians",
    )


class PruneConfig(Section):
    """Pruning and fine-tuning after ``train.steps``; off by default."""

    fraction: float = Field(
        default=0.0, ge=0, lt=1, description="fraction of the Gaussians to remove; 0: none"
    )
    score: Literal["sensitivity", "contribution", "temporal", "variation"] = Field(
        default="sensitivity",
        description="importance score (`dyngs docs motion`); the Gaussians with the lowest scores "
        "are removed",
    )
    signed: bool = Field(
        default=False,
        description="whether `temporal` and `variation` use the second derivative of the opacity "
        "with its sign; false: its magnitude",
    )
    mask_times: int = Field(
        default=0,
        ge=0,
        description="number of key times of the visibility masks (4DGS-1K), which skip Gaussians "
        "that hardly contribute at a time; 0 or 1: no masks",
    )
    mask_between: bool = Field(
        default=True,
        description="whether masks keep Gaussians that are visible only between key times; false: "
        "as in 4DGS-1K",
    )
    steps: int = Field(default=2000, ge=1, description="number of fine-tuning steps after pruning")

    @property
    def is_enabled(self) -> bool:
        return self.fraction > 0 or self.mask_times > 1


class BudgetConfig(Section):
    """Limits of a run; null: no limit."""

    max_gaussians: int | None = Field(
        default=None, ge=1, description="maximum number of Gaussians at the end of the run"
    )
    max_mb: float | None = Field(
        default=None,
        gt=0,
        description="maximum size of the exported file `export/scene.dyngs`, 1e6 bytes; null: no "
        "file is written",
    )


class RunConfig(Section):
    """Output folder and execution of a run."""

    name: str = Field(
        default="static",
        description="name of the run; if you set it, the default folder is runs/NAME",
    )
    dir: Path | None = Field(
        default=None,
        description="run folder; null: runs/CAPTURE-NAME, which continues a run of the same keys, "
        "or else runs/CAPTURE-NAME-2, ...",
    )
    seed: int = Field(default=42, ge=0, lt=2**63, description="seed of all random numbers")
    threads: int = Field(
        default=0, ge=0, le=1024, description="number of CPU threads; 0: one per core"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        default="auto",
        description="device to train on; auto: a supported CUDA GPU if there is one, else the CPU",
    )
    deterministic: bool = Field(
        default=True,
        description="whether runs on a GPU are reproducible to the byte; false may be faster; runs "
        "on the CPU always are",
    )


class Config(Section):
    """Complete configuration of a run, see ``dyngs config`` for its keys.

    Example:

        import dyngs

        config = dyngs.load_config("static", {"data.root": "lego"})
        config.train.steps, config.replace({"train.steps": 60_000}).train.steps
    """

    data: DataConfig
    camera: CameraConfig = CameraConfig()
    model: Annotated[
        AnyModel, BeforeValidator(_model_section), Field(description="model to train")
    ] = Field(default_factory=_default_model)
    init: Annotated[
        PointsInit | RandomInit | SceneInit,
        Field(discriminator="kind", description="source of the initial Gaussians"),
    ] = PointsInit()
    colour: Annotated[
        ShColour | NetworkColour | AutoColour,
        Field(discriminator="kind", description="colour representation"),
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

    def replace(self, changes: Mapping[str, Any] | None = None, /, **keys: Any) -> Config:
        """Return a validated copy with some values changed.

        Example:

            import dyngs

            config = dyngs.load_config("static", {"data.root": "lego"})
            longer = config.replace(**{"train.steps": 60_000, "strategy.kind": "mcmc"})
            same = config.replace(train={"steps": 60_000}, strategy={"kind": "mcmc"})

        Args:
            changes: values by dotted key, or nested mappings. A changed ``kind`` resets its
                section to the defaults of that kind.
            keys: more of them.

        Raises:
            DyngsError: an unknown key or invalid value; the message has similar keys or the
                allowed values.
        """
        from dyngs.config.io import replace_config

        return replace_config(self, {**(changes or {}), **keys})

    @property
    def total_steps(self) -> int:
        return self.train.steps + (self.prune.steps if self.prune.is_enabled else 0)

    @property
    def stored_sh_degree(self) -> int:
        return self.colour.stored_degree(self.model.sh_degree)
