"""Every kind of scene refuses the same cameras and backgrounds, with the same message, and
composites alike."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import pytest
import torch
from camera_rings import ring_of
from scene_kinds import KINDS, onlooker, scene_of_kind
from small_triangles import bent
from splat_scenes import cloud
from torch import Tensor

from dyngs.baselines.fields.kind import NerfModel, NgpModel
from dyngs.baselines.fields.nerf import NerfField
from dyngs.baselines.fields.ngp import NgpField
from dyngs.baselines.fields.scene import FieldScene
from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.static_scene import StaticScene, ViewSides
from dyngs.human.predict.fields.prediction import NETWORKS, PredictedField
from dyngs.human.predict.kind import PredictedFieldModel
from dyngs.human.predict.people import PosedBody, Sources
from dyngs.models.renderable import Renderable
from dyngs.ops.rays import Space

SPACE = Space((0.0, 0.0, 0.0), 2.0, 1, 8)
WITH_CAMERA_GRADIENTS = (*KINDS, "sides")
WITHOUT_CAMERA_GRADIENTS = ("ngp", "nerf", "triangles", *NETWORKS)
ALL = (*WITH_CAMERA_GRADIENTS, "levels", *WITHOUT_CAMERA_GRADIENTS)


def scene_of(kind: str) -> Renderable:
    generator = torch.Generator().manual_seed(0)
    if kind == "ngp":
        return FieldScene(NgpField.new(NgpModel(sizes="tiny"), SPACE, generator))
    if kind == "nerf":
        return FieldScene(NerfField.new(NerfModel(sizes="tiny"), SPACE, generator))
    if kind == "triangles":
        return TriangleScene(bent(), 1.0)
    if kind == "levels":
        return LevelScene.from_scene(StaticScene(gaussians=cloud()))
    if kind == "sides":
        parts = [cloud(40), cloud(60)]
        eyes = [torch.tensor([4.0, 0.0, 1.5]), torch.tensor([-4.0, 0.0, 1.5])]
        return StaticScene(gaussians=Gaussians.joined(parts), sides=ViewSides.joined(parts, eyes))
    if kind in NETWORKS:
        images = Sources(
            torch.ones(3, 4, 16, 16), torch.eye(4).expand(3, 4, 4), torch.eye(3).expand(3, 3, 3)
        )
        body = PosedBody(torch.zeros(4, 3), torch.zeros(3, 3), torch.zeros(1, 3, dtype=torch.long))
        return PredictedField(NETWORKS[kind](generator, PredictedFieldModel()), images, body, 1.0)
    return scene_of_kind(kind)


@pytest.fixture(params=ALL, scope="module")
def scene(request: pytest.FixtureRequest) -> Renderable:
    return scene_of(request.param)


def two_cameras() -> Cameras:
    one = onlooker()
    return Cameras(
        one.cam_from_world.repeat(2, 1, 1), one.intrinsics.repeat(2, 1, 1), one.width, one.height
    )


@pytest.mark.parametrize(
    ("where", "value", "problem"),
    [
        (
            ("pose", 0, 3),
            float("nan"),
            r"cam_from_world holds 1 NaN or infinite value\(s\) in 1 of 2 rows",
        ),
        (("pose", 1, 1), float("inf"), r"cam_from_world holds 1 NaN or infinite value"),
        (("pose", 0, 0), 2.0, "the matrix of camera 1 "),
        (("lens", 0, 0), float("inf"), r"intrinsics holds 1 NaN or infinite value"),
        (("lens", 1, 2), float("nan"), r"intrinsics holds 1 NaN or infinite value"),
        (
            ("lens", 0, 0),
            0.0,
            "intrinsics: focal lengths must be positive, .*but camera 1 has 0 and 30",
        ),
        (
            ("lens", 1, 1),
            -30.0,
            "intrinsics: focal lengths must be positive, .*but camera 1 has 30 and -30",
        ),
    ],
)
def test_cameras_that_cannot_exist(
    scene: Renderable, where: tuple[str, int, int], value: float, problem: str
) -> None:
    cameras = two_cameras()
    which, row, column = where
    (cameras.cam_from_world if which == "pose" else cameras.intrinsics)[1, row, column] = value
    with pytest.raises(DyngsError, match=problem):
        scene.render(cameras)


@pytest.mark.parametrize(
    ("background", "problem"),
    [
        (torch.ones(4), r"background must be \(3,\) or \(2, 3\), got \(4,\)"),
        (torch.ones(1), r"background must be \(3,\) or \(2, 3\), got \(1,\)"),
        (torch.ones(3, 3), r"background must be \(3,\) or \(2, 3\), got \(3, 3\)"),
        (torch.tensor([0.0, float("nan"), 0.0]), "background holds 1 NaN or infinite value"),
    ],
)
def test_backgrounds_that_do_not_fit(scene: Renderable, background: Tensor, problem: str) -> None:
    with pytest.raises(DyngsError, match=problem):
        scene.render(two_cameras(), background=background)
    with pytest.raises(DyngsError, match=problem):
        copy.copy(scene).on_background(background).render(two_cameras())


def test_no_cameras(scene: Renderable) -> None:
    cameras = two_cameras()
    none = replace(
        cameras, cam_from_world=cameras.cam_from_world[:0], intrinsics=cameras.intrinsics[:0]
    )
    with pytest.raises(DyngsError, match="cameras: there is none to render from"):
        scene.render(none)


@pytest.mark.parametrize("kind", [kind for kind in ALL if kind not in NETWORKS])
def test_a_background_for_each_view(kind: str) -> None:
    """A batch matches single views with their own backgrounds, also for double-precision
    cameras."""
    scene = scene_of(kind)
    cameras = two_cameras()
    colours = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.25]])
    with torch.no_grad():
        both = scene.render(cameras.to(dtype=torch.float64), background=colours)
        for i, colour in enumerate(colours):
            alone = scene.render(cameras.select(i), background=colour)
            torch.testing.assert_close(both.rgb[i], alone.rgb[0], atol=2e-3, rtol=0)
    difference = both.rgb[0] - both.rgb[1]
    expected = both.transmittance[0, ..., None] * (colours[0] - colours[1])
    torch.testing.assert_close(difference, expected, atol=1e-4, rtol=0)


def watched(cameras: Cameras, which: str) -> Cameras:
    """The cameras with one of their tensors as a leaf."""
    leaf = getattr(cameras, which).clone().requires_grad_()
    changes: dict[str, Any] = {which: leaf}
    return replace(cameras, **changes)


@pytest.mark.parametrize("which", ["cam_from_world", "intrinsics"])
@pytest.mark.parametrize("kind", WITHOUT_CAMERA_GRADIENTS)
def test_gradients_by_cameras_are_refused_where_there_are_none(kind: str, which: str) -> None:
    scene = scene_of(kind)
    cameras = watched(two_cameras(), which)
    with pytest.raises(
        DyngsError, match="only scenes of Gaussians have gradients by poses and intrinsics"
    ):
        scene.render(cameras)
    if kind not in NETWORKS:
        with torch.no_grad():
            scene.render(cameras)  # no gradient is wanted


@pytest.mark.parametrize("kind", WITH_CAMERA_GRADIENTS)
def test_scenes_of_gaussians_have_gradients_by_cameras(kind: str) -> None:
    scene = scene_of(kind)
    cameras = watched(ring_of(2, torch.zeros(3).numpy()).to(dtype=torch.float32), "cam_from_world")
    (scene.render(cameras).rgb ** 2).sum().backward()
    grad = cameras.cam_from_world.grad
    assert grad is not None
    assert bool(grad[:, :3].any())
