"""``dyngs.train`` and the other one-call functions: arguments, captures in memory, own losses."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import dyngs
from dyngs.cli import main
from dyngs.data.loader import ImageLoader

FEW: dict[str, Any] = {
    "steps": 2,
    "device": "cpu",
    "init": {"kind": "random", "num_random": 40},
    "run.threads": 1,
}
pytestmark = pytest.mark.usefixtures("one_thread")


def twelve_images() -> tuple[np.ndarray, dyngs.Cameras]:
    """Random images of cameras on a line."""
    images = np.random.default_rng(0).integers(0, 256, (12, 8, 10, 3), dtype=np.uint8)
    poses = np.stack([np.eye(4)] * 12)
    poses[:, 0, 3] = np.arange(12)
    intrinsics = [[10.0, 0, 5], [0, 10, 4], [0, 0, 1]]
    return images, dyngs.Cameras.from_matrices(poses, intrinsics, 10, 8)


def dark(look: dyngs.LossInput) -> Tensor:
    return look.rendered.mean()


def test_captures_in_memory_hold_the_same_pixels_cameras_times_and_masks() -> None:
    images, cameras = twelve_images()
    masks = [np.arange(80).reshape(8, 10) % 3 > 0] * 12
    capture = dyngs.Capture.from_images(images / 255, list(cameras), times=range(12), masks=masks)
    assert [view.name[-2:] for view in capture.splits["test"]] == ["04"]
    loader = ImageLoader(capture.splits["train"])
    for i, number in enumerate([0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]):
        image = loader[i]
        assert torch.equal(
            (255 * image.rgb_premultiplied).round().byte(), torch.tensor(images[number])
        )
        torch.testing.assert_close(image.cameras.centers, torch.tensor([[float(number), 0, 0]]))
        torch.testing.assert_close(image.cameras.intrinsics[0].double(), cameras.intrinsics[0])
        assert image.time == pytest.approx(number / 11)
        assert image.mask is not None
        assert np.array_equal(image.mask.bool().numpy(), masks[0])
    assert dyngs.Capture.from_images(images / 255, cameras, range(12), masks).root == capture.root


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[:3], "give one camera, time and mask per image"),
        (lambda x: x.transpose(0, 3, 1, 2), r"images\[0\]: its shape must begin with \(8, 10\)"),
        (lambda x: x.astype(float), "uint8, or float from 0 to 1, got float64 from 0 to 255"),
        (lambda x: x * np.nan, "from nan to nan"),
        (lambda x: x.astype(int), "got int64"),
    ],
)
def test_other_arrays_are_refused(change: Callable[[np.ndarray], np.ndarray], message: str) -> None:
    images, cameras = twelve_images()
    with pytest.raises(dyngs.DyngsError, match=message):
        dyngs.Capture.from_images(change(images), cameras)


def test_a_run_of_images_in_memory_is_evaluated_resumed_and_a_changed_capture_passed_again() -> (
    None
):
    capture = dyngs.Capture.from_images(*twelve_images())
    scene = dyngs.train("static", capture, run_dir="run", **FEW)
    assert (scene.run.path, scene.run.step) == (Path("run"), 2)
    assert dyngs.evaluate(scene).psnr == dyngs.evaluate("run", capture=capture).psnr
    assert dyngs.train(resume="run", steps=3).run.step == 3

    few = capture.replace(splits={**capture.splits, "train": capture.splits["train"][:4]})
    dyngs.train("static", few, run_dir="few", **FEW)
    with pytest.raises(dyngs.DyngsError, match="not the capture that the run was trained on"):
        dyngs.train(resume="few", steps=3)
    assert dyngs.train(resume="few", steps=3, data=few).run.step == 3
    with pytest.raises(dyngs.DyngsError, match="no effect on a capture that was read already"):
        dyngs.train("static", capture, **{"data.test_every": 3})


def test_keywords_dotted_and_nested_keys_give_the_same_run(still: Path) -> None:
    dyngs.train("static", still, run_dir="one", **FEW)
    config = dyngs.load_config("static", {"data.root": still, "train": {"steps": 2}})
    config = config.replace(init={"kind": "random", "num_random": 40}, run={"threads": 1})
    dyngs.train(config.replace({"run.dir": "two", "run.device": "cpu"}))
    one, two = (dyngs.load(run).gaussians.means for run in ("one", "two"))
    assert torch.equal(one, two)


def test_an_own_loss_changes_the_run_and_must_be_passed_again(
    still: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = dyngs.train("static", still, run_dir="plain", **FEW)
    darker = dyngs.train("static", still, run_dir="dark", losses=[dark], **FEW)
    assert darker.gaussians.base_rgb.mean() < plain.gaussians.base_rgb.mean()
    with pytest.raises(dyngs.DyngsError, match=r"the run has \['1 dark'\], given were \[\]"):
        dyngs.train(resume="dark", steps=4)
    assert main(["train", "--resume", "dark", "train.steps=4"]) == 2
    assert "pass the same again from Python" in capsys.readouterr().err
    dyngs.train(resume="dark", steps=4, losses=[dark])
    with pytest.raises(
        dyngs.DyngsError, match=r"loss 1 .*: must return a scalar tensor, got float"
    ):
        dyngs.train("static", still, run_dir="bad", losses=[lambda _: 1.0], **FEW)


def test_refusals_of_train_and_of_changed_scenes(still: Path) -> None:
    for keys, message in (
        ({"config": "ngp", "data": still}, "only scenes of Gaussians"),
        ({"resume": "run", "seed": 1}, "the configuration of a run is fixed"),
        ({"data": still, "trian": {"steps": 3}}, "unknown key 'trian'; did you mean 'train.steps'"),
        ({"data": {"root": still, "longest_sid": 3}}, "did you mean 'data.longest_side'"),
    ):
        with pytest.raises(dyngs.DyngsError, match=message):
            dyngs.train(**keys)  # pyright: ignore[reportArgumentType]
    scene = dyngs.train("static", still, run_dir="run", **FEW)
    changed = scene.select(torch.arange(3))
    for call in (dyngs.evaluate, dyngs.export):
        with pytest.raises(dyngs.DyngsError, match="this scene was changed"):
            call(changed)
    dyngs.save(changed, "three.ply")
    assert len(dyngs.load("three.ply")) == 3
    with pytest.raises(dyngs.DyngsError, match="sh_degre: no option"):
        dyngs.export(scene, "x.ply", sh_degre=0)


def test_cameras_and_captures_from_a_path_see_what_the_scene_shows(still: Path) -> None:
    scene = dyngs.train("static", still, run_dir="run", **{**FEW, "data.longest_side": 16})
    camera = ImageLoader(dyngs.read_capture(still).splits["test"])[0].cameras
    (file,) = dyngs.render_path(scene, camera, out="one")
    from PIL import Image

    shown = scene.render(camera).rgb[0].detach().clamp(0, 1).numpy()
    assert np.abs(np.asarray(Image.open(file)) / 255 - shown).max() < 0.51 / 255
    assert [x.suffix for x in dyngs.render_path(scene, out="orbit.mp4", frames=2)] == [".mp4"]


def test_package_functions_have_their_signature_and_their_modules(still: Path) -> None:
    import dyngs.evaluate.report

    assert callable(dyngs.evaluate)
    assert "capture" in inspect.signature(dyngs.evaluate).parameters
    assert dyngs.evaluate.report.evaluate_run.__doc__ == dyngs.evaluate.__doc__
    assert {"train", "Capture"} < set(dir(dyngs))


def test_reprs_are_short_and_a_rendering_is_a_png(still: Path) -> None:
    capture = dyngs.read_capture(still)
    scene = dyngs.train("static", still, run_dir="run", **FEW)
    camera = ImageLoader(capture.splits["test"])[0].cameras
    rendering = scene.render(camera)
    assert repr(capture).endswith("views: 4 train, 1 test; 0 points)")
    assert repr(camera) == "Cameras(1 of 16x16 px)"
    assert "40 Gaussians, static, cpu, run)" in repr(scene)
    assert repr(rendering) == "GaussianRendering(1 image of 16x16 px, cpu)"
    assert repr(scene.gaussians).startswith("Gaussians(40 Gaussians, SH degree")
    assert rendering._repr_png_().startswith(b"\x89PNG")
