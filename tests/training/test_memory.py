"""The forecast of memory: of the right size, told in a line, a warning with what to set where there
is too little."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from pretend_gpu import GPU, pretend_gpu
from tensor_bytes import TensorBytes

from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    FixedStrategy,
    McmcStrategy,
    PointsInit,
    RandomInit,
    TrainConfig,
)
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.deform.keys import DynamicModel
from dyngs.human.keys import HumanModel
from dyngs.training import memory
from dyngs.training.memory import (
    MemoryForecast,
    expected_gaussians,
    free_memory,
    gaussian_bytes,
    memory_forecast,
    memory_forecasts,
    num_changes,
    peak_memory,
    require_room,
    resident_memory,
    whole_memory,
)
from dyngs.training.new_trainer import assemble

GB = 10**9
PLENTY = MemoryForecast(
    program=GB // 2,
    images=2 * GB,
    drawing=GB // 10,
    field=0,
    count=250_000,
    most=3_000_000,
    least=1000,
    each=1652,
    least_each=944,
    free=20 * GB,
    whole=24 * GB,
    all_kept=True,
    longest_side=1000,
)
BAND = 0.3, 1.1
"""Bytes of tensors that a Gaussian adds to the peak of a step, over its forecast; an allocator
needs the rest."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def _config(capture: Path, **changes: object) -> Config:
    return Config(data=DataConfig(root=capture), init=RandomInit(num_random=60)).model_copy(
        update=changes
    )


