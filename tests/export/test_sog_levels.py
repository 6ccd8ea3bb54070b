"""A scene in levels of detail as PlayCanvas streams it, read again by the description of the
format."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
import torch

from dyngs.export import splat_files
from dyngs.export.splat_files import write_sog_levels
from dyngs.gaussians import Gaussians
from dyngs.gaussians.levels import build_levels
from dyngs.io.formats.formats import SOG_INDEX, read_splats
from dyngs.io.formats.splat_file import SplatFile

N = 20_000


def scene() -> SplatFile:
    generator = torch.Generator().manual_seed(3)
    means = torch.rand(N, 3, generator=generator) * torch.tensor([4.0, 1.0, 2.0])
    quats = torch.nn.functional.normalize(torch.randn(N, 4, generator=generator), dim=1)
    scales = torch.rand(N, 3, generator=generator) - 4
    sh = torch.rand(N, 4, 3, generator=generator) - 0.5
    return SplatFile(
        Gaussians(means, quats, scales, torch.randn(N, generator=generator), sh), up="-y"
    )


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    if "children" not in node:
        return [node]
    for child in node["children"]:
        for axis in range(3):
            assert node["bound"]["min"][axis] <= child["bound"]["min"][axis]
            assert node["bound"]["max"][axis] >= child["bound"]["max"][axis]
    return [leaf for child in node["children"] for leaf in leaves(child)]


def test_leaves_are_alternatives_of_one_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splat_files, "PER_LEAF", 4096)
    monkeypatch.setattr(splat_files, "PER_FILE", 8192)
    splat = scene()
    counts = write_sog_levels(tmp_path / "town", splat)
    index = json.loads((tmp_path / "town" / SOG_INDEX).read_text(encoding="utf-8"))
    assert counts == (20_000, 5_000, 1_250)
    assert (index["version"], index["lodLevels"], index["counts"]) == (1, 3, list(counts))
    assert index["count"] == sum(counts)
    assert index["filenames"] == [
        f"{name}/meta.json" for name in ("0_0", "0_1", "0_2", "1_0", "2_0")
    ]
    files = []
    for name in index["filenames"]:
        folder = tmp_path / "town" / Path(name).parent
        path = tmp_path / f"{Path(name).parent}.sog"
        with zipfile.ZipFile(path, "w") as archive:
            for part in folder.iterdir():
                archive.write(part, part.name)
        files.append(read_splats(path).gaussians)
    wanted = build_levels(splat.gaussians).levels
    shown = [0] * 3
    for leaf in leaves(index["tree"]):
        low = torch.tensor(leaf["bound"]["min"])
        high = torch.tensor(leaf["bound"]["max"])
        for level, where in enumerate(leaf["lods"][str(level)] for level in range(3)):
            rows = slice(where["offset"], where["offset"] + where["count"])
            means = files[where["file"]].means[rows]
            first = shown[level]
            assert len(means) == where["count"]
            torch.testing.assert_close(
                means, wanted[level].means[first : first + len(means)], atol=1e-3, rtol=0
            )
            assert bool(((means >= low) & (means <= high)).all())
            shown[level] += len(means)
    assert tuple(shown) == counts
