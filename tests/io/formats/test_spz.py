"""Files of .spz in other coordinate systems and in version 4."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from splat_scenes import cloud, psnr, seen

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.io.formats.formats import SPZ_4, read_splats, upright, write_splats
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.formats.spz import packed_spz

SYSTEMS = ["LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"]
SYSTEMS += ["LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"]
"""By their numbers, from 1, in Niantic's library."""
LETTERS = {
    "R": (1, 0, 0),
    "L": (-1, 0, 0),
    "U": (0, 1, 0),
    "D": (0, -1, 0),
    "B": (0, 0, 1),
    "F": (0, 0, -1),
}


def record(kind: int, value: bytes) -> bytes:
    return struct.pack("<II", kind, len(value)) + value


def stating(number: int) -> bytes:
    return record(0xADBE0003, struct.pack("<I", number))


def version_3(splat: SplatFile, extensions: bytes) -> bytes:
    """Return a file of version 3 with extensions, which lie at the end there."""
    content = bytearray(gzip.decompress(packed_spz(splat)))
    content[14] |= 2
    return gzip.compress(bytes(content) + extensions)


def points(means: np.ndarray) -> Gaussians:
    count = len(means)
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), -3.0),
        logit_opacities=torch.zeros(count),
        sh=torch.zeros(count, 1, 3),
    )


@pytest.mark.parametrize("name", SYSTEMS)
def test_points_lie_where_the_coordinate_system_says(name: str, tmp_path: Path) -> None:
    stored = np.array([[1.0, 0, 0], [0, 2, 0], [0, 0, 4], [1, 2, 4]])
    (tmp_path / "a.spz").write_bytes(
        version_3(SplatFile(points(stored)), stating(1 + SYSTEMS.index(name)))
    )
    back = read_splats(tmp_path / "a.spz")
    world = stored @ np.array([LETTERS[letter] for letter in name])
    np.testing.assert_allclose(back.gaussians.means.numpy(), world, atol=1e-6)
    assert back.up == "y"
    assert ["it states other axes" in note for note in back.notes] == [True] * (name != "RUB")


@pytest.mark.parametrize("up", ["y", "-y", "z", "-z"])
def test_version_4_states_its_axes(up: str, tmp_path: Path) -> None:
    """Whichever axis is up in the file, readers of the statement find the same scene, harmonics
    included."""
    pytest.importorskip("zstandard")
    scene = cloud(degree=4)
    path = tmp_path / "a.spz"
    written = write_splats(
        path, upright(SplatFile(scene, RasterizeMode.ANTIALIASED, up="y"), up, path), own=SPZ_4
    )
    data = path.read_bytes()
    assert struct.unpack("<4sI", data[:8]) == (b"NGSP", 4)
    assert data[32:44] == stating(
        1 + SYSTEMS.index({"y": "RUB", "-y": "RDF", "z": "RFU", "-z": "RBD"}[up])
    )
    back = read_splats(path)
    assert (back.up, back.mode, written.splat.up) == ("y", RasterizeMode.ANTIALIASED, "y")
    assert psnr(seen(back.gaussians), seen(scene)) > 36
    torch.testing.assert_close(
        back.gaussians.means, written.splat.gaussians.means, rtol=0, atol=1e-4
    )


def test_version_4_holds_what_version_3_holds(tmp_path: Path) -> None:
    pytest.importorskip("zstandard")
    for degree in (0, 2):
        scene = SplatFile(cloud(50, degree), up="y")
        old = read_splats(write_splats(tmp_path / "old.spz", scene).path).gaussians.tensors()
        new = read_splats(
            write_splats(tmp_path / "new.spz", scene, own=SPZ_4).path
        ).gaussians.tensors()
        for name, tensor in old.items():
            torch.testing.assert_close(new[name], tensor, rtol=0, atol=0)
        # Empty streams are not stored.
        assert (tmp_path / "new.spz").read_bytes()[15] == (6 if degree else 5)
    nothing = write_splats(
        tmp_path / "new.spz", SplatFile(cloud(5), up="x"), own=SPZ_4
    ).path.read_bytes()
    assert nothing[14] & 2 == 0  # no coordinate system has x up


def test_extensions_that_are_unknown_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    splat = SplatFile(points(np.array([[1.0, 2.0, 4.0]])))
    orbit = record(0xADBE0002, bytes(12))
    path.write_bytes(version_3(splat, orbit + stating(6)))
    assert read_splats(path).gaussians.means.tolist() == [[1.0, -2.0, -4.0]]
    for kept in (orbit, stating(0), orbit + stating(4)):
        path.write_bytes(version_3(splat, kept))
        assert read_splats(path).gaussians.means.tolist() == [[1.0, 2.0, 4.0]]
    for broken, problem in (
        (stating(17), "coordinate system 17"),
        (orbit[:-1], "cannot be read"),
        (orbit + b"x", "cannot be read"),
    ):
        path.write_bytes(version_3(splat, broken))
        with pytest.raises(DyngsError, match=problem):
            read_splats(path)
