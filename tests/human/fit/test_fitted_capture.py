"""The fit before training: when it runs, and that it runs once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.config import DataConfig
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.human.fit import fitted_capture
from dyngs.human.fit.fitted_capture import with_fitted_body, write_fitted_capture
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture


@pytest.fixture
def data(tmp_path: Path, short_fits: None) -> DataConfig:
    """A small capture, an empty cache, and fits of two steps."""
    options = HumanOptions(size=64, num_frames=2, num_new=2, num_cameras=3, num_test=1, samples=1, body_seed=3)
    root = write_human_capture(tmp_path / "person", options)
    for name in ("train", "pose"):
        arrays = dict(np.load(root / f"body_{name}.npz"))
        arrays |= {"betas": np.zeros(10), "surface_model_type": np.array("smplx")}
        np.savez(root / f"body_{name}.npz", **arrays)
    return DataConfig(root=root)


def test_a_capture_is_fitted_once(data: DataConfig) -> None:
    said: list[str] = []
    fitted = with_fitted_body(data, say=said.append)
    assert fitted.body is not None
    assert {path.name for path in fitted.body.iterdir()} == {
        *("body_train.npz", "body_pose.npz", "fit_report.json", "fit_overlays.png")
    }
    body = read_capture(fitted).body
    assert body is not None
    assert {split: frames.shape_space for split, frames in body.items()} == dict.fromkeys(
        ("train", "val", "test", "pose"), "anny"
    )
    assert "fitted to the silhouettes first" in said[0]
    again = with_fitted_body(data, say=said.append)
    assert again == fitted
    assert "the fit of before" in said[-1]


def test_given_poses_are_left_alone_unless_asked_for(data: DataConfig) -> None:
    assert with_fitted_body(data, only_if_needed=True, say=pytest.fail) == data


def test_what_is_a_fit_is_not_fitted_again(data: DataConfig, tmp_path: Path) -> None:
    out = write_fitted_capture(data, tmp_path / "fitted", lambda *_: None).root
    given = DataConfig(root=out)
    assert with_fitted_body(given, say=pytest.fail) == given
    named = data.model_copy(update={"body": out})
    assert with_fitted_body(named, say=pytest.fail) == named


def test_a_fitted_capture_shows_the_same_images(data: DataConfig, tmp_path: Path) -> None:
    out = write_fitted_capture(data, tmp_path / "fitted", lambda *_: None).root
    before, after = read_capture(data), read_capture(DataConfig(root=out))
    for split in ("train", "test", "pose"):
        assert len(after.splits[split]) == len(before.splits[split])
        ordered = sorted(before.splits[split], key=lambda view: view.frame or 0)
        for old, new in zip(ordered, sorted(after.splits[split], key=lambda view: view.frame or 0), strict=True):
            assert (old.time, old.width) == (new.time, new.width)
            assert np.allclose(old.intrinsics, new.intrinsics)
    assert not list(tmp_path.glob(".fitted*")), "nothing is left beside it"


def test_without_silhouettes_poses_are_taken_as_given(data: DataConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = read_capture(data).replace(has_alpha=False)
    monkeypatch.setattr(fitted_capture, "read_capture", lambda _: capture)
    said: list[str] = []
    assert with_fitted_body(data, say=said.append) == data
    assert "taken as given" in said[0]
    monkeypatch.setattr(fitted_capture, "read_capture", lambda _: capture.replace(body=None))
    with pytest.raises(DyngsError, match="neither silhouettes nor body parameters"):
        with_fitted_body(data)
