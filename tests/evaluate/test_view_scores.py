"""Scores of views: known answers, masks, what cannot be scored, and times."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from flat_wall import BLACK, cameras_before_wall, seen_from
from moving_scene import Sliding, moving_scene, still_scene

import dyngs
from dyngs.api.train import train
from dyngs.cli import main
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import Lpips, psnr, ssim
from dyngs.data.loader import Image
from dyngs.data.read import read_capture
from dyngs.evaluate.report import scene_of_split
from dyngs.evaluate.view_scores import (
    TimeScore,
    background_scores,
    person_scores,
    psnr_per_time,
    right_half_scores,
    score_views,
)
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.gaussians.static_scene import StaticScene
from dyngs.human.avatar import pose_fit
from dyngs.human.avatar.scene import as_human_scene
from dyngs.models.renderable import Rendering
from dyngs.runs.checkpoint import load_run

NO_LPIPS = Lpips("alex", "no weights here")


def some_gaussians(count: int = 12, degree: int = 0) -> Gaussians:
    random = torch.Generator().manual_seed(3)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=random) * 2 - 1

    sh = uniform(count, (degree + 1) ** 2, 3)
    return Gaussians(
        uniform(count, 3), uniform(count, 4), uniform(count, 3) * 0.3 - 1.5, uniform(count) + 1, sh
    )


def as_scene(gaussians: Gaussians) -> StaticScene:
    return StaticScene(gaussians=gaussians)


def camera(width: int = 20, height: int = 14, distance: float = 4.0) -> Cameras:
    pose = torch.eye(4)
    pose[2, 3] = distance
    intrinsics = torch.tensor([[20.0, 0, width / 2], [0, 20, height / 2], [0, 0, 1]])
    return Cameras(pose[None], intrinsics[None], width, height)


def image(
    rgb: torch.Tensor, cameras: Cameras, name: str = "a", mask: torch.Tensor | None = None
) -> Image:
    return Image(
        name=name, cameras=cameras, rgb_premultiplied=rgb, alpha=None, mask=mask, time=None
    )


@pytest.mark.parametrize("background", [0.0, 0.3, 1.0])
def test_a_hole_in_a_white_object_shows_on_black_alone(background: float) -> None:
    """Half of the true image is a white object, the rendering is empty."""
    cameras = camera()
    alpha = torch.zeros(14, 20)
    alpha[:, :10] = 1
    truth = replace(image(alpha[..., None].expand(-1, -1, 3), cameras), alpha=alpha)
    nothing = Rendering(torch.full((1, 14, 20, 3), background), torch.ones(1, 14, 20), None)
    scores = background_scores(truth, nothing, torch.full((3,), background))
    assert scores["psnr_white"] == pytest.approx(100.0)
    assert scores["psnr_black"] == pytest.approx(-10 * math.log10(0.5), abs=1e-4)
    assert scores["see_through"] == 1.0
    blurred = replace(nothing, transmittance=(torch.arange(20) >= 8).expand(1, 14, 20).float())
    edge = background_scores(truth, blurred, torch.full((3,), background))
    assert edge["see_through"] == 0  # an edge that is off by two pixels is no hole
    masked = background_scores(
        replace(truth, mask=1 - alpha), nothing, torch.full((3,), background)
    )
    assert masked["psnr_black"] == pytest.approx(100.0)
    without = background_scores(
        image(alpha[..., None].expand(-1, -1, 3), cameras), nothing, torch.zeros(3)
    )
    assert without == {}


def test_scores_are_those_of_the_images() -> None:
    gaussians = some_gaussians()
    cameras = camera()
    options = RenderOptions()
    background = torch.tensor([0.2, 0.4, 0.6])
    rendered = render(gaussians, cameras, options, background=background).rgb[0].clamp(0, 1)
    darker = rendered * 0.5
    images = [image(rendered, cameras, "same"), image(darker, cameras, "darker")]
    scores, reasons = score_views(as_scene(gaussians), images, options, background, NO_LPIPS)
    same, other = scores
    assert (same.name, same.psnr, same.width, same.height) == ("same", 100.0, 20, 14)
    assert same.ssim == pytest.approx(1.0, abs=1e-6)
    assert other.psnr == psnr(rendered, darker)
    assert other.ssim < 0.99
    assert same.lpips is None
    assert reasons["lpips"] == "no weights here"
    assert (same.flip is None) == ("flip" in reasons)
    assert same.flip in (None, 0.0)
    assert all(score.render_seconds > 0 for score in scores)


def test_masks_reach_every_metric() -> None:
    gaussians = some_gaussians()
    cameras = camera()
    options = RenderOptions()
    rendered = render(gaussians, cameras, options).rgb[0].clamp(0, 1)
    mask = torch.ones(14, 20)
    mask[:, :10] = 0
    spoiled = torch.where(mask[..., None] > 0, rendered, 1 - rendered)
    scores, _ = score_views(
        as_scene(gaussians), [image(spoiled, cameras, mask=mask)], options, torch.zeros(3), NO_LPIPS
    )
    assert scores[0].psnr == 100.0
    assert scores[0].ssim == pytest.approx(1.0, abs=1e-6)
    assert scores[0].flip in (None, 0.0)


@pytest.mark.parametrize(
    ("truth", "mask", "message"),
    [
        (
            torch.full((14, 20, 3), math.nan),
            None,
            "view 'a': psnr is not finite .the image contains",
        ),
        (
            torch.zeros(14, 20, 3),
            torch.zeros(14, 20),
            "view 'a': psnr is not finite .all pixels are masked",
        ),
    ],
)
def test_values_that_are_not_finite_are_refused(truth, mask, message) -> None:
    images = [image(truth, camera(), mask=mask)]
    with pytest.raises(DyngsError, match=message):
        score_views(as_scene(some_gaussians()), images, RenderOptions(), torch.zeros(3), NO_LPIPS)


def test_views_are_drawn_at_their_own_times() -> None:
    scene = moving_scene(Sliding())
    options = RenderOptions()
    black = torch.zeros(3)
    images = [
        replace(image(render(scene.at(t), camera(), options).rgb[0].clamp(0, 1), camera()), time=t)
        for t in (0.0, 0.8)
    ]
    scores, _ = score_views(scene, images, options, black, NO_LPIPS)
    assert [(s.psnr, s.time) for s in scores] == [(100.0, 0.0), (100.0, 0.8)]
    scores, _ = score_views(still_scene(), images, options, black, NO_LPIPS)
    assert scores[1].psnr < 40
    assert all(s.deform_seconds <= s.render_seconds for s in scores)


def image_and_rendering() -> tuple[Image, Rendering]:
    image = seen_from(cameras_before_wall(1))[0]
    rgb = 0.6 * torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(0))
    rendering = Rendering(rgb[None], torch.zeros(1, 60, 80), None)
    return replace(image, rgb_premultiplied=rgb), rendering


def test_exposure_does_not_count() -> None:
    image, rendering = image_and_rendering()
    brighter = replace(image, rgb_premultiplied=1.4 * image.rgb_premultiplied + 0.02)
    found = right_half_scores(brighter, rendering, BLACK)
    assert found["psnr_right"] < 20
    assert found["psnr_right_fitted"] > 50


def test_errors_in_the_right_half_count_though_the_left_half_is_perfect() -> None:
    image, rendering = image_and_rendering()
    wrong = image.rgb_premultiplied.clone()
    wrong[:, 40:] = 1.4 * wrong[:, 40:]
    found = right_half_scores(replace(image, rgb_premultiplied=wrong), rendering, BLACK)
    assert found["psnr_right_fitted"] < 25


def test_a_half_without_pixels_has_no_score() -> None:
    image, rendering = image_and_rendering()
    mask = torch.ones(60, 80)
    mask[:, :40] = 0
    assert right_half_scores(replace(image, mask=mask), rendering, BLACK) == {}


CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[20.0, 0, 10], [0, 20, 6], [0, 0, 1]]]), 20, 12)


def of_a_square(mask: torch.Tensor | None = None) -> tuple[Image, Rendering]:
    """A grey square of 4 x 5 px before nothing, and on white a render of it that is 0.1 too
    bright."""
    alpha = torch.zeros(12, 20)
    alpha[3:7, 8:13] = 1
    image = Image(
        "a", CAMERA, 0.5 * alpha[..., None].expand(-1, -1, 3).contiguous(), alpha, mask, None
    )
    shown = (0.6 * alpha + 1 - alpha)[..., None].expand(-1, -1, 3)
    return image, Rendering(shown[None].contiguous(), (1 - alpha)[None], None)


def test_scores_in_the_box_and_on_black() -> None:
    image, rendering = of_a_square()
    scores = person_scores(image, rendering, torch.ones(3), NO_LPIPS)
    assert scores["psnr_person"] == pytest.approx(20, abs=1e-4)
    larger = 10 * math.log10(12 * 20 / 20)
    on_black = background_scores(image, rendering, torch.ones(3))["psnr_black"]
    assert on_black == pytest.approx(20 + larger, abs=1e-4)
    black = (
        rendering.rgb[0] * image.alpha[..., None] if image.alpha is not None else rendering.rgb[0]
    )
    assert scores["ssim_black"] == pytest.approx(ssim(black, image.rgb_premultiplied), abs=1e-6)
    assert scores["lpips_black"] is None


@pytest.fixture(scope="module")
def run(person: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a capture without another clip: the last of its three frames is held out."""
    folder = tmp_path_factory.mktemp("runs")
    root = shutil.copytree(
        person, folder / "capture", ignore=shutil.ignore_patterns("*_pose.*", "pose")
    )
    keys = [
        f"data.root={root}",
        "data.pose_frames=2::",
        f"run.dir={folder / 'run'}",
        "train.steps=6",
        "run.threads=1",
    ]
    return train(dyngs.load_config("human", [*keys, "model.resolution=24", "model.fit=false"]))


