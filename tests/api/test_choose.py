"""What is decided by small runs: a clear gain wins, within a tenth of the run, and nothing else is
asked."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image
from two_balls import two_balls

from dyngs.api import choose as module
from dyngs.api.choose import Choice, OpenSetting, _Plan, as_static, choose, write_choices
from dyngs.api.train import train
from dyngs.config import Config, DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import (
    DynamicOptions,
    StillOptions,
    write_dynamic_capture,
    write_still_capture,
)
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.rendering import render
from dyngs.runs.folder import CHOICES_NAME
from dyngs.training.trainer import Trainer

LONG = "train.steps=200_000"


def preset(root: Path, *keys: str, name: str = "dynamic") -> Config:
    return load_config(packaged_preset(name), [f"data.root={root}", "run.threads=1", *keys])


def decided(config: Config) -> tuple[Config, list[Choice]]:
    best, found, _ = choose(config, read_capture(config.data))
    return best, found


def without_name(config: Config) -> Config:
    return config.model_copy(update={"run": config.run.model_copy(update={"name": "any"})})


def scored(monkeypatch: pytest.MonkeyPatch, psnr_of: Any) -> list[Config]:
    """Let nothing be trained: a short training has the PSNR that ``psnr_of`` gives it, and differs
    a little by view.

    The model at rest of a trial of motion has no ``deform`` there. Returns the configs that were
    tried.
    """
    tried: list[Config] = []

    def small_run(config: Config, capture: Capture, held_out: frozenset[int]) -> Any:
        tried.append(config)
        return SimpleNamespace(config=config, held_out=held_out)

    def both(config: Config, capture: Capture, held_out: frozenset[int], deadline: float) -> Any:
        return tuple(small_run(c, capture, held_out) for c in (as_static(config), config))

    def score(one: Any, other: Any, index: int) -> tuple[float, float]:
        return psnr_of(one.config), psnr_of(other.config) + 0.02 * (index % 2)

    monkeypatch.setattr(module, "_small_run", small_run)
    monkeypatch.setattr(module, "_with_and_without_motion", both)
    for name in ("plain", "explained", "after_pose_fit", "after_colour_fit"):
        monkeypatch.setattr(module, name, score)
    real = module._settings
    monkeypatch.setattr(
        module, "_settings", lambda config: [replace(x, score=score) for x in real(config)]
    )
    monkeypatch.setattr(
        module, "OpenSetting", lambda text, applied, _=None: OpenSetting(text, applied, score)
    )
    return tried


def moving_wins(config: Config) -> float:
    return 20.0 + isinstance(config.model, DynamicModel)


def test_all_runs_differ_in_one_setting_and_winners_stay(
    moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scored(
        monkeypatch,
        lambda c: 20.0 + isinstance(c.model, DynamicModel) - (c.colour.kind == "network"),
    )
    best, found = decided(preset(moving, LONG))
    assert [choice.taken for choice in found] == [True, False, False]
    assert isinstance(best.model, DynamicModel)
    assert not best.model.choose
    assert best.colour.kind == "sh"
    assert [c.model.kind for c in tried[:4]] == ["static", "dynamic"] * 2, "twice, as views are few"
    assert (
        len({(c.train.steps, c.data.longest_side, c.strategy.growth_limit) for c in tried[4:]}) == 1
    )
    assert [c.colour.kind for c in tried[4::2]] == ["sh", "network", "sh"]


def test_where_motion_does_not_pay_the_scene_is_static_and_no_more_is_asked(
    moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scored(monkeypatch, lambda c: 20.0 - isinstance(c.model, DynamicModel))
    config = preset(moving, LONG)
    best, found = decided(config)
    assert best == as_static(config)
    assert [choice.setting for choice in found] == ["model.kind=dynamic"]
    assert len(tried) == 4, "two of each"


def test_what_is_open_in_a_static_scene_is_asked_once_it_is_found_still(
    moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scored(
        monkeypatch,
        lambda c: 20.0 - isinstance(c.model, DynamicModel) + (c.train.robust == "always"),
    )
    best, found = decided(preset(moving, LONG, "train.robust=auto"))
    assert [choice.setting for choice in found] == ["model.kind=dynamic", "train.robust=always"]
    assert without_name(best) == without_name(
        preset(moving, LONG, "train.robust=always", name="static")
    )


def test_what_was_requested_is_not_questioned(
    moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scored(monkeypatch, lambda _: 20.0 + len(tried))
    keys = ("colour.kind=sh", "model.deform.moves=[rotations]", "camera.refine=never")
    _, found = decided(preset(moving, LONG, *keys))
    assert [choice.setting for choice in found] == ["model.kind=dynamic"]
    assert decided(preset(moving, "model.choose=false"))[1] == []


@pytest.mark.parametrize(("cameras", "first"), [(3, "control_nodes"), (6, "free")])
def test_before_fixed_cameras_free_primitives_and_nodes_are_compared(
    cameras: int, first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before many the former come first; their images grow early, also where nothing can be
    asked."""
    options = DynamicOptions(size=24, num_times=8, num_cameras=cameras, samples=1)
    root = write_dynamic_capture("room", tmp_path / "room", options)

    def kind_of(config: Config) -> str:
        assert isinstance(config.model, DynamicModel)
        kind = config.model.deform.kind
        assert config.train.resolution_grows_from == (0.3 if kind == "free" else 0.6)
        assert kind == "free" or config.model.deform == preset(root).model.deform  # type: ignore[union-attr]
        return kind

    def psnr_of(config: Config, winner: str) -> float:
        return 20.0 + (
            1 + 2 * (config.model.deform.kind == winner)
            if isinstance(config.model, DynamicModel)
            else 0
        )

    for winner in ("control_nodes", "free"):
        tried = scored(monkeypatch, lambda c, winner=winner: psnr_of(c, winner))
        best, found = decided(preset(root, LONG))
        assert kind_of(tried[1]) == first
        assert found[0].setting == "model.kind=dynamic"
        assert (
            found[1].setting == f"model.deform.kind={({'control_nodes', 'free'} - {first}).pop()}"
        )
        assert found[1].taken == (winner != first)
        assert kind_of(best) == winner


