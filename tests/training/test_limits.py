"""Limits on the number of Gaussians: never exceeded, and refused where they cannot be kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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
from dyngs.data.capture import PointCloud
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.deform.keys import DynamicModel
from dyngs.human.keys import HumanPredictorModel
from dyngs.models.static_section import StaticModel
from dyngs.training.limits import (
    apply_gaussian_cap,
    apply_pixel_cap,
    gaussian_limit,
    validate_limits,
)
from dyngs.training.new_trainer import build_trainer
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
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=1, samples=1))
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
    assert largest_count(build_trainer(config)) > 90
    assert largest_count(build_trainer(apply_gaussian_cap(config, cap), uncapped=config)) == most


def test_cap_from_training_pixels(still: Path, tmp_path: Path) -> None:
    """Only a limit that was not requested is lowered, and not below twice the initial points."""
    capture = read_capture(still)
    config = still_config(still, tmp_path, DefaultStrategy())
    assert apply_pixel_cap(config, capture).strategy.growth_limit == 100_000
    many = PointCloud(np.zeros((70_000, 3)), np.zeros((70_000, 3), np.uint8))
    capture = capture.replace(points=many)
    assert apply_pixel_cap(config, capture).strategy.growth_limit == 140_000
    requested = still_config(still, tmp_path, DefaultStrategy(max_gaussians=200_000))
    assert apply_pixel_cap(requested, capture).strategy.growth_limit == 200_000


@pytest.mark.parametrize("model", [StaticModel(), DynamicModel()])
def test_a_size_without_room_is_refused_and_the_one_named_is_not(
    model: StaticModel | DynamicModel,
) -> None:
    config = NOTHING.model_copy(update={"model": model})
    with pytest.raises(DyngsError, match=r"budget.max_mb=0.001: too small") as refused:
        gaussian_limit(limited(config, max_mb=0.001), 20)
    would_do = float(str(refused.value).split(";")[1].split()[1])
    found = gaussian_limit(limited(config, max_mb=would_do), 20)
    assert found is not None
    assert found >= 500


def test_contradicting_limits_are_refused(tmp_path: Path) -> None:
    validate_limits(NOTHING)
    network = NOTHING.model_copy(update={"model": HumanPredictorModel()})
    both = NOTHING.model_copy(
        update={"prune": PruneConfig(fraction=0.5), "run": RunConfig(dir=tmp_path / "run")}
    )
    for config, said in (
        (limited(network, max_mb=5.0), "budget.max_mb"),
        (timed(network, 5.0), "train.minutes"),
        (timed(both, 5.0), "train.minutes: .*dyngs prune"),
        (
            network.model_copy(update={"train": TrainConfig(image_every=5)}),
            "train.image_every=5: not supported",
        ),
    ):
        with pytest.raises(DyngsError, match=said):
            train(config)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("preset", ["human", "human_predictor", "bg_triangle", "ngp", "gps"])
def test_cameras_are_refined_by_still_and_moving_scenes_alone(preset: str) -> None:
    config = load_config(packaged_preset(preset), ["data.root=capture", "camera.refine=always"])
    with pytest.raises(DyngsError, match=r"camera\.refine=always"):
        validate_limits(config)
