"""Regions of images against images whose moving pixels are known, and the PSNR inside them against
closed forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from moving_scene import camera

from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.evaluate.view_scores import (
    NO_ALPHA,
    NO_MOTION_KNOWN,
    NO_TIMES,
    TOO_SMALL,
    Regions,
)

SIDE = 24
WHITE = torch.ones(3)


def images_of_a_walk(count: int = 5) -> list[Image]:
    """A white square of 6x6 pixels walks over grey ground; a single pixel flashes in the third
    image."""
    shown = []
    for k in range(count):
        rgb = torch.full((SIDE, SIDE, 3), 0.4)
        rgb[9:15, 3 * k : 3 * k + 6] = 1.0
        if k == 2:
            rgb[20, 20] = 1.0
        shown.append(Image(f"v{k}", camera(SIDE, SIDE), rgb, None, None, k / (count - 1)))
    return shown


def views_of(images: Sequence[Image], *, standing: bool = True) -> list[View]:
    poses = [np.eye(4) for _ in images]
    for k, pose in enumerate(poses):
        pose[0, 3] = 0.0 if standing else k
    return [
        View(p.name, Path(p.name), pose, np.eye(3), SIDE, SIDE, time=p.time)
        for p, pose in zip(images, poses, strict=True)
    ]


def regions_of(images: Sequence[Image], *, standing: bool = True) -> Regions:
    return Regions(views_of(images, standing=standing), cast(ImageLoader, images), WHITE)


def test_pixels_that_change_before_a_fixed_camera_are_moving() -> None:
    images = images_of_a_walk()
    regions = regions_of(images)
    for k, image in enumerate(images):
        expected = torch.zeros(SIDE, SIDE, dtype=torch.bool)
        expected[9:15, 3 * k : 3 * k + 6] = True
        moving = regions.moving(image)
        assert moving is not None
        assert torch.equal(moving, expected), "and the single pixel does not count"
    assert regions.moving_from == "change over time"


def test_scores_are_those_of_the_pixels_of_each_region() -> None:
    images = images_of_a_walk()
    regions = regions_of(images)
    image = images[1]
    rendered = image.rgb_premultiplied.clone()
    rendered[9:15, 3:9] -= 0.1
    rendered[0, :, :] += 0.01
    scores = regions.scores(image, rendered, image.rgb_premultiplied)
    assert scores["psnr_foreground"] is None
    assert scores["psnr_moving"] == pytest.approx(20.0, abs=1e-3)
    rest = SIDE * SIDE - 36
    assert scores["psnr_static"] == pytest.approx(-10 * np.log10(SIDE * 1e-4 / rest), abs=1e-3)
    assert regions.reason("psnr_foreground") == NO_ALPHA


def test_motion_masks_come_first_and_empty_background_counts_nowhere() -> None:
    moves = torch.zeros(SIDE, SIDE)
    alpha = torch.zeros(SIDE, SIDE)
    moves[:, :12], alpha[:12] = 1.0, 1.0
    black = torch.zeros(SIDE, SIDE, 3)
    image = replace(images_of_a_walk()[0], alpha=alpha, rgb_premultiplied=black, motion_mask=moves)
    regions = regions_of([image])
    truth = image.composite(WHITE)
    rendered = truth.clone()
    rendered[:12, :12] += 0.1
    rendered[12:] -= 0.5
    scores = regions.scores(image, rendered, truth)
    assert scores["psnr_moving"] == pytest.approx(20.0, abs=1e-3)
    assert scores["psnr_static"] == 100.0
    assert scores["psnr_foreground"] == pytest.approx(20.0 + 10 * np.log10(2), abs=1e-3)
    assert regions.moving_from == "motion masks"


def test_a_mask_of_a_image_holds_in_its_regions() -> None:
    images = images_of_a_walk()
    mask = torch.ones(SIDE, SIDE)
    mask[12:] = 0
    image = replace(images[1], mask=mask)
    rendered = image.rgb_premultiplied.clone()
    rendered[12:] = 0
    assert (
        regions_of(images).scores(image, rendered, image.rgb_premultiplied)["psnr_static"] == 100.0
    )
    hidden = replace(image, mask=torch.zeros(SIDE, SIDE))
    assert (
        regions_of(images).scores(hidden, rendered, image.rgb_premultiplied)["psnr_static"] is None
    )


def test_reasons_say_why_there_is_no_score() -> None:
    images = images_of_a_walk()
    moved = regions_of(images, standing=False)
    assert moved.moving(images[0]) is None
    assert (moved.reason("psnr_moving"), moved.moving_from) == (NO_MOTION_KNOWN, None)
    still = regions_of([replace(p, time=None) for p in images])
    assert still.moving(images[0]) is None
    assert still.reason("psnr_static") == NO_TIMES
    same = [replace(p, rgb_premultiplied=torch.full((SIDE, SIDE, 3), 0.4)) for p in images]
    nothing = regions_of(same)
    scores = nothing.scores(same[0], same[0].rgb_premultiplied, same[0].rgb_premultiplied)
    assert (scores["psnr_moving"], scores["psnr_static"]) == (None, 100.0)
    assert nothing.reason("psnr_moving") == TOO_SMALL
