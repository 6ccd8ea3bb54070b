"""Pilot runs that resolve automatic settings: only clear gains win, within a tenth of the run."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image
from two_balls import two_balls

from dyngs.api import choose as module
from dyngs.api.choose import as_static, resolve_by_pilot_runs
from dyngs.api.train import train
from dyngs.config import Config, DataConfig, RunConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import (
    StaticOptions,
    write_static_capture,
)
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.rendering import render
from dyngs.training.trainer import Trainer


def without_name(config: Config) -> Config:
    """The config without what the preset of another kind calls its runs."""
    return config.model_copy(update={"run": RunConfig()})


def preset(root: Path, *keys: str, name: str = "dynamic") -> Config:
    return load_config(packaged_preset(name), [f"data.root={root}", "run.threads=1", *keys])


def test_few_views_are_held_out_in_two_folds_and_many_in_one() -> None:
    def views(count: int) -> list[Any]:
        return [SimpleNamespace(time=i / count, name=str(i)) for i in range(count)]

    assert module._held_out(views(7)) == []
    first, second = module._held_out(views(12))
    assert len(first) == len(second) == 3
    assert not first & second
    for count in (24, 48, 100, 1000):
        (held_out,) = module._held_out(views(count))
        assert 8 <= len(held_out) <= count / 3


def test_a_capture_without_times_is_refused_with_what_to_add(still: Path) -> None:
    with pytest.raises(DyngsError, match=r"no times.*configs/static.yaml.*data\.times=order"):
        resolve_by_pilot_runs(preset(still), read_capture(DataConfig(root=still)))


@pytest.mark.parametrize(
    "keys",
    [
        (),
        ("train.steps=123", "train.minutes=2", "train.robust=always"),
        ("model.sh_degree=2", "train.ssim_weight=0.5", "optim.lr_means=1e-3"),
        (
            "strategy.kind=mcmc",
            "strategy.max_gaussians=77",
            "init.kind=random",
            "colour.kind=network",
        ),
    ],
)
def test_as_static_is_the_static_preset_with_what_was_requested(
    keys: tuple[str, ...], moving: Path, tmp_path: Path
) -> None:
    """Also by a copy of the preset, whose values its user has not requested."""
    static = without_name(preset(moving, *keys, name="static"))
    assert without_name(as_static(preset(moving, *keys))) == static
    copy = tmp_path / "own.yaml"
    copy.write_text(packaged_preset("dynamic").read_text() + "camera:\n  refine: always\n")
    own = load_config(copy, [f"data.root={moving}", "run.threads=1", *keys])
    assert without_name(as_static(own)) == static.model_copy(update={"camera": own.camera})
    assert own.camera.refine == "always"


def write_rolling_ball(root: Path) -> None:
    """32 images of 24 px of a ball that goes 1.6 along x, at eight times, from everywhere."""
    write_static_capture(root, StaticOptions(size=24, num_train=32, num_test=1, samples=1))
    views = read_capture(DataConfig(root=root)).splits["train"]
    for split, times in (("train", [i % 8 / 7 for i in range(32)]), ("test", [0.5])):
        file = root / f"transforms_{split}.json"
        document = json.loads(file.read_text())
        for frame, time in zip(document["frames"], times, strict=True):
            frame["time"] = time
        file.write_text(json.dumps(document))
    for i, view in enumerate(views):
        ball = (
            two_balls()
            .select(torch.tensor([0]))
            .replace(means=torch.tensor([[1.6 * (i % 8) / 7 - 0.8, 0.0, 0.0]]))
        )
        pose, intrinsics = (
            torch.from_numpy(x).float()[None] for x in (view.cam_from_world, view.intrinsics)
        )
        drawn = render(ball, Cameras(pose, intrinsics, 24, 24))
        alpha = drawn.alpha[0][..., None]
        rgba = torch.cat([drawn.rgb[0] / alpha.clamp_min(1e-3), alpha], -1).clamp(0, 1)
        Image.fromarray((255 * rgba).round().byte().numpy()).save(view.image_path)


def test_only_moving_pixels_decide_about_motion_before_fixed_cameras() -> None:
    """A walker on few pixels: a model that renders it wins, though its background is worse."""
    truth = torch.full((20, 20, 3), 0.5)
    moving = torch.zeros(20, 20, dtype=torch.bool)
    moving[4:10, 4:10] = True
    image = SimpleNamespace(
        cameras=SimpleNamespace(width=20, height=20),
        composite=lambda _: truth,
        mask=None,
        time=0.0,
    )

    class Images:
        views = ("view",)

        def __getitem__(self, _: int) -> Any:
            return image

    def trainer(rgb: torch.Tensor) -> Any:
        scene = SimpleNamespace(render=lambda *_, **__: SimpleNamespace(rgb=rgb[None]))
        return SimpleNamespace(
            images=Images(),
            background="black",
            config=SimpleNamespace(train=SimpleNamespace(exposure="never")),
            model=SimpleNamespace(scene=scene, options=None),
        )

    static = truth + 0.1 * moving[..., None]
    dynamic = truth + 0.06 * ~moving[..., None]
    pair = (trainer(static), trainer(dynamic))
    masks: Any = SimpleNamespace(mask=lambda *_: moving)
    before, after = (module.view_psnr(x, 0) for x in pair)
    assert before > after
    before, after = (module.view_psnr(x, 0, masks) for x in pair)
    assert before == pytest.approx(20.0, abs=0.01)
    assert after == 100.0
    none: Any = SimpleNamespace(mask=lambda *_: torch.zeros_like(moving))
    assert module.view_psnr(pair[0], 0, none) == module.view_psnr(pair[0], 0)


def write_still_views(root: Path) -> None:
    write_static_capture(root, StaticOptions(size=24, num_train=48, num_test=1, samples=1))


@pytest.mark.parametrize(("moves", "steps"), [(True, 200), (False, 300)])
def test_never_worse_than_static(
    moves: bool, steps: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Motion wins real pilot runs where something moves, the static model where nothing does."""
    root = tmp_path / "capture"
    keys = ["init.num_random=200", "model.num_random_moving=60"]
    if moves:
        write_rolling_ball(root)
    else:
        write_still_views(root)
        keys = ["init.num_random=300", "model.num_random_moving=150", "data.times=order"]
        monkeypatch.setattr(module, "_finds_motion", lambda *_: True)
    monkeypatch.setattr(module, "MOTION", replace(module.MOTION, steps=steps))
    config = preset(root, "train.steps=20_000", *keys)
    best, choice = resolve_by_pilot_runs(config, read_capture(config.data))
    assert choice is not None
    assert choice.taken is moves, choice
    assert isinstance(best.model, DynamicModel) is moves