def test_what_is_requested_for_what_moves_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = write_dynamic_capture(
        "room", tmp_path / "room", DynamicOptions(size=24, num_times=8, samples=1)
    )
    scored(monkeypatch, moving_wins)
    best, _ = decided(preset(root, LONG, "train.resolution_grows_from=0.2"))
    assert isinstance(best.model, DynamicModel)
    assert (best.model.deform.kind, best.train.resolution_grows_from) == ("free", 0.2)
    for key in ("model.deform.kind=hexplane", "model.deform.rigidity=0.3"):
        requested, _ = decided(preset(root, LONG, key))
        assert isinstance(requested.model, DynamicModel)
        assert requested.model.deform.kind == ("hexplane" if "hex" in key else "control_nodes")


def test_before_fixed_cameras_nothing_is_thinner_than_they_show(
    moving: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = DynamicOptions(size=24, num_times=8, num_cameras=3, samples=1)
    fixed = write_dynamic_capture("room", tmp_path / "room", options)
    scored(monkeypatch, moving_wins)
    assert decided(preset(fixed, LONG))[0].model.filter_3d
    assert (
        "fixed cameras, 3 at a time: nothing is drawn thinner than they show"
        in capsys.readouterr().out
    )
    assert not decided(preset(fixed, LONG, "model.filter_3d=false"))[0].model.filter_3d
    assert not decided(preset(moving, LONG))[0].model.filter_3d
    scored(monkeypatch, lambda c: 20.0 - isinstance(c.model, DynamicModel))
    assert not decided(preset(fixed, LONG))[0].model.filter_3d
    assert "thinner" not in capsys.readouterr().out


def test_settings_of_a_static_scene_are_asked_only_where_they_are_auto(
    still: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FEWEST_VIEWS", 2)
    tried = scored(monkeypatch, lambda c: 20.0 + (c.train.robust == "always"))
    config = preset(still, LONG, name="static")
    assert decided(config) == (config, [])
    assert not tried
    best, found = decided(
        preset(still, LONG, "train.robust=auto", "train.exposure=auto", name="static")
    )
    assert (best.train.robust, best.train.exposure) == ("always", "never")
    assert [choice.setting for choice in found] == ["train.exposure=always", "train.robust=always"]


@pytest.mark.parametrize("keys", [("train.steps=400",), (LONG, "train.minutes=0.0001")])
def test_where_nothing_can_be_found_out_the_scene_is_static(
    keys: tuple[str, ...], moving: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    best, found = decided(preset(moving, *keys))
    assert without_name(best) == without_name(preset(moving, *keys, name="static"))
    assert not found
    assert "too short a run" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("gains", "taken"),
    [
        ([0.66, 0.5, 0.8, 0.6], True),
        ([2.0, -1.4, 1.9, -1.3], False),
        ([0.03, 0.03, 0.03], False),
        ([5.0], False),
    ],
)
def test_a_gain_counts_pair_by_pair_above_twice_its_standard_error(
    gains: list[float], taken: bool
) -> None:
    """However much the views themselves differ."""
    pairs = [(10.0 * i, 10.0 * i + gain) for i, gain in enumerate(gains)]
    found = module._choice("a=b", pairs, 500, 1.0)
    assert found.taken is taken
    assert found.gain == pytest.approx(fmean(gains))


def test_small_runs_keep_within_a_tenth_and_leave_out_the_last_settings(moving: Path) -> None:
    capture = read_capture(preset(moving).data)
    view = capture.splits["train"][0]
    for steps in (2000, 20_000, 50_000, 400_000):
        config = preset(moving, f"train.steps={steps}")
        plan = _Plan.of(config, capture, 3)
        small = module._small(config, 1000, plan.first_side)
        spent = plan.runs * len(plan.folds) * plan.steps * module._work_of_step(small, view)
        assert spent <= 0.1 * steps * module._work_of_step(config, view)
        assert plan.runs in (0, 2, 3, 4)
    assert _Plan.of(preset(moving, "train.steps=400_000"), capture, 3).runs == 4


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
        decided(preset(still))


@pytest.mark.parametrize(
    "keys",
    [
        (),
        ("train.steps=123", "train.minutes=2", "train.robust=auto"),
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


def test_what_only_moving_scenes_have_is_left_out(moving: Path) -> None:
    config = preset(moving, "model.deform.kind=hexplane", "model.time_window=0.5")
    assert without_name(as_static(config)) == without_name(preset(moving, name="static"))


def test_choices_are_a_table_in_the_run_folder(tmp_path: Path) -> None:
    write_choices(tmp_path, [Choice("a=b", 9, 20.0, 0.5, 0.1, 500, 2.0, taken=True)])
    (row,) = json.loads((tmp_path / CHOICES_NAME).read_text())
    assert (row["setting"], row["gain"], row["taken"]) == ("a=b", 0.5, True)


def write_rolling_ball(root: Path) -> None:
    """32 images of 24 px of a ball that goes 1.6 along x, at eight times, from everywhere."""
    write_still_capture(root, StillOptions(size=24, num_train=32, num_test=1, samples=1))
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


@pytest.mark.parametrize(("moves", "steps"), [(True, 200), (False, 300)])
def test_never_worse_than_static(
    moves: bool,
    steps: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A real trial: motion wins where something moves, the static model where nothing does."""
    root = tmp_path / "capture"
    keys = ["init.num_random=200", "model.num_random_moving=60"]
    if moves:
        write_rolling_ball(root)
    else:
        write_still_capture(root, StillOptions(size=24, num_train=48, num_test=1, samples=1))
        keys = ["init.num_random=300", "model.num_random_moving=150", "data.times=order"]
    monkeypatch.setattr(module, "TRIAL_STEPS", steps)
    config = preset(
        root, "train.steps=20_000", *keys, "colour.kind=sh", "model.deform.moves=[rotations]"
    )
    best, (choice,) = decided(config)
    assert choice.taken is moves, choice
    assert isinstance(best.model, DynamicModel) is moves
    assert f"model.kind=dynamic {'' if moves else 'not '}taken: " in capsys.readouterr().out


def test_a_trial_that_is_interrupted_leaves_nothing_and_has_the_same_end_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_rolling_ball(tmp_path / "capture")
    monkeypatch.setattr(module, "TRIAL_STEPS", 12)
    monkeypatch.setattr(module, "FEWEST_MOVING", 1)
    monkeypatch.setattr(module, "TRIAL_SPENT", 1000)
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
    chosen = [decided(config) for _ in range(2)]
    assert replace(chosen[0][1][0], seconds=0) == replace(chosen[1][1][0], seconds=0)


def test_motion_is_not_asked_about_where_too_few_steps_fit_in_the_minutes(
    moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scored(monkeypatch, moving_wins)
    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr(module.time, "monotonic", lambda: float(next(clock)))
    assert decided(preset(moving, "train.minutes=10"))[1][0].taken, (
        "10 s of the trial, 10 min of the run"
    )
    assert decided(preset(moving, "train.minutes=0.2"))[1] == []


def test_the_trial_is_a_quarter_of_the_run_at_most(
    moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = scored(monkeypatch, moving_wins)
    view = read_capture(preset(moving).data).splits["train"][0]
    for steps in (1000, 2000, 4000, 8000, 16_000):
        config = preset(moving, f"train.steps={steps}")
        tried.clear()
        decided(config)
        work = sum(
            module.TRIAL_COST * c.train.steps * module._work_of_step(c, view)
            for c in tried
            if c.model.may_move
        )
        assert work <= module.TRIAL_SPENT * steps * module._work_of_step(config, view)
        assert bool(work) == (steps > 4000)
