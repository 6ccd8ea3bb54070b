from pathlib import Path

import pytest
import torch
from pretend_gpu import GPU, pretend_gpu
from scene_kinds import scene_of_kind
from view_sessions import opened_at

from dyngs.core.errors import DyngsError
from dyngs.runs.opened import Opened
from dyngs.view.people import (
    AS_CAPTURED,
    AT_REST,
    BY_SLIDERS,
    MAIN_JOINTS,
    in_motion,
    joint_row,
    motion_files,
    posed,
)


@pytest.fixture
def opened() -> Opened:
    return opened_at(scene_of_kind("human"), "person")


def test_sliders_at_zero_are_the_rest_pose(opened: Opened) -> None:
    rest = in_motion(opened, AT_REST, {}, {"neck": (90.0, 0, 0)})  # sliders do not count
    zero = in_motion(opened, BY_SLIDERS, {}, {"neck": (0.0, 0, 0)})
    assert rest.scene.is_static
    assert torch.allclose(rest.scene.at(None).means, zero.scene.at(None).means, atol=1e-6)
    assert in_motion(opened, AS_CAPTURED, {}, {}) is opened


def test_a_turned_joint_moves_some_of_the_person(opened: Opened) -> None:
    rest, turned = (
        posed(opened, angles).scene.at(None).means for angles in ({}, {"pelvis": (0.0, 90.0, 0.0)})
    )
    assert float((turned - rest).norm(dim=1).max()) > 1e-3
    back = posed(opened, {"pelvis": (0.0, 360.0, 0.0)}).scene.at(None).means
    assert torch.allclose(back, rest, atol=1e-4)


def test_a_person_on_a_gpu_is_posed_there(opened: Opened) -> None:
    angles = {"neck": (30.0, 0.0, 0.0)}
    expected = in_motion(opened, BY_SLIDERS, {}, angles).scene.at(None).means
    with pretend_gpu():
        posed_there = in_motion(opened.to(GPU), BY_SLIDERS, {}, angles).scene.at(None).means
        assert posed_there.device == GPU
        found = posed_there.cpu()
    assert torch.equal(found, expected)


@pytest.mark.parametrize("count", [24, 52, 55])
def test_every_body_has_the_main_joints(count: int) -> None:
    rows = [joint_row(name, count) for name in MAIN_JOINTS]
    assert len(set(rows)) == len(rows)
    assert max(rows) < count


def test_motion_files_are_found_by_suffix(tmp_path: Path) -> None:
    for name in ("walk.npz", "b/run.BVH", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert list(motion_files(tmp_path)) == ["b/run.BVH", "walk.npz"]
    assert list(motion_files(tmp_path / "walk.npz")) == ["walk.npz"]
    assert motion_files(None) == {}
    with pytest.raises(DyngsError, match="no such file"):
        motion_files(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DyngsError, match="no motion files"):
        motion_files(tmp_path / "empty")


def test_a_motion_that_cannot_be_read_is_one_line(opened: Opened, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"--motion .*walk\.npz"):
        in_motion(opened, "walk.npz", {"walk.npz": tmp_path / "walk.npz"}, {})
