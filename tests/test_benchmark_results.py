"""The benchmark pages and README's table equal the stored results."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def results() -> ModuleType:
    spec = importlib.util.spec_from_file_location("results", ROOT / "benchmarks/results.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["results"] = module
    spec.loader.exec_module(module)
    return module


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
