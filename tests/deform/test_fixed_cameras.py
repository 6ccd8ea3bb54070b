"""Change detection in the images of a fixed camera, robust to noise and shadows."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from static_balls import BLACK, Ball, cameras, drawn, filmed

from dyngs.data.loader import Image
from dyngs.deform.fixed_cameras import LONGEST_SIDE, build_fixed_camera_clip, detect_changes

TIMES = tuple(i / 8 for i in range(9))


def static(noise: float = 0.0, count: int = 9) -> np.ndarray:
    """Images (T, H, W, 3) of a static scene by one camera."""
    shown = [drawn(cameras(1)[0], [], noise, seed) for seed in range(count)]
    return (255 * torch.stack(shown)).round().to(torch.uint8).numpy()


def with_patch(factor: tuple[float, float, float], at: int = 0) -> np.ndarray:
    """The images with the brightness of a square changed in image ``at``."""
    images = static().copy()
    images[at, 20:40, 20:40] = (
        (images[at, 20:40, 20:40] * np.array(factor)).clip(0, 255).astype(np.uint8)
    )
    return images


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_ball_is_found_at_its_position(noise: float) -> None:
    """Pixels whose rays hit the ball are marked in each image, except at its rim."""
    path = [Ball((0.0, 1.2 * t - 0.6, 0.0)) for t in TIMES]
    camera = cameras(1)[0]
    one = filmed(lambda t: [path[TIMES.index(t)]], TIMES, 1, noise)[0]
    for i, ball in enumerate(path):
        truth = (drawn(camera, [ball]) != drawn(camera, [])).any(-1).numpy()
        both = (truth & one.changed[i]).sum() / (truth | one.changed[i]).sum()
        assert both > 0.85
    assert np.abs(one.median / 255 - drawn(camera, []).numpy()).mean() < 0.02


def test_shadows_are_not_changes() -> None:
    """A shadow darkens all channels alike. Coloured, brighter and black patches are objects."""
    assert not detect_changes(with_patch((0.6, 0.62, 0.65))).any()
    for factor in ((0.9, 0.4, 0.4), (1.4, 1.4, 1.4), (0.05, 0.05, 0.05)):
        found = detect_changes(with_patch(factor, 3))
        assert found[3, 21:39, 21:39].all()
        assert found.sum() < 1.2 * 20 * 20


def test_large_images_are_shrunk_and_masks_kept() -> None:
    width = 2 * LONGEST_SIDE
    camera = cameras(1)[0]
    large = type(camera)(camera.cam_from_world, camera.intrinsics, width, 10)
    mask = torch.ones(10, width)
    mask[:, :20] = 0
    images = [
        Image("view", large, torch.full((10, width, 3), 0.1 * i), None, mask, i / 2)
        for i in range(3)
    ]
    one = build_fixed_camera_clip(images, BLACK)
    assert one.images.shape == (3, 5, LONGEST_SIDE, 3)
    assert not one.counted[:, :, :10].any()
    assert one.counted[:, :, 10:].all()
    assert not one.changed[:, :, :10].any()
    assert one.times == (0.0, 0.5, 1.0)
    assert build_fixed_camera_clip(images, BLACK, total=8000).images.shape[2] == LONGEST_SIDE // 2
    with pytest.raises(ValueError, match="no images"):
        build_fixed_camera_clip([], BLACK)
