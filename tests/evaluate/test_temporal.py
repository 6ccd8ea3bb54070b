"""Measures over time: known answers for scenes that stand, slide and blink."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from moving_scene import (
    TEST_TIMES,
    Blinking,
    Sliding,
    camera,
    moving_scene,
    still_scene,
    write_timed_capture,
)

from dyngs.config import DataConfig
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.evaluate.view_scores import (
    SceneRenderer,
    TimeScore,
    flicker,
    flicker_error,
    psnr_per_time,
    temporal_scores,
)
from dyngs.gaussians.rendering import RenderOptions


def drawing(scene) -> SceneRenderer:
    return SceneRenderer(scene, RenderOptions(), torch.zeros(3))


def even(count: int) -> tuple[float, ...]:
    return tuple(torch.linspace(0, 1, count, dtype=torch.float64).tolist())


@pytest.fixture
def split(tmp_path):
    """Loader and views of a test split whose camera stands."""
    config = DataConfig.model_validate(
        {"root": write_timed_capture(tmp_path / "capture", standing=True)}
    )
    views = read_capture(config).splits["test"]
    return ImageLoader(views, config), views


def test_psnr_per_time_is_the_mean_of_the_views_of_each_time() -> None:
    scores = [(0.5, 30.0), (0.0, 10.0), (0.5, 20.0), (None, 99.0), (0.0, 11.0), (1.0, 5.0)]
    assert psnr_per_time(scores) == (
        TimeScore(0.0, 10.5, 2),
        TimeScore(0.5, 25.0, 2),
        TimeScore(1.0, 5.0, 1),
    )
    assert psnr_per_time([(None, 3.0)]) == ()


@pytest.mark.parametrize("count", [3, 5, 61, 100])
def test_blinking_is_twice_the_difference_of_its_two_images(count: int) -> None:
    scene = drawing(moving_scene(Blinking(0.5, num_times=count), times=even(count)))
    dark = scene.image(camera(), 0.0)
    bright = scene.image(camera(), 1 / (count - 1))
    wanted = 2 * 255 * float((bright - dark).abs().double().mean())
    assert wanted > 1
    assert flicker(scene, camera(), even(count)).value == pytest.approx(wanted, rel=1e-5)


def test_a_linear_change_does_not_flicker_however_it_is_sampled() -> None:
    """Of a colour that rises linearly, uneven moments see no second difference either."""

    class Brightening(Sliding):
        def offsets(self, means, time, rows=None):
            shift = torch.full((len(means), 3), 0.4 * time)
            return replace(super().offsets(means, 0.0), colors=shift)

    times = (0.0, 0.1, 0.15, 0.6, 1.0)
    assert flicker(drawing(moving_scene(Brightening())), camera(), times).value == pytest.approx(
        0, abs=1e-3
    )


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_times_are_a_reason(count: int) -> None:
    found = flicker(drawing(moving_scene(Sliding())), camera(), (0.0, 1.0)[:count])
    assert found.value is None
    assert f"found {count}" in (found.reason or "")


def test_flicker_error_is_that_of_the_differences(split) -> None:
    loader, views = split
    assert [v.time for v in views] == list(TEST_TIMES)
    truth = [loader[i].composite(torch.zeros(3)) for i in range(3)]
    scene = drawing(moving_scene(Sliding()))
    rendered = [scene.image(loader[i].cameras, views[i].time) for i in range(3)]
    steps = [(rendered[i + 1] - rendered[i]) - (truth[i + 1] - truth[i]) for i in range(2)]
    wanted = 255 * float(torch.stack(steps).abs().double().mean())
    assert wanted > 0.1
    assert flicker_error(scene, loader, views).value == pytest.approx(wanted, rel=1e-4)
    assert flicker_error(scene, loader, views[::-1]).value is not None


def test_masks_leave_pixels_out_of_the_flicker_error(split) -> None:
    loader, views = split

    class Masked(ImageLoader):
        def __getitem__(self, index: int) -> Image:
            mask = torch.ones(16, 16)
            mask[:, : 4 + 4 * index] = 0
            return replace(super().__getitem__(index), mask=mask)

    masked = Masked(views, DataConfig(root=views[0].image_path.parent))
    truth = (
        torch.stack([loader[i].composite(torch.zeros(3)) for i in range(3)])
        .diff(dim=0)
        .abs()
        .double()
    )
    total = truth[0, :, 8:].sum() + truth[1, :, 12:].sum()
    wanted = 255 * float(total) / (3 * 16 * (8 + 4))
    assert flicker_error(drawing(still_scene()), masked, views).value == pytest.approx(
        wanted, rel=1e-4
    )


def test_reasons_where_there_is_nothing_to_measure(split) -> None:
    loader, views = split
    scene = drawing(moving_scene(Sliding()))
    untimed = [replace(v, time=None) for v in views]
    for found in temporal_scores(scene, loader, untimed).values():
        assert (found.value, found.reason) == (None, "the images have no times")
    assert "no static camera" in (flicker_error(scene, loader, views[:1]).reason or "")
