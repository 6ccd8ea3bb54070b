"""How far images disagree with static Gaussians where they show, and the score that parts two
groups of them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import look_around
from torch import Tensor
from two_balls import cameras_around, two_balls

from dyngs.core.camera import Cameras
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.deform.static_errors import (
    MIN_SAME,
    changed_fraction,
    group_fixed_cameras,
    otsu_threshold,
    select_comparison_views,
    static_errors,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render

SIZE = 24
OPTIONS = RenderOptions(nonfinite="trust")
BLACK = torch.zeros(3)

pytestmark = pytest.mark.usefixtures("one_thread")


def camera(view: int = 0) -> Cameras:
    """One of three around the origin, 3 away from it."""
    intrinsics = torch.tensor([[20.0, 0, SIZE / 2], [0, 20, SIZE / 2], [0, 0, 1]])
    return Cameras(look_around(3, torch.float32)[view][None], intrinsics[None], SIZE, SIZE)


def balls(*places: tuple[float, float, float]) -> Gaussians:
    """Grey, dense balls, far smaller than the image."""
    means = torch.tensor(places)
    count = len(places)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(
        means,
        quats,
        torch.full((count, 3), -2.0),
        torch.full((count,), 4.0),
        torch.zeros(count, 1, 3),
    )


def rendered(gaussians: Gaussians, background: Tensor = BLACK, view: int = 0) -> Tensor:
    return render(gaussians, camera(view), OPTIONS, background=background).rgb[0].detach()


def image(
    rgb: Tensor, mask: Tensor | None = None, alpha: Tensor | None = None, view: int = 0
) -> Image:
    return Image("view", camera(view), rgb, alpha, mask, 0.5)


def sideways(x: float) -> tuple[float, float, float]:
    """A place in the first camera's image plane, ``x`` to the right of the middle."""
    right = camera().cam_from_world[0, 0, :3]
    down = camera().cam_from_world[0, 1, :3]
    a, b, c = (x * right + 0.0 * down).tolist()
    return a, b, c


