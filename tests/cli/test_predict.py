"""The words after ``dyngs predict``."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_people import NET, people
from tiny_stereo import stereo_config, stereo_people

from dyngs.api.train import train
from dyngs.cli import main
from dyngs.cli.predict import parse_views
from dyngs.config import Config
from dyngs.runs.checkpoint import checkpoint_paths, load_run


def test_views_are_a_number_or_names() -> None:
    assert parse_views("3") == 3
    assert parse_views("-1") == -1
    assert parse_views("a.png, b.png") == ("a.png", "b.png")
    assert parse_views("a") == ("a",)


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, message in (
        ([str(tmp_path), str(tmp_path)], "required: --out"),
        ([str(tmp_path), str(tmp_path), "--out", "x"], "not a run folder"),
    ):
        assert main(["predict", *words]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1


# --- what gps cannot predict from
# -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A stereo network of two steps, and the capture of a person."""
    folder = tmp_path_factory.mktemp("stereo")
    root = stereo_people(folder / "people")
    run = train(stereo_config(root, folder / "net", steps=2))
    return run, root / "s0000" / "p000000"


Frames = list[dict[str, Any]]


def same_place(frames: Frames) -> None:
    frames[2]["transform_matrix"] = frames[1]["transform_matrix"]


def twice_as_long(frames: Frames) -> None:
    frames[2] |= {"fl_x": 110.0, "fl_y": 110.0}


def turned_away(frames: Frames) -> None:
    """The pose of a camera that looks past the person, of an image that shows the person: nothing
    fits."""
    pose = np.array(frames[2]["transform_matrix"])
    c = np.cos(0.6)
    s = np.sin(0.6)
    pose[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ pose[:3, :3]
    frames[2]["transform_matrix"] = pose.tolist()


def as_it_is(_: Frames) -> None:
    return


def opaque(folder: Path) -> None:
    for file in folder.rglob("images/**/*.png"):
        Image.open(file).convert("RGB").save(file)


def nobody(folder: Path) -> None:
    file = folder / "images" / "train" / "f000_c02.png"
    Image.fromarray(np.zeros((40, 40, 4), np.uint8)).save(file)


def no_change(_: Path) -> None:
    return


@pytest.mark.parametrize(
    ("views", "poses", "files", "message"),
    [
        ("c01", as_it_is, no_change, "c01 has no neighbouring view"),
        ("c01,c01", as_it_is, no_change, "named twice"),
        ("c01,c02", same_place, no_change, "c01 has no neighbouring view"),
        ("c01,c13", as_it_is, no_change, "c01 has no neighbouring view"),
        ("c01,c07", as_it_is, no_change, "side by side, 5 to 50 degrees apart"),
        ("c01,c02", twice_as_long, no_change, "check the calibration"),
        ("c01,c02", turned_away, no_change, "c02"),
        ("c01,c02", as_it_is, nobody, "c02: no silhouette of a person"),
        ("c01,c02", as_it_is, opaque, "no silhouettes"),
    ],
)
def test_views_that_do_not_suit_are_one_line(
    stereo: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    views: str,
    poses: Callable[[Frames], None],
    files: Callable[[Path], None],
    message: str,
) -> None:
    run, person = stereo
    capture = shutil.copytree(person, tmp_path / "ann")
    listed = json.loads((capture / "transforms_train.json").read_text())
    poses(listed["frames"])
    (capture / "transforms_train.json").write_text(json.dumps(listed))
    files(capture)
    names = ",".join(f"f000_{view}.png" for view in views.split(","))
    assert (
        main(["predict", str(run), str(capture), "--out", str(tmp_path / "out"), "--views", names])
        == 2
    )
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ann"], "nothing is written"


def test_weights_that_do_not_suit_are_one_line(
    stereo: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of another kind of network, and a file of which the second half is missing."""
    run, person = stereo
    values = {"data": {"root": people(tmp_path / "p", (1,))}, "model": NET, "train": {"steps": 1}}
    other = train(
        Config.model_validate(values | {"run": {"dir": tmp_path / "other", "threads": 1}})
    )
    capsys.readouterr()
    for name, written in (
        ("mixed", checkpoint_paths(other)[-1].read_bytes()),
        (
            "half",
            checkpoint_paths(run)[-1].read_bytes()[: checkpoint_paths(run)[-1].stat().st_size // 2],
        ),
    ):
        copy = shutil.copytree(run, tmp_path / name)
        file = checkpoint_paths(copy)[-1]
        file.write_bytes(written)
        assert (
            main(
                ["predict", str(copy), str(person), "--out", str(tmp_path / "out"), "--views", "2"]
            )
            == 2
        )
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert str(file) in error
        assert ("is not of this network" in error) == (name == "mixed")
    assert not (tmp_path / "out").exists()


def test_a_network_is_exported_as_one_file(
    stereo: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Which predicts like its run, but for float16; what is no network has no such file."""
    run, person = stereo
    file = tmp_path / "net.safetensors"
    assert main(["export", str(run), "--format", "network", "--out", str(file)]) == 0
    pair = ["--views", "2", "--out"]
    for network, out in ((run, "a"), (file, "b")):
        assert main(["predict", str(network), str(person), *pair, str(tmp_path / out)]) == 0
    counts = [len(load_run(tmp_path / out).scene) for out in ("a", "b")]
    assert counts[1] == pytest.approx(counts[0], rel=0.02)
    capsys.readouterr()
    other = shutil.copy(checkpoint_paths(run)[-1], tmp_path / "other.safetensors")
    for words in (
        ["export", str(tmp_path / "a"), "--format", "network"],
        ["export", str(run), "--format", "network", "--time", "0"],
        ["predict", str(other), str(person), *pair, str(tmp_path / "c")],
    ):
        assert main(words) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "c").exists()
