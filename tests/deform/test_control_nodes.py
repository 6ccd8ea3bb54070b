"""Control nodes with poses at key times: placement, motion, insertion and removal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scene import write_timed_capture
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from tiny_fields import busy_config, cloud, tiny_setup
from torch import Tensor

from dyngs.config import OptimConfig
from dyngs.core.state import strip_roles
from dyngs.data.capture import View
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.keys import CLIP_NODES, JUMPING_NODES, ControlNodesField
from dyngs.deform.start import is_clip
from dyngs.gaussians import TopologyEdit
from dyngs.training.new_trainer import build_trainer

MEANS_ONLY = {"moves": ()}


def control_nodes(
    nodes: int = 5, pieces: int = 4, num_times: int = 10, **options: object
) -> ControlNodes:
    """An untrained field of control nodes."""
    return ControlNodes(
        ControlNodesField(nodes=nodes, pieces=pieces, **options),  # type: ignore[arg-type]
        tiny_setup(num_times=num_times),
        torch.Generator(),
    )


def placed(means: Tensor, **options: object) -> ControlNodes:
    """A field with placed nodes."""
    field = control_nodes(**options)  # type: ignore[arg-type]
    field.offsets(means, 0.0)
    return field


def changed(field: ControlNodes, source: Tensor, is_new: Tensor) -> ControlNodes:
    """The field after an edit of the Gaussians during training."""
    field = field.apply_edit(TopologyEdit(source, is_new))
    field.invalidate()
    return field


def points_of(field: ControlNodes) -> Tensor:
    """(P,) control points of the first node's motion along x."""
    return field.parameters["means"].detach()[0, :, 0]


def hold(field: ControlNodes, name: str, values: Tensor) -> None:
    """Set one head of all nodes to ``values`` (S, size) at all times, by equal control points."""
    field.parameters[name].data[:] = values[:, None]


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 1), st.integers(1, 6), st.integers(0, 10_000))
def test_motion_is_a_cubic_spline(time: float, pieces: int, seed: int) -> None:
    """Equal to SciPy's cubic B-spline with uniform knots."""
    means = cloud().means
    field = placed(means, nodes=1, pieces=pieces, **MEANS_ONLY)
    values = np.random.default_rng(seed).normal(size=(pieces + 3, 3))
    field.parameters["means"].data[0] = torch.from_numpy(values).float()
    expected = BSpline((np.arange(pieces + 7) - 3) / pieces, values, 3)(time)
    found = field.offsets(means, time).means.detach()
    # Four values of up to 5 with weights that add up to 1: 8 roundings of those; the place among up
    # to 6 pieces is off by 3 units of 6, and the slope there at most 10. Together 80 + 180 units.
    allowed = 260 * 0.5 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(
        found, torch.from_numpy(expected).float().expand(9, 3), rtol=0, atol=allowed
    )


def test_a_rigid_motion_of_the_nodes_is_one_of_the_gaussians() -> None:
    means = cloud(30).means
    field = placed(means, nodes=6, pieces=1)
    positions = field.buffers["positions"]
    turn = Rotation.from_rotvec([0.3, -0.5, 0.9])
    matrix = torch.from_numpy(turn.as_matrix()).float()
    shift = torch.tensor([0.1, 0.2, -0.3])
    hold(field, "means", positions @ matrix.T + shift - positions)
    quat = torch.from_numpy(turn.as_quat()).float().roll(1)
    hold(field, "quats", (quat - torch.tensor([1.0, 0, 0, 0])).expand(6, 4))
    moved = means + field.offsets(means, 1.0).means.detach()
    torch.testing.assert_close(moved, means @ matrix.T + shift, rtol=0, atol=1e-5)
    assert float(field.penalties(1.0)["node rigidity"].detach()) < 1e-10


# --- nodes come and go
# ------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 12), st.lists(st.lists(st.integers(0, 11), max_size=15), min_size=1, max_size=4)
)
def test_nodes_lie_at_gaussians_after_any_edits(nodes: int, sets: list[list[int]]) -> None:
    """Nodes are distinct and at most as many as requested. With as many nodes as positions, each
    Gaussian has its own node.
    """
    everything = cloud(12).means
    field = placed(everything, nodes=nodes)
    index = torch.arange(12)
    for chosen in sets:
        rows = torch.tensor(
            [i % len(index) for i in chosen] if len(index) else [], dtype=torch.long
        )
        field = changed(field, rows, torch.zeros(len(rows), dtype=torch.bool))
        index = index[rows]
        means = everything[index]
        offsets = field.offsets(means, 0.3)
        assert offsets.means.shape == (len(index), 3)
        if len(index) == 0:
            continue
        positions = field.buffers["positions"]
        followed = field.buffers["followed"]
        assert 1 <= len(positions) <= nodes
        assert len(positions.unique(dim=0)) == len(positions) == len(field.parameters["means"])
        assert followed.max() < len(positions)
        if nodes == 12:
            assert torch.equal(positions[followed[:, 0]], means)
        assert all(len(x) == len(positions) for x in strip_roles(field.parameters.state()).values())


