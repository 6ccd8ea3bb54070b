"""BVH files: round trips, any order of channels, and broken files that end in one line."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from measured import cost_of
from motion_files import (
    as_local,
    pelvis_path,
    random_motion,
    skeleton,
    tiny_body,
    world_rotations,
    write_bvh,
)
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.human.motion.bvh import read_bvh
from dyngs.human.motion.retarget import retarget

TWO = """HIERARCHY
ROOT Hip Bone {
  OFFSET 1 2 3
  CHANNELS 4 Yposition Zrotation Xrotation Yrotation
  JOINT Spine
  {
    OFFSET 0 1 0
    CHANNELS 1 Xrotation
    End Site
    {
      OFFSET 0 1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.025
5 90 0 0 0
5 0 0 0 90
"""


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """Two joints, two frames."""
    path = tmp_path / "two.bvh"
    path.write_text(TWO)
    return path


def test_known_answer(two: Path) -> None:
    """Position channels take the place of OFFSET along their axis; a joint turns what hangs on
    it."""
    source = read_bvh(two)
    assert source.names == ("Hip Bone", "Spine")
    assert source.fps == 40.0
    assert not source.world_is_y_up
    np.testing.assert_allclose(source.rest, [[0, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(source.positions[:, 0], [[1, 5, 3], [1, 5, 3]])
    np.testing.assert_allclose(source.positions[:, 1], [[0, 5, 3], [1, 6, 3]], atol=1e-12)
    np.testing.assert_allclose(
        source.rotations[0, 1], Rotation.from_euler("z", 90, degrees=True).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(
        source.rotations[1, 1], Rotation.from_euler("x", 90, degrees=True).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize("order", ["".join(x) for x in permutations("XYZ")])
def test_round_trip_of_a_body(tmp_path: Path, order: str) -> None:
    """World rotations of all joints and the pelvis' path come back, in any order of rotations."""
    own = skeleton()
    motion = random_motion(5)
    body = tiny_body()
    path = write_bvh(
        tmp_path / "x.bvh", own, as_local(motion, own), pelvis_path(body, motion), order, fps=120
    )
    found = retarget(read_bvh(path), body)
    ours, theirs = (world_rotations(x.poses.double().numpy(), own.parents) for x in (found, motion))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
    moved, expected = (x.trans.numpy() - x.trans.numpy()[0] for x in (found, motion))
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    assert found.fps == pytest.approx(120, rel=1e-6)


@pytest.mark.parametrize(
    "change", [("\n", "\r\n"), ("  ", "\t"), ("  OFFSET", "  \n\n  offset"), ("{", "\n{\n\n")]
)
def test_looks_do_not_matter(two: Path, change: tuple[str, str]) -> None:
    expected = read_bvh(two)
    two.write_bytes(b"\xef\xbb\xbf" + TWO.replace(*change).encode())
    found = read_bvh(two)
    assert found.names == expected.names
    np.testing.assert_array_equal(found.positions, expected.positions)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("MOTION\n", "", "no MOTION section"),
        ("  JOINT Spine\n  {", "  JOINT Spine\n", "cannot be read|truncated"),
        ("}\nMOTION", "MOTION", "HIERARCHY is truncated"),
        ("OFFSET 1 2 3", "OFFSET 1 2", "cannot be read"),
        ("  OFFSET 1 2 3\n", "", "a joint without OFFSET"),
        ("OFFSET 1 2 3", "OFFSET 1 2 nan", "NaN or huge"),
        ("OFFSET 1 2 3", "OFFSET 1 2 x", "could not convert"),
        ("CHANNELS 4", "CHANNELS 6", "CHANNELS of 'Hip Bone' must be a count"),
        ("Xrotation Y", "Wrotation Y", "CHANNELS of 'Hip Bone' must be a count"),
        ("Frames: 2", "Frames: 0", "expected 0 frames"),
        ("Frames: 2", "Frames: 3", "expected 3 frames of 5 numbers, got 10"),
        ("Frames: 2", "Frames: 999999999", "exceed the limit"),
        ("Frame Time: 0.025", "Frame Time: 0", "division by zero"),
        ("Frame Time: 0.025", "Frame Time: 1e8", "frame rate 1e-08 is outside"),
        ("5 0 0 0 90", "5 0 0 0", "cannot be read"),
        ("5 0 0 0 90", "5 0 0 0 inf", "NaN or huge"),
        ("5 0 0 0 90", "5 0 0 0 9,5", "could not convert"),
    ],
)
def test_broken_files_say_what_is_wrong(two: Path, old: str, new: str, problem: str) -> None:
    assert old in TWO
    two.write_text(TWO.replace(old, new, 1))
    with pytest.raises(DyngsError, match=problem) as caught:
        read_bvh(two)
    assert str(two) in str(caught.value)
    assert "\n" not in str(caught.value)


HOSTILE = {
    "frames": (
        f"{TWO[: TWO.index('Frames')]}Frames: 300000\nFrame Time: 0.03\n" + "0 " * 1_500_000,
        "exceed the limit",
    ),
    "blank lines": ("HIERARCHY" + "\n" * 1_000_000, "no MOTION section"),
    "joints": (
        "HIERARCHY ROOT a\n{\n" + "JOINT a\n{\n" * 5000 + TWO[TWO.index("MOTION") :],
        "4,097 joints exceed",
    ),
    "a long word": (TWO.replace("0.025", "9" * 1_000_000), "is outside 0.001 to 100,000"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_cost_little(two: Path, name: str) -> None:
    text, problem = HOSTILE[name]
    two.write_text(text)

    def read() -> None:
        with pytest.raises(DyngsError, match=problem) as caught:
            read_bvh(two)
        assert len(str(caught.value)) < 600

    memory, seconds = cost_of(read)
    assert memory < 150e6
    assert seconds < 20
