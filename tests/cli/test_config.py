"""``dyngs config`` prints a preset that loads as the same configuration."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.cli import main
from dyngs.config.io import load_config, load_resolved, packaged_presets, save_config


def _printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(["config", *words]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("preset", sorted(packaged_presets()))
def test_the_output_is_a_preset(
    preset: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = _printed(capsys, preset)
    (tmp_path / "all.yaml").write_text(text)
    root = f"data.root={tmp_path}"
    assert load_config(tmp_path / "all.yaml", [root]) == load_config(preset, [root])
    assert "  # root: FOLDER" in text
    assert all(len(line) <= 160 for line in text.splitlines())


def test_overrides_count_and_every_key_has_its_default_and_meaning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = _printed(capsys, "static", "train.steps=123", "strategy.kind=mcmc")
    assert "  steps: 123  # default 7000" in text
    assert "  # number of training steps; all schedules scale with it (an integer >= 1)" in text
    assert "kind is one of default, mcmc, fixed" in text
    assert "  noise: " in text
    assert "reset_every" not in text
    values = [
        line for line in text.splitlines() if ": " in line and not line.lstrip().startswith("#")
    ]
    assert all("  # default " in line for line in values), "each has its default"


def test_a_run_and_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = load_config("dynamic", [f"data.root={tmp_path}", "run.name=a: b # c"])
    save_config(config, tmp_path / "config.yaml")
    for source in (tmp_path, tmp_path / "config.yaml"):
        (tmp_path / "all.yaml").write_text(_printed(capsys, str(source)))
        assert load_resolved(tmp_path / "all.yaml") == config
    assert main(["config", "statik"]) == 2
    assert "did you mean 'static'" in capsys.readouterr().err


def test_presets_are_listed_in_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["presets"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == list(packaged_presets())
    assert all(50 < len(line) <= 110 and line.endswith(".") for line in lines[:-1])
