from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_scene import MOVING_ROWS, camera, still_scene, write_moving_run
from pretend_gpu import GPU, pretend_gpu
from view_sessions import balls

from dyngs.output.render_job import render_frame
from dyngs.view.layers import LAYERS, PARTS, Shot, draw, motion_colours, truth_in_window
from dyngs.view.viewed import Viewed, load_viewed


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Viewed:
    return load_viewed(write_moving_run(tmp_path_factory.mktemp("run")))


def test_colours_are_those_of_dyngs_render() -> None:
    viewed = balls()
    shown = draw(viewed, Shot(camera(80, 56), 0.3))
    wanted = render_frame(viewed.scene, viewed.scene.time_step(0.3), camera(80, 56), background=torch.ones(3)).rgb
    assert np.abs(shown / 255.0 - wanted).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("part", PARTS)
def test_every_layer_of_every_part_is_a_image(layer: str, part: str) -> None:
    for viewed in (balls(), replace(balls(), scene=still_scene())):
        shown = draw(viewed, Shot(camera(), 0.5, layer, part))  # type: ignore[arg-type]
        assert shown.shape == (14, 20, 3)
        assert shown.dtype == np.uint8


@pytest.mark.parametrize("layer", LAYERS)
def test_a_gpu_draws_every_layer_alike(run: Viewed, layer: str) -> None:
    view = 0 if layer in ("colour", "error") else None
    shots = [Shot(camera(), 0.5, layer, part, view, 0.5) for part in PARTS]  # type: ignore[arg-type]
    expected = [draw(run, shot) for shot in shots]
    with pretend_gpu():
        there = run.on(GPU)
        found = [draw(there, shot) for shot in shots]
    for a, b in zip(found, expected, strict=True):
        assert np.array_equal(a, b)


def test_parts_together_are_all() -> None:
    seen = {part: draw(balls(), Shot(camera(80, 56), 0.0, "alpha", part))[..., 0] > 128 for part in PARTS}
    assert np.array_equal(seen["all"], seen["moving"] | seen["still"])
    assert 0 < seen["moving"].sum() < seen["all"].sum()


def test_motion_is_red_where_it_is_far_and_dark_where_nothing_moves() -> None:
    colours = motion_colours(balls())
    moving = colours[list(MOVING_ROWS)]
    assert bool((moving[:, 0] > moving[:, 2]).all())
    assert bool((colours[0] == colours[2]).all())
    assert not bool(torch.isclose(moving[0], colours[0]).all())


def test_the_moment_of_a_time_is_computed_once() -> None:
    viewed = balls()
    asked = viewed.scene.field  # type: ignore[attr-defined]
    for _ in range(3):
        draw(viewed, Shot(camera(), 0.5))
    assert asked.calls == 1
    draw(viewed, Shot(camera(), 0.6))
    assert asked.calls == 2


@pytest.mark.parametrize("size", [(48, 48), (96, 48), (30, 60)])
def test_the_truth_fits_the_window(run: Viewed, size: tuple[int, int]) -> None:
    truth = truth_in_window(run, 0, size)
    assert truth is not None
    assert truth.shape == (size[1], size[0], 3)
    inside = ~np.isnan(truth).any(-1)
    side = min(size)
    assert inside.sum() == side * side  # the images are square
    assert run.footage.images is not None
    mean = run.footage.images[0].composite(run.background).mean((0, 1)).numpy()
    assert truth[inside].mean(0) == pytest.approx(mean, abs=0.02)


def test_the_line_divides_render_and_truth(run: Viewed) -> None:
    def shown(divide: float) -> np.ndarray:
        return draw(run, Shot(camera(64, 64), 0.0, view=2, divide=divide))

    both, render, truth = shown(0.5), shown(1.0), shown(0.0)
    assert np.array_equal(both[:, :31], render[:, :31])
    assert np.array_equal(both[:, 33:], truth[:, 33:])
    assert not np.array_equal(render, truth)


def test_the_error_is_that_of_render_and_truth(run: Viewed) -> None:
    window = truth_in_window(run, 1, (32, 32))
    assert window is not None
    render = draw(run, Shot(camera(32, 32), view=1)) / 255.0
    error = draw(run, Shot(camera(32, 32), layer="error", view=1)).sum(-1).astype(float)
    wanted = np.abs(render - window).mean(-1)
    assert np.corrcoef(error.ravel(), np.minimum(wanted * 4, 1).ravel())[0, 1] > 0.9


def test_beside_the_true_image_it_is_darker(run: Viewed) -> None:
    wide = draw(run, Shot(camera(96, 48), view=0, divide=1.0))
    assert wide[:, :20].mean() <= 128
    assert wide[:, 40:56].mean() > 128
