from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import camera

from dyngs.core.camera import Cameras
from dyngs.export.camera_paths import read_path
from dyngs.io.formats.similarity import Similarity
from dyngs.view.recording import Keyframe, Recording


def at_depth(depth: float) -> Cameras:
    one = camera(40, 28)
    pose = one.cam_from_world.clone()
    pose[0, 2, 3] = depth
    return Cameras(pose, one.intrinsics, 40, 28)


@pytest.mark.parametrize("loops", [False, True])
def test_dyngs_render_reads_what_was_recorded_and_sees_what_was_previewed(
    tmp_path: Path, loops: bool
) -> None:
    offset = np.array([10.0, -20, 5])
    keys = (
        Keyframe(at_depth(4), 0.0, 1.0),
        Keyframe(at_depth(6), 0.5, 2.0),
        Keyframe(at_depth(3), 1.0, 1.0),
    )
    recording = Recording(keys, loops)
    assert recording.duration == (4.0 if loops else 3.0)
    file = tmp_path / "path.json"
    file.write_text(recording.document((20, 14), 10.0, offset))
    path = read_path(file, offset)
    assert (path.cameras.width, path.cameras.height, path.fps) == (20, 14, 10.0)
    assert path.times is not None
    assert len(path) == (40 if loops else 31)
    for frame in (0, 7, 10, 25, len(path) - 1):
        shown, time = recording.at(frame / 10)
        assert time == pytest.approx(path.times[frame], abs=1e-6)
        assert torch.allclose(
            path.cameras.cam_from_world[frame], shown.cam_from_world[0], atol=1e-4
        )
        assert path.cameras.intrinsics[frame, 1, 1] == pytest.approx(
            float(shown.intrinsics[0, 1, 1]) / 2
        )


def test_a_path_through_a_moved_scene_is_in_the_axes_of_the_capture(tmp_path: Path) -> None:
    turned = Similarity((0.5, 0.5, -0.5, 0.5), 2.0)
    offset = np.array([1.0, 2, 3])
    file = tmp_path / "path.json"
    one = Recording((Keyframe(at_depth(4), None),))
    file.write_text(one.moved(turned.inverse()).document((40, 28), 30.0, offset))
    seen = turned.cameras(read_path(file, offset).cameras)
    assert torch.allclose(seen.cam_from_world, at_depth(4).cam_from_world, atol=1e-6)


def test_a_still_scene_has_no_times(tmp_path: Path) -> None:
    file = tmp_path / "path.json"
    one = Recording((Keyframe(at_depth(4), None), Keyframe(at_depth(5), None)))
    file.write_text(one.document((40, 28), 30.0, np.zeros(3)))
    assert read_path(file).times is None
    assert one.at(0.5)[1] is None
