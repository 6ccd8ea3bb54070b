"""The preset that fits a capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_captures import write_image

from dyngs.capture.preset import choose_preset
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError


def preset_of(root: Path) -> str:
    return choose_preset(DataConfig(root=root))[0]


def test_captures(blender_root: Path, moving: Path, person: Path) -> None:
    assert preset_of(blender_root) == "static"
    assert preset_of(moving) == "dynamic"
    assert preset_of(person) == "human"


def test_photos_and_videos(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    for i in range(3):
        write_image(photos / f"{i}.png", np.full((4, 6, 3), i, np.uint8))
    assert preset_of(photos) == "static"
    assert choose_preset(DataConfig(root=photos, times="order"))[0] == "dynamic"
    for name in ("clip.mp4", "rig/left.mp4", "rig/right.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert preset_of(tmp_path / "clip.mp4") == "dynamic"
    assert preset_of(tmp_path / "rig") == "dynamic"


def test_folders_without_a_capture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no capture found"):
        preset_of(tmp_path)
    (tmp_path / "people.json").touch()
    with pytest.raises(DyngsError, match="several people; choose a preset, such as gps"):
        preset_of(tmp_path)