def left_half() -> Tensor:
    half = torch.zeros(SIZE, SIZE)
    half[:, : SIZE // 2] = 1.0
    return half


def scores_of(gaussians: Gaussians, images: list[Image], background: Tensor) -> Tensor:
    """(N,) of cameras that do not stay in place."""
    found = static_errors(lambda _: gaussians, images, OPTIONS, background)
    assert torch.equal(found.peak, found.typical)
    return found.peak


@settings(max_examples=25, deadline=None)
@given(st.lists(st.floats(-1, 1, width=32), min_size=3, max_size=3))
def test_error_of_a_known_colour(colour: list[float]) -> None:
    """Images that differ by a colour all over: its mean over the channels, for all that shows,
    however little."""
    ball = balls(sideways(0.0), sideways(0.5)).replace(logit_opacities=torch.tensor([4.0, -4.0]))
    images = [
        image(rendered(ball, view=view) + torch.tensor(colour), view=view) for view in range(3)
    ]
    expected = sum(abs(x) for x in colour) / 3
    assert scores_of(ball, images, BLACK).tolist() == pytest.approx(
        [expected] * 2, rel=1e-3, abs=1e-6
    )


def test_errors_are_weighted_by_visibility() -> None:
    """The left half is wrong by 0.3: one ball is in it, one in the other half, one on the
    border."""
    scene = balls(sideways(-0.9), sideways(0.9), sideways(0.0))
    wrong = image(rendered(scene) + 0.3 * left_half()[..., None])
    left, right, border = scores_of(scene, [wrong], BLACK).tolist()
    assert (left, right) == pytest.approx((0.3, 0.0), abs=0.01)
    assert 0.05 < border < 0.25


def test_detail_cancels_in_a_view_but_not_between_views() -> None:
    """Stripes that a ball cannot resolve are no error; a ball too bright in one view and too dark
    in the next is."""
    ball = balls(sideways(0.0)).replace(log_scales=torch.full((1, 3), -0.7))
    signs = torch.ones(SIZE)
    signs[1::2] = -1.0
    stripes = image(rendered(ball) + 0.3 * signs[None, :, None])
    assert float(scores_of(ball, [stripes], BLACK)) < 0.02
    changes = [
        image(rendered(ball, view=view) + 0.3 * (-1) ** view, view=view) for view in range(2)
    ]
    assert float(scores_of(ball, changes, BLACK)) == pytest.approx(0.3, rel=1e-3)


# --- cameras that stay in place
# ---------------------------------------------------------------------------------------


def in_place(*errors: float, view: int = 0) -> list[Image]:
    """What one camera shows while all of the image is brighter by ``errors``, one after the
    other."""
    ball = balls(sideways(0.0))
    return [image(rendered(ball, view=view) + error, view=view) for error in errors]


def test_unlearned_detail_is_not_motion() -> None:
    """Wrong by far, but in all images alike; with too few images to know, it may be motion."""
    ball = balls(sideways(0.0))
    found = static_errors(lambda _: ball, in_place(*[0.4] * MIN_SAME), OPTIONS, BLACK)
    assert (float(found.peak), float(found.typical)) == pytest.approx((0.0, 0.0), abs=1e-6)
    few = static_errors(lambda _: ball, in_place(*[0.4] * (MIN_SAME - 1)), OPTIONS, BLACK)
    assert float(few.peak) == pytest.approx(0.4, rel=1e-3)


def test_occluded_gaussians_do_not_move() -> None:
    """Something passes in front in two of ten images: seen by ``most``, not by ``usual``."""
    found = static_errors(
        lambda _: balls(sideways(0.0)), in_place(*[0.0] * 8, 0.3, 0.3), OPTIONS, BLACK
    )
    assert (float(found.peak), float(found.typical)) == pytest.approx(
        (0.3, 0.0), rel=1e-3, abs=1e-6
    )


def test_repeated_change_is_motion() -> None:
    found = static_errors(
        lambda _: balls(sideways(0.0)), in_place(*[0.0] * 6, 0.1, 0.2, 0.3, 0.4), OPTIONS, BLACK
    )
    assert float(found.peak) == pytest.approx(0.4, rel=1e-3)
    assert float(found.typical) == pytest.approx(0.1, rel=1e-3)


def views(*cameras: int) -> list[View]:
    """From one of three places each."""
    poses = look_around(3, torch.float64).numpy()
    intrinsics = camera().intrinsics[0].double().numpy()
    place = partial(View, image_path=Path("x.png"), intrinsics=intrinsics, width=SIZE, height=SIZE)
    return [place(str(i), cam_from_world=poses[at], time=i / 1000) for i, at in enumerate(cameras)]


def test_of_cameras_in_place_few_are_chosen_with_many_moments() -> None:
    chosen = select_comparison_views(views(*[0, 1, 2] * 40), 20)
    assert chosen == [*range(0, 120, 12), *range(1, 120, 12)]
    assert select_comparison_views(views(0, 0, 0, 1), 50) == [0, 1, 2]
    assert group_fixed_cameras(views(0, 1, 1, 0, 1, 2)) == [[1, 2, 4]]
    assert group_fixed_cameras(views(0, 1, 2, 0, 1, 2)) == []


# --- two groups
# ----------------------------------------------------------------------------------------------


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.floats(0, 0.1), min_size=2, max_size=40),
    st.lists(st.floats(0.6, 0.7), min_size=2, max_size=40),
    st.floats(1e-3, 10),
)
def test_two_clear_groups_are_parted(low: list[float], high: list[float], scale: float) -> None:
    """At any scale, in any order, if neither is tiny; to a 256th of the range, which is counted in
    so many bins."""
    scores = scale * torch.tensor(low + high)
    order = torch.randperm(len(scores), generator=torch.Generator().manual_seed(len(scores)))
    threshold = otsu_threshold(scores[order])
    bin_width = float(scores.max() - scores.min()) / 256
    assert scale * max(low) - bin_width <= threshold < scale * min(high) - bin_width


def test_exposure_change_is_not_motion() -> None:
    room = 0.5 * torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    assert changed_fraction([[room, room + 0.2, room + 0.4]]) == 0
    come = room.clone()
    come[:4, :4] += 0.3
    assert changed_fraction([[room, room, come]]) == 4 / 48, (
        "of 16 blocks of 2x2 pixels in each image"
    )


# --- motion masks
# ----------------------------------------------------------------------------------------------


def masked_image(moves: torch.Tensor | None, mask: torch.Tensor | None = None) -> Image:
    return Image("a", cameras_around(1), torch.zeros(18, 24, 3), None, mask, 0.0, motion_mask=moves)


def left() -> torch.Tensor:
    moves = torch.zeros(18, 24)
    moves[:, :13] = 1
    return moves


def test_the_fraction_of_each_gaussian_in_the_mask() -> None:
    """The left ball lies in the mask, the right one does not; a fraction of one half counts as
    ``sure``."""
    found = static_errors(
        lambda _: two_balls(), [masked_image(left())], RenderOptions(), BLACK, mask_error=0.06
    )
    torch.testing.assert_close(found.peak, torch.tensor([0.12, 0.0]), rtol=0, atol=2e-3)
    torch.testing.assert_close(found.typical, found.peak)


def test_occlusion_is_not_typical_error() -> None:
    images = (
        [masked_image(left())]
        + [masked_image(torch.zeros(18, 24)) for _ in range(4)]
        + [masked_image(None)]
    )
    found = static_errors(lambda _: two_balls(), images, RenderOptions(), BLACK, mask_error=0.06)
    assert float(found.peak[0]) > 0.1
    assert float(found.typical.max()) == 0
