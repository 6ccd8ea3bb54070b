"""Masks by the difference from the background."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from dyngs.capture.fixed_camera import read_fixed_camera
from dyngs.capture.masks import (
    add_background_masks,
    background_of,
    estimate_alpha,
    measure_separation,
    person_mask,
    soften_outline,
)
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.images.images import read_image
from dyngs.io.write import write_image

HEIGHT, WIDTH, FRAMES, RADIUS = 120, 240, 12, 22


def clip(speed: float, noise: float = 2.0, shade: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Images (F, H, W, 3) uint8 of a checkered disc that moves ``speed`` px per frame, and its
    masks."""
    rng = np.random.default_rng(1)
    ground = rng.uniform(90, 170, (HEIGHT // 8, WIDTH // 8, 3)).repeat(8, 0).repeat(8, 1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    images = []
    masks = []
    for frame in range(FRAMES):
        middle = 30 + speed * frame
        mask = (rows - 56) ** 2 + (columns - middle) ** 2 < RADIUS**2
        inside = (abs(rows - 94) < 12) & (abs(columns - middle) < 28)
        shadow = ndimage.gaussian_filter(inside.astype(float), 4.0)
        colours = ground * (1 - (1 - shade) * shadow[..., None])
        own = np.where((rows // 3 + (columns - round(middle)) // 3) % 2 == 0, 30.0, 230.0)[
            ..., None
        ] * [1, 0.8, 0.5]
        colours = np.where(mask[..., None], own, colours) + rng.normal(0, noise, (HEIGHT, WIDTH, 3))
        images.append(np.clip(colours.round(), 0, 255).astype(np.uint8))
        masks.append(mask)
    return np.array(images), np.array(masks)


def worst_iou(found: np.ndarray, true: np.ndarray) -> float:
    return float(((found & true).sum((1, 2)) / (found | true).sum((1, 2))).min())


@pytest.mark.parametrize(
    ("noise", "shade", "least"), [(2.0, 1.0, 0.9), (5.0, 1.0, 0.85), (2.0, 0.7, 0.85)]
)
def test_who_walks_by_is_cut_out(noise: float, shade: float, least: float) -> None:
    images, true = clip(16.0, noise, shade)
    background = background_of(images)
    found = np.stack([person_mask(background, image) for image in images])
    assert worst_iou(found, true) > least
    assert measure_separation(background, images, found).is_clear


def rough(masks: np.ndarray) -> np.ndarray:
    """Masks as a detector has them: too wide in odd images, too narrow in even ones."""
    return np.stack(
        [
            (ndimage.binary_dilation if i % 2 else ndimage.binary_erosion)(x)
            for i, x in enumerate(masks)
        ]
    )


@pytest.mark.parametrize("speed", [16.0, 6.0])
def test_a_detector_and_the_background_outline_better_than_each(speed: float) -> None:
    """Also of somebody whose median over time is not the background."""
    images, true = clip(speed)
    alpha = estimate_alpha(images, rough(true))
    assert alpha is not None
    found = alpha > 0.5
    assert worst_iou(found, true) > 0.96 > worst_iou(rough(true), true)
    background = background_of(images)
    alone = np.stack([person_mask(background, image) for image in images])
    assert worst_iou(found, true) > worst_iou(alone, true)


def test_alpha_at_outlines_is_that_of_the_image() -> None:
    """Halves the error of softened masks where half of the outline is too wide by 2 px."""
    rng = np.random.default_rng(2)
    ground = rng.uniform(90, 170, (HEIGHT // 8, WIDTH // 8, 3)).repeat(8, 0).repeat(8, 1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    true = []
    images = []
    masks = []
    for frame in range(FRAMES):
        distance = np.hypot(rows - 60, columns - 40 - 14 * frame)
        true.append((RADIUS + 16.5 - distance).clip(0, 1))
        alpha = true[-1][..., None]
        colours = alpha * [40.0, 20.0, 60.0] + (1 - alpha) * ground
        noisy = colours + rng.normal(0, 2, colours.shape)
        images.append(noisy.round().clip(0, 255).astype(np.uint8))
        masks.append(distance < RADIUS + 16 + 2 * (rows < 60))
    alpha = estimate_alpha(np.array(images), np.array(masks))
    assert alpha is not None
    soft = np.stack([soften_outline(mask) for mask in masks])
    assert np.abs(alpha - true).sum() < 0.5 * np.abs(soft - true).sum()


def test_a_moving_camera_has_no_outlines_and_nobody_no_mask() -> None:
    images, true = clip(6.0)
    moved = np.stack([np.roll(image, 6 * t, axis=1) for t, image in enumerate(images)])
    assert estimate_alpha(moved, np.zeros_like(true)) is None
    nobody = estimate_alpha(images, np.zeros_like(true))
    assert nobody is not None
    assert not nobody.any()


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_who_stays_is_not(speed: float) -> None:
    images, _ = clip(speed)
    background = background_of(images)
    found = np.stack([person_mask(background, image) for image in images])
    assert not measure_separation(background, images, found).is_clear


SIZE = (60, 90)
COUNT = 9


def ground() -> np.ndarray:
    return (
        np.random.default_rng(0)
        .uniform(80, 180, (6, 9, 3))
        .repeat(10, 0)
        .repeat(10, 1)
        .astype(np.uint8)
    )


def moving_block(folder: Path, step: int, turn: int = 0) -> Capture:
    """A bright block that moves by ``step`` px per image, before a background that moves by
    ``turn``."""
    for i in range(COUNT):
        image = np.roll(ground(), turn * i, axis=1)
        image[20:50, 5 + step * i : 17 + step * i] = [250, 240, 20]
        write_image(folder / f"f{i}.png", image)
    return read_fixed_camera(DataConfig(root=folder))


def mask_of(capture: Capture, index: int) -> np.ndarray:
    silhouette = capture.splits["train"][index].silhouette
    assert silhouette is not None
    return read_image(silhouette.path)[..., 0].numpy() > 127


def iou_of(mask: np.ndarray, step: int, index: int) -> float:
    true = np.zeros(SIZE, bool)
    true[20:50, 5 + step * index : 17 + step * index] = True
    return (mask & true).sum() / (mask | true).sum()


def test_who_walks_by_gets_masks(tmp_path: Path) -> None:
    said: list[str] = []
    capture = add_background_masks(moving_block(tmp_path / "c", 8), tmp_path / "m", log=said.append)
    assert capture.has_alpha
    assert all(iou_of(mask_of(capture, i), 8, i) > 0.9 for i in range(COUNT))
    assert len(said) == 1
    assert "of the outlines lie on image edges" in said[0]


def test_who_stays_needs_masks(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"no person stands out .*--masks"):
        add_background_masks(moving_block(tmp_path / "c", 0), tmp_path / "m")


def test_a_camera_that_moves_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="moves, so its background is unknown"):
        add_background_masks(moving_block(tmp_path / "c", 8, turn=2), tmp_path / "m")
    capture = moving_block(tmp_path / "d", 8)
    views = list(capture.splits["train"])
    pose = views[3].cam_from_world.copy()
    pose[0, 3] = 0.1
    views[3] = replace(views[3], cam_from_world=pose)
    with pytest.raises(DyngsError, match="moves, so its background is unknown"):
        add_background_masks(capture.replace(splits={"train": tuple(views)}), tmp_path / "m")
