"""The memory forecast is accurate. Where memory is short, a warning names the settings to
change."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pretend_gpu import GPU, pretend_gpu

from dyngs.config import (
    Config,
    DataConfig,
    FixedStrategy,
    RandomInit,
    TrainConfig,
)
from dyngs.training import memory
from dyngs.training.memory import (
    MemoryForecast,
    expected_gaussians,
    free_memory,
    memory_forecasts,
    resident_memory,
)
from dyngs.training.new_trainer import build_trainer

GB = 10**9
PLENTY = MemoryForecast(
    place="memory",
    program=GB // 2,
    images=2 * GB,
    drawing=GB // 10,
    gaussians=GB // 2,
    count=250_000,
    free=20 * GB,
    processes=1,
    largest=(2 * GB, "data.cache_mb", 2000, 1.0),
)


def config_of(still: Path, **changes: object) -> Config:
    config = Config(data=DataConfig(root=still), init=RandomInit(num_random=60))
    return config.model_copy(update={"strategy": FixedStrategy(), **changes})


def test_a_run_is_forecast_before_it_begins(still: Path) -> None:
    (found,) = memory_forecasts(build_trainer(config_of(still)))
    assert found.count == 60
    assert found.gaussians == 60 * 4 * 7 * 59
    assert found.warning() is None
    (none,) = memory_forecasts(
        build_trainer(config_of(still, data=DataConfig(root=still, cache_mb=0)))
    )
    assert none.images < found.images


def test_on_a_gpu_the_scene_is_forecast_there_and_the_rest_here(
    still: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dyngs.training.new_trainer.select_device", lambda _: GPU)
    monkeypatch.setattr(memory, "gpu_memory", lambda _: (3 * GB, 8 * GB))
    with pretend_gpu():
        gpu, machine = memory_forecasts(build_trainer(config_of(still)))
    assert (gpu.free, gpu.program) == (3 * GB, 0)
    assert gpu.count == 60
    assert machine.count == machine.gaussians == 0


def test_settings_of_the_warning_make_the_run_fit() -> None:
    assert PLENTY.warning() is None
    assert replace(PLENTY, free=None).warning() is None
    warning = replace(PLENTY, free=GB).warning()
    assert warning is not None
    cache_mb = float(warning.split("data.cache_mb=")[1].split()[0])
    assert replace(PLENTY, free=GB, images=round(1e6 * cache_mb)).warning() is None


def test_more_steps_are_expected_to_end_with_more_gaussians() -> None:
    def count(steps: int) -> int:
        return expected_gaussians(
            Config(data=DataConfig(root=Path("x")), train=TrainConfig(steps=steps)), 1000
        )

    assert 1000 <= count(500) < count(7000) < count(30_000)


def test_memory_of_this_machine_is_measured() -> None:
    free = free_memory()
    assert resident_memory() > 0
    assert free is not None
    assert free > 0
