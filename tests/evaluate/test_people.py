"""Scores of people: known answers, and poses refined on the tested images beside those as given."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import pytest
import torch

import dyngs
from dyngs.camera import Cameras
from dyngs.cli import main
from dyngs.data.loader import Image
from dyngs.data.read import read_capture
from dyngs.evaluate.people import person_box, person_scores
from dyngs.evaluate.report import scene_of_split
from dyngs.human.avatar import pose_fit
from dyngs.human.avatar.scene import avatar_of
from dyngs.metrics import Lpips, ssim
from dyngs.models.renderable import Rendering
from dyngs.runs.checkpoint import load_run

NO_LPIPS = Lpips("alex", "no weights here")
CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[20.0, 0, 10], [0, 20, 6], [0, 0, 1]]]), 20, 12)


def of_a_square(mask: torch.Tensor | None = None) -> tuple[Image, Rendering]:
    """A grey square of 4 x 5 px before nothing, and on white a render of it that is 0.1 too bright."""
    alpha = torch.zeros(12, 20)
    alpha[3:7, 8:13] = 1
    image = Image("a", CAMERA, 0.5 * alpha[..., None].expand(-1, -1, 3).contiguous(), alpha, mask, None)
    shown = (0.6 * alpha + 1 - alpha)[..., None].expand(-1, -1, 3)
    return image, Rendering(shown[None].contiguous(), (1 - alpha)[None], None, torch.zeros(1, 1, 2))


def test_scores_in_the_box_and_on_black() -> None:
    image, rendering = of_a_square()
    assert person_box(image) == (slice(3, 7), slice(8, 13))
    scores = person_scores(image, rendering, torch.ones(3), NO_LPIPS)
    assert scores["psnr_person"] == pytest.approx(20, abs=1e-4)
    larger = 10 * math.log10(12 * 20 / 20)
    assert scores["psnr_black"] == pytest.approx(20 + larger, abs=1e-4)
    black = rendering.rgb[0] * image.alpha[..., None] if image.alpha is not None else rendering.rgb[0]
    assert scores["ssim_black"] == pytest.approx(ssim(black, image.rgb_premultiplied), abs=1e-6)
    assert scores["lpips_black"] is None


def test_masked_pixels_do_not_count() -> None:
    mask = torch.zeros(12, 20)
    mask[:, 8:] = 1
    scores = person_scores(*of_a_square(mask), torch.ones(3), NO_LPIPS)
    assert scores["psnr_black"] == pytest.approx(20 + 10 * math.log10(12 * 12 / 20), abs=1e-4)


def test_nobody_is_to_be_seen() -> None:
    image, rendering = of_a_square()
    for alpha in (None, torch.zeros(12, 20)):
        empty = Image("a", CAMERA, image.rgb_premultiplied, alpha, None, None)
        assert person_scores(empty, rendering, torch.ones(3), NO_LPIPS) == {}


@pytest.fixture(scope="module")
def run(person: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a capture without another clip: the last of its three frames is held out."""
    folder = tmp_path_factory.mktemp("runs")
    root = shutil.copytree(person, folder / "capture", ignore=shutil.ignore_patterns("*_pose.*", "pose"))
    keys = [f"data.root={root}", "data.pose_frames=2::", f"run.dir={folder / 'run'}", "train.steps=6", "run.threads=1"]
    return dyngs.train(dyngs.load_config("human", [*keys, "model.resolution=24"]))


def test_held_out_frames_are_scored_in_the_poses_of_the_file(run: Path) -> None:
    loaded = load_run(run)
    capture = read_capture(loaded.config.data)
    trained, held = (avatar_of(scene_of_split(loaded, capture, split)) for split in ("test", "pose"))
    assert trained is not None
    assert held is not None
    assert (len(trained.moves_as), len(held.moves_as)) == (2, 1)
    assert capture.body is not None
    given = torch.from_numpy(capture.body["pose"].poses[2]).float()
    assert held.played is not None
    torch.testing.assert_close(held.played.poses[0], given, rtol=0, atol=1e-6)


def test_refined_poses_stand_beside_those_as_given(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(pose_fit, "MOST_WINDOWS", 1)
    stored = {}
    for name, more in (("given", []), ("refined", ["--refine"]), ("former name", ["--refine-poses"])):
        assert main(["eval", str(run), "--split", "pose", *more]) == 0
        stored[name] = json.loads((run / "metrics_pose.json").read_text())
    out = capsys.readouterr().out
    assert out.count("on black, poses refined") == out.count("on black, poses from silhouettes") == 2
    given, refined = stored["given"], stored["refined"]
    changed = {key for key in given if given[key] != refined[key]} - {"fps", "deform_fraction", "per_view"}
    assert changed == {"psnr_own_poses", "own_poses", "silhouette_poses"}
    timed = {"render_seconds", "deform_seconds"}
    views = [
        [{k: x for k, x in view.items() if k not in timed} for view in own["per_view"]] for own in (given, refined)
    ]
    assert views[0] == views[1], "as given is not touched"
    own, again = refined["own_poses"], stored["former name"]["own_poses"]
    assert own["psnr"] == refined["psnr_own_poses"] == again["psnr"]
    assert own["psnr_person"] == again["psnr_person"], "the same on every run"
    assert own["psnr_black"] > given["psnr_black"] - 0.1
    assert (given["lpips_black"] is None) == ("lpips" in given["reasons"])
    assert len(own["per_view"]) == given["num_views"]


def test_poses_that_were_trained_on_are_not_refined(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(run), "--split", "train", "--refine"]) == 2
    assert "--refine is for images that were not trained on; name them with --split" in capsys.readouterr().err
