"""A .sog whose files lie in a folder."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
import torch
from splat_scenes import cloud

from dyngs.cli import main
from dyngs.core.errors import DyngsError
from dyngs.io.formats.formats import read_splats, write_splats
from dyngs.io.formats.splat_file import SplatFile
from dyngs.view.source import open_source


def unpacked(folder: Path) -> Path:
    """Write a .sog and its files in ``scene`` beside it."""
    write_splats(folder / "a.sog", SplatFile(cloud(60, 1), up="-y"))
    with zipfile.ZipFile(folder / "a.sog") as archive:
        archive.extractall(folder / "scene")
    return folder / "scene"


def test_a_folder_and_its_meta_are_the_packed_file(tmp_path: Path) -> None:
    scene = unpacked(tmp_path)
    wanted = read_splats(tmp_path / "a.sog")
    for path in (scene, scene / "meta.json"):
        back = read_splats(path)
        assert back.up == "-y"
        for name, tensor in wanted.gaussians.tensors().items():
            torch.testing.assert_close(back.gaussians.tensors()[name], tensor, rtol=0, atol=0)
        assert main(["convert", str(path), str(tmp_path / "out.ply")]) == 0
        assert len(read_splats(tmp_path / "out.ply").gaussians) == 60
        command = [
            "render",
            str(path),
            "--out",
            str(tmp_path / "drawn"),
            "--path",
            "orbit",
            "--frames",
            "1",
        ]
        assert main([*command, "--size", "32x24"]) == 0
        (tmp_path / "drawn" / "frame_0000.png").unlink()
    assert open_source(scene, None, None).names == ("scene",)


def test_files_outside_of_the_folder_are_not_read(tmp_path: Path) -> None:
    scene = unpacked(tmp_path)
    text = (scene / "meta.json").read_text()
    (tmp_path / "secret.webp").write_bytes((scene / "quats.webp").read_bytes())
    for name in ("../secret.webp", str(tmp_path / "secret.webp"), "link.webp", "..\\secret.webp"):
        if name == "link.webp":
            (scene / name).symlink_to(tmp_path / "secret.webp")
        meta = json.loads(text)
        meta["quats"]["files"] = [name]
        (scene / "meta.json").write_text(json.dumps(meta))
        with pytest.raises(DyngsError, match="lies outside of its folder"):
            read_splats(scene)
    (scene / "meta.json").write_text(text)
    (scene / "sh0.webp").unlink()
    with pytest.raises(DyngsError, match=r"No such file or directory: .*sh0\.webp"):
        read_splats(scene)
