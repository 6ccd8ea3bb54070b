"""Readers and exporters of other packages: those of ``examples/plugin``, and broken ones."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from toy_plugin import installed, write_package

import dyngs
from dyngs.cli import main
from dyngs.config.io import load_config
from dyngs.config.kinds import kind_names
from dyngs.core.errors import DyngsError
from dyngs.core.plugins import plugin_entries
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture


@pytest.fixture(autouse=True)
def template() -> Iterator[None]:
    with installed():
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with ``cameras.csv``."""
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=6, num_test=1, samples=1))
    views = dyngs.read_capture(folder).splits["train"]
    poses = [f"r{row}{column}" for row in range(3) for column in range(4)]
    with (folder / "cameras.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["image", "fx", "fy", "cx", "cy", *poses])
        for view in views:
            k = view.intrinsics
            pose = view.cam_from_world[:3].ravel().tolist()
            image = view.image_path.relative_to(folder).as_posix()
            table.writerow([image, k[0, 0], k[1, 1], k[0, 2], k[1, 2], *pose])
    return folder


def alone(capture: Path, tmp_path: Path) -> Path:
    """The capture without the files of a built-in format."""
    (tmp_path / "scan").mkdir()
    for file in [*capture.rglob("*.png"), capture / "cameras.csv"]:
        target = tmp_path / "scan" / file.relative_to(capture)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(file.read_bytes())
    return tmp_path / "scan"


def test_the_template_reads_trains_and_exports(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = alone(capture, tmp_path)
    run = tmp_path / "run"
    keys = ["train.steps=2", "run.threads=1", "init.num_random=40", f"run.dir={run}"]
    assert main(["train", "static", f"data.root={scan}", "data.format=camera_table", *keys]) == 0
    assert load_config(run / "config.yaml").data.format == "camera_table"
    assert main(["export", str(run), "--out", str(tmp_path / "points.xyz")]) == 0
    points = np.loadtxt(tmp_path / "points.xyz")
    np.testing.assert_allclose(points[:, :3], dyngs.load(run).at(0).means, rtol=1e-4)
    dyngs.export(run, tmp_path / "again.xyz")
    assert (tmp_path / "again.xyz").read_bytes() == (tmp_path / "points.xyz").read_bytes()
    capsys.readouterr()
    assert main(["export", str(run), "--out", str(tmp_path / "b.xyz"), "--sh-degree", "1"]) == 2
    assert "--sh-degree is not supported with --format .xyz" in capsys.readouterr().err
    assert not (tmp_path / "b.xyz").exists()


def test_built_in_formats_come_first_and_a_plugin_can_be_chosen(capture: Path) -> None:
    built_in = dyngs.read_capture(capture)
    assert built_in.format == "blender"
    config = load_config("static", [f"data.root={capture}", "data.format=camera_table"])
    table = dyngs.read_capture(config.data)
    assert table.format == "camera_table"
    first = next(view for view in built_in.splits["train"] if view.name.endswith("0"))
    same = [v for s in table.splits.values() for v in s if v.image_path == first.image_path]
    assert np.allclose(same[0].cam_from_world, first.cam_from_world)


def test_an_unknown_format_names_those_that_are_looked_for(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"camera_table: cameras\.csv"):
        dyngs.read_capture(tmp_path)
    with pytest.raises(DyngsError, match=r"data\.format"):
        load_config("static", [f"data.root={tmp_path}", "data.format=camera_tables"])


def test_a_wrong_table_is_one_line(capture: Path, tmp_path: Path) -> None:
    scan = alone(capture, tmp_path)
    (scan / "cameras.csv").write_text("image,fx\ntrain/r_0.png,1\n")
    with pytest.raises(DyngsError) as error:
        dyngs.read_capture(scan)
    assert "\n" not in str(error.value)


def test_broken_and_shadowing_plugins_are_reported_and_break_nothing(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = alone(capture, tmp_path)
    site = tmp_path / "site"
    site.mkdir()
    (site / "broken_module.py").write_text("import no_such_package\n")
    entries = {
        "dyngs.readers": {"broken": "broken_module:FORMAT", "colmap": "broken_module:FORMAT"},
        "dyngs.exporters": {"abc": "broken_module:write", "ply": "broken_module:write"},
        "dyngs.models": {"shaky": "broken_module:KIND", "static": "broken_module:KIND"},
    }
    write_package(site, "broken-package", entries)
    with installed(site):
        assert dyngs.read_capture(scan).format == "camera_table"
        names = kind_names()
        assert "toy" in names
        assert "shaky" not in names
        assert names.count("static") == 1
        load_config("static", [f"data.root={capture}"])
        with pytest.raises(DyngsError, match=r"shaky .* of the package broken-package"):
            load_config("static", [f"data.root={capture}", "model.kind=shaky"])
        run = tmp_path / "run"
        keys = ["train.steps=1", "run.threads=1", "init.num_random=9", f"run.dir={run}"]
        assert main(["train", "static", f"data.root={capture}", *keys]) == 0
        assert main(["export", str(run), "--out", str(tmp_path / "scene.ply")]) == 0
        capsys.readouterr()
        assert main(["export", str(run), "--out", str(tmp_path / "scene.abc")]) == 2
        error = capsys.readouterr().err.strip()
        assert "the plug-in abc (dyngs.exporters) of the package broken-package" in error
        assert "\n" not in error


def test_plugins_are_not_searched_before_they_are_needed(capture: Path) -> None:
    load_config("static", [f"data.root={capture}", "data.format=blender"])
    dyngs.read_capture(capture)
    assert plugin_entries.cache_info().misses == 0
