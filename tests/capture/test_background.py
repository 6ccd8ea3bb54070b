"""Masks by the difference from the background: a disc that crosses an image with texture, noise and its shadow."""

import numpy as np
import pytest
from scipy import ndimage

from dyngs.capture.background import background_of, person_mask, separation

HEIGHT, WIDTH, FRAMES, RADIUS = 120, 240, 12, 22


def clip(speed: float, noise: float = 2.0, shade: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Images (F, H, W, 3) uint8 of a checkered disc that moves ``speed`` px per frame, and its masks."""
    rng = np.random.default_rng(1)
    ground = rng.uniform(90, 170, (HEIGHT // 8, WIDTH // 8, 3)).repeat(8, 0).repeat(8, 1)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    images, masks = [], []
    for frame in range(FRAMES):
        middle = 30 + speed * frame
        mask = (rows - 56) ** 2 + (columns - middle) ** 2 < RADIUS**2
        inside = (abs(rows - 94) < 12) & (abs(columns - middle) < 28)
        shadow = ndimage.gaussian_filter(inside.astype(float), 4.0)
        colours = ground * (1 - (1 - shade) * shadow[..., None])
        own = np.where((rows // 3 + (columns - round(middle)) // 3) % 2 == 0, 30.0, 230.0)[..., None] * [1, 0.8, 0.5]
        colours = np.where(mask[..., None], own, colours) + rng.normal(0, noise, (HEIGHT, WIDTH, 3))
        images.append(np.clip(colours.round(), 0, 255).astype(np.uint8))
        masks.append(mask)
    return np.array(images), np.array(masks)


def worst_iou(found: np.ndarray, true: np.ndarray) -> float:
    return float(((found & true).sum((1, 2)) / (found | true).sum((1, 2))).min())


@pytest.mark.parametrize(("noise", "shade", "least"), [(2.0, 1.0, 0.9), (5.0, 1.0, 0.85), (2.0, 0.7, 0.85)])
def test_who_walks_by_is_cut_out(noise: float, shade: float, least: float) -> None:
    images, true = clip(16.0, noise, shade)
    background = background_of(images)
    found = np.stack([person_mask(background, image) for image in images])
    assert worst_iou(found, true) > least
    assert separation(background, images, found).is_clear


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_who_stays_is_not(speed: float) -> None:
    images, _ = clip(speed)
    background = background_of(images)
    found = np.stack([person_mask(background, image) for image in images])
    assert not separation(background, images, found).is_clear


def test_nobody_is_not_found() -> None:
    images, _ = clip(16.0)
    empty = np.repeat(images[:1, :, 120:], 5, axis=0)
    assert not person_mask(background_of(empty), empty[0]).any()
