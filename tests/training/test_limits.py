"""Limits on the number of Gaussians: never exceeded, and refused where they cannot be kept."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_fields import tiny_options

from dyngs.api.train import train
from dyngs.config import (
    BudgetConfig,
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    PruneConfig,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.deform.keys import DynamicModel
from dyngs.human.keys import HumanPredictorModel
from dyngs.static.keys import StaticModel
from dyngs.training.limits import require_possible, room, within_cap
from dyngs.training.new_trainer import assemble
from dyngs.training.trainer import Trainer

NOTHING = Config(data=DataConfig(root=Path("nowhere")))
BUSY = DefaultStrategy(start=1, stop=30_000, every=2, grad_threshold=1e-9)
BUSY_MCMC = McmcStrategy(start=1, stop=30_000, every=2)


def timed(config: Config, minutes: float) -> Config:
    return config.model_copy(update={"train": config.train.model_copy(update={"minutes": minutes})})


def limited(config: Config = NOTHING, **limits: float) -> Config:
    return config.model_copy(update={"budget": BudgetConfig.model_validate(limits)})


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def still_config(
    capture: Path, run_dir: Path, strategy: DefaultStrategy | McmcStrategy = BUSY
) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=1),
        init=RandomInit(num_random=60),
        strategy=strategy,
        train=TrainConfig(steps=8, log_every=1),
        run=RunConfig(dir=run_dir, threads=1),
    )


def largest_count(trainer: Trainer) -> int:
    """The largest number after any step."""
    counts = []
    while trainer.done < trainer.config.train.steps:
        trainer.step()
        counts.append(len(trainer.model.scene.gaussians))
    return max(counts)


@pytest.mark.parametrize(("cap", "most"), [(40, 60), (90, 90)])
@pytest.mark.parametrize("strategy", [BUSY, BUSY_MCMC], ids=["default", "mcmc"])
def test_none_are_added_beyond_a_cap(
    still: Path, tmp_path: Path, strategy: DefaultStrategy | McmcStrategy, cap: int, most: int
) -> None:
    """The run begins with 60."""
    config = still_config(still, tmp_path, strategy)
    assert largest_count(assemble(config)) > 90
    assert largest_count(assemble(limited(config, max_gaussians=cap))) == most


def test_room_grows_with_the_size_and_shrinks_with_what_is_stored() -> None:
    assert room(NOTHING, 0, 5.0) == pytest.approx(5e6 / (16 + 0.35 * 45), abs=1)
    assert room(NOTHING, 0, 10.0) == pytest.approx(2 * room(NOTHING, 0, 5.0), abs=1)
    flat = NOTHING.model_copy(update={"model": StaticModel(sh_degree=0)})
    assert room(flat, 0, 5.0) == 5e6 / 16
    fixed = flat.model_copy(
        update={"model": DynamicModel(sh_degree=0, deform=tiny_options("hexplane"))}
    )
    assert room(fixed, 1, 5.0) == 5e6 / 16, "nothing moves at one time"
    less = 5e6 / 16 - room(fixed, 10, 5.0)
    assert 0 < less == pytest.approx(1e7 / 16 - room(fixed, 10, 10.0), abs=1)


@pytest.mark.parametrize("model", [StaticModel(), DynamicModel()])
def test_a_size_without_room_is_refused_and_the_one_named_is_not(
    model: StaticModel | DynamicModel,
) -> None:
    config = NOTHING.model_copy(update={"model": model})
    with pytest.raises(DyngsError, match=r"budget.max_mb=0.001: .* would do") as refused:
        within_cap(limited(config, max_mb=0.001), 20)
    would_do = float(str(refused.value).split(";")[1].split()[0])
    assert room(config, 20, would_do) >= 500


def test_what_contradicts_is_refused(tmp_path: Path) -> None:
    require_possible(NOTHING)
    with pytest.raises(
        DyngsError, match=r"budget.max_mb: model.kind=human_predictor has no Gaussians"
    ):
        require_possible(
            limited(NOTHING.model_copy(update={"model": HumanPredictorModel()}), max_mb=5.0)
        )
    both = NOTHING.model_copy(
        update={"prune": PruneConfig(fraction=0.5), "run": RunConfig(dir=tmp_path / "run")}
    )
    with pytest.raises(DyngsError, match=r"train.minutes: .*dyngs prune"):
        train(timed(both, 5.0))
    with pytest.raises(
        DyngsError, match=r"train.minutes: model.kind=human_predictor is trained for"
    ):
        require_possible(timed(NOTHING.model_copy(update={"model": HumanPredictorModel()}), 5.0))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("preset", ["human", "human_predictor"])
def test_cameras_of_people_are_not_refined(preset: str) -> None:
    config = load_config(packaged_preset(preset), ["data.root=capture", "camera.refine=always"])
    with pytest.raises(DyngsError, match=r"camera\.refine: cameras of people are not refined"):
        require_possible(config)


@pytest.mark.parametrize("preset", ["bg_triangle", "ngp", "nerf", "gps"])
def test_cameras_are_refined_by_gaussians_alone(preset: str) -> None:
    """The gradients of others by cameras miss a part, or all."""
    config = load_config(packaged_preset(preset), ["data.root=capture", "camera.refine=always"])
    with pytest.raises(DyngsError, match=rf"camera\.refine=always: model\.kind={preset} "):
        require_possible(config)
