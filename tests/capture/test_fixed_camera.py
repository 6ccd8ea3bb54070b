"""A folder of frames as a capture of one fixed camera: order, size, masks, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from dyngs.capture.fixed_camera import FOCAL, read_fixed_camera
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.io.write import write_image


def frames(folder: Path, count: int, size: tuple[int, int] = (12, 16), channels: int = 3) -> Path:
    for i in range(count):
        write_image(folder / f"f{i}.png", np.full((*size, channels), 10 * i, np.uint8))
    return folder


def test_frames_are_in_order_with_one_camera(tmp_path: Path) -> None:
    capture = read_fixed_camera(DataConfig(root=frames(tmp_path / "c", 11)))
    views = capture.splits["train"]
    assert [view.name for view in views] == [f"f{i}" for i in range(11)]
    assert [view.frame for view in views] == list(range(11))
    assert (views[0].time, views[-1].time) == (0.0, 1.0)
    assert views[3].intrinsics.tolist() == [[FOCAL * 16, 0, 8], [0, FOCAL * 16, 6], [0, 0, 1]]
    assert not capture.has_alpha
    assert "guessed" in capture.warnings[0]


def test_frames_are_chosen_by_number_or_evenly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = frames(tmp_path / "c" / "images", 9).parent
    chosen = read_fixed_camera(DataConfig(root=root, frames="1:8:3")).splits["train"]
    assert [view.name for view in chosen] == ["f1", "f4", "f7"]
    monkeypatch.setattr("dyngs.capture.fixed_camera.MOST_FRAMES", 3)
    spread = read_fixed_camera(DataConfig(root=root)).splits["train"]
    assert [view.name for view in spread] == ["f0", "f3", "f6"]
    with pytest.raises(DyngsError, match="selects none of 9 frames"):
        read_fixed_camera(DataConfig(root=root, frames="20:"))


def test_masks_are_named_as_images(tmp_path: Path) -> None:
    root = frames(tmp_path / "c", 3)
    masks = frames(tmp_path / "m", 2, channels=1)
    with pytest.raises(DyngsError, match=r"no mask for 1 of 3 images, first f2\.png"):
        read_fixed_camera(DataConfig(root=root), masks)
    capture = read_fixed_camera(DataConfig(root=root, frames=":2"), masks)
    shown = capture.splits["train"][1].silhouette
    assert capture.has_alpha
    assert shown is not None
    assert shown.path.name == "f1.png"
    with pytest.raises(DyngsError, match="no such folder of masks"):
        read_fixed_camera(DataConfig(root=root), tmp_path / "none")
