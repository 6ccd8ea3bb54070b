"""Files for viewers that render without antialiasing, or without SH coefficients."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from moving_scene import write_moving_run
from splat_scenes import cloud, psnr
from two_balls import cameras_around

from dyngs.cli import main
from dyngs.core.conventions import RasterizeMode
from dyngs.export.classic import CLASSIC, fit_classic
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.io.formats.formats import read_splats, write_splats
from dyngs.io.formats.splat_file import SplatFile, with_sh_degree

MIP = RenderOptions(eps2d=0.1, mode=RasterizeMode.ANTIALIASED)
AROUND = cameras_around(24, 48, 36)
HELD_OUT = cameras_around(5, 48, 36)


def difference(own: Gaussians, splat: SplatFile) -> float:
    return psnr(render(own, HELD_OUT, MIP).rgb, render(splat.gaussians, HELD_OUT, CLASSIC).rgb)


def mip_file(gaussians: Gaussians) -> SplatFile:
    return SplatFile(gaussians, MIP.mode, MIP.eps2d)


def test_small_gaussians_look_the_same_in_classic_viewers() -> None:
    """One of 0.7 px at the centre of a ring of cameras fits exactly; a cloud nearly does."""
    own = cloud(1, 0).replace(
        means=torch.zeros(1, 3),
        log_scales=torch.full((1, 3), 0.7 * 4.0 / float(AROUND.intrinsics[0, 0, 0])).log(),
        logit_opacities=torch.full((1,), 2.0),
    )
    fitted, note = fit_classic(mip_file(own), AROUND, MIP.near, 3)
    assert fitted.mode is RasterizeMode.CLASSIC
    assert "opacities and scales fitted" in note
    assert difference(own, mip_file(own)) < 50
    assert difference(own, fitted) > 90
    thin = cloud(300, 0)
    thin = thin.replace(log_scales=thin.log_scales - 1.5)
    fitted, _ = fit_classic(mip_file(thin), AROUND, MIP.near, 3)
    assert difference(thin, fitted) > difference(thin, mip_file(thin)) + 15


def test_colours_without_harmonics_are_their_mean(tmp_path: Path) -> None:
    own = cloud(200, 2)
    own = own.replace(sh=own.sh + 0.4 * (torch.arange(9) > 0)[:, None])
    fitted, note = fit_classic(mip_file(own), AROUND, MIP.near, 0)
    simple = mip_file(with_sh_degree(own, 0))
    assert "mean colours" in note
    written = read_splats(write_splats(tmp_path / "a.splat", fitted).path)
    assert difference(own, written) > difference(own, simple) + 1


def test_a_fit_that_does_not_help_is_dropped() -> None:
    own = cloud(20, 0)
    own = own.replace(log_scales=own.log_scales + 2)
    file = replace(mip_file(own), mode=RasterizeMode.CLASSIC, eps2d=None)
    fitted, note = fit_classic(file, AROUND, MIP.near, 3)
    assert "no change needed" in note
    assert torch.equal(fitted.gaussians.log_scales, own.log_scales)


def test_formats_without_a_render_mode_are_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_moving_run(tmp_path, moves=False)
    config = run / "config.yaml"
    config.write_text(
        config.read_text().replace("rasterize_mode: classic", "rasterize_mode: antialiased")
    )
    for name, options in {"a.glb": [], "b.ply": ["--classic"]}.items():
        assert main(["export", str(run), "--out", str(tmp_path / name), *options]) == 0
        assert "viewers without antialiasing" in capsys.readouterr().out
        assert read_splats(tmp_path / name).mode is RasterizeMode.CLASSIC
    for name, options in {"c.glb": ["--no-classic"], "d.ply": []}.items():
        assert main(["export", str(run), "--out", str(tmp_path / name), *options]) == 0
        assert read_splats(tmp_path / name).mode is RasterizeMode.ANTIALIASED
    assert (
        main(["export", str(tmp_path / "d.ply"), "--classic", "--out", str(tmp_path / "e.ply")])
        == 2
    )
    assert "--classic fits to training cameras" in capsys.readouterr().err


def test_what_the_closed_form_cannot_fit_is_optimized(monkeypatch: pytest.MonkeyPatch) -> None:
    own = cloud(200, 2)
    own = own.replace(sh=own.sh + 0.1 * (torch.arange(9) > 0)[:, None])
    optimized, _ = fit_classic(mip_file(own), AROUND, MIP.near, 0)
    monkeypatch.setattr("dyngs.export.classic.GOOD_PSNR", 0.0)
    closed_form, _ = fit_classic(mip_file(own), AROUND, MIP.near, 0)
    assert difference(own, optimized) > difference(own, closed_form) + 0.5
