import math

import numpy as np
import pytest
import torch
from moving_scene import camera

from dyngs.core.camera import Cameras
from dyngs.data.aim import look_at
from dyngs.view.cameras import camera_at, fitting_fov, look_point, nearest_camera, pose_of


def looking(
    eye: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0)
) -> Cameras:
    pose = np.linalg.inv(look_at(np.array(eye), np.array(target), np.array([0.0, 0, 1])))
    return Cameras(torch.from_numpy(pose).float()[None], camera().intrinsics, 20, 14)


def test_a_pose_goes_to_the_browser_and_back() -> None:
    one = looking((1, 2, 3))
    back = camera_at(*pose_of(one), 2 * math.atan(0.5 * 14 / 20), (20, 14))
    assert torch.allclose(back.cam_from_world, one.cam_from_world, atol=1e-6)
    assert torch.allclose(back.intrinsics, one.intrinsics)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 20 / 14, 3.0])
def test_a_window_shows_the_whole_image(aspect: float) -> None:
    one = camera()
    half = math.tan(fitting_fov(one, aspect) / 2)
    assert half >= 0.5 * 14 / 20 - 1e-9
    assert half * aspect >= 0.5 * 20 / 20 - 1e-9
    assert min(half - 0.5 * 14 / 20, half * aspect - 0.5) == pytest.approx(0, abs=1e-9)


def test_the_point_to_orbit_lies_on_the_axis_as_deep_as_the_scene() -> None:
    assert look_point(looking((0, -4, 0)), np.array([1.0, 0, 1]), 1.0) == pytest.approx(
        [0, 0, 0], abs=1e-6
    )
    small = look_point(looking((0, -4e-5, 0)), np.array([1e-5, 0, 1e-5]), 1e-5)
    assert small == pytest.approx([0, 0, 0], abs=1e-10)
    behind = look_point(looking((0, -4, 0)), np.array([0.0, -9, 0]), 2.0)
    assert behind == pytest.approx([0, -3.8, 0], abs=1e-6)


def test_the_nearest_camera_is_near_in_place_direction_and_time() -> None:
    eyes = [(0, -4, 0), (4, 0, 0), (0, -4, 0.1)]
    poses = np.concatenate([looking(eye).cam_from_world.double().numpy() for eye in eyes])
    assert nearest_camera(looking((3.5, 0.2, 0)), None, poses, (None, None, None), 1.0) == 1
    assert nearest_camera(looking((0, -4, 0)), 0.9, poses, (0.0, 0.5, 1.0), 1.0) == 2
    assert nearest_camera(looking((0, -4, 0)), 0.1, poses, (0.0, 0.5, 1.0), 1.0) == 0