def test_held_out_frames_are_scored_in_the_poses_of_the_file(run: Path) -> None:
    loaded = load_run(run)
    capture = read_capture(loaded.config.data)
    trained, held = (
        as_human_scene(scene_of_split(loaded, capture, split)) for split in ("test", "pose")
    )
    assert trained is not None
    assert held is not None
    assert (len(trained.played_clip), len(held.played_clip)) == (2, 1)
    assert capture.body is not None
    given = torch.from_numpy(capture.body["pose"].poses[2]).float()
    assert held.replacement_clip is not None
    torch.testing.assert_close(held.replacement_clip.poses[0], given, rtol=0, atol=1e-6)


def test_refined_poses_stand_beside_those_as_given(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pose_fit, "MAX_WINDOWS", 1)
    stored = {}
    for name, more in (("given", []), ("refined", ["--refine"]), ("again", ["--refine"])):
        assert main(["eval", str(run), "--split", "pose", *more]) == 0
        stored[name] = json.loads((run / "metrics_pose.json").read_text())
    out = capsys.readouterr().out
    assert (
        out.count("on black, poses refined") == out.count("on black, poses from silhouettes") == 2
    )
    given = stored["given"]
    refined = stored["refined"]
    changed = {key for key in given if given[key] != refined[key]} - {
        "fps",
        "deform_fraction",
        "per_view",
    }
    assert changed == {"psnr_own_poses", "own_poses", "silhouette_poses"}
    timed = {"render_seconds", "deform_seconds"}
    views = [
        [{k: x for k, x in view.items() if k not in timed} for view in own["per_view"]]
        for own in (given, refined)
    ]
    assert views[0] == views[1], "as given is not touched"
    own = refined["own_poses"]
    again = stored["again"]["own_poses"]
    assert own["psnr"] == refined["psnr_own_poses"] == again["psnr"]
    assert own["psnr_person"] == again["psnr_person"], "the same on every run"
    assert own["psnr_black"] > given["psnr_black"] - 0.1
    assert (given["lpips_black"] is None) == ("lpips" in given["reasons"])
    assert len(own["per_view"]) == given["num_views"]


def test_poses_that_were_trained_on_are_not_refined(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(run), "--split", "train", "--refine"]) == 2
    assert "--refine needs images that were not trained on; use --split" in capsys.readouterr().err


pytestmark = pytest.mark.usefixtures("one_thread")


def test_psnr_per_time_is_the_mean_of_the_views_of_each_time() -> None:
    scores = [(0.5, 30.0), (0.0, 10.0), (0.5, 20.0), (None, 99.0), (0.0, 11.0), (1.0, 5.0)]
    assert psnr_per_time(scores) == (
        TimeScore(0.0, 10.5, 2),
        TimeScore(0.5, 25.0, 2),
        TimeScore(1.0, 5.0, 1),
    )
    assert psnr_per_time([(None, 3.0)]) == ()