def test_on_a_gpu_the_scene_is_forecast_there_and_the_rest_here(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dyngs.training.new_trainer.device_for", lambda _: GPU)
    monkeypatch.setattr(memory, "gpu_memory", lambda _: (3 * GB, 8 * GB))
    monkeypatch.setattr("dyngs.data.loader.gpu_memory", lambda _: (2000, 8 * GB))
    config = _config(
        capture, strategy=DefaultStrategy(max_gaussians=10**7), train=TrainConfig(steps=30_000)
    )
    with pretend_gpu():
        trainer = assemble(config)
        gpu, machine = memory_forecasts(trainer)
        monkeypatch.setattr(memory, "gpu_memory", lambda _: (GB // 100, 8 * GB))
        small = memory_forecasts(trainer, 2)[0]
    assert (gpu.free, gpu.whole, gpu.program, gpu.images) == (3 * GB, 8 * GB, 0, 500)
    assert gpu.count > 60
    assert machine.count == machine.field == 0
    assert machine.images > 4 * 16 * 16 * 3 - 500
    assert gpu.total + machine.total > memory_forecast(trainer).total
    line = r"memory of the GPU: about [\d.]+ GB \(3 are there\): [\d.e-]+ images \(as many as a quarter of it keeps\), "
    assert re.match(line, str(gpu))
    assert str(machine).endswith(" drawing, no Gaussians")
    assert small.processes == 2
    warning = small.warning()
    assert warning is not None
    assert "GB of memory of the GPU are needed" in warning
    assert "strategy.max_gaussians=" in warning
    assert "data.cache_mb" not in warning, "it is not what limits them there"


def test_a_run_is_forecast_before_it_begins(capture: Path) -> None:
    found = memory_forecast(assemble(_config(capture, strategy=FixedStrategy())))
    assert found.count == found.most == 60
    assert found.each == 4 * 7 * 59
    # four images, of 3 bytes a pixel, and those that are decoded ahead
    assert 4 * 16 * 16 * 3 <= found.images <= 4 * 16 * 16 * 200
    assert found.all_kept
    assert found.warning() is None
    none = memory_forecast(
        assemble(
            _config(capture, data=DataConfig(root=capture, cache_mb=0), strategy=FixedStrategy())
        )
    )
    assert none.images == 45 * 16 * 16, "what decoding one takes"
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
    assert replace(PLENTY, free=GB, images=round(1e6 * cache_mb)).warning() is None


def _with(forecast: MemoryForecast, advice: str) -> MemoryForecast:
    """The forecast of the run with the keys that a line says to set."""
    for key, value in re.findall(r"([a-z_]+[.][a-z_]+)=(\d+)", advice):
        match key:
            case "data.cache_mb":
                forecast = replace(forecast, images=min(forecast.images, 10**6 * int(value)))
            case "strategy.max_gaussians":
                forecast = replace(forecast, count=min(forecast.count, int(value)))
            case "data.longest_side":
                scale = min(int(value) / forecast.longest_side, 1.0) ** 2
                forecast = replace(forecast, drawing=round(forecast.drawing * scale))
            case _:
                raise AssertionError(key)
    return forecast


@pytest.mark.parametrize("count", [1000, 3_000_000])
@pytest.mark.parametrize("images", [0, 8 * GB])
@pytest.mark.parametrize("drawing", [GB // 100, 5 * GB])
@pytest.mark.parametrize("free", [GB // 2, 3 * GB])
@pytest.mark.parametrize("processes", [1, 2])
def test_with_what_a_warning_says_the_run_has_room(
    count: int, images: int, drawing: int, free: int, processes: int
) -> None:
    parts = {
        "count": count,
        "images": images,
        "drawing": drawing,
        "free": free,
        "processes": processes,
    }
    forecast = replace(PLENTY, **parts)
    warning = forecast.warning()
    if warning is None:
        assert processes * (forecast.total - forecast.program) <= free
        return
    assert "\n" not in warning
    assert _with(forecast, warning.split("give ")[1]).warning() is None


def test_the_key_that_limits_the_gaussians_is_that_of_the_run(capture: Path) -> None:
    free = replace(PLENTY, images=0, count=10**7, free=GB)
    assert "give strategy.max_gaussians=" in (free.warning() or "")
    found = replace(free, limits=("model.resolution", 2000)).warning()
    assert found is not None
    side = int(found.split("model.resolution=")[1])
    assert replace(free, count=round(10**7 * (side / 2000) ** 2)).warning() is None
    assert memory_forecast(assemble(_config(capture, strategy=FixedStrategy()))).limits == (
        "init.num_random",
        60,
    )


def test_only_what_certainly_does_not_fit_is_refused() -> None:
    PLENTY.require_possible()
    replace(PLENTY, free=0).require_possible()  # others may end
    replace(PLENTY, count=10**9).require_possible()  # it may not come to so many
    replace(PLENTY, whole=None, least=10**9).require_possible()
    big = replace(PLENTY, least=40_000_000, count=40_000_000)
    with pytest.raises(
        DyngsError, match="at least 40 GB of memory are needed, and this machine gives 24: give "
    ) as found:
        big.require_possible()
    assert "strategy.max_gaussians=" in str(found.value)
    replace(PLENTY, least=16_000_000).require_possible()
    with pytest.raises(DyngsError, match="and fewer processes"):
        replace(PLENTY, least=16_000_000, count=16_000_000, processes=2).require_possible()


def test_random_gaussians_beyond_the_machine_are_refused_before_they_are_made(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "whole_memory", lambda: GB)
    require_room(_config(capture))
    require_room(_config(capture, init=PointsInit()))
    with pytest.raises(
        DyngsError, match=r"init[.]num_random=2000000: at least 1[.]9 GB .* gives 1: give .*=529661"
    ):
        require_room(_config(capture, init=RandomInit(num_random=2_000_000)))


def _peak(config: Config, steps: int) -> tuple[int, int]:
    """The most bytes of tensors in a run of ``steps``, in which all may move, and the number of
    Gaussians."""
    with TensorBytes() as found:
        trainer = assemble(config)
        if not trainer.model.scene.is_static or trainer.model.scene.times:
            trainer.model.exchange(
                trainer.model.training.all_moving(trainer.model.scene, trainer.extent)
            )
            trainer.done = 25  # past the step at which motion begins
        found.most = found.now
        for _ in range(steps):
            trainer.step()
    return found.most, trainer.num_gaussians


@pytest.mark.parametrize("kind", ["static", "mcmc", "control_nodes", "mlp", "human"])
def test_a_gaussian_takes_what_is_forecast_within_the_band(
    kind: str, request: pytest.FixtureRequest
) -> None:
    found = []
    for size in (1, 3):
        match kind:
            case "static" | "mcmc":
                strategy = McmcStrategy if kind == "mcmc" else DefaultStrategy
                grows = {"start": 0, "every": 2, "stop": 30_000, "max_gaussians": 1000 * size}
                config = _config(
                    request.getfixturevalue("still"),
                    init=RandomInit(num_random=800 * size),
                    strategy=strategy.model_validate(grows),
                    train=TrainConfig(steps=50),
                )
            case "human":
                config = Config(
                    data=DataConfig(root=request.getfixturevalue("person")),
                    model=HumanModel(resolution=16 + 16 * size, sh_degree=0),
                    strategy=FixedStrategy(),
                )
            case _:
                field = {"kind": kind} | ({"depth": 2, "width": 64} if kind == "mlp" else {})
                model = {
                    "deform": field,
                    "sh_degree": 1,
                    "motion_from": 0.0,
                    "time_window": 1.0,
                    "freeze_below_px": 0,
                }
                config = _config(
                    request.getfixturevalue("moving"),
                    model=DynamicModel.model_validate(model),
                    init=RandomInit(num_random=500 * size),
                    strategy=FixedStrategy(),
                    train=TrainConfig(steps=50),
                )
        found.append((*_peak(config, 5), gaussian_bytes(config)))
    (few, count, each), (many, more, _) = found
    assert more > 1.5 * count
    assert BAND[0] < (many - few) / (more - count) / each < BAND[1]


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
    whole = whole_memory()
    assert free is None or whole is None or free <= whole
    assert gaussian_bytes(_config(Path("x"))) == 1652
