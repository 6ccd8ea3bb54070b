"""``dyngs convert`` and the suffixes of ``dyngs export``: one line for each thing that is chosen or
lost."""

from __future__ import annotations

from pathlib import Path

import pytest
from moving_scene import write_moving_run
from splat_scenes import cloud, readable

from dyngs.cli import main
from dyngs.cli.splats import SPLAT_FORMATS
from dyngs.io.formats.formats import FORMATS, read_splats, write_splats
from dyngs.io.formats.splat_file import SplatFile

Capture = pytest.CaptureFixture[str]


def refused(capsys: Capture, *words: object) -> str:
    assert main([str(word) for word in words]) == 2
    out = capsys.readouterr()
    assert out.err.count("\n") == 1
    return out.err


def test_names_for_the_help_are_those_of_the_formats() -> None:
    assert sorted(f.name for f in FORMATS) == sorted(SPLAT_FORMATS)


def test_a_file_is_converted_there_and_back(tmp_path: Path, capsys: Capture) -> None:
    plain = write_splats(tmp_path / "a.ply", SplatFile(cloud(200), up="-y")).path
    assert main(["convert", str(plain), str(tmp_path / "b.spz")]) == 0
    said = capsys.readouterr().out
    assert "note: 200 Gaussians, up axis rotated from -y to y" in said
    assert "note: drawn again: " in said
    assert (
        main(["convert", str(tmp_path / "b.spz"), str(tmp_path / "c.ply"), "--sh-degree", "4"]) == 0
    )
    assert "up axis rotated from y to -y" in capsys.readouterr().out
    assert read_splats(tmp_path / "c.ply").gaussians.sh_degree == 4
    means = read_splats(tmp_path / "c.ply").gaussians.means
    assert float((means - read_splats(plain).gaussians.means).abs().max()) < 1e-3
    assert main(["convert", str(plain), str(tmp_path / "d.splat"), "--up=keep"]) == 0
    captured = capsys.readouterr()
    assert "SH coefficients above degree 0 are dropped: splat stores no more" in captured.out
    assert "visible differences" in captured.err


def test_unsupported_conversions_are_refused(tmp_path: Path, capsys: Capture) -> None:
    plain = write_splats(tmp_path / "a.ply", SplatFile(cloud(5))).path
    assert "unknown file type; use one of" in refused(capsys, "convert", plain, tmp_path / "b.xyz")
    assert "exists, which is an input" in refused(capsys, "convert", plain, plain)
    assert "no such file" in refused(capsys, "convert", tmp_path / "no.ply", tmp_path / "b.ply")
    assert "at most degree 0" in refused(
        capsys, "convert", plain, tmp_path / "b.splat", "--sh-degree", 3
    )


def test_the_suffix_decides_what_export_writes(tmp_path: Path, capsys: Capture) -> None:
    run = write_moving_run(tmp_path / "run")
    for kind in readable():
        path = tmp_path / f"a{kind.suffixes[0]}"
        assert main(["export", str(run), "--time", "0.5", "--out", str(path)]) == 0
        assert f"up is {kind.up} in the file" in capsys.readouterr().out
        assert len(read_splats(path).gaussians) == 5
    for name in ("b", "b.xyz"):
        said = refused(capsys, "export", run, "--out", tmp_path / name)
        assert "unknown format; add --format, or a suffix: .compressed.ply, .ply, .spz" in said
    for name in ("a.ply", "a.xyz"):
        words = ["--format", "spz", "--out", tmp_path / name]
        said = refused(capsys, "export", run, *words)
        assert "wrong suffix for --format spz" in said
    assert (
        main(
            [
                "export",
                str(run),
                "--times",
                "0:1:2",
                "--format",
                "spz",
                "--out",
                str(tmp_path / "seq"),
            ]
        )
        == 0
    )
    assert sorted(p.name for p in (tmp_path / "seq").iterdir()) == [
        "frame_0000.spz",
        "frame_0001.spz",
    ]


def test_axes_of_an_export(tmp_path: Path, capsys: Capture) -> None:
    run = write_moving_run(tmp_path / "run")
    path = tmp_path / "a.ply"
    assert main(["export", str(run), "--out", str(path), "--up", "keep"]) == 0
    kept = read_splats(path).gaussians.means
    assert main(["export", str(run), "--out", str(path), "--from-up=x", "--up=y"]) == 0
    assert "rotated from x in the capture" in capsys.readouterr().out
    turned = read_splats(path)
    assert turned.up == "y"
    assert float((turned.gaussians.means[:, 1] - kept[:, 0]).abs().max()) < 1e-5


def test_a_scene_file_is_drawn(tmp_path: Path, capsys: Capture) -> None:
    run = write_moving_run(tmp_path / "run")
    assert main(["export", str(run), "--format", "dyngs", "--out", str(tmp_path / "small")]) == 0
    words = ["--path", "orbit", "--frames", "2", "--size", "16x12", "--out", str(tmp_path / "out")]
    assert main(["render", str(tmp_path / "small" / "scene.dyngs"), *words]) == 0
    assert len(list((tmp_path / "out").glob("*.png"))) == 2
    other = tmp_path / "small" / "other.dyngs"
    other.write_bytes((tmp_path / "small" / "scene.dyngs").read_bytes())
    capsys.readouterr()
    assert "must be named scene.dyngs" in refused(capsys, "render", other, *words)
