from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.training.priors.agreement import (
    depth_agreement,
    flow_agreement,
    mask_agreement,
    track_agreement,
)

SIZE, FOCAL, FAR, NEAR = 48, 48.0, 6.0, 3.0
BOX = slice(16, 32)


def texture(seed: int, channels: int = 3) -> torch.Tensor:
    """(96, 96, 3) smooth noise: neighbouring pixels are alike, as in photos."""
    noise = torch.rand(1, channels, 24, 24, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(noise, size=(96, 96), mode="bilinear")[0].permute(
        1, 2, 0
    )


def image(shift: float = 0.0, box_px: int = 0, time: float = 0.0) -> Image:
    """A wall ``FAR`` away and a box ``NEAR`` before it, from a camera ``shift`` to the right.

    The box moves ``box_px`` to the right beside its parallax.
    """
    pose = torch.eye(4)
    pose[0, 3] = -shift
    k = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]])
    wall, box = (round(FOCAL * shift / z) for z in (FAR, NEAR))
    rgb = texture(0)[24 : 24 + SIZE, 24 + wall : 24 + wall + SIZE].clone()
    depth = torch.full((SIZE, SIZE), FAR)
    moves = torch.zeros(SIZE, SIZE)
    left = BOX.start - box + box_px
    where = (BOX, slice(left, left + BOX.stop - BOX.start))
    rgb[where] = texture(1)[BOX, BOX]
    depth[where] = NEAR
    moves[where] = 1.0
    return Image(
        "a",
        Cameras(pose[None], k[None], SIZE, SIZE),
        rgb,
        None,
        None,
        time,
        moves=moves,
        depth=depth,
    )


def noisy(x: torch.Tensor, size: float) -> torch.Tensor:
    return x + size * torch.randn(x.shape, generator=torch.Generator().manual_seed(2))


def with_flow(flow: torch.Tensor) -> list[tuple[Image, Image]]:
    return [(replace(image(), flow=flow), image(box_px=5))]


def true_flow() -> torch.Tensor:
    flow = torch.zeros(SIZE, SIZE, 2)
    flow[BOX, BOX, 0] = 5
    return flow


def test_flow_is_used_where_it_is_right_also_with_noise() -> None:
    assert flow_agreement(with_flow(true_flow())).holds
    assert flow_agreement(with_flow(noisy(true_flow(), 1.0))).holds


@pytest.mark.parametrize("kind", ["none", "backward", "random", "unknown"])
def test_flow_that_explains_nothing_is_not_used(kind: str) -> None:
    flow = {
        "none": torch.zeros(SIZE, SIZE, 2),
        "backward": -true_flow(),
        "random": noisy(torch.zeros(SIZE, SIZE, 2), 5.0),
        "unknown": torch.full((SIZE, SIZE, 2), torch.nan),
    }[kind]
    assert not flow_agreement(with_flow(flow)).holds


def test_tracks_are_compared_with_tracks_at_random() -> None:
    random = torch.Generator().manual_seed(3)
    start = 17 + 14 * torch.rand(30, 2, generator=random)
    end = start + torch.tensor([5.0, 0.0])
    first = image()
    second = image(box_px=5)
    assert track_agreement([(first, second, start, end)]).holds
    assert track_agreement([(first, second, start, noisy(end, 0.7))]).holds
    assert not track_agreement(
        [(first, second, start, end[torch.randperm(30, generator=random)])]
    ).holds
    assert not track_agreement([]).holds


def triple(depth: torch.Tensor) -> list[tuple[Image, Image, Image]]:
    return [(replace(image(), depth=depth), image(0.25), image(-0.25))]


def test_depth_is_used_whatever_its_scale_and_shift() -> None:
    truth = image().depth
    assert truth is not None
    assert depth_agreement(triple(noisy(0.1 * truth + 0.4, 0.01)), 5.0)[1].holds
    _, inverse = depth_agreement(triple(1 / (0.2 / truth + 0.02)), 5.0)
    assert inverse.holds


@pytest.mark.parametrize("kind", ["constant", "reversed", "noise"])
def test_depth_that_explains_nothing_is_not_used(kind: str) -> None:
    truth = image().depth
    assert truth is not None
    random = torch.rand(SIZE, SIZE, generator=torch.Generator().manual_seed(4)) + 0.5
    depth = {"constant": torch.ones(SIZE, SIZE), "reversed": 10 - truth, "noise": random}[kind]
    assert not depth_agreement(triple(depth), 5.0)[1].holds


@pytest.mark.parametrize("shift", [0.0, 0.25])
def test_masks_are_used_unless_they_are_the_wrong_way_round(shift: float) -> None:
    """From one camera that stands, and from one that moves: parallax is not motion."""
    first = image()
    second = image(shift, box_px=6, time=0.1)
    assert first.moves is not None
    assert mask_agreement([(first, second)], 5.0).holds
    assert not mask_agreement([(replace(first, moves=1 - first.moves), second)], 5.0).holds
    assert not mask_agreement([(replace(first, moves=torch.zeros(SIZE, SIZE)), second)], 5.0).holds
