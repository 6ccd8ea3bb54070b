"""Neighbour views are sampled at the right pixels."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from flat_wall import (
    BLACK,
    DISTANCE,
    cameras_before_wall,
    learned,
    seen_from,
    wall,
    with_block,
    with_depth,
)
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.models.renderable import Rendering
from dyngs.training.corrections.cells import cell_camera
from dyngs.training.corrections.exposure import estimate_log_gains
from dyngs.training.corrections.robust import FEWEST, NeighbourViews


def asked(
    count: int, step: float = 0.15, distance: float = DISTANCE, alpha: float = 1.0
) -> torch.Tensor:
    """Return the differences of other views from what a perfect model shows of view 1, for all of
    its cells."""
    cameras = cameras_before_wall(count, step)
    others = NeighbourViews(seen_from(cameras), cameras)  # type: ignore[arg-type]
    rgb = wall(cameras[1])
    more = torch.stack(
        [torch.full_like(rgb[..., 0], distance), torch.full_like(rgb[..., 0], alpha)], -1
    )
    cells = cell_camera(cameras[1])
    grid = (cells.height, cells.width)
    drawn = adaptive_avg_pool2d(torch.cat([rgb, more], -1).permute(2, 0, 1), grid)
    return others.difference(1, torch.ones(grid, dtype=torch.bool), drawn, BLACK).view(grid)


def test_views_of_one_wall_agree_at_its_depth() -> None:
    found = asked(6)
    assert bool(found[:, :2].isinf().all())  # only views 0 and 1 see it
    assert float(found[:, 2:].max()) < 0.006
    assert float(asked(6, distance=2 * DISTANCE)[:, 10:30].max()) > 0.02


@pytest.mark.parametrize(
    "case", [{"count": FEWEST}, {"count": 6, "step": 50.0}, {"count": 6, "alpha": 0.3}]
)
def test_where_too_few_see_a_place_nothing_is_known(case: dict[str, float]) -> None:
    assert bool(asked(**case).isinf().all())  # type: ignore[arg-type]


def test_colours_lie_on_the_background_and_masked_cells_do_not_count() -> None:
    image = seen_from(cameras_before_wall(1))[0]
    alpha = torch.zeros_like(image.rgb_premultiplied[..., 0])
    mask = torch.ones_like(image.rgb_premultiplied[..., 0])
    mask[:, :40] = 0
    empty = type(image)(
        "e", image.cameras, torch.zeros_like(learned(image.cameras)), alpha, mask, None
    )
    colours, counts = NeighbourViews([empty], [image.cameras]).cells_of(
        0, torch.tensor([0.2, 0.4, 0.6])
    )  # type: ignore[arg-type]
    assert torch.allclose(colours, torch.tensor([0.2, 0.4, 0.6])[:, None, None].expand_as(colours))
    assert not bool(counts[:, :20].any())
    assert bool(counts[:, 20:].all())


def test_places_are_found_by_cameras_as_they_are_by_now() -> None:
    """Wrong cameras that are corrected find what the right ones do."""
    right = cameras_before_wall(6)
    shift = torch.tensor([0.4, 0.3, 0.0])
    wrong = []
    for camera in right:
        pose = camera.cam_from_world.clone()
        pose[0, :3, 3] += shift
        wrong.append(replace(camera, cam_from_world=pose))
    rgb = wall(right[1])
    more = torch.stack([torch.full_like(rgb[..., 0], DISTANCE), torch.ones_like(rgb[..., 0])], -1)
    cells = cell_camera(right[1])
    grid = (cells.height, cells.width)
    drawn = adaptive_avg_pool2d(torch.cat([rgb, more], -1).permute(2, 0, 1), grid)
    which = torch.ones(grid, dtype=torch.bool)
    images = seen_from(right)
    given = NeighbourViews(
        images,  # type: ignore[arg-type]
        right,
    ).difference(1, which, drawn, BLACK)
    found = NeighbourViews(images, wrong, lambda i, _: cell_camera(right[i])).difference(
        1, which, drawn, BLACK
    )  # type: ignore[arg-type]
    assert torch.equal(found, given)


COUNT = 12
GAINS = torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(0)) + 0.5


def drawn(cameras: Cameras, time: float | None) -> Rendering:
    return with_depth(cameras)


def images_with(gains: Tensor) -> Any:
    """Return images along a wall, so that the first and the last have nothing in common; whites are
    cut off."""
    cameras = cameras_before_wall(COUNT, step=0.8)
    return [
        replace(image, rgb_premultiplied=(gain * image.rgb_premultiplied).clamp_max(1))
        for image, gain in zip(seen_from(cameras), gains, strict=True)
    ]


def found(images: list[Image], which: list[int] | None = None) -> Tensor:
    return estimate_log_gains(
        images,  # type: ignore[arg-type]
        list(range(COUNT)) if which is None else which,
        drawn,
    )


def test_gains_of_images_that_only_neighbours_share_places_with() -> None:
    wanted = GAINS.log() - GAINS.log().mean(0)
    torch.testing.assert_close(found(images_with(GAINS)), wanted, atol=0.03, rtol=0)


def test_images_that_agree_have_none() -> None:
    torch.testing.assert_close(
        found(images_with(torch.ones(COUNT, 3))), torch.zeros(COUNT, 3), atol=0.01, rtol=0
    )


def test_what_stands_in_front_of_some_does_not_matter() -> None:
    images = images_with(GAINS)
    for i in (2, 3, 7):
        images[i] = with_block(images[i], slice(15, 45), slice(20, 50))
    wanted = GAINS.log() - GAINS.log().mean(0)
    torch.testing.assert_close(found(images), wanted, atol=0.08, rtol=0)
