"""The benchmark pages and README's table equal the stored results."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from dyngs.config.io import load_config
from dyngs.deform.keys import DynamicModel

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


def test_a_comparison_shows_means_spread_and_refusals(results: ModuleType) -> None:
    numbers = {key: 5 for key, _, _ in results.COMPARED} | {"psnr_moving": None}
    about = {"capture": "rig", "variant": "mlp", "minutes": 1.5, "load": 1.0}
    rows = [about | numbers | {"seed": seed, "psnr": 30.0 + seed} for seed in range(2)]
    rows.append(about | {"variant": "free", "refused": "no times"})
    text = results.comparison_table(rows)
    assert "| rig | mlp | 2 | 30.50 ± 0.50 |  | 5.00 ± 0.00 |" in text
    assert "Not trained: rig, free: no times" in text


def test_a_row_for_each_published_system(
    results: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as nothing_stored:
        for name in ("RESULTS", "PRUNING", "MEGA"):
            nothing_stored.setattr(results, name, tmp_path / name)
        page = results.systems_page({}, [])
    assert page.count("| not measured |") == 18
    assert "36.39 dB" in page
    stored = results.systems_page(results.load_results(), [])
    assert "| lego400 35.64 | 400x400, 30,000 steps |" in stored


def test_a_system_shows_the_compared_variant_nearest_to_its_paper(results: ModuleType) -> None:
    about = {"capture": "rig", "minutes": 1.5, "commit": "c0ffee00", "command": "dyngs"}
    rows = [about | {"variant": "hexplane", "psnr": 20.0}, about | {"variant": "mlp", "psnr": 1.0}]
    system = {"variants": ["4dgs", "hexplane"]}
    assert [x.figure for x in results.own_figures(system, {}, rows)] == ["rig 20.00"]
    rows.append(about | {"variant": "4dgs", "psnr": 30.0})
    assert [x.figure for x in results.own_figures(system, {}, rows)] == ["rig 30.00"]


def test_a_system_shows_the_rows_that_it_selects(
    results: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = {"capture": "rig", "commit": "c0ffee00", "psnr": 20.0, "mb": 3.0, "part": "network"}
    (tmp_path / "comparisons").mkdir()
    stored = tmp_path / "comparisons/mega.json"
    stored.write_text(json.dumps([row, row | {"part": "zip", "psnr": 10.0}]), encoding="utf-8")
    monkeypatch.setattr(results, "RESULTS", tmp_path)
    system = {"rows": {"mega": {"part": "network"}}, "command": "dyngs"}
    assert [x.figure for x in results.own_figures(system, {}, [])] == ["rig 20.00, 3.00 MB"]


def test_every_compared_variant_is_a_valid_configuration() -> None:
    for name, (preset, *overrides) in load_benchmark("dynamic").VARIANTS.items():
        config = load_config(preset, ["data.root=capture", *overrides])
        assert isinstance(config.model, DynamicModel)
        assert name.startswith(config.model.deform.kind)
