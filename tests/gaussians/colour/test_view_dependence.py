"""SH pruning: a matte scene keeps no SH, a partly glossy one keeps those of its glossy part."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.training import (
    MeasuredView,
    ViewDependence,
    find_view_dependent,
    select_worthwhile,
)
from dyngs.gaussians.rendering import RenderOptions, render

BLACK = torch.zeros(3)
GLOSSY = torch.arange(24) < 6


def camera(angle: float) -> Cameras:
    """A camera at distance 3 that looks at the origin, rotated about y."""
    c = math.cos(angle)
    s = math.sin(angle)
    pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 3], [0, 0, 0, 1]])
    intrinsics = torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    return Cameras(pose[None], intrinsics[None], 32, 32)


def balls(rest: Tensor) -> Gaussians:
    """24 grey Gaussians on a ring, with SH of degree 1 (24, 3, 3)."""
    angle = torch.arange(24) * (2 * math.pi / 24)
    means = torch.stack([angle.cos(), 0.7 * (3 * angle).sin(), angle.sin()], dim=1)
    sh = torch.cat([torch.full((24, 1, 3), 0.3), rest], dim=1)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).expand(24, 4),
        torch.full((24, 3), -2.2),
        torch.ones(24),
        sh,
    )


def noise(seed: int) -> Tensor:
    return torch.randn(24, 3, 3, generator=torch.Generator().manual_seed(seed))


def looks(
    angles: list[float], model: Gaussians, truth: Gaussians, mask: Tensor | None = None
) -> list[MeasuredView]:
    return [MeasuredView(model, camera(a), render(truth, camera(a)).rgb[0], mask) for a in angles]


def find(
    model: Gaussians, truth: Gaussians, tolerance: float = 0.05, mask: Tensor | None = None
) -> ViewDependence:
    seen = looks([0.37 * i for i in range(17)], model, truth)
    held_out = looks([0.1 + 0.9 * i for i in range(7)], model, truth, mask)
    return find_view_dependent(seen, held_out, RenderOptions(), BLACK, tolerance)


def test_matte_scene_keeps_no_harmonics() -> None:
    """The learned view dependence is noise, so its gain is negative."""
    found = find(balls(0.05 * noise(0)), balls(torch.zeros(24, 3, 3)))
    assert not found.kept_harmonics.any()
    assert found.gain_all < 0
    assert found.gain_kept == 0
    assert "view-dependent colour removed" in str(found)


def test_only_glossy_gaussians_keep_harmonics() -> None:
    rest = 0.3 * noise(1) * GLOSSY[:, None, None]
    found = find(balls(rest + 0.01 * noise(2)), balls(rest))
    assert found.kept_harmonics[GLOSSY].float().mean() > 0.8, (
        "all but those that are hardly seen or hardly glossy"
    )
    assert not found.kept_harmonics[~GLOSSY].any()
    assert found.gain_kept > 3
    assert "kept for 2" in str(found)


def test_dropped_harmonics_become_mean_colour() -> None:
    """The SH value that is common to all views is added to the base colour."""
    rest = torch.zeros(24, 3, 3)
    model = balls(rest)
    lone = model.replace(sh=model.sh.clone())
    lone.sh[:, 2] = 0.5  # along z: one camera sees all from about the same side
    seen = looks([0.0], lone, lone)
    found = find_view_dependent(seen, looks([0.01], lone, lone), RenderOptions(), BLACK, 300.0)
    assert not found.kept_harmonics.any(), "300 dB may be given away"
    plain = model.replace(
        sh=torch.cat([lone.sh[:, :1] + found.offsets[:, None] / SH_C0, rest], dim=1)
    )
    torch.testing.assert_close(
        render(plain, camera(0.0)).rgb, render(lone, camera(0.0)).rgb, rtol=0, atol=2e-5
    )


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 40), st.floats(0, 3))
def test_selects_fewest_rows_within_tolerance(seed: int, count: int, tolerance: float) -> None:
    g = torch.Generator().manual_seed(seed)
    changes = torch.rand(count, generator=g)
    worths = torch.randn(count, generator=g)
    without = float(worths.clamp_min(0).sum()) + 1
    kept_harmonics = select_worthwhile(changes, worths, without, tolerance)
    order = changes.argsort(descending=True, stable=True)
    errors = [without - float(worths[order[:k]].double().sum()) for k in range(count + 1)]
    limit = min(errors) * 10 ** (tolerance / 10) * (1 + 1e-9)
    chosen = int(kept_harmonics.sum())
    assert set(torch.nonzero(kept_harmonics)[:, 0].tolist()) == set(order[:chosen].tolist())
    assert errors[chosen] <= limit + 1e-5
    assert all(error > limit - 1e-5 for error in errors[:chosen])
