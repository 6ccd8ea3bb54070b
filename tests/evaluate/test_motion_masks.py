"""Estimated motion masks against images whose moving pixels are known."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.evaluate.motion_masks import MotionMasks
from dyngs.io.write import write_image

SIDE = 64
FOCAL = 64.0
DEPTH = 4.0
FLAG = Path(__file__).parents[3] / "shared/data/flag"


def write_clip(
    root: Path,
    count: int,
    camera_x: Callable[[int], float] = lambda _: 0.0,
    *,
    noise: float = 0.0,
    walks: bool = True,
) -> None:
    """A camera in front of a textured wall, before which a square of 12x12 pixels walks.

    The camera moves sideways, so the wall shifts by FOCAL / DEPTH pixels per unit.
    """
    rng = np.random.default_rng(0)
    wall = rng.uniform(0.1, 0.5, (SIDE, 2 * SIDE, 3)).repeat(4, 0).repeat(4, 1)[:SIDE]
    frames = []
    for k in range(count):
        shift = round(FOCAL / DEPTH * camera_x(k))
        image = wall[:, 32 + shift : 32 + shift + SIDE].copy()
        image += noise * rng.standard_normal(image.shape)
        if walks:
            image[26:38, left(k) : left(k) + 12] = (1.0, 0.2, 0.1)
        write_image(root / f"images/{k:03d}.png", image.clip(0, 1).astype(np.float32))
        pose = np.eye(4)  # OpenGL axes: looks along -z
        pose[0, 3] = camera_x(k)
        frames.append(
            {
                "file_path": f"images/{k:03d}.png",
                "transform_matrix": pose.tolist(),
                "time": float(k),
            }
        )
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": SIDE / 2, "cy": SIDE / 2, "w": SIDE, "h": SIDE}
    points = np.full((400, 3), -DEPTH)
    points[:, 0] = rng.uniform(-3, 3, 400)
    points[:, 1] = rng.uniform(-2, 2, 400)
    trimesh.PointCloud(points).export(root / "points.ply")
    capture = {**lens, "ply_file_path": "points.ply", "frames": frames}
    (root / "transforms.json").write_text(json.dumps(capture))


def sideways(k: int) -> float:
    """Position of a camera before which the wall shifts by one pixel per frame."""
    return k * DEPTH / FOCAL


def left(k: int) -> int:
    """Left column of the square in frame ``k``."""
    return 2 + 4 * k


def overlap(mask: Tensor, truth: Tensor) -> float:
    """Return the intersection over union of two masks."""
    return int((mask & truth).sum()) / int((mask | truth).sum())


def masks_of(root: Path) -> list[tuple[Tensor, Tensor]]:
    """Return the estimated and the true mask of each frame."""
    options = DataConfig(root=root)
    capture = read_capture(options)
    masks = MotionMasks(capture, options)
    found = []
    for views in capture.splits.values():
        for view in views:
            mask = masks.mask(view, SIDE, SIDE)
            assert mask is not None
            k = int(Path(view.image_path).stem)
            truth = torch.zeros(SIDE, SIDE, dtype=torch.bool)
            truth[26:38, left(k) : left(k) + 12] = True
            found.append((mask, truth))
    return found


@pytest.mark.parametrize("moves", [False, True])
def test_what_walks_before_a_wall_moves(moves: bool, tmp_path: Path) -> None:
    """Before a fixed camera, and before one that moves by one pixel per frame."""
    write_clip(tmp_path, 12, sideways if moves else lambda _: 0.0, noise=0.005)
    for mask, truth in masks_of(tmp_path):
        assert overlap(mask, truth) > 0.7


def test_nothing_moves_in_a_static_clip(tmp_path: Path) -> None:
    write_clip(tmp_path, 12, sideways, noise=0.005, walks=False)
    for mask, _ in masks_of(tmp_path):
        assert not mask.any()


def test_masks_are_stored_by_the_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another image size or split gives the same masks; other images do not."""
    monkeypatch.setenv("DYNGS_CACHE_DIR", str(tmp_path / "cache"))
    root = tmp_path / "clip"
    write_clip(root, 6)
    masks_of(root)
    (folder,) = (tmp_path / "cache/motion").iterdir()
    assert len(list(folder.iterdir())) == 6
    for file in folder.iterdir():
        write_image(file, np.full((8, 8), 255, np.uint8))
    options = DataConfig(root=root, test_every=2, longest_side=16)
    capture = read_capture(options)
    view = capture.splits["test"][0]
    mask = MotionMasks(capture, options).mask(view, 16, 16)
    assert mask is not None
    assert mask.shape == (16, 16)
    assert mask.all()
    (folder / "00001.png").write_bytes(b"damaged")
    for damaged, _ in masks_of(root):
        assert damaged.shape == (SIDE, SIDE)
    write_clip(root, 6, noise=0.01)
    mask = MotionMasks(capture, options).mask(view, 16, 16)
    assert mask is not None
    assert not mask.all()


def test_two_times_are_too_few(tmp_path: Path) -> None:
    write_clip(tmp_path, 2)
    options = DataConfig(root=tmp_path)
    capture = read_capture(options)
    assert MotionMasks(capture, options).mask(capture.splits["train"][0], SIDE, SIDE) is None


@pytest.mark.skipif(not FLAG.is_dir(), reason="needs the capture `flag`")
def test_a_cloth_waves_on_a_still_pole() -> None:
    """The cloth is red and yellow, pole and base are nearly grey; one camera per time."""
    options = DataConfig(root=FLAG, longest_side=120)
    capture = read_capture(options)
    masks = MotionMasks(capture, options)
    loader = ImageLoader(capture.splits["test"], options)
    scores = []
    for i in (3, 12):
        image = loader[i]
        alpha = image.alpha
        assert alpha is not None
        straight = image.rgb_premultiplied / alpha.clamp_min(1e-3)[..., None]
        highest = straight.amax(-1)
        saturation = (highest - straight.amin(-1)) / highest.clamp_min(1e-3)
        mask = masks.mask(loader.views[i], 120, 120)
        assert mask is not None
        scores.append(overlap(mask, (alpha > 0.5) & (saturation > 0.42)))
    assert np.mean(scores) > 0.7
