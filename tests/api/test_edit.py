"""Edits of runs and files: outputs, coordinate frames, and contents that must not change."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import MOVING_ROWS, moved_x, write_moving_run
from scaled_files import FAR, write_far_ply
from splat_scenes import cloud, readable

from dyngs.api.edit import Edits, edit_scene
from dyngs.core.errors import DyngsError
from dyngs.export.edit.crop import Box, Sphere
from dyngs.export.edit.frame import Frame, control_point_frame
from dyngs.export.splat_files import read_4dgs_frame
from dyngs.io.formats.formats import Format, read_splats, write_splats
from dyngs.io.formats.splat_file import SplatFile

HALF = Edits(frame=Frame(up=(0.0, 0.0, 1.0), origin=(0.5, 0.0, 0.0), scale=0.5))


def silent(text: str) -> None:
    """Discard a progress message."""


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    return write_splats(
        tmp_path / "plain.ply", SplatFile(cloud(300, 2), up="-y", comments=("mine",))
    ).path


@pytest.mark.parametrize("kind", readable(), ids=lambda kind: kind.name)
def test_a_frame_in_every_format_and_back(kind: Format, plain: Path, tmp_path: Path) -> None:
    before = plain.read_bytes()
    path = tmp_path / f"a{kind.suffixes[0]}"
    written = edit_scene(plain, path, HALF, tell=silent)
    assert written.redrawn > (99 if kind.name in ("ply", "usd", "glb") else 15)
    assert read_splats(path).up == kind.up
    if not kind.stores_comments:
        return
    edit_scene(path, tmp_path / "back.ply", Edits(undo=True), tell=silent)
    back = read_splats(tmp_path / "back.ply")
    assert plain.read_bytes() == before
    if kind.name in ("ply", "usd", "glb"):  # others change the order and round
        for name, x in read_splats(plain).gaussians.tensors().items():
            got = getattr(back.gaussians, name)
            torch.testing.assert_close(
                got.abs() if name == "quats" else got,
                x.abs() if name == "quats" else x,
                rtol=0,
                atol=2e-5,
            )


def test_control_points_far_away(plain: Path, tmp_path: Path) -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    world = 2 * points[:, [1, 2, 0]] + [691000.0, 5334000.0, 500.0]
    rows = np.concatenate([points, world], axis=1)
    (tmp_path / "geo.txt").write_text("\n".join(" ".join(map(repr, row)) for row in rows.tolist()))
    told: list[str] = []
    edit_scene(
        plain,
        tmp_path / "a.ply",
        Edits(geo=control_point_frame(tmp_path / "geo.txt")),
        tell=told.append,
    )
    found = read_splats(tmp_path / "a.ply")
    line = next(text for text in told if text.startswith("offset to add"))
    offset = np.array([float(x) for x in line.split(": ")[1].split()])
    wanted = 2 * read_splats(plain).gaussians.means.numpy()[:, [1, 2, 0]] + [
        691000.0,
        5334000.0,
        500.0,
    ]
    np.testing.assert_allclose(found.gaussians.means.double().numpy() + offset, wanted, atol=1e-4)
    assert "viewers of the format take -y for up" in told[-1]
    edit_scene(
        tmp_path / "a.ply",
        tmp_path / "b.ply",
        Edits(region=Sphere((0.0, 0.0, 0.0), 1e3)),
        tell=silent,
    )
    part = read_splats(tmp_path / "b.ply")
    assert part.up == "z"
    torch.testing.assert_close(part.gaussians.means, found.gaussians.means, rtol=0, atol=0)


def test_a_file_far_from_the_origin_is_edited_in_its_own_coordinates(tmp_path: Path) -> None:
    source = tmp_path / "far.ply"
    whole = cloud(200, 0)
    positions = write_far_ply(source, SplatFile(whole))
    corner = np.array(FAR)
    edits = Edits(region=Box(corner, corner + 100), frame=Frame(origin=FAR, scale=2.0))
    edit_scene(source, tmp_path / "part.ply", edits, tell=silent)
    inside = positions[(positions > corner).all(axis=1)] - corner
    found = read_splats(tmp_path / "part.ply").gaussians.means.double().numpy()
    np.testing.assert_allclose(found, 2 * inside, rtol=0, atol=1e-5)


def test_a_moving_run(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path)
    told = []
    frame = Edits(frame=Frame(scale=3.0, up=(0.0, -1.0, 0.0)))
    edit_scene(run, tmp_path / "a.ply", frame, tell=told.append)
    assert "time 0 of a moving scene" in told[0]
    edit_scene(run, tmp_path / "a.ply", replace(frame, time=0.75), tell=told.append)
    rows = list(MOVING_ROWS)
    moved = read_splats(tmp_path / "a.ply").gaussians.means[rows, 0]
    torch.testing.assert_close(moved, 3 * moved_x(MOVING_ROWS, 0.75), rtol=0, atol=1e-5)
    for edits, said in (
        (replace(frame, merge=(run,)), "--merge requires static scenes"),
        (Edits(undo=True), "was not changed by"),
    ):
        with pytest.raises(DyngsError, match=said):
            edit_scene(run, tmp_path / "b.ply", edits, tell=silent)
    assert not (tmp_path / "b.ply").exists()


@pytest.mark.skipif(find_spec("fourdgs") is None, reason="needs fourdgs")
def test_all_times_of_a_moving_run(tmp_path: Path) -> None:
    path = tmp_path / "a.4dgs"
    run = write_moving_run(tmp_path)
    edits = Edits(region=Sphere((0.0, 0.0, 0.0), 0.2), frame=Frame(scale=3.0, up=(0.0, -1.0, 0.0)))
    assert edit_scene(run, path, edits, tell=silent).redrawn > 40
    assert len(read_4dgs_frame(path, 2).gaussians) == 3
    assert float(read_4dgs_frame(path, 4).gaussians.means[0, 0]) == pytest.approx(
        3 * float(moved_x((1,), 1.0)), abs=0.01
    )


def test_nothing_is_written_where_nothing_is_left(plain: Path, tmp_path: Path) -> None:
    far = Edits(region=Sphere((99.0, 0.0, 0.0), 1.0))
    with pytest.raises(DyngsError, match="--crop leaves none of 300 Gaussians; they lie between"):
        edit_scene(plain, tmp_path / "a.ply", far, tell=silent)
    edit_scene(plain, tmp_path / "a.ply", replace(far, outside=True), tell=silent)
    assert len(read_splats(tmp_path / "a.ply").gaussians) == 300
    for name, said in (
        ("a.4dgs", "holds a scene that moves"),
        ("a.html", "edits end in a file of Gaussians or a run"),
    ):
        with pytest.raises(DyngsError, match=said):
            edit_scene(plain, tmp_path / name, HALF, tell=silent)
    with pytest.raises(DyngsError, match="--up auto needs the cameras"):
        edit_scene(plain, tmp_path / "b.ply", Edits(frame=Frame(up="auto")), tell=silent)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "plain.ply"]
