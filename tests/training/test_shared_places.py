"""Gains of images are found from places that several show, whatever the images are of."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from flat_wall import SIZE, cameras_before_wall, learned, seen_from, with_block, with_depth
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.models.renderable import Rendering
from dyngs.training.shared_places import log_gains

COUNT = 12
GAINS = torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(0)) + 0.5


def drawn(cameras: Cameras, time: float | None) -> Rendering:
    return with_depth(cameras)


def images_with(gains: Tensor) -> Any:
    """Return images along a wall, so that the first and the last have nothing in common; whites are cut off."""
    cameras = cameras_before_wall(COUNT, step=0.8)
    return [
        replace(image, rgb_premultiplied=(gain * image.rgb_premultiplied).clamp_max(1))
        for image, gain in zip(seen_from(cameras), gains, strict=True)
    ]


def found(images: list[Image], which: list[int] | None = None) -> Tensor:
    return log_gains(images, list(range(COUNT)) if which is None else which, drawn)  # type: ignore[arg-type]


def test_gains_of_images_that_only_neighbours_share_places_with() -> None:
    wanted = GAINS.log() - GAINS.log().mean(0)
    torch.testing.assert_close(found(images_with(GAINS)), wanted, atol=0.03, rtol=0)


def test_images_that_agree_have_none() -> None:
    torch.testing.assert_close(found(images_with(torch.ones(COUNT, 3))), torch.zeros(COUNT, 3), atol=0.01, rtol=0)


def test_what_stands_in_front_of_some_does_not_matter() -> None:
    images = images_with(GAINS)
    for i in (2, 3, 7):
        images[i] = with_block(images[i], slice(15, 45), slice(20, 50))
    wanted = GAINS.log() - GAINS.log().mean(0)
    torch.testing.assert_close(found(images), wanted, atol=0.08, rtol=0)


def test_images_that_are_held_out_are_not_looked_at() -> None:
    images = images_with(GAINS)
    which = [i for i in range(COUNT) if i != 5]
    before = found(images, which)
    images[5] = replace(images[5], rgb_premultiplied=torch.rand(SIZE[1], SIZE[0], 3))
    assert torch.equal(found(images, which), before)
    assert not bool(before[5].any())


@pytest.mark.parametrize("hidden", ["masked", "transparent", "far"])
def test_without_shared_places_nothing_is_corrected(hidden: str) -> None:
    images = images_with(GAINS)
    nothing = torch.zeros(SIZE[1], SIZE[0])
    if hidden == "masked":
        images = [replace(x, mask=nothing) for x in images]
    elif hidden == "transparent":
        images = [replace(x, alpha=nothing) for x in images]
    else:
        cameras = cameras_before_wall(COUNT, step=50.0)
        images = [replace(x, cameras=camera) for x, camera in zip(images, cameras, strict=True)]
    torch.testing.assert_close(found(images), torch.zeros(COUNT, 3), atol=1e-6, rtol=0)


def test_what_the_scene_looks_like_does_not_matter() -> None:
    """Only its depth does."""
    images = images_with(GAINS)
    assert float(learned(images[0].cameras).std()) > 0
    dark = log_gains(
        images,
        list(range(COUNT)),
        lambda cameras, time: replace(with_depth(cameras), rgb=0.1 * with_depth(cameras).rgb),
    )
    assert torch.equal(dark, found(images))
