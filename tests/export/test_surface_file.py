"""Surfaces of Gaussians as files, through the command: still and moving ones, in the capture's own
coordinates."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from moving_scene import write_moving_run

from dyngs.cli import main
from dyngs.export.surface_file import SUFFIXES


def mesh_of(path: Path) -> trimesh.Trimesh:
    found = trimesh.load(path, force="mesh", process=False)
    assert isinstance(found, trimesh.Trimesh)
    return found


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_far_from_the_origin_is_the_mesh_moved(tmp_path: Path, suffix: str) -> None:
    offset = (500_123.25, 4_600_321.5, 117.0)
    found = []
    for name, where in (("near", (0.0, 0.0, 0.0)), ("far", offset)):
        (tmp_path / name).mkdir()
        run = write_moving_run(tmp_path / name, moves=False, offset=where)
        out = tmp_path / f"{name}{suffix}"
        command = f"export {run} --format mesh --cells 32 --up keep --out {out}"
        assert main(command.split()) == 0
        found.append(mesh_of(out))
    near, far = found
    np.testing.assert_array_equal(far.faces, near.faces)
    np.testing.assert_allclose(far.vertices - offset, near.vertices, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(far.visual.vertex_colors, near.visual.vertex_colors)


UP_IN = {".ply": "keep", ".glb": "y", ".obj": "y"}
"""What points up in the files, by their suffix."""


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("up", [None, "-y", "z"])
def test_up_is_what_programs_take_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str, up: str | None
) -> None:
    """The capture has z up; colours stay, and triangles look outwards as before."""
    run = write_moving_run(tmp_path, moves=False, offset=(1.0, 2.0, 3.0))
    command = ["export", str(run), "--format", "mesh", "--cells", "32", "--from-up", "z"]
    meshes = []
    for name, options in (
        ("kept", ["--up", "keep"]),
        ("turned", [] if up is None else [f"--up={up}"]),
    ):
        out = tmp_path / f"{name}{suffix}"
        assert main([*command, "--out", str(out), *options]) == 0
        meshes.append(mesh_of(out))
    kept, turned = meshes
    x, y, z = kept.vertices.T
    wanted = {"y": (x, z, -y), "-y": (x, -z, y), "z": (x, y, z), "keep": (x, y, z)}[
        up or UP_IN[suffix]
    ]
    np.testing.assert_allclose(turned.vertices, np.stack(wanted, 1), atol=1e-5)
    np.testing.assert_array_equal(turned.faces, kept.faces)
    np.testing.assert_array_equal(turned.visual.vertex_colors, kept.visual.vertex_colors)
    assert turned.volume == pytest.approx(kept.volume, rel=1e-3)
    said = capsys.readouterr().out
    assert "axes of the capture are kept" in said
    assert (f"up is {up or 'y'} in the file" in said) == (up is not None or suffix != ".ply")


def test_a_moving_scene_has_a_mesh_for_each_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_moving_run(tmp_path)
    out = tmp_path / "meshes"
    command = f"export {run} --format mesh --cells 24 --times 0:1:2 --out {out}".split()
    assert main(command) == 0
    assert len(re.findall(r"triangles, .* vertices", capsys.readouterr().out)) == 2
    first, last = (mesh_of(path) for path in sorted(out.iterdir()))
    assert not np.array_equal(first.vertices[:50], last.vertices[:50])
    assert main(command) == 0
    np.testing.assert_array_equal(mesh_of(out / "mesh_0000.ply").vertices, first.vertices)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--cells 7", "--cells: '7' is not a number of cells"),
        ("--level 2", "--level: not supported for the mesh"),
        (
            "--out x.stl",
            r"x\.stl: a mesh file must end in \.ply, \.glb, \.obj",
        ),
        ("--times 0:1:2 --out x.ply", r"x\.ply: --times writes a folder; use --out x"),
        ("--static", "--static is not supported with --format mesh"),
    ],
)
def test_refusals_are_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: str,
    words: str,
) -> None:
    run = write_moving_run(tmp_path)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert main(["export", str(run), "--format", "mesh", *options.split()]) == 2
    said = capsys.readouterr().err
    assert re.search(words, said)
    assert said.count("\n") == 1
    assert not list((tmp_path / "empty").iterdir())
    assert not list(run.glob("mesh*"))


def test_a_file_of_gaussians_has_no_views(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_moving_run(tmp_path, moves=False)
    file = tmp_path / "balls.ply"
    assert main(["export", str(run), "--out", str(file)]) == 0
    capsys.readouterr()
    assert main(["export", str(file), "--format", "mesh", "--out", str(tmp_path / "mesh.glb")]) == 2
    assert re.fullmatch(
        r"dyngs: error: .*balls\.ply: a mesh needs the depth of training views; .*\n",
        capsys.readouterr().err,
    )
    assert not (tmp_path / "mesh.glb").exists()
