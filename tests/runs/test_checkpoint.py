"""Checkpoints: equal bytes for equal runs, atomic writes, and one-line errors for damaged files."""

from __future__ import annotations

import json
import math
import random
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from forged import CONTENTS, contents, forged, one_line, require_drawable, stored_as_they_are
from moving_scene import MOVING_ROWS, TRAIN_TIMES, moved_x, write_moving_run

from dyngs.config import Config, DataConfig, RunConfig
from dyngs.config.io import RESOLVED_NAME, save_config
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.filters import fuse_filter
from dyngs.gaussians.scene import restore_scene
from dyngs.io import tensor_file
from dyngs.io.tensor_file import write_tensors
from dyngs.models.static_section import StaticModel
from dyngs.runs import checkpoint
from dyngs.runs.checkpoint import (
    Checkpoint,
    CheckpointInfo,
    checkpoint_paths,
    latest_checkpoint,
    load_checkpoint,
    load_run,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.stored_file import tensors_to_store


def _checkpoint(step: int) -> Checkpoint:
    generator = torch.Generator().manual_seed(step)
    tensors = {
        "gaussians.means": torch.randn((4, 3), generator=generator),
        "gaussians.quats": torch.randn((4, 4), generator=generator),
        "gaussians.log_scales": torch.randn((4, 3), generator=generator),
        "gaussians.logit_opacities": torch.randn(4, generator=generator),
        "gaussians.sh": torch.randn((4, 4, 3), generator=generator),
        "model.filter_std": torch.rand(4, generator=generator),
        "strategy.seen": torch.zeros(0),
        "sampler.order": torch.arange(5),
        "rng": generator.get_state(),
    }
    return Checkpoint(
        CheckpointInfo(step, 2.5, (1e6 + 0.25, 0.0, -3.0), "white", "classic"), tensors
    )


def _config(root: Path, **model: bool) -> Config:
    return Config(data=DataConfig(root=root), model=StaticModel(**model), run=RunConfig(name="x"))  # type: ignore[arg-type]


def test_the_newest_is_that_of_the_most_steps(tmp_path: Path) -> None:
    """Also where steps take more digits than names have room for."""
    for step in (9_999_998, 9_999_999, 10_000_000):
        save_checkpoint(tmp_path, _checkpoint(step), 1.0)
    assert [path.stem for path in checkpoint_paths(tmp_path)] == ["step_9999999", "step_10000000"]
    assert latest_checkpoint(tmp_path).info.step == 10_000_000


def test_nobody_is_told_to_delete_a_file_that_may_be_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too little memory, too many open files, no permission."""
    for step in (1, 2):
        save_checkpoint(tmp_path, _checkpoint(step), 1.0)
    for error in (
        RuntimeError("unable to mmap: Cannot allocate memory (12)"),
        MemoryError(),
        PermissionError(13, "no"),
    ):

        def failing(*given: object, error: Exception = error, **named: object) -> None:
            raise error

        monkeypatch.setattr(tensor_file, "safe_open", failing)
        with pytest.raises(DyngsError, match=r"keep it and try again$"):
            latest_checkpoint(tmp_path)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_link_to_nothing_is_an_error(tmp_path: Path) -> None:
    """It was taken for a checkpoint that is removed meanwhile, and looked for without end."""
    save_checkpoint(tmp_path, _checkpoint(1), 1.0)
    (tmp_path / "checkpoints" / "step_0000002.safetensors").symlink_to(tmp_path / "nothing")
    with pytest.raises(DyngsError, match=r"step_0000002.*"):
        latest_checkpoint(tmp_path)


def test_saving_and_loading_round_trips(tmp_path: Path) -> None:
    saved = _checkpoint(7)
    loaded = load_checkpoint(save_checkpoint(tmp_path, saved, 1.5))
    assert loaded.info == saved.info
    assert loaded.tensors.keys() == saved.tensors.keys()
    for name, x in saved.tensors.items():
        assert x.dtype == loaded.tensors[name].dtype
        assert torch.equal(x, loaded.tensors[name])
    assert loaded.part("sampler").keys() == {"order"}


def test_only_the_last_two_are_kept_with_their_times(tmp_path: Path) -> None:
    for step, seconds in ((5, 1.0), (10, 2.0), (15, 3.0)):
        save_checkpoint(tmp_path, _checkpoint(step), seconds)
    assert [path.name for path in checkpoint_paths(tmp_path)] == [
        "step_0000010.safetensors",
        "step_0000015.safetensors",
    ]
    assert latest_checkpoint(tmp_path).info.step == 15
    assert (seconds_at(tmp_path, 10), seconds_at(tmp_path, 15), seconds_at(tmp_path, 99)) == (
        2.0,
        3.0,
        0.0,
    )
    save_checkpoint(tmp_path, _checkpoint(12), 9.0)  # by a run that went on from step 10
    assert (seconds_at(tmp_path, 10), seconds_at(tmp_path, 12), seconds_at(tmp_path, 15)) == (
        2.0,
        9.0,
        0.0,
    )


@pytest.mark.parametrize(
    "damage", ["truncated", "altered", "header", "empty", "no safetensors", "foreign"]
)
def test_damage_is_named_with_the_file_and_the_previous_one(tmp_path: Path, damage: str) -> None:
    save_checkpoint(tmp_path, _checkpoint(5), 1.0)
    path = save_checkpoint(tmp_path, _checkpoint(10), 2.0)
    data = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "altered":
        path.write_bytes(data[:-3] + bytes([data[-3] ^ 1]) + data[-2:])
    elif damage == "header":
        path.write_bytes(data.replace(b'\\"step\\": 10', b'\\"step\\": 11'))
        assert path.read_bytes() != data
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "no safetensors":
        path.write_bytes(b"hello" * 100)
    else:
        from safetensors.torch import save_file

        save_file({"x": torch.zeros(3)}, path)
    with pytest.raises(DyngsError) as caught:
        latest_checkpoint(tmp_path)
    assert str(path) in str(caught.value)
    assert "step_0000005.safetensors" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_model_that_is_not_finite_is_not_saved(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, _checkpoint(5), 1.0)
    bad = _checkpoint(10)
    bad.tensors["gaussians.means"][1, 2] = math.nan
    with pytest.raises(DyngsError, match=r"means is not finite after step 10.*step_0000005"):
        save_checkpoint(tmp_path, bad, 2.0)
    assert latest_checkpoint(tmp_path).info.step == 5


def test_a_failed_write_leaves_the_earlier_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_checkpoint(tmp_path, _checkpoint(5), 1.0)

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dyngs.io.tensor_file.save_file", full)
    with pytest.raises(DyngsError, match=r"step_0000010.safetensors.*No space left"):
        save_checkpoint(tmp_path, _checkpoint(10), 2.0)
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == [
        "step_0000005.safetensors"
    ]


def test_load_run_gives_the_newest_model(tmp_path: Path) -> None:
    save_config(_config(tmp_path), tmp_path / RESOLVED_NAME)
    save_checkpoint(tmp_path, _checkpoint(5), 1.0)
    save_checkpoint(tmp_path, _checkpoint(10), 2.5)
    run = load_run(tmp_path)
    assert (run.step, run.seconds_train, run.config) == (10, 2.5, _config(tmp_path))
    assert run.info.world_offset == (1e6 + 0.25, 0.0, -3.0)
    assert torch.equal(run.scene.gaussians.sh, _checkpoint(10).tensors["gaussians.sh"])
    assert torch.equal(
        run.scene.gaussians.log_scales, _checkpoint(10).tensors["gaussians.log_scales"]
    )


def test_load_run_fuses_the_filter_of_a_filtered_model(tmp_path: Path) -> None:
    save_config(_config(tmp_path, filter_3d=True), tmp_path / RESOLVED_NAME)
    checkpoint = _checkpoint(5)
    save_checkpoint(tmp_path, checkpoint, 1.0)
    expected = fuse_filter(
        Gaussians(**checkpoint.part("gaussians")), checkpoint.tensors["model.filter_std"]
    )
    drawn = load_run(tmp_path).scene.at(None)
    assert torch.equal(drawn.log_scales, expected.log_scales)
    assert torch.equal(drawn.logit_opacities, expected.logit_opacities)


def test_a_moving_scene_is_loaded_with_its_field(tmp_path: Path) -> None:
    scene = load_run(write_moving_run(tmp_path)).scene
    assert not scene.is_static
    assert scene.rows.tolist() == list(MOVING_ROWS)
    assert scene.times == TRAIN_TIMES
    for time in (0.0, 0.3, 1.0):
        torch.testing.assert_close(scene.at(time).means[:, 0], moved_x(tuple(range(5)), time))


def test_a_field_that_lacks_something_is_named(tmp_path: Path) -> None:
    run_dir = write_moving_run(tmp_path)
    checkpoint = latest_checkpoint(run_dir)
    tensors = {name: x for name, x in checkpoint.tensors.items() if name != "model.field.box"}
    save_checkpoint(run_dir, replace(checkpoint, tensors=tensors), 1.0)
    with pytest.raises(DyngsError, match=r"step_0000007\.safetensors lacks 'box'"):
        load_run(run_dir)


def test_a_field_that_is_not_finite_is_not_saved(tmp_path: Path) -> None:
    run_dir = write_moving_run(tmp_path)
    good = latest_checkpoint(run_dir)
    bad = replace(good, info=replace(good.info, step=8), tensors=dict(good.tensors))
    bad.tensors["model.field.learned.means"] = torch.full((2, 1, 3), math.nan)
    with pytest.raises(DyngsError, match=r"field.*not finite after step 8.*step_0000007"):
        save_checkpoint(run_dir, bad, 2.0)
    assert latest_checkpoint(run_dir).info.step == 7


def test_missing_things_are_named(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="not a run folder"):
        load_run(tmp_path)
    save_config(_config(tmp_path), tmp_path / RESOLVED_NAME)
    with pytest.raises(DyngsError, match="no checkpoints"):
        load_run(tmp_path)
    checkpoint = _checkpoint(5)
    without = {name: x for name, x in checkpoint.tensors.items() if name != "gaussians.sh"}
    save_checkpoint(tmp_path, replace(checkpoint, tensors=without), 1.0)
    with pytest.raises(DyngsError, match="lacks 'sh'"):
        load_run(tmp_path)
    assert json.loads((tmp_path / "timing.json").read_text()) == {"seconds_train": {"5": 1.0}}


def _header(**changes: object) -> dict[str, object]:
    info = CheckpointInfo(7, 1.5, (0.0, 0.0, 0.0), "white", "classic")
    return asdict(info) | changes


@pytest.mark.parametrize("has_only_scene_file", [False, True])
@pytest.mark.parametrize("kind", CONTENTS)
def test_contents_that_do_not_fit_end_in_one_line_or_a_finite_image(
    tmp_path: Path, kind: str, has_only_scene_file: bool
) -> None:
    """The checksum fits; tensors lack, have other types, shapes and values, headers others kinds of
    fields."""
    (tensors, model), chance = contents(kind), random.Random(kind)
    save_config(Config(data=DataConfig(root=tmp_path), model=model), tmp_path / RESOLVED_NAME)
    path = tmp_path / (
        "scene.dyngs" if has_only_scene_file else "checkpoints/step_0000007.safetensors"
    )
    path.parent.mkdir(exist_ok=True)
    if has_only_scene_file:
        tensors = tensors_to_store(
            restore_scene(Checkpoint(CheckpointInfo(**_header()), tensors), model)
        )  # type: ignore[arg-type]
    refused = 0
    told = []
    for trial in range(11):
        changed, header = forged(tensors, _header(), chance) if trial else (tensors, _header())
        try:
            if has_only_scene_file:
                path.write_bytes(stored_as_they_are(changed, header))
            else:
                write_tensors(path, checkpoint._KIND, changed, header)
        except (ValueError, DyngsError):
            continue  # the format cannot say that
        try:
            require_drawable(load_run(tmp_path).scene)
        except DyngsError as error:
            refused += 1
            told.append(error)
            assert trial, error  # noqa: PT017 (the first is whole)
    assert refused > 2
    for error in told:
        one_line(error, path)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("model.rows", lambda x: x.flip(0), "'rows' is not strictly ascending"),
        ("model.rows", lambda x: x + 6, "'rows' has indices outside"),
        ("model.rows", lambda x: x.int(), "'rows' is int32"),
        ("model.times", lambda x: x + 0.5, "outside"),
        ("model.filter_std", lambda x: -x, "negative"),
        (
            "model.field.buffers.followed",
            lambda x: x + 5,
            "'followed' has indices outside",
        ),
        ("model.field.buffers.followed", lambda x: x[1:], r"'followed' is int64 \(3, 4\)"),
        ("model.field.buffers.radii", torch.zeros_like, "'radii' must be above 0"),
        ("model.field.buffers.positions", lambda x: x[1:], r"float32 \(4,"),
        ("model.field.learned.means", lambda x: x[:, 1:], "'means' is float32"),
        ("model.field.learned.exp_avg.means", lambda x: x.double(), "'exp_avg.means' is float64"),
        ("model.field.box", torch.zeros_like, "'box' must be above 0"),
        ("model.field.numbers", lambda x: -x, "'numbers' must be above 0"),
        ("gaussians.sh", lambda x: x[:, :3], "'sh' has an invalid number"),
        ("gaussians.means", lambda x: x * torch.nan, "'means' has NaN"),
    ],
)
def test_mismatched_contents_are_named(
    tmp_path: Path, name: str, change: Callable[[torch.Tensor], torch.Tensor], said: str
) -> None:
    tensors, model = contents("control_nodes")
    save_config(Config(data=DataConfig(root=tmp_path), model=model), tmp_path / RESOLVED_NAME)
    path = tmp_path / "checkpoints" / "step_0000007.safetensors"
    path.parent.mkdir()
    write_tensors(
        path, checkpoint._KIND, tensors | {name: change(tensors[name]).contiguous()}, _header()
    )
    with pytest.raises(
        DyngsError, match=rf"step_0000007\.safetensors: cannot be read \(ValueError: .*{said}"
    ):
        load_run(tmp_path)
