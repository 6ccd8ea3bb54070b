"""The benchmark pages and README's table equal the stored results."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


def load_benchmark(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / f"benchmarks/{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def results() -> ModuleType:
    return load_benchmark("results")


def test_pages_and_readme_equal_stored_results(results: ModuleType) -> None:
    for path, text in results.written_pages(results.load_results()).items():
        assert path.read_text(encoding="utf-8") == text, (
            f"{path.name} is stale: run `python benchmarks/results.py write`"
        )


def test_every_stored_file_is_a_measurement(results: ModuleType) -> None:
    names = {path.stem for path in results.RESULTS.glob("*.json")}
    assert names == results.load_results().keys()


def test_a_stored_command_is_that_of_its_measurement(results: ModuleType) -> None:
    for name, result in results.load_results().items():
        measurement = results.MEASUREMENTS[name]
        place = Path(measurement.capture).name
        words = results.training_command(measurement, place, f"runs/{name}", result.threads)
        assert result.command == "dyngs " + " ".join(words)
        stored = json.loads((results.RESULTS / f"{name}.json").read_text(encoding="utf-8"))
        assert stored["commit"]
        assert stored["date"]


@pytest.mark.usefixtures("results")
def test_the_comparison_of_moving_systems_shows_means_spread_and_refusals(tmp_path: Path) -> None:
    dynamic = load_benchmark("dynamic")
    (tmp_path / "results").mkdir()
    numbers = {key: 5 for key, _, _ in dynamic.COLUMNS} | {"psnr_moving": None}
    for seed, psnr in enumerate((30.0, 31.0)):
        facts = {"capture": "rig", "variant": "mlp", "seed": seed, "load": 1.0, **numbers}
        path = tmp_path / "results" / f"rig_mlp_{seed}.json"
        dynamic.write_result(path, facts | {"psnr": psnr})
    refused = {"capture": "flag", "variant": "free", "seed": 0, "load": 2.0, "refused": "no times"}
    dynamic.write_result(tmp_path / "results" / "flag_free_0.json", refused)
    text = dynamic.results_table(dynamic.load_results(tmp_path))
    assert "| rig | mlp | 2 | 30.50 ± 0.50 |  | 5.00 ± 0.00 |" in text
    assert "Not trained: flag, free: no times" in text
