"""Scores of views: known answers, masks, what cannot be scored, and times."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from moving_scene import Sliding, moving_scene, still_scene

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.errors import DyngsError
from dyngs.evaluate.view_scores import mean_of, score_views
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.metrics import Lpips, psnr
from dyngs.static.scene import StaticScene

NO_LPIPS = Lpips("alex", "no weights here")


def some_gaussians(count: int = 12, degree: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random) * 2 - 1

    sh = uniform(count, (degree + 1) ** 2, 3)
    return Gaussians(uniform(count, 3), uniform(count, 4), uniform(count, 3) * 0.3 - 1.5, uniform(count) + 1, sh)


def as_scene(gaussians: Gaussians) -> StaticScene:
    return StaticScene(gaussians=gaussians)


def camera(width: int = 20, height: int = 14, distance: float = 4.0) -> Cameras:
    pose = torch.eye(4)
    pose[2, 3] = distance
    intrinsics = torch.tensor([[20.0, 0, width / 2], [0, 20, height / 2], [0, 0, 1]])
    return Cameras(pose[None], intrinsics[None], width, height)


def image(rgb: torch.Tensor, cameras: Cameras, name: str = "a", mask: torch.Tensor | None = None) -> Image:
    return Image(name=name, cameras=cameras, rgb_premultiplied=rgb, alpha=None, mask=mask, time=None)


def test_scores_are_those_of_the_images() -> None:
    gaussians, cameras, options = some_gaussians(), camera(), RenderOptions()
    background = torch.tensor([0.2, 0.4, 0.6])
    rendered = render(gaussians, cameras, options, background=background).rgb[0].clamp(0, 1)
    darker = rendered * 0.5
    images = [image(rendered, cameras, "same"), image(darker, cameras, "darker")]
    scores, reasons = score_views(as_scene(gaussians), images, options, background, NO_LPIPS)
    same, other = scores
    assert (same.name, same.psnr, same.width, same.height) == ("same", 100.0, 20, 14)
    assert same.ssim == pytest.approx(1.0, abs=1e-6)
    assert other.psnr == psnr(rendered, darker)
    assert other.ssim < 0.99
    assert same.lpips is None
    assert reasons["lpips"] == "no weights here"
    assert (same.flip is None) == ("flip" in reasons)
    assert same.flip in (None, 0.0)
    assert all(score.render_seconds > 0 for score in scores)


def test_masks_reach_every_metric() -> None:
    gaussians, cameras, options = some_gaussians(), camera(), RenderOptions()
    rendered = render(gaussians, cameras, options).rgb[0].clamp(0, 1)
    mask = torch.ones(14, 20)
    mask[:, :10] = 0
    spoiled = torch.where(mask[..., None] > 0, rendered, 1 - rendered)
    scores, _ = score_views(
        as_scene(gaussians), [image(spoiled, cameras, mask=mask)], options, torch.zeros(3), NO_LPIPS
    )
    assert scores[0].psnr == 100.0
    assert scores[0].ssim == pytest.approx(1.0, abs=1e-6)
    assert scores[0].flip in (None, 0.0)


@pytest.mark.parametrize(
    ("truth", "mask", "message"),
    [
        (torch.full((14, 20, 3), math.nan), None, "view 'a': psnr is not finite, the image holds"),
        (torch.zeros(14, 20, 3), torch.zeros(14, 20), "view 'a': psnr is not finite, its mask ignores every pixel"),
    ],
)
def test_values_that_are_not_finite_are_refused(truth, mask, message) -> None:
    images = [image(truth, camera(), mask=mask)]
    with pytest.raises(DyngsError, match=message):
        score_views(as_scene(some_gaussians()), images, RenderOptions(), torch.zeros(3), NO_LPIPS)


def test_views_are_drawn_at_their_own_times() -> None:
    scene, options, black = moving_scene(Sliding()), RenderOptions(), torch.zeros(3)
    images = [
        replace(image(render(scene.at(t), camera(), options).rgb[0].clamp(0, 1), camera()), time=t) for t in (0.0, 0.8)
    ]
    scores, _ = score_views(scene, images, options, black, NO_LPIPS)
    assert [(s.psnr, s.time) for s in scores] == [(100.0, 0.0), (100.0, 0.8)]
    scores, _ = score_views(still_scene(), images, options, black, NO_LPIPS)
    assert scores[1].psnr < 40
    assert all(s.deform_seconds <= s.render_seconds for s in scores)


def test_a_mean_is_known_where_all_values_are() -> None:
    assert mean_of([1.0, 3.0]) == 2.0
    assert mean_of([1.0, None]) is None
