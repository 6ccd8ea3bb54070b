"""Dynamic scenes at the extremes: one test per row of the second table in docs/numerics.md."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from moving_scene import write_timed_capture
from scenes import look_around, weights
from tiny_fields import (
    ALL_KINDS,
    KINDS,
    busy_config,
    cloud,
    stir,
    stirred_field,
    tiny_field,
    tiny_options,
    write_tiny_capture,
)
from torch import Tensor

from dyngs.config import ControlNodesField, DynamicModel, HexplaneField, StaticModel, TrainConfig
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import tensors_of
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import MAX_KEY_TIMES, DeformationField, FieldSetup, Offsets, deformed
from dyngs.deform.fields import new_field
from dyngs.deform.hexplane import Hexplane, time_rows
from dyngs.deform.motion import MAX_SAMPLES, measure_motion
from dyngs.deform.random_gaussians import box_of
from dyngs.deform.scene import DynamicScene
from dyngs.deform.time_window import FRONTIER_VIEWS, TimeWindow
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.rendering import render
from dyngs.gaussians.restored import restored_scene
from dyngs.ops.planes import PlaneLevel, hexplane_features
from dyngs.static.scene import StaticScene
from dyngs.training.new_trainer import assemble
from dyngs.training.trainer import Trainer

LONG = 10_000

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_capture(tmp_path_factory.mktemp("capture") / "moving")


def values(offsets: Offsets) -> Tensor:
    """(M, all) numbers of the offsets."""
    parts = [x for x in vars(offsets).values() if x is not None]
    return torch.cat([x.reshape(len(x), -1) for x in parts], dim=1)


def scene_of(rows: Tensor, field: DeformationField) -> DynamicScene:
    """The cloud, ``rows`` of which a field moves."""
    return DynamicScene(gaussians=cloud(), seen_at=(0.0, 1.0), field=field, moving=rows)


def fine_trainer(capture: Path, kind: str, **model: object) -> Trainer:
    """After ten steps, eight of them without motion."""
    trainer = assemble(busy_config(capture, capture, kind, **model))
    for _ in range(10):
        trainer.step()
    return trainer


def timed(capture: Path, times: list[float]) -> Path:
    """The capture of ``write_timed_capture`` with these five training times."""
    write_timed_capture(capture)
    for split in ("train", "test"):
        file = capture / f"transforms_{split}.json"
        document = json.loads(file.read_text())
        for i, frame in enumerate(document["frames"]):
            frame["time"] = times[i]
        file.write_text(json.dumps(document))
    return capture


# --- times
# ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("time", [0.0, 1.0])
def test_the_ends_of_the_clip_are_ordinary_times(kind: str, time: float) -> None:
    """Continuous up to them, and gradients reach all that takes part."""
    field = stirred_field(kind)
    means = cloud().means
    inside = abs(time - 1e-6)
    torch.testing.assert_close(
        values(field.offsets(means, time)), values(field.offsets(means, inside)), atol=1e-3, rtol=0
    )
    found = values(field.offsets(means, time))
    (found * weights(found)).sum().backward()
    grads = [field.parameters[name].grad for name in field.parameters.values()]
    assert all(x is not None and x.isfinite().all() and x.any() for x in grads)


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_times_outside_the_clip_are_clamped(kind: str) -> None:
    scene = scene_of(torch.arange(9), stirred_field(kind))
    for outside, inside in ((-1e-9, 0.0), (-1e30, 0.0), (1 + 1e-9, 1.0), (float("inf"), 1.0)):
        assert torch.equal(scene.at(outside).means, scene.at(inside).means)


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_single_training_time_is_a_static_scene(tmp_path: Path, kind: str) -> None:
    trainer = assemble(busy_config(timed(tmp_path / "capture", [0.5] * 5), tmp_path, kind))
    assert isinstance(trainer.model.scene, StaticScene)
    assert trainer.step().loss > 0


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_two_training_times(tmp_path: Path, kind: str) -> None:
    """Trained on together from the first step on; planes and keys have the least that there can be,
    two."""
    config = busy_config(timed(tmp_path / "capture", [0.0, 1.0, 0.0, 1.0, 1.0]), tmp_path, kind)
    assert isinstance(config.model, DynamicModel)
    automatic = {"hexplane": {"time_resolution": 0}, "control_nodes": {"pieces": 0}}.get(kind, {})
    model = config.model.model_copy(
        update={"deform": config.model.deform.model_copy(update=automatic)}
    )
    trainer = assemble(config.model_copy(update={"model": model}))
    seen = {trainer.step().image.time for _ in range(12)}
    assert seen == {0.0, 1.0}
    assert isinstance(trainer.model.scene, DynamicScene)
    field = trainer.model.scene.field
    if isinstance(field, Hexplane):
        assert field.levels[0].time.shape[1] == 2
    if isinstance(field, ControlNodes):
        assert field.num_pieces == 1


def test_10000_training_times() -> None:
    """No more than 256 rows or keys; the window and the measure of motion stay cheap, and
    neighbours are told apart."""
    assert time_rows(HexplaneField(), LONG) == MAX_KEY_TIMES
    assert time_rows(HexplaneField(time_resolution=LONG // 2), LONG) == LONG // 2
    setup = FieldSetup(torch.zeros(3), torch.ones(3), LONG, 3, 1.0)
    control_nodes = new_field(ControlNodesField(nodes=2), setup, torch.Generator())
    assert isinstance(control_nodes, ControlNodes)
    assert control_nodes.num_pieces == MAX_KEY_TIMES
    times = tuple(i / (LONG - 1) for i in range(LONG))
    window = TimeWindow.around_middle(times, 0.1, 1000, 1000, 8000)
    assert sum(window.holds(time, 1001) for time in times) == pytest.approx(LONG / 10, abs=2)
    assert 0 < sum(window.holds(time, 1002) for time in times) <= FRONTIER_VIEWS + 1
    asked: list[float] = []
    field = stirred_field("control_nodes")
    real = field.offsets
    field.offsets = lambda means, time: (asked.append(time), real(means, time))[1]  # type: ignore[method-assign]
    measure_motion(field, cloud(), times, torch.ones(9))
    assert len(asked) == MAX_SAMPLES
    ramp = torch.arange(float(LONG // 2))[None, :, None, None].expand(3, -1, 2, 1).contiguous()
    level = PlaneLevel(torch.ones(3, 2, 2, 1, dtype=torch.float64), ramp.double())
    nowhere = torch.zeros(1, 3, dtype=torch.float64)
    rows = torch.cat([hexplane_features(nowhere, t, [level]) for t in times[-50:]])[:, 0] ** (1 / 3)
    torch.testing.assert_close(
        rows, torch.tensor(times[-50:], dtype=torch.float64) * (LONG // 2 - 1), rtol=1e-9, atol=0
    )


# --- sets
# -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_no_moving_gaussians(kind: str) -> None:
    """Of the right shapes, and their gradient is zero."""
    field = tiny_field(kind, 0)
    gaussians = cloud()
    offsets = field.offsets(gaussians.means[:0], 0.3)
    assert {name: tuple(x.shape) for name, x in vars(offsets).items()} == {
        "means": (0, 3), "quats": (0, 4), "log_scales": (0, 3), "logit_opacities": (0,), "colors": (0, 3)
    }  # fmt: skip
    moved = deformed(gaussians, offsets, torch.zeros(0, dtype=torch.long))
    assert all(torch.equal(x, gaussians.tensors()[name]) for name, x in moved.tensors().items())
    if moved.means.requires_grad:
        moved.means.sum().backward()
    assert field.parameters.step(1, 0.0) == 0
    scene = replace(scene_of(torch.zeros(0, dtype=torch.long), field), gaussians=gaussians)
    assert scene.at(0.4) is gaussians


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_the_last_moving_gaussian_is_pruned_during_a_run(capture: Path, kind: str) -> None:
    """The run goes on with what is left, and its checkpoint can be loaded."""
    trainer = fine_trainer(capture, kind)
    scene = trainer.model.scene
    two = TopologyEdit.select(torch.tensor([0, 3]))
    assert isinstance(scene, DynamicScene)
    assert scene.field is not None
    field = scene.field.edited(two)
    field.regroup()
    trainer.model.exchange(replace(scene, moving=two.source, field=field))
    trainer.step()
    keep = torch.ones(len(trainer.model.scene), dtype=torch.bool)
    keep[trainer.model.scene.rows] = False
    assert not keep.all()
    trainer.model.densifier = assemble(trainer.config).model.densifier
    trainer.model.keep(keep, trainer.done)
    for _ in range(2):
        assert trainer.step().loss > 0
        assert trainer.num_moving == 0
    other = assemble(trainer.config)
    other.restore(trainer.checkpoint())
    assert other.step().loss == trainer.step().loss


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_one_gaussian(kind: str) -> None:
    field = stirred_field(kind, 1)
    gaussian = cloud(1)
    moved = deformed(gaussian, field.offsets(gaussian.means, 0.8))
    assert all(x.isfinite().all() for x in moved.tensors().values())
    assert not torch.equal(moved.means, gaussian.means)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("flat", ["point", "line", "plane"])
def test_boxes_without_volume(kind: str, flat: str) -> None:
    """All means in one point, on a line, in a plane: the box has at least a thousandth of the
    extent to each side."""
    means = cloud().means.clone()
    means[:, {"point": 0, "line": 1, "plane": 2}[flat] :] = 0.7
    gaussians = cloud().replace(means=means, logit_opacities=torch.full((9,), 3.0))
    center, half_size = box_of(gaussians, 2.0)
    assert half_size.min() == pytest.approx(2e-3)
    field = new_field(
        tiny_options(kind),
        FieldSetup(center, half_size, 10, 9, 2.0),
        torch.Generator().manual_seed(0),
    )
    field.offsets(means, 0.3)
    stir(field)
    found = values(field.offsets(means, 0.3))
    assert found.isfinite().all()
    (found * weights(found)).sum().backward()
    grads = [field.parameters[name].grad for name in field.parameters.values()]
    assert all(x is None or x.isfinite().all() for x in grads)
    if flat == "point" and kind != "control_nodes":
        torch.testing.assert_close(found, found[:1].expand_as(found))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_box_of_nothing_or_of_one_point_has_a_size(count: int) -> None:
    for logit in (5.0, -20.0):
        gaussians = cloud(max(count, 1)).select(torch.zeros(count, dtype=torch.long))
        center, half_size = box_of(
            gaussians.replace(logit_opacities=torch.full((count,), logit)), 2.0
        )
        assert center.isfinite().all()
        assert (half_size >= 2e-3).all()
        if count:
            torch.testing.assert_close(center, gaussians.means[0])


def test_means_that_are_not_finite_do_not_spoil_the_box() -> None:
    gaussians = cloud(50).replace(logit_opacities=torch.full((50,), 2.0))
    means = gaussians.means.clone()
    means[0] = math.nan
    means[1] = math.inf
    center, half_size = box_of(gaussians.replace(means=means), 1.0)
    assert center.isfinite().all()
    assert half_size.isfinite().all()


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e30])
def test_gaussians_far_outside_the_box(distance: float) -> None:
    """Planes: the offsets of the border. Nodes: those of the nearest, carried along by its turn.
    All finite to 1e6."""
    means = cloud().means.clone()
    means[3] = distance
    planes = stirred_field("hexplane")
    border = means.clamp(-2, 2)
    torch.testing.assert_close(
        values(planes.offsets(means, 0.4)), values(planes.offsets(border, 0.4))
    )
    if distance > 1e6:
        return
    for kind in ("mlp", "control_nodes"):
        field = stirred_field(kind)
        field = field.edited(TopologyEdit(torch.arange(9), torch.zeros(9, dtype=torch.bool)))
        assert values(field.offsets(means, 0.4)).isfinite().all()


# --- rotations
# --------------------------------------------------------------------------------------------------------


def image_of(gaussians: Gaussians) -> Tensor:
    intrinsics = torch.tensor([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    return render(gaussians, Cameras(look_around(1, torch.float32), intrinsics[None], 32, 32)).rgb


def test_a_zero_quaternion_cannot_be_turned() -> None:
    """It stays the identity, which is what the rasterizer takes it for."""
    gaussians = cloud().replace(quats=torch.zeros(9, 4))
    turned = deformed(gaussians, Offsets(torch.zeros(9, 3), torch.randn(9, 4)))
    assert torch.equal(image_of(turned), image_of(gaussians))


def test_an_offset_that_cancels_the_identity_is_no_rotation() -> None:
    """1 + (-1) leaves a zero quaternion: drawn unrotated, with finite gradients."""
    quats = torch.zeros(9, 4)
    quats[:, 0] = -1.0
    quats.requires_grad_()
    turned = deformed(cloud(), Offsets(torch.zeros(9, 3), quats))
    identity = cloud().replace(quats=torch.tensor([[1.0, 0, 0, 0]]).expand(9, 4))
    assert torch.equal(image_of(turned), image_of(identity))
    (slope,) = torch.autograd.grad(image_of(turned).sum(), [quats])
    assert slope.isfinite().all()


# --- fields that explode
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_that_are_not_finite_are_left_out(kind: str) -> None:
    """Row by row, counted in the log as ``bad_gradients``; what is learned stays finite."""
    field = stirred_field(kind)
    means = cloud().means
    values(field.offsets(means, 0.4)).sum().backward()
    for name in field.parameters.values():
        grad = field.parameters[name].grad
        assert grad is not None
        grad.view(-1)[0] = float("nan")
    assert field.parameters.step(1, 0.0) == len(field.parameters.values())
    assert all(x.isfinite().all() for x in tensors_of(field.parameters.state()).values())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("kind", ALL_KINDS)
def test_what_is_learned_is_not_finite(capture: Path, kind: str, bad: float) -> None:
    """The next step stops before anything changes, and names step, view, attributes and time."""
    trainer = fine_trainer(capture, kind)
    scene = trainer.model.scene
    assert isinstance(scene, DynamicScene)
    assert scene.field is not None
    for x in scene.field.parameters.values().values():
        x.fill_(bad)
    before = trainer.model.scene.gaussians.means.detach().clone()
    with pytest.raises(
        DyngsError,
        match=r"^step 11, view '.*': the field makes means.* at [0-9.]+ not finite; .*deform$",
    ):
        trainer.step()
    assert torch.equal(trainer.model.scene.gaussians.means, before)


# --- where motion begins
# ----------------------------------------------------------------------------------------------


def test_a_image_that_a_still_model_explains(capture: Path) -> None:
    """No error stands out: nothing moves, no random Gaussians, no field; the run goes on static."""
    trainer = fine_trainer(capture, "control_nodes", motion_threshold=10.0)
    assert isinstance(trainer.model.scene, DynamicScene)
    assert trainer.model.scene.field is None
    assert len(trainer.model.scene.gaussians) == len(reference_set(capture))
    assert trainer.step().loss > 0


def test_no_random_gaussians(capture: Path) -> None:
    """Just the Gaussians that were there move."""
    sizes = []
    moving = []
    for added in (12, 0):
        trainer = assemble(busy_config(capture, capture, "control_nodes", num_random_moving=added))
        for _ in range(8):
            trainer.step()
        sizes.append(len(trainer.model.scene.gaussians))
        moving.append(trainer.num_moving)
        assert trainer.step().loss > 0
    assert sizes[0] == sizes[1] + 12
    assert moving[0] == moving[1] + 12 > 12


def reference_set(capture: Path) -> Gaussians:
    """What a static run of as many steps has."""
    config = busy_config(capture, capture, "control_nodes")
    trainer = assemble(config.model_copy(update={"model": StaticModel(sh_degree=1)}))
    for _ in range(10):
        trainer.step()
    return trainer.model.scene.gaussians


@pytest.mark.parametrize("filtered", [False, True])
def test_a_run_of_one_step(capture: Path, filtered: bool) -> None:
    """It ends as motion begins: with a field that is the identity, for the random Gaussians too,
    and filtered."""
    config = busy_config(capture, capture, "hexplane", filter_3d=filtered)
    config = config.model_copy(update={"train": TrainConfig(steps=1)})
    trainer = assemble(config)
    trainer.step()
    scene = restored_scene(trainer.checkpoint(), config.model)
    assert not scene.is_static
    assert len(scene) == 60 + 12
    assert torch.equal(scene.at(0.3).means, scene.gaussians.means)
