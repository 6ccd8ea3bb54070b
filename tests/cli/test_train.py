"""The words after ``dyngs train``."""

from __future__ import annotations

from pathlib import Path

import pytest
from refused import error_line

from dyngs.cli import main
from dyngs.cli.train import parse_config
from dyngs.config.io import load_config, save_config
from dyngs.core.errors import DyngsError


def test_a_path_is_the_capture(blender_root: Path, moving: Path) -> None:
    given = parse_config(["static", f"data.root={blender_root}", "train.steps=5"], None)
    assert parse_config([str(blender_root), "train.steps=5"], None) == given
    assert parse_config(["static", str(blender_root), "train.steps=5"], None) == given
    assert parse_config([str(moving)], None) == load_config("dynamic", [f"data.root={moving}"])
    assert parse_config(["mip", str(moving)], None).model.kind == "static"


def test_the_chosen_preset_is_printed(
    blender_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", str(blender_root), "train.steps=0"]) == 2
    text = capsys.readouterr().out
    assert text.startswith("preset static (capture without times)")
    assert f"dyngs train PRESET {blender_root}" in text


def test_names_of_presets_come_before_folders(
    blender_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(blender_root.parent)
    blender_root.rename("static")
    with pytest.raises(DyngsError, match=r"data\.root is required"):
        parse_config(["static"], None)
    assert parse_config(["static", "./static"], None).data.root == Path("static").absolute()


def test_a_moved_capture_of_a_resumed_run(tmp_path: Path, blender_root: Path) -> None:
    run = tmp_path / "run"
    save_config(load_config("static", ["data.root=gone"]), run / "config.yaml")
    assert parse_config([str(blender_root)], run).data.root == blender_root
    with pytest.raises(DyngsError, match="'static': the configuration of a run is fixed"):
        parse_config(["static"], run)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("nowhere", "nowhere: no such preset (see `dyngs presets`) and no such path"),
        ("statik", "did you mean static"),
        ("photo", "did you mean photos?"),
        ("static mip photos", "'mip': a second preset"),
        ("photos data.root=x", "'data.root=x': a second capture"),
        ("run", "run: not a capture; it is a run, for `dyngs eval run`"),
        ("notes.txt", "notes.txt: not a capture; give a folder"),
        ("--data photos", "use data.root=FOLDER"),
        ("-s photos -m out", "use data.root=FOLDER"),
        ("photos -m out", "use run.dir=FOLDER"),
        ("photos --max-splats 5", "use strategy.max_gaussians=N"),
        ("photos --strategy.cap-max=5", "use strategy.max_gaussians=N"),
        ("static data.root=x cap_max=5", "cap_max=5: unknown key 'cap_max'; use strategy.max_ga"),
        ("photos --pipeline.max-num-iterations 5", "use train.steps=N"),
        ("photos -r 2", "use data.longest_side=PIXELS"),
        ("photos --minutes 5", "use train.minutes=..."),
        ("photos --frobnicate", "settings are written as section.key=value"),
    ],
)
def test_refusals(
    words: str,
    part: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("photos", "run"):
        (tmp_path / name).mkdir()
    for name in ("run/config.yaml", "notes.txt"):
        (tmp_path / name).touch()
    assert part in error_line(capsys, "train", *words.split())
