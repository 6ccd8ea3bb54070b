"""The forecast of memory: of the right size, told in a line, a warning with what to set where there is too little."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dyngs.build import assemble
from dyngs.config import Config, DataConfig, DefaultStrategy, FixedStrategy, McmcStrategy, RandomInit, TrainConfig
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.training.memory import (
    MemoryForecast,
    expected_gaussians,
    free_memory,
    gaussian_bytes,
    memory_forecast,
    num_changes,
    peak_memory,
    resident_memory,
)

GB = 10**9
PLENTY = MemoryForecast(GB // 2, 2 * GB, GB // 10, 250_000, 3_000_000, 1652, 20 * GB, True)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def _config(capture: Path, **changes: object) -> Config:
    return Config(data=DataConfig(root=capture), init=RandomInit(num_random=60)).model_copy(update=changes)


def test_a_run_is_forecast_before_it_begins(capture: Path) -> None:
    found = memory_forecast(assemble(_config(capture, strategy=FixedStrategy())))
    assert found.count == found.most == 60
    assert found.each == 4 * 7 * 59
    # four pictures, of 3 bytes a pixel, and those that are decoded ahead
    assert 4 * 16 * 16 * 3 <= found.pictures <= 4 * 16 * 16 * 200
    assert found.all_kept
    assert found.warning() is None
    none = memory_forecast(
        assemble(_config(capture, data=DataConfig(root=capture, cache_mb=0), strategy=FixedStrategy()))
    )
    assert none.pictures == 45 * 16 * 16, "what decoding one takes"
    assert not none.all_kept


def test_it_is_told_in_a_line_and_too_little_in_another() -> None:
    line = str(PLENTY)
    assert line.startswith("memory: about 3 GB (20 are there)")
    assert "5 for the 3,000,000 that strategy.max_gaussians allows" in line
    assert PLENTY.warning() is None
    assert replace(PLENTY, free=None).warning() is None
    warning = replace(PLENTY, free=GB).warning()
    assert warning is not None
    assert "3 GB of memory are needed, and 1.5 are there: give data.cache_mb=" in warning
    # with what it says, the run has room
    cache_mb = float(warning.split("data.cache_mb=")[1].split()[0])
    assert replace(PLENTY, free=GB, pictures=round(1e6 * cache_mb)).warning() is None


def test_more_steps_are_expected_to_end_with_more_gaussians(capture: Path) -> None:
    short, long = (_config(capture, train=TrainConfig(steps=steps)) for steps in (1000, 7000))
    assert num_changes(short) < num_changes(long) == 33
    assert num_changes(long, 300) == 2
    assert 60 < expected_gaussians(short, 60) < expected_gaussians(long, 60) < 300_000
    assert expected_gaussians(_config(capture, strategy=McmcStrategy(max_gaussians=77)), 60) == 77
    assert expected_gaussians(_config(capture, strategy=DefaultStrategy(grow=False)), 60) == 60
    assert num_changes(_config(capture, strategy=FixedStrategy())) == 0


def test_what_this_machine_says() -> None:
    assert min(resident_memory(), peak_memory()) >= 0
    free = free_memory()
    assert free is None or free > 0
    assert gaussian_bytes(_config(Path("x"))) == 1652
