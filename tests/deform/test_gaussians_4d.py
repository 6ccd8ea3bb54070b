"""4D Gaussians: known shapes and lifetimes, splits, growth, storage, exports and PSNR."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from moving_scene import camera
from scaled_captures import scaled_capture
from tiny_fields import busy_config, cloud, moved, stirred_field, tiny_field, write_tiny_capture
from torch import Tensor

import dyngs
from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.core.state import select_prefix, strip_roles
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.deform.field import DeformationField
from dyngs.deform.fields import field_state, restore_field
from dyngs.deform.free import FreeInitialization
from dyngs.deform.gaussians_4d import MIN_WEIGHT, Gaussians4D
from dyngs.deform.keys import DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.evaluate.report import evaluate_run
from dyngs.export.edit.crop import Sphere, gaussians_in_region
from dyngs.export.splat_files import tracks_of
from dyngs.gaussians import Gaussians
from dyngs.ops.quaternions import quat_product, rotation_matrices, unit_quats
from dyngs.runs.checkpoint import CheckpointInfo, latest_checkpoint
from dyngs.runs.stored_file import decode_scene, encode_scene
from dyngs.training.new_trainer import build_trainer


def as_4d(field: DeformationField) -> Gaussians4D:
    assert isinstance(field, Gaussians4D)
    return field


def unsheared(times: list[float], spans: list[float]) -> tuple[Gaussians4D, Gaussians]:
    """Gaussians with random axes of space, without velocities."""
    gaussians = cloud(len(times))
    start = FreeInitialization(
        torch.zeros(0), (), torch.tensor(times), torch.tensor(spans), torch.zeros(len(times), 3)
    )
    field = as_4d(tiny_field("gaussians_4d", len(times)))
    return field.with_initialization(start, gaussians)


def covariances(gaussians: Gaussians) -> Tensor:
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None]
    return axes @ axes.mT


def test_at_its_mean_time_an_unsheared_one_is_the_3d_gaussian() -> None:
    field, gaussians = unsheared([0.4] * 9, [0.3] * 9)
    now = moved(field, gaussians, 0.4)
    torch.testing.assert_close(now.means, gaussians.means)
    torch.testing.assert_close(covariances(now), covariances(gaussians))
    torch.testing.assert_close(now.opacities, gaussians.opacities)
    assert torch.equal(now.sh, gaussians.sh)
    torch.testing.assert_close(moved(field, gaussians, 0.7).means, now.means, rtol=0, atol=1e-6)


def test_opacities_halve_and_end() -> None:
    span = 0.2
    field, gaussians = unsheared([0.5], [span])
    half_life = span * math.sqrt(2 * math.log(2))
    for time in (0.5 - half_life, 0.5 + half_life):
        found = moved(field, gaussians, time).opacities
        torch.testing.assert_close(found, gaussians.opacities / 2)
    end = span * math.sqrt(-2 * math.log(MIN_WEIGHT))
    assert moved(field, gaussians, 0.5 + 0.99 * end).opacities > 0
    assert moved(field, gaussians, 0.5 + 1.01 * end).opacities == 0


def test_sheared_ones_move_along_lines_and_keep_their_shape() -> None:
    field = as_4d(stirred_field("gaussians_4d"))
    gaussians = cloud()
    lines = field.linear(gaussians)
    for time in (0.3, 0.5, 0.6):
        now = moved(field, gaussians, time).detach()
        delay = time - lines.times
        expected = gaussians.means + lines.velocities * delay[:, None]
        torch.testing.assert_close(now.means, expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(covariances(now), covariances(lines.gaussians))
        weight = (-0.5 * (delay / lines.log_stds.exp()).square()).exp()
        weight = torch.where(weight > MIN_WEIGHT, weight, 0.0)
        torch.testing.assert_close(now.opacities, gaussians.opacities * weight)
    assert lines.velocities.norm(dim=1).min() > 0.01


def test_halves_are_drawn_from_the_density_over_space_and_time() -> None:
    field = as_4d(stirred_field("gaussians_4d", 1))
    one = cloud(1)
    count = 50_000
    rows = torch.zeros(count, dtype=torch.long)
    means, changes = field.split(one.select(rows), rows, torch.Generator().manual_seed(0))
    points = torch.cat([changes["times"], means], 1).detach().double()
    scales = torch.cat([field.parameters["log_spans"], one.log_scales], 1).exp()
    right = unit_quats(field.parameters["right_quats"])
    axes = quat_product(quat_product(unit_quats(one.quats), torch.diag(scales[0])), right)
    expected = (axes.mT @ axes).detach().double()
    torch.testing.assert_close(points.T.cov(), expected, rtol=0, atol=0.03 * float(expected.max()))
    center = torch.cat([field.parameters["times"], one.means], 1).detach().double()
    error = (points.mean(0) - center[0]) / expected.diagonal().sqrt()
    assert error.abs().max() < 5 / math.sqrt(count)
    shrunk = field.parameters["log_spans"] - changes["log_spans"]
    torch.testing.assert_close(shrunk.exp(), torch.full((count, 1), 1.6))


def test_quantised_rotations_are_the_same_gaussians() -> None:
    """Of any left rotation, also those that storage turns by halves elsewhere."""
    field = as_4d(stirred_field("gaussians_4d", 40))
    scene = DynamicScene(
        gaussians=cloud(40), training_times=(0.0, 1.0), field=field, moving=torch.arange(40)
    )
    info = CheckpointInfo(7, 1.0, (0.0, 0.0, 0.0), "white", "classic")
    steps = {f"gaussians.{name}": 1e-4 for name in ("means", "quats", "log_scales", "sh_base")}
    names = ("times", "log_spans", "right_quats", "sh_time")
    data = encode_scene(info, scene, steps | {f"model.field.learned.{n}": 1e-4 for n in names})
    tensors = decode_scene(data).tensors
    again = DynamicScene.from_state(
        DynamicModel(deform=field.options),
        Gaussians.stored(select_prefix(tensors, "gaussians")),
        select_prefix(tensors, "model"),
    )
    for time in (0.1, 0.6):
        found, wanted = (x.render(camera(), time).rgb for x in (again, scene))
        torch.testing.assert_close(found, wanted, rtol=0, atol=4e-3)


def test_exports_leave_out_what_does_not_exist(tmp_path: Path) -> None:
    field, gaussians = unsheared([0.0, 0.5, 1.0], [0.05, 0.05, 2.0])
    scene = DynamicScene(
        gaussians=gaussians, training_times=(0.0, 1.0), field=field, moving=torch.arange(3)
    )
    dyngs.save(scene, tmp_path / "middle.ply", time=0.5)
    kept = dyngs.load(tmp_path / "middle.ply").gaussians
    torch.testing.assert_close(kept.means, gaussians.means[1:])
    tracks = tracks_of(scene, (0.0, 0.5, 1.0))
    expected = [[True, False, False], [False, True, False], [True, True, True]]
    assert tracks.visible.tolist() == expected
    everywhere = Sphere((0.0, 0.0, 0.0), 100.0)
    inside = gaussians_in_region(everywhere, scene, times=[0.5])
    assert inside.tolist() == [False, True, True]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"sh_time": lambda x: x[:, :-1]}, "sh_time"),
        ({"sh_time": lambda x: x[:, :6].contiguous()}, "sh_time"),
        ({"right_quats": lambda x: x * float("nan")}, "right_quats"),
        ({"times": lambda x: x[1:]}, "times"),
        ({"log_spans": lambda x: x[:, 0]}, "log_spans"),
    ],
)
def test_broken_tensors_are_refused(
    change: dict[str, Callable[[Tensor], Tensor]], reason: str
) -> None:
    field = as_4d(stirred_field("gaussians_4d"))
    state = strip_roles(field_state(field))
    tensors = {name: x for name, x in state.items() if "exp_avg" not in name}
    for name, edit in change.items():
        tensors[f"learned.{name}"] = edit(tensors[f"learned.{name}"])
    with pytest.raises(ValueError, match=reason):
        restore_field(field.options, tensors, 9, 4)


def grown(config: Config, threshold: float) -> int:
    """Number of Gaussians after a run that grows by the gradient of mean times alone."""
    assert isinstance(config.model, DynamicModel)
    field = config.model.deform.model_copy(update={"time_grad_threshold": threshold})
    strategy = config.strategy.model_copy(update={"grad_threshold": 1e9})
    model = config.model.model_copy(update={"deform": field})
    trainer = build_trainer(config.model_copy(update={"model": model, "strategy": strategy}))
    for _ in range(18):
        trainer.step()
    return len(trainer.model.scene)


def test_gradients_of_mean_times_add_gaussians(tmp_path: Path) -> None:
    config = busy_config(write_tiny_capture(tmp_path / "capture"), tmp_path, "gaussians_4d")
    assert grown(config, 1e-12) > grown(config, 1e9)


def test_all_or_selected_gaussians_enter_the_field(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    for selects in (True, False):
        config = busy_config(capture, tmp_path, "gaussians_4d", select_moving=selects)
        trainer = build_trainer(config)
        for _ in range(12):
            trainer.step()
        scene = trainer.model.scene
        assert (scene.num_moving < len(scene)) == selects


def test_the_unit_of_length_changes_nothing(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    tiny = scaled_capture(capture, tmp_path / "tiny", 2.0**-13)
    found = [
        latest_checkpoint(train(busy_config(root, tmp_path / f"run{i}", "gaussians_4d"))).tensors
        for i, root in enumerate((capture, tiny))
    ]
    assert all(torch.equal(x, found[1][name]) for name, x in found[0].items())


def test_a_ball_in_front_of_fixed_cameras_is_learned(tmp_path: Path) -> None:
    """PSNR of what moves in views between the cameras."""
    options = DynamicOptions(
        size=40, num_times=5, num_cameras=8, num_test=4, samples=1, style="fixed"
    )
    capture = write_dynamic_capture("roll", tmp_path / "capture", options)
    keys = [
        f"data.root={capture}",
        f"run.dir={tmp_path / 'run'}",
        "run.threads=1",
        "init.num_random=600",
        "train.steps=200",
        "train.initial_downscale=1",
        "train.alpha_weight=0.1",
        "model.pilot_runs=false",
        "model.deform.kind=gaussians_4d",
        "model.num_random_moving=300",
        "strategy.max_gaussians=1500",
    ]
    train(load_config("dynamic", keys))
    found = evaluate_run(tmp_path / "run").psnr_moving
    assert found is not None
    assert found > 14.5
