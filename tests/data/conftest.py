"""Tiny captures on disk, and the shared real ones where they are present."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_captures import random_pixels, write_colmap, write_frames, write_picture

SHARED = Path(__file__).parents[2] / "../shared/data"


@pytest.fixture
def blender_root(tmp_path: Path) -> Path:
    """16 train and 2 test RGBA pictures of 12x8."""
    for split, count in (("train", 16), ("test", 2)):
        names = [f"./{split}/r_{i}" for i in range(count)]
        for i, name in enumerate(names):
            write_picture(tmp_path / f"{name}.png", random_pixels(8, 12, 4, seed=i))
        write_frames(tmp_path / f"transforms_{split}.json", names, {"camera_angle_x": 0.7})
    return tmp_path


@pytest.fixture
def nerfstudio_root(tmp_path: Path) -> Path:
    """10 JPEG pictures of 12x8 with OPENCV distortion."""
    names = [f"images/{i:02d}.jpg" for i in range(10)]
    for i, name in enumerate(names):
        write_picture(tmp_path / name, random_pixels(8, 12, 3, seed=i))
    fields = {"w": 12, "h": 8, "fl_x": 10.0, "fl_y": 11.0, "cx": 6.5, "cy": 3.5, "camera_model": "OPENCV"}
    write_frames(tmp_path / "transforms.json", names, {**fields, "k1": 0.1, "p2": -0.01})
    return tmp_path


@pytest.fixture
def colmap_root(tmp_path: Path) -> Path:
    """Nine pictures in two subfolders, binary model."""
    return write_colmap(tmp_path)


@pytest.fixture
def shared() -> Path:
    """The folder of real captures."""
    if not SHARED.is_dir():
        pytest.skip("the real captures of ../shared/data are not here")
    return SHARED
