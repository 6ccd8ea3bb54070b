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
from dyngs.data.loader import Image
from dyngs.evaluate.motion_masks import MotionMasks
from dyngs.evaluate.view_scores import (
    NO_ALPHA,
    NO_MOTION_KNOWN,
    NO_TIMES,
    TOO_SMALL,
    Regions,
)

SIDE = 24
WHITE = torch.ones(3)


class KnownMasks:
    """Masks in place of estimated ones."""

    def mask(self, view: View, width: int, height: int) -> torch.Tensor | None:
        if view.time is None:
            return None
        mask = torch.zeros(height, width, dtype=torch.bool)
        start = int(view.name.removeprefix("v"))
        mask[9:15, 3 * start : 3 * start + 6] = True
        return mask


def images_of_a_walk(count: int = 5) -> list[Image]:
    """A white square of 6x6 pixels walks over grey ground."""
    shown = []
    for k in range(count):
        rgb = torch.full((SIDE, SIDE, 3), 0.4)
        rgb[9:15, 3 * k : 3 * k + 6] = 1.0
        shown.append(Image(f"v{k}", camera(SIDE, SIDE), rgb, None, None, k / (count - 1)))
    return shown


def regions_of(images: Sequence[Image], *, known: bool = True) -> Regions:
    views = [
        View(x.name, Path(x.name), np.eye(4), np.eye(3), SIDE, SIDE, time=x.time) for x in images
    ]
    return Regions(views, cast(MotionMasks, KnownMasks()) if known else None)


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
    truth = image.rgb_premultiplied
    assert scores["ssim_moving"] is not None
    assert scores["ssim_moving"] < 0.99
    assert scores["flip_moving"] is None, "FLIP was not requested"
    exact = truth.clone()
    exact[20:] = 0.0
    exact = regions.scores(image, exact, truth, with_flip=True)
    assert exact["ssim_moving"] == pytest.approx(1.0)
    assert exact["flip_moving"] in (None, 0.0)


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
    moved = regions_of(images, known=False)
    assert moved.moving(images[0]) is None
    assert (moved.reason("psnr_moving"), moved.moving_from) == (NO_MOTION_KNOWN, None)
    still = regions_of([replace(p, time=None) for p in images])
    assert still.moving(images[0]) is None
    assert still.reason("psnr_static") == NO_TIMES
    outside = replace(images[0], name="v9")
    nothing = regions_of([outside])
    truth = outside.rgb_premultiplied
    scores = nothing.scores(outside, truth, truth)
    assert (scores["psnr_moving"], scores["psnr_static"]) == (None, 100.0)
    assert nothing.reason("psnr_moving") == TOO_SMALL


def test_flicker_is_the_deviation_of_static_pixels_over_time() -> None:
    """Renderings alternate by 0.02 where nothing moves; the images do not change there."""
    images = images_of_a_walk()
    regions = regions_of(images)
    for k, image in enumerate(images):
        rendered = image.rgb_premultiplied + 0.02 * (k % 2)
        rendered[9:15, :18] = 0.2 * k  # where the square walks
        regions.scores(image, rendered, image.rgb_premultiplied)
    expected = float(np.std([0.0, 0.02, 0.0, 0.02, 0.0], ddof=1))
    flicker = regions.flicker()
    assert flicker["flicker_static"] == pytest.approx(expected, abs=1e-6)
    assert flicker["flicker_static_images"] == pytest.approx(0.0, abs=1e-6)
    assert regions_of(images[:1]).flicker() == {}


def test_flicker_before_a_moving_camera_is_that_of_static_points() -> None:
    """A point on the ground, one that the square hides in one view, and one behind the camera."""
    images = images_of_a_walk()
    poses = [np.eye(4) for _ in images]
    for k, pose in enumerate(poses):
        pose[:3, 3] = 0.1 * k, 0.0, 4.0
    intrinsics = camera(SIDE, SIDE).intrinsics[0].double().numpy()
    views = [
        View(x.name, Path(x.name), pose, intrinsics, SIDE, SIDE, time=x.time)
        for x, pose in zip(images, poses, strict=True)
    ]
    points = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -9.0]])
    regions = Regions(views, cast(MotionMasks, KnownMasks()), points)
    for k, image in enumerate(images):
        rendered = torch.full((SIDE, SIDE, 3), 0.2 * k)
        rendered[20:] = 0.4 + 0.02 * (k % 2)  # the ground
        regions.scores(image, rendered, image.rgb_premultiplied)
    expected = float(np.std([0.0, 0.02, 0.0, 0.02, 0.0], ddof=1))
    assert regions.flicker()["flicker_static"] == pytest.approx(expected, abs=1e-6)
    assert regions.flicker()["flicker_static_images"] == pytest.approx(0.0, abs=1e-6)
