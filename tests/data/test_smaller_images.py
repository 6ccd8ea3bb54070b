"""Copies of images in ``images_2``, ``images_4``: when they are read, and that scenes stay the
same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_captures import opengl_pose, write_colmap, write_frames, write_image

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.data.read import describe_shrinking

WIDTH, HEIGHT, COUNT = 64, 48, 4
GREY = {1: 50, 2: 100, 4: 150, 8: 200}
"""Grey level of the images of each size."""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    names = [f"images/{i}.png" for i in range(COUNT)]
    for factor, level in GREY.items():
        folder = "images" if factor == 1 else f"images_{factor}"
        for i in range(COUNT):
            pixels = np.full((HEIGHT // factor, WIDTH // factor, 3), level, np.uint8)
            write_image(tmp_path / folder / f"{i}.png", pixels)
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 50.0, "cx": 30.0, "cy": 26.0}
    write_frames(tmp_path / "transforms.json", names, lens, opengl_pose)
    return tmp_path


def read(root: Path, **options: object) -> tuple[Capture, DataConfig]:
    config = DataConfig.model_validate({"root": root, "test_every": 0, **options})
    return read_capture(config), config


@pytest.mark.parametrize(
    ("options", "factor", "size"),
    [
        ({}, 1, (64, 48)),
        ({"downscale": 1.5}, 1, (43, 32)),
        ({"downscale": 2}, 2, (32, 24)),
        ({"downscale": 3}, 2, (21, 16)),
        ({"downscale": 4}, 4, (16, 12)),
        ({"downscale": 16}, 8, (4, 3)),
        ({"longest_side": 40}, 1, (40, 30)),
        ({"longest_side": 20}, 2, (20, 15)),
        ({"longest_side": 16}, 4, (16, 12)),
        ({"longest_side": 24, "downscale": 4}, 4, (16, 12)),
    ],
)
def test_smallest_copy_that_is_large_enough(
    root: Path, options: dict, factor: int, size: tuple[int, int]
) -> None:
    capture, config = read(root, **options)
    loader = ImageLoader(capture.splits["train"], config)
    assert loader.sizes == [size] * COUNT
    image = loader[0]
    assert (image.cameras.width, image.cameras.height) == size
    np.testing.assert_allclose(image.rgb_premultiplied, GREY[factor] / 255, atol=1e-6)
    scale = size[0] / WIDTH
    expected = [
        [50 * scale, 0, 30 * scale],
        [0, 50 * size[1] / HEIGHT, 26 * size[1] / HEIGHT],
        [0, 0, 1],
    ]
    np.testing.assert_allclose(image.cameras.intrinsics[0], expected, rtol=1e-6)
    names = [view.name for view in capture.splits["train"]]
    assert names == [f"images/{i}" for i in range(COUNT)]
    lines = [f"images_{factor} is read instead of images"] if factor > 1 else []
    assert [line.partition(",")[0] for line in capture.warnings] == lines


def test_message_on_shrinking_names_the_full_size(root: Path) -> None:
    """Views of a smaller copy count with the size of their originals."""
    capture, config = read(root, longest_side=20)
    message = describe_shrinking(capture.splits, config)
    assert message is not None
    assert message.startswith("images of 64x48 px are shrunk to 20x15")
    capture, config = read(root)
    assert describe_shrinking(capture.splits, config) is None


@pytest.mark.parametrize("is_absent", [False, True])
def test_copies_of_a_colmap_capture(tmp_path: Path, is_absent: bool) -> None:
    write_colmap(tmp_path)
    for path in sorted((tmp_path / "images").rglob("*.jpg")):
        small = tmp_path / "images_2" / path.relative_to(tmp_path / "images").with_suffix(".JPG")
        write_image(small, np.full((4, 6, 3), 255, np.uint8))
    if is_absent:
        (tmp_path / "images").rename(tmp_path / "other")
    capture, config = read(tmp_path, longest_side=6)
    images = ImageLoader(capture.splits["train"], config)
    assert len(images) == 9
    assert all(float(images[i].rgb_premultiplied.min()) == 1 for i in range(9))
    np.testing.assert_allclose(images[0].cameras.intrinsics[0, 0, 0], 5.0)
