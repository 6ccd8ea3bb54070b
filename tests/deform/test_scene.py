"""A dynamic scene at any time, in parts, and from a checkpoint."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_fields import ALL_KINDS, cloud, moved, stirred_field, tiny_options
from torch import Tensor

from dyngs.core.state import strip_roles
from dyngs.deform.field import DeformationField
from dyngs.deform.fields import field_state
from dyngs.deform.keys import DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import fuse_filter
from dyngs.gaussians.visibility import VisibilityMasks

ROWS = torch.tensor([1, 4, 5, 8])
NOTHING = torch.zeros(0, dtype=torch.long)


def scene_of(
    rows: Tensor, field: DeformationField | None = None, filter_std: Tensor | None = None
) -> DynamicScene:
    """A scene of the cloud in which a field moves ``rows``."""
    times = (0.0, 0.5, 1.0)
    return DynamicScene(
        gaussians=cloud(), training_times=times, field=field, moving=rows, filter_std=filter_std
    )


def some_scene(kind: str = "hexplane", filter_std: Tensor | None = None) -> DynamicScene:
    return scene_of(ROWS, stirred_field(kind, len(ROWS)), filter_std)


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(x, b.tensors()[name]) for name, x in a.tensors().items())


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_only_moving_rows_are_deformed(kind: str) -> None:
    scene = some_scene(kind)
    early = scene.at(0.1)
    late = scene.at(0.9)
    changed = (early.means != late.means).any(1)
    assert torch.equal(torch.nonzero(changed)[:, 0], ROWS)
    others = torch.nonzero(~changed)[:, 0]
    assert same(late.select(others), scene.gaussians.select(others))
    assert not late.means.requires_grad


@pytest.mark.parametrize("time", [1.0001, 7.0, float("inf")])
def test_times_after_the_clip_are_clamped(time: float) -> None:
    scene = some_scene()
    assert same(scene.at(time), scene.at(1.0))
    assert not same(scene.at(time), scene.at(0.0))


@pytest.mark.parametrize("kind", ALL_KINDS)
@pytest.mark.parametrize("is_filtered", [False, True])
def test_moving_and_static_parts_make_the_scene(kind: str, is_filtered: bool) -> None:
    """Together, in their order, at each time."""
    scene = some_scene(kind, 0.1 + torch.arange(9.0) / 10 if is_filtered else None)
    moving = scene.part("moving")
    static = scene.part("still")
    others = torch.tensor([0, 2, 3, 6, 7])
    assert (len(moving), len(static)) == (4, 5)
    assert (moving.is_static, static.is_static) == (False, True)
    assert (moving.moving_fraction, static.moving_fraction) == (1.0, 0.0)
    assert moving.times == static.times == scene.times
    for time in (0.0, 0.37, 1.0):
        whole = scene.at(time)
        assert same(moving.at(time), whole.select(ROWS))
        assert same(static.at(time), whole.select(others))


@pytest.mark.parametrize("kind", ALL_KINDS)
@pytest.mark.parametrize("rows", [ROWS, None, NOTHING], ids=["some", "all", "none"])
def test_scene_loads_from_a_checkpoint(kind: str, rows: Tensor | None) -> None:
    """As stored by the model; without rows all Gaussians move."""
    gaussians = cloud()
    num_moving = 9 if rows is None else len(rows)
    field = stirred_field(kind, num_moving)
    state = {f"field.{name}": x for name, x in strip_roles(field_state(field)).items()}
    state |= {
        "times": torch.tensor([0.0, 0.25, 1.0], dtype=torch.float64),
        "filter_std": torch.ones(9),
    }
    if rows is not None:
        state["rows"] = rows
    scene = DynamicScene.from_state(DynamicModel(deform=tiny_options(kind)), gaussians, state)
    assert scene.times == (0.0, 0.25, 1.0)
    assert torch.equal(scene.rows, torch.arange(9) if rows is None else rows)
    assert scene.is_static == (num_moving == 0)
    with torch.no_grad():
        expected = moved(field, gaussians, 0.3, rows) if num_moving else gaussians
    assert same(scene.at(0.3), fuse_filter(expected, torch.ones(9)))


@pytest.mark.parametrize("kind", ALL_KINDS)
@pytest.mark.parametrize("is_filtered", [False, True])
def test_visibility_masks_keep_the_image(kind: str, is_filtered: bool) -> None:
    """Before, between and after key times, in any order of times; parts and sizes are those of all
    Gaussians."""
    scene = some_scene(kind, 0.1 + torch.arange(9.0) / 10 if is_filtered else None)
    seen = torch.rand(3, 9, generator=torch.Generator().manual_seed(1)) < 0.4
    masked = replace(scene, masks=VisibilityMasks.pack((0.0, 0.5, 1.0), seen))
    for time, active in (
        (0.1, seen[:2]),
        (0.9, seen[1:]),
        (0.3, seen[:2]),
        (1.0, seen[1:]),
        (None, seen[:2]),
    ):
        found = masked.at(time)
        whole = scene.at(time).select(active.any(0))
        for name, x in found.tensors().items():
            torch.testing.assert_close(x, whole.tensors()[name], rtol=0, atol=1e-6)
    assert len(masked) == 9
    assert same(masked.part("moving").at(0.4), scene.part("moving").at(0.4))
    assert same(masked.without_masks().at(0.4), scene.at(0.4))
