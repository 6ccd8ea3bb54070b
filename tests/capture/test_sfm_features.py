"""Features of frames: weak ones are left out where there are many."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from skimage.filters import gaussian

from dyngs.capture import sfm_features
from dyngs.capture.photos import Photo
from dyngs.capture.sfm_features import find_features
from dyngs.capture.sfm_work import SfmOptions, SfmTask
from dyngs.data.images.images import read_header
from dyngs.io.write import write_image


def test_weak_features_are_left_out_where_frames_have_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    names = [f"{i}.png" for i in range(4)]
    for name in names:
        texture = gaussian(rng.random((96, 128)), 1.5)
        write_image(
            tmp_path / "images" / name, np.repeat((texture - 0.2).clip(0, 1)[..., None], 3, 2)
        )
    photos = [Photo(name, read_header(tmp_path / "images" / name)) for name in names]
    options = SfmOptions(num_threads=1)
    task = SfmTask(tmp_path / "all.db", tmp_path / "images", names, photos, options)
    assert find_features(task) == 1.0
    with pycolmap.Database.open(task.database) as opened:
        count = opened.num_keypoints() / len(names)
    fewer = SfmTask(
        tmp_path / "fewer.db", tmp_path / "images", names, photos, options, is_video=True
    )
    monkeypatch.setattr(sfm_features, "ENOUGH", int(count * 0.7))
    assert find_features(fewer) > 1
    with pycolmap.Database.open(fewer.database) as opened:
        assert 0 < opened.num_keypoints() / len(names) <= 0.9 * count
    monkeypatch.setattr(sfm_features, "ENOUGH", 10 * int(count))
    assert find_features(fewer) == 1.0
