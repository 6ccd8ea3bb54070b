"""Levels of detail: merging preserves moments, and a cut covers every Gaussian once."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scene import camera
from splat_scenes import cloud

from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.gaussians import levels as module
from dyngs.gaussians.levels import MERGED, Levels, build_levels, merge_gaussians
from dyngs.gaussians.rendering import render
from dyngs.ops.quaternions import rotation_matrices


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "BLOCK", 16)


def covariances(gaussians: Gaussians) -> torch.Tensor:
    half = rotation_matrices(gaussians.quats) @ torch.diag_embed(gaussians.scales)
    return half @ half.mT


def test_merged_moments_are_those_of_the_mixture() -> None:
    """Compared in closed form: E[x], E[x x^T], and the mean of all colour coefficients."""
    several = (
        cloud(40, degree=2)
        .to(dtype=torch.float64)
        .replace(logit_opacities=torch.full((40,), -5.0).double())
    )
    one, shares = merge_gaussians(several, 4)
    second = covariances(several) + several.means[:, :, None] * several.means[:, None, :]
    for i in range(10):
        own = slice(4 * i, 4 * i + 4)
        mean = (shares[i, :, None] * several.means[own]).sum(0)
        mixed = (shares[i, :, None, None] * second[own]).sum(0) - mean[:, None] * mean
        torch.testing.assert_close(one.means[i], mean)
        torch.testing.assert_close(covariances(one)[i], mixed)
        torch.testing.assert_close(one.sh[i], (shares[i, :, None, None] * several.sh[own]).sum(0))
    torch.testing.assert_close(shares.sum(1), torch.ones(10).double())


@pytest.mark.parametrize("count", [1, 15, 16, 17, 64, 1000])
def test_each_level_merges_the_level_below(count: int, small_blocks: None) -> None:
    gaussians = cloud(count)
    levels = build_levels(gaussians)
    assert len(levels.levels[-1]) <= 16
    for fine, coarse in zip(levels.levels, levels.levels[1:], strict=False):
        assert len(coarse) == -(-len(fine) // MERGED)
    assert sorted(levels.levels[0].means[:, 0].tolist()) == sorted(gaussians.means[:, 0].tolist())
    for i, balls in enumerate(levels.blocks):
        blocks = [(i, k) for k in range(len(balls))]
        assert sum(levels.count(block) for block in blocks) == len(levels.levels[i])
        assert all(len(levels.block_gaussians(block)) == levels.count(block) for block in blocks)
        if i:
            below = [child for block in blocks for child in levels.children(block)]
            assert below == [(i - 1, k) for k in range(len(levels.blocks[i - 1]))]


def whole(levels: Levels, cut: list[tuple[int, int]]) -> list[int]:
    """Number of times that the cut covers each block of the finest level."""
    shown = np.zeros(len(levels.blocks[0]), int)
    for level, place in cut:
        shown[place * MERGED**level : (place + 1) * MERGED**level] += 1
    return shown.tolist()


def test_cut_covers_every_gaussian_once(small_blocks: None) -> None:
    levels = build_levels(cloud(1000))
    counts = []
    for pixels in (0.0, 0.5, 2.0, 8.0, 1e9):
        cut = levels.cut(camera(), pixels=pixels)
        assert set(whole(levels, cut)) == {1}
        counts.append(sum(levels.count(block) for block in cut))
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == len(levels.levels[-1])
    for most in (20, 100, 500):
        cut = levels.cut(camera(), most)
        assert set(whole(levels, cut)) == {1}
        assert sum(levels.count(block) for block in cut) <= most


def test_finest_cut_equals_the_scene_bitwise(small_blocks: None) -> None:
    """The whole scene is in view. No two depths are equal, since ties are blended in index order."""
    gaussians = cloud(300)
    levels = build_levels(gaussians)
    seen = levels.select_gaussians(camera(), pixels=0.0)
    assert len(seen) == 300
    assert torch.equal(render(seen, camera()).rgb, render(gaussians, camera()).rgb)


def test_blocks_outside_the_image_stay_coarse(small_blocks: None) -> None:
    levels = build_levels(cloud(1000))
    pose = camera().cam_from_world.clone()
    for turn in (
        torch.diag(torch.tensor([-1.0, 1, -1, 1])),
        torch.tensor([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]),
    ):
        away = Cameras(turn @ pose, camera().intrinsics, camera().width, camera().height)
        assert levels.cut(away, pixels=0.0) == [(len(levels.levels) - 1, 0)]


def test_distant_cut_needs_fewer_gaussians(small_blocks: None) -> None:
    """The cloud is a few pixels wide. The cut has a fifth of the Gaussians and is closer to a
    supersampled image.
    """
    gaussians = cloud(2000)
    pose = camera().cam_from_world.clone()
    pose[0, 2, 3] *= 20
    far = Cameras(pose, camera().intrinsics, camera().width, camera().height)
    sharp = Cameras(
        pose,
        camera().intrinsics * torch.tensor([8.0, 8, 1])[:, None],
        8 * far.width,
        8 * far.height,
    )
    truth = torch.nn.functional.avg_pool2d(
        render(gaussians, sharp).rgb.permute(0, 3, 1, 2), 8
    ).permute(0, 2, 3, 1)
    seen = build_levels(gaussians).select_gaussians(far)
    assert len(seen) < len(gaussians) / 5
    errors = [float((render(x, far).rgb - truth).square().mean()) for x in (seen, gaussians)]
    assert errors[0] < 1.02 * errors[1]