def test_a_still_scene_that_a_static_model_explains_needs_no_pilot_runs(tmp_path: Path) -> None:
    write_still_views(tmp_path)
    keys = ("train.steps=3000", "init.num_random=300", "data.times=order")
    config = preset(tmp_path, *keys)
    best, choice = resolve_by_pilot_runs(config, read_capture(config.data))
    assert choice is None
    assert without_name(best) == without_name(preset(tmp_path, *keys, name="static"))


def test_interrupted_pilot_runs_leave_nothing_and_repeat(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_rolling_ball(tmp_path / "capture")
    monkeypatch.setattr(module, "MOTION", replace(module.MOTION, steps=12, spent=1000))
    monkeypatch.setattr(module, "FEWEST_MOVING", 1)
    run = tmp_path / "run"
    real = Trainer.step
    config = preset(tmp_path / "capture", "train.steps=12", "init.num_random=40", f"run.dir={run}")

    def interrupted(trainer: Trainer[Any]) -> Any:
        signal.raise_signal(signal.SIGINT)
        return real(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", interrupted)
        with pytest.raises(KeyboardInterrupt, match="nothing is written"):
            train(config)
    assert not list(run.glob("*"))
    capture = read_capture(config.data)
    first, second = (resolve_by_pilot_runs(config, capture)[1] for _ in range(2))
    assert first is not None
    assert second is not None
    assert replace(first, seconds=0) == replace(second, seconds=0)
