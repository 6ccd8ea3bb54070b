"""Extensions of .spz files."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.io.formats.formats import read_splats, write_splats
from dyngs.io.formats.splat_file import SplatFile


def record(kind: int, value: bytes) -> bytes:
    return struct.pack("<II", kind, len(value)) + value


def stating(number: int) -> bytes:
    return record(0xADBE0003, struct.pack("<I", number))


def version_3(splat: SplatFile, extensions: bytes, path: Path) -> bytes:
    """Return a file of version 3 with extensions, which lie at the end there."""
    content = bytearray(gzip.decompress(write_splats(path, splat).path.read_bytes()))
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


def test_extensions_that_are_unknown_or_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    splat = SplatFile(points(np.array([[1.0, 2.0, 4.0]])))
    orbit = record(0xADBE0002, bytes(12))
    for kept in (orbit, stating(0), orbit + stating(4)):
        path.write_bytes(version_3(splat, kept, tmp_path / "b.spz"))
        assert read_splats(path).gaussians.means.tolist() == [[1.0, 2.0, 4.0]]
    for broken, problem in (
        (orbit + stating(6), "coordinate system 6 is not supported"),
        (orbit[:-1], "cannot be read"),
        (orbit + b"x", "cannot be read"),
    ):
        path.write_bytes(version_3(splat, broken, tmp_path / "b.spz"))
        with pytest.raises(DyngsError, match=problem):
            read_splats(path)
