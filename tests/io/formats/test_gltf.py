"""Gaussians in glTF that are compressed as a .spz."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import pytest
import torch
from splat_scenes import cloud, psnr, seen

from dyngs.core.conventions import RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.io.formats.formats import (
    GLB_OF_SPZ,
    read_splats,
    write_splats,
)
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.formats.spz import packed_spz

BASE = "KHR_gaussian_splatting"
SPZ = f"{BASE}_compression_spz_2"


def as_cesium_writes(path: Path, own: dict[str, Any], spz: bytes) -> None:
    """Write a document as tiles of CesiumJS hold it: accessors without data, and a node that turns
    it."""
    accessor = {"componentType": 5126, "count": 400, "type": "VEC3"}
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": [BASE, SPZ],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [1, 2, 3]}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0}, "mode": 0, "extensions": {BASE: own}}]}
        ],
        "accessors": [accessor],
        "bufferViews": [{"buffer": 0, "byteLength": len(spz)}],
        "buffers": [{"byteLength": len(spz)}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary = spz + bytes(-len(spz) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(binary))
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(binary), b"BIN\0")
        + binary
    )
    path.write_bytes(head + chunks)


def test_gaussians_compressed_by_another_program(tmp_path: Path) -> None:
    scene = cloud()
    spz = packed_spz(SplatFile(scene, RasterizeMode.ANTIALIASED))
    for own in (
        {"extensions": {SPZ: {"bufferView": 0}}},
        {"extensions": {f"{BASE}_compression_spz": {"bufferView": 0}}},
    ):
        as_cesium_writes(tmp_path / "a.glb", own, spz)
        back = read_splats(tmp_path / "a.glb")
        assert (back.up, back.mode) == ("y", RasterizeMode.ANTIALIASED)
        near = back.gaussians.replace(means=back.gaussians.means - torch.tensor([1.0, 2.0, 3.0]))
        torch.testing.assert_close(near.means, scene.means, rtol=0, atol=1e-4)
        assert psnr(seen(near), seen(scene)) > 36


@pytest.mark.parametrize(
    ("own", "problem"),
    [
        (
            {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "extensions": {"EXT_other": {}},
            },
            "'EXT_other'",
        ),
        ({"extensions": {SPZ: {"bufferView": 7}}}, "missing buffer view"),
        ({"extensions": {SPZ: {"bufferView": "0"}}}, "names no buffer view"),
        ({"extensions": {SPZ: 3}}, "names no buffer view"),
        ({"extensions": [SPZ]}, "are no object"),
        (
            {"colorSpace": "lin_rec709_display", "extensions": {SPZ: {"bufferView": 0}}},
            "lin_rec709_display",
        ),
    ],
)
def test_compressions_that_are_not_read(own: dict[str, Any], problem: str, tmp_path: Path) -> None:
    as_cesium_writes(tmp_path / "a.glb", own, packed_spz(SplatFile(cloud(5))))
    with pytest.raises(DyngsError, match=problem):
        read_splats(tmp_path / "a.glb")


def test_what_is_written_compressed_comes_back(tmp_path: Path) -> None:
    scene = cloud(degree=2)
    path = tmp_path / "a.glb"
    whole = write_splats(tmp_path / "whole.glb", SplatFile(scene, up="y")).path
    write_splats(
        path,
        SplatFile(scene, RasterizeMode.ANTIALIASED, up="y", world_offset=(1, 2, 3)),
        own=GLB_OF_SPZ,
    )
    back = read_splats(path)
    assert (back.up, back.mode, back.world_offset) == ("y", RasterizeMode.ANTIALIASED, (1, 2, 3))
    assert psnr(seen(back.gaussians), seen(scene)) > 36
    assert path.stat().st_size < 0.4 * whole.stat().st_size
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert document["extensionsRequired"] == document["extensionsUsed"] == [BASE, SPZ]
    (primitive,) = document["meshes"][0]["primitives"]
    assert "bufferView" in primitive["extensions"][BASE]["extensions"][SPZ]
    counts = {document["accessors"][index]["count"] for index in primitive["attributes"].values()}
    assert counts == {len(scene)}
    assert f"{BASE}:SH_DEGREE_2_COEF_4" in primitive["attributes"]
    assert f"{BASE}:SH_DEGREE_3_COEF_0" not in primitive["attributes"]
    assert (
        document["accessors"][primitive["attributes"]["POSITION"]]["max"]
        == scene.means.amax(0).tolist()
    )
