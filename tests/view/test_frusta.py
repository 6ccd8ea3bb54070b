from types import SimpleNamespace

import numpy as np
import pytest
from view_sessions import looking_at_balls

from dyngs.view.frusta import Frusta, distinct, frustum_size


def test_a_fixed_camera_is_shown_once() -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[[1, 3], 0, 3] = 1.0
    poses[5, 2, 3] = 2.0
    for unit in (1.0, 1e-4, 1e-9, 1e3):
        relative = poses.copy()
        relative[:, :3, 3] *= unit
        assert distinct(relative) == [0, 1, 5]


def test_frusta_are_as_small_as_the_cameras_stand_close() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    assert frustum_size(poses, 4.0) == pytest.approx(0.2)  # one fixed camera
    poses[:, 0, 3] = [-1, 1, -1, 1]
    assert frustum_size(poses, 4.0) == pytest.approx(0.15)
    assert frustum_size(100 * poses, 4.0) == pytest.approx(0.2)


def test_a_frustum_that_the_camera_stands_in_is_hidden() -> None:
    session, _ = looking_at_balls()
    frusta = Frusta(SimpleNamespace(session=session))  # type: ignore[arg-type]
    assert session.eye is not None
    here, there = (SimpleNamespace(visible=True) for _ in range(2))
    eye = np.array(session.eye.position)
    frusta._handles = [(here, eye + 0.01, 0.2), (there, eye + 1.0, 0.2)]
    frusta.hide_what_covers()
    assert (here.visible, there.visible) == (False, True)
