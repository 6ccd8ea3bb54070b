from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_captures import edit_json, write_image
from tiny_priors import with_priors

from dyngs.capture.inspection.report import format_report, inspect_capture
from dyngs.config import DataConfig
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError


def loaded(root: Path, **options: object) -> ImageLoader:
    config = DataConfig.model_validate({"root": root, "test_every": 0, **options})
    return ImageLoader(read_capture(config).splits["train"], config, with_maps=True)


def test_maps_come_with_the_image(tmp_path: Path) -> None:
    """Flow in the pixels of the smaller image; depth of its own size; the next view is that of the next time."""
    images = loaded(with_priors(tmp_path), downscale=2)
    assert [view.flow_to for view in images.views] == [None, "a", "b"]
    first, second = images[0], images[1]
    assert first.moves is not None
    assert first.depth is not None
    assert second.moves is not None
    assert second.flow is not None
    assert first.moves.shape == first.depth.shape == (4, 6)
    assert (float(first.moves.max()), float(second.moves.min()), float(first.depth.max())) == (0, 1, 2)
    torch.testing.assert_close(second.flow, torch.full((4, 6, 2), 2.0))
    small = second.shrunk(2)
    assert small.flow is not None
    assert small.depth is not None
    assert float(small.flow.max()) == 1
    assert float(small.depth.min()) == 3


def test_who_does_not_ask_for_maps_does_not_pay_for_them(tmp_path: Path) -> None:
    views = read_capture(with_priors(tmp_path)).splits["train"]
    (tmp_path / "a_depth.npy").write_bytes(b"")
    image = ImageLoader(views)[0]
    assert image.depth is None
    assert image.flow is None


def test_missing_priors_are_done_without(tmp_path: Path) -> None:
    with_priors(tmp_path)
    for name in ("b_depth.npy", "c_moves.png", "tracks.npz"):
        (tmp_path / name).unlink()
    capture = read_capture(DataConfig(root=tmp_path, test_every=0))
    assert [view.depth_path is None for view in capture.splits["train"]] == [False, True, False]
    assert capture.tracks_path is None
    assert any("1 of 3 depth maps are missing" in line for line in capture.warnings)
    assert any("1 of 3 motion masks are missing" in line for line in capture.warnings)
    assert any("tracks.npz are missing" in line for line in capture.warnings)


@pytest.mark.parametrize("key", ["depth_file_path", "flow_file_path", "motion_mask_path", "instance_mask_path"])
def test_priors_outside_the_capture_are_refused(tmp_path: Path, key: str) -> None:
    root = tmp_path / "capture"
    root.mkdir()
    with_priors(root)
    np.save(tmp_path / "other.npy", np.zeros(3))
    edit_json(
        root / "transforms_train.json",
        lambda c: [f.pop("motion_mask_path") for f in c["frames"]] and c["frames"][1].update({key: "../other.npy"}),
    )
    with pytest.raises(DyngsError, match="outside the capture"):
        read_capture(root)


def test_maps_of_another_size_are_refused(tmp_path: Path) -> None:
    np.save(with_priors(tmp_path) / "b_flow.npy", np.zeros((4, 6, 2)))
    with pytest.raises(DyngsError, match=r"b_flow\.npy: the flow field is 6x4 but its image is 12x8"):
        loaded(tmp_path)[1]


def test_instance_masks_mean_that_everything_labelled_moves(tmp_path: Path) -> None:
    with_priors(tmp_path)
    write_image(tmp_path / "labels.png", np.arange(96, dtype=np.uint16).reshape(8, 12, 1))
    edit_json(
        tmp_path / "transforms_train.json",
        lambda c: c["frames"][0].pop("motion_mask_path") and c["frames"][0].update(instance_mask_path="labels.png"),
    )
    moves = loaded(tmp_path)[0].moves
    assert moves is not None
    assert int(moves.sum()) == 95


def test_inspection_counts_them(tmp_path: Path) -> None:
    report = format_report(inspect_capture(DataConfig(root=with_priors(tmp_path), test_every=0)))
    assert "3 depth maps, 3 motion masks, 3 flow fields, 1 file of tracks" in report
