"""Scenes in other axes: the turned scene seen by turned cameras is the scene."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from splat_scenes import AROUND, cameras_turned, cloud, seen

from dyngs.core.errors import DyngsError
from dyngs.io.formats.rotation import (
    AXES,
    axis_of,
    inverse,
    mirrored,
    nearest_axis,
    product,
    turn_between,
    turned,
    turned_harmonics,
)
from dyngs.ops.quaternions import rotate

ODD = tuple(
    torch.nn.functional.normalize(
        torch.tensor([0.3, -0.7, 0.2, 0.6], dtype=torch.float64), dim=0
    ).tolist()
)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize(
    "rotation", [ODD, (0.0, 1.0, 0.0, 0.0), (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)]
)
def test_a_turned_scene_looks_the_same_to_turned_cameras(
    degree: int, rotation: tuple[float, ...]
) -> None:
    scene = cloud(150, degree)
    got = seen(turned(scene, rotation), cameras_turned(rotation))
    torch.testing.assert_close(got, seen(scene), rtol=0, atol=3e-5)
    # the turn is seen
    assert float((seen(scene, cameras_turned(rotation)) - seen(scene)).abs().max()) > 0.1


def test_harmonics_left_as_they_are_would_be_seen() -> None:
    scene = cloud(150, 3)
    wrong = turned(scene, ODD).replace(sh=scene.sh)
    assert float((seen(wrong, cameras_turned(ODD)) - seen(scene)).abs().max()) > 0.05


def test_harmonics_of_one_degree_stay_in_it() -> None:
    sh = torch.zeros(1, 25, 3)
    sh[:, 4:9] = 1.0
    matrix = torch.linalg.qr(
        torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    )[0]
    matrix = matrix * torch.linalg.det(matrix)
    got = turned_harmonics(sh, matrix)
    assert not got[:, :4].any()
    assert not got[:, 9:].any()
    # real harmonics are orthonormal
    torch.testing.assert_close(got.square().sum(), sh.square().sum())


def test_scale_and_shift() -> None:
    scene = cloud(20, 1)
    shift = torch.tensor([1.0, 2.0, 3.0])
    moved = turned(scene, (1.0, 0.0, 0.0, 0.0), 2.0, shift)
    torch.testing.assert_close(moved.means, 2 * scene.means + shift)
    torch.testing.assert_close(moved.scales, 2 * scene.scales)
    torch.testing.assert_close(moved.sh, scene.sh)


@pytest.mark.parametrize("start", AXES)
@pytest.mark.parametrize("end", AXES)
def test_the_turn_between_axes(start: str, end: str) -> None:
    turn = turn_between(axis_of(start), axis_of(end))
    quat = torch.tensor(turn, dtype=torch.float64)
    wanted = torch.tensor(axis_of(end), dtype=torch.float64)
    torch.testing.assert_close(
        rotate(quat, torch.tensor(axis_of(start), dtype=torch.float64)), wanted
    )
    assert product(inverse(turn), turn) == pytest.approx((1, 0, 0, 0), abs=1e-12)


def test_the_turns_that_people_know() -> None:
    # OpenCV to OpenGL: y and z change sign
    assert turn_between(AXES["-y"], AXES["y"]) == (0.0, 1.0, 0.0, 0.0)
    half = math.sqrt(0.5)
    # Blender to glTF
    assert turn_between(AXES["z"], AXES["y"]) == pytest.approx((half, -half, 0, 0))


def test_names_of_axes() -> None:
    assert nearest_axis((0.1, -0.9, 0.2)) == "-y"
    assert nearest_axis((1.0, 1.0, 1.0)) is None
    assert nearest_axis((0.0, 0.0, 0.0)) is None
    with pytest.raises(DyngsError, match="no axis 'up'"):
        axis_of("up")


def test_no_turn_changes_no_bit() -> None:
    scene = cloud(10, 2)
    assert turned(scene, (1.0, 0.0, 0.0, 0.0)) is scene
    assert AROUND.width == 48


@pytest.mark.parametrize("degree", range(5))
def test_a_mirrored_scene_is_seen_in_a_mirror(degree: int) -> None:
    """A camera on the plane of the mirror sees the image flipped."""
    scene = cloud(150, degree)
    camera = AROUND.select(0)
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = 4.0
    ahead = replace(camera, cam_from_world=pose)
    got = seen(mirrored(scene), ahead)
    torch.testing.assert_close(got, seen(scene, ahead).flip(2), rtol=0, atol=3e-5)
    assert float((seen(scene, ahead) - got).abs().max()) > 0.1