def test_new_nodes_interpolate_the_motion_of_the_field() -> None:
    """In a field that moves rigidly new nodes get the same motion, and existing ones keep it."""
    means = cloud(30).means
    field = placed(means[:10], nodes=20, pieces=2)
    assert len(field.buffers["positions"]) == 10
    turn = Rotation.from_rotvec([0.0, 0.0, 0.8])
    matrix = torch.from_numpy(turn.as_matrix()).float()
    positions = field.buffers["positions"]
    hold(field, "means", positions @ matrix.T - positions)
    quat = torch.from_numpy(turn.as_quat()).float().roll(1)
    hold(field, "quats", (quat - torch.tensor([1.0, 0, 0, 0])).expand(10, 4))
    field = changed(field, torch.arange(30) % 10, torch.arange(30) >= 10)
    moved = means + field.offsets(means, 1.0).means.detach()
    assert len(field.buffers["positions"]) == 20
    torch.testing.assert_close(moved, means @ matrix.T, rtol=0, atol=1e-5)


def test_unused_nodes_are_removed_with_their_moments() -> None:
    means = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    field = placed(means, nodes=3, pieces=1, **MEANS_ONLY)
    field.offsets(means, 0.5).means.square().sum().backward()
    for x in (field.parameters["means"],):
        x.grad = torch.ones_like(x)
    field.parameters.step(1, 0.0)
    stays = [x.tolist() for x in field.buffers["positions"]].index([-1.0, 0.0, 0.0])
    old = {name: x[stays].clone() for name, x in strip_roles(field.parameters.state()).items()}
    field = changed(field, torch.tensor([0]), torch.tensor([False]))
    field.offsets(means[:1], 0.5)
    assert field.buffers["positions"].tolist() == [[-1.0, 0.0, 0.0]]
    assert all(
        torch.equal(x, old[name][None]) for name, x in strip_roles(field.parameters.state()).items()
    )
    field = changed(field, torch.tensor([0, 0]), torch.tensor([False, True]))
    field.offsets(means[[0, 2]], 0.5)
    state = strip_roles(field.parameters.state())
    assert state["exp_avg.means"][0].any()
    assert not state["exp_avg.means"][1].any()


# --- times not seen yet
# -----------------------------------------------------------------------------------------------


def test_motion_is_extrapolated_at_constant_velocity() -> None:
    """The velocity is that of the last two intervals on either side. The outermost control points
    are ignored.
    """
    field = placed(cloud().means, pieces=10)
    field.parameters["means"].data[0, :, 0] = torch.tensor([-7.0] * 5 + [3, 4, 6, 7] + [-7] * 4)
    field.extend((0.4, 0.6), (0.2, 0.8))
    assert points_of(field).tolist() == [-4.5, -3, -1.5, 0, 1.5, 3, 4, 6, 7.5, 9, 10.5, 12, 13.5]
    field.extend((0.0, 1.0), (0.0, 1.0))
    assert points_of(field)[[0, -1]].tolist() == [-4.5, 13.5], (
        "with all times seen the ends are free"
    )


# --- penalties
# -------------------------------------------------------------------------------------------------


# --- rigid groups
# -------------------------------------------------------------------------------------------------


def turning_views(degrees: float, num_times: int = 8) -> list[View]:
    """Views at successive times by a camera that turns by ``degrees`` between them."""
    views = []
    for i in range(num_times):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", degrees * i, degrees=True).as_matrix()
        views.append(View(f"{i}", Path(f"{i}.png"), pose, np.eye(3), 4, 4, time=i / num_times))
    return views


@pytest.mark.parametrize(("degrees", "expected"), [(1.0, True), (80.0, False), (0.0, False)])
def test_clips_are_taken_by_smoothly_moving_cameras(degrees: float, expected: bool) -> None:
    """A camera that does not move is a fixed one."""
    assert is_clip(turning_views(degrees)) is expected


def test_several_cameras_are_no_clip() -> None:
    views = turning_views(1.0)
    same_time = [replace(view, time=0.5 * (i % 2)) for i, view in enumerate(views)]
    assert not is_clip(same_time)


def test_clips_learn_twice_as_fast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step of Adam is as long as the learning rate. A requested factor is kept."""
    given = busy_config(write_timed_capture(tmp_path), tmp_path, "control_nodes")
    requested = given.model_copy(update={"optim": OptimConfig(rate_factor=3)})
    for config, is_a_clip, factor in ((given, True, 2), (given, False, 1), (requested, True, 3)):
        monkeypatch.setattr("dyngs.deform.start.is_clip", lambda _, found=is_a_clip: found)
        trainer = build_trainer(config)
        before = trainer.model.scene.gaussians.logit_opacities.detach().clone()
        trainer.step()
        change = (trainer.model.scene.gaussians.logit_opacities.detach() - before).abs().max()
        assert float(change) == pytest.approx(factor * config.optim.lr_opacities, rel=1e-3)


def test_requested_numbers_of_nodes_are_kept() -> None:
    for is_a_clip, (nodes, rate) in ((True, CLIP_NODES), (False, JUMPING_NODES)):
        resolved = ControlNodesField().resolve_nodes(is_a_clip)
        assert (resolved.nodes, resolved.lr_means) == (nodes, rate)
        requested = ControlNodesField(nodes=7, lr_means=0.1)
        assert requested.resolve_nodes(is_a_clip) == requested
