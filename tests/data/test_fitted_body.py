"""Fits kept beside a capture: their files, and the frames that they are for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dyngs.config import DataConfig
from dyngs.data.capture import Capture, Splits
from dyngs.data.fitted_body import numbered, read_body_file, with_fitted_body
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    options = HumanOptions(size=16, num_frames=3, num_new=2, num_cameras=2, num_test=1, samples=1)
    return read_capture(DataConfig(root=write_human_capture(tmp_path_factory.mktemp("body") / "person", options)))


def write(path: Path, count: int = 3, **more: np.ndarray) -> Path:
    rows = np.arange(count, dtype=np.float64)[:, None]
    np.savez(path, poses=np.zeros((count, 165)), trans=rows * np.ones(3), betas=np.zeros(44), **more)
    return path


def test_rows_are_for_the_frames_that_the_file_names(tmp_path: Path) -> None:
    body = read_body_file(write(tmp_path / "b.npz", frames=np.array([7, 3, 5])))
    assert body.frames == (3, 5, 7)
    assert body.trans[:, 0].tolist() == [1, 2, 0]
    assert body.shape_space == "smpl"
    assert read_body_file(write(tmp_path / "c.npz")).frames == (0, 1, 2)


@pytest.mark.parametrize("frames", [np.zeros((3, 1), int), np.array([0.0, 1, 2]), np.array([1, 2])])
def test_frames_that_are_no_numbers_of_the_rows_are_refused(tmp_path: Path, frames: np.ndarray) -> None:
    with pytest.raises(DyngsError, match=r"b\.npz: 'frames' must hold one whole number"):
        read_body_file(write(tmp_path / "b.npz", frames=frames))


def test_a_fit_replaces_the_bodies_of_a_capture(capture: Capture, tmp_path: Path) -> None:
    write(tmp_path / "body_train.npz", surface_model_type=np.array("anny"))
    found = with_fitted_body(capture, tmp_path)
    assert found.body is not None
    assert found.body["train"].shape_space == "anny"
    assert found.body["test"] is found.body["train"]
    assert "pose" not in found.splits, "no parameters for the other clip"
    write(tmp_path / "body_pose.npz", count=2)
    assert "pose" in with_fitted_body(capture, tmp_path).splits


def test_a_capture_is_read_with_the_fit_that_the_options_name(capture: Capture, tmp_path: Path) -> None:
    write(tmp_path / "body_train.npz")
    found = read_capture(DataConfig(root=capture.root, body=tmp_path))
    assert found.body is not None
    assert found.body["train"].trans[:, 0].tolist() == [0, 1, 2]
    with pytest.raises(DyngsError, match=r"body_train\.npz: no such file.* comes back by training"):
        read_capture(DataConfig(root=capture.root, body=tmp_path / "elsewhere"))


def test_views_without_frames_are_numbered_by_time(capture: Capture) -> None:
    splits: Splits = {
        name: tuple(replace(view, frame=None) for view in capture.splits[name]) for name in ("train", "test")
    }
    for name, views in numbered(splits).items():
        assert [view.frame for view in views] == [view.frame for view in capture.splits[name]]
    assert numbered(capture.splits) is capture.splits
