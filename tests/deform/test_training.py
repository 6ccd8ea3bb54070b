"""Training of dynamic scenes: phases, start of motion, freezing, and edits of the Gaussians."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_training import (
    DISTANCE,
    FINE,
    FOCAL,
    FULL,
    SPLIT,
    STEPS,
    THRESHOLD,
    TIMES,
    alike,
    begun,
    camera,
    flat_cloud,
    move,
    new_run,
    speeds_of,
)
from static_balls import Ball, filmed
from tiny_fields import KINDS, stir, tiny_options

from dyngs.config import OptimConfig
from dyngs.deform.keys import DynamicModel, FreeField, MlpField
from dyngs.deform.schedule import DeformSchedule
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import GaussianOptimizer
from dyngs.gaussians.rendering import render
from dyngs.gaussians.schedule import RateSchedule

# --- phases
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("step", "tracks"), [(FINE + 2, True), (FINE + 3, False)])
def test_newest_views_train_only_the_deformation(step: int, tracks: bool) -> None:
    """Views of new times must not change the canonical Gaussians before their motion is fitted."""
    gaussians = flat_cloud()
    run = begun(gaussians, time_window=0.3, full=FINE + 10)
    run.time_step(0.6, step).gaussians.means.sum().backward()
    assert run.scene.field is not None
    assert run.scene.field.parameters["means"].grad is not None
    assert (gaussians.means.grad is None) == tracks


# --- where motion begins
# ----------------------------------------------------------------------------------------------

ERRORS = (0.01, 0.3, 0.02, 0.35, 0.03, 0.0, 0.31, 0.02, 0.01)
"""Of a static model; 1, 3 and 6 stand out."""


def test_static_residual_marks_moving_gaussians() -> None:
    """Gaussians are marked only after the last step of the coarse phase."""
    run = new_run(flat_cloud(), static_errors=lambda _: alike(torch.tensor(ERRORS)))
    result = run.grow(FINE)
    assert run.scene.rows.tolist() == [1, 3, 6]
    assert run.scene.num_moving == 3
    assert result is not None
    assert result.edit is not None
    assert result.edit.source.tolist() == list(range(9)), "without random Gaussians the set stays"
    field = run.scene.field
    for step in (1, FINE + 1, FULL, SPLIT):
        assert run.grow(step) is None
    assert run.scene.field is field


@pytest.mark.parametrize(
    ("errors", "motion_threshold", "rows"),
    [
        (ERRORS, 0.5, []),
        # the groups part at 0.06
        ((0.0, 0.0, 0.0, 0.06, 0.3, 0.3, 0.3, 0.3, 0.4), 0.1, [4, 5, 6, 7, 8]),
        # at 0.3, but that is surely motion
        ((0.0, 0.0, 0.3, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0), 0.1, [*range(2, 9)]),
        ((0.05,) * 9, 0.04, []),  # not well explained, but all alike
        ((0.12,) * 9, 0.04, [*range(9)]),
        ((0.0,) * 999 + (0.5,), 0.04, []),  # one in a thousand is noise
        ((0.0,) * 9, 0.0, []),
        ((0.0,) * 8 + (0.01,), 0.0, [8]),
    ],
)
def test_small_errors_are_no_motion(
    errors: tuple[float, ...], motion_threshold: float, rows: list[int]
) -> None:
    """Without outliers in the residual the model stays static, with the same Gaussians and no
    field.
    """
    gaussians = flat_cloud()
    run = new_run(
        gaussians,
        static_errors=lambda _: alike(torch.tensor(errors)),
        motion_threshold=motion_threshold,
        num_random_moving=5,
    )
    result = run.grow(FINE)
    if rows:
        assert run.scene.rows.tolist() == [*rows, *range(9, 14)]
    else:
        assert (result, run.scene.field, run.scene.rows.tolist(), run.scene.num_moving) == (
            None,
            None,
            [],
            0,
        )
        assert run.model_state.keys() == {"times"}
        assert run.time_step(0.2, FINE + 1).gaussians is gaussians


@pytest.mark.parametrize("kind", KINDS)
def test_random_gaussians_move_too(kind: str) -> None:
    gaussians = flat_cloud()
    run = new_run(
        gaussians,
        static_errors=lambda _: alike(torch.tensor(ERRORS)),
        num_random_moving=4,
        deform=tiny_options(kind),
    )
    result = run.grow(FINE)
    assert result is not None
    optimizer = GaussianOptimizer(gaussians, OptimConfig())
    optimizer.apply(result)
    grown = optimizer.parameters
    run.scene = run.scene.with_gaussians(grown)
    assert run.scene.rows.tolist() == [1, 3, 6, 9, 10, 11, 12]
    assert run.scene.num_moving == 7
    assert torch.equal(run.drawn_at(0.3).means, grown.means.detach())
    assert run.scene.field is not None
    stir(run.scene.field)
    moved = (run.drawn_at(0.3).means != run.drawn_at(0.9).means).any(1)
    assert torch.equal(torch.nonzero(moved)[:, 0], run.scene.rows)


# --- the field learns
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_motion_is_learned_from_images(kind: str) -> None:
    """Balls move 0.3 units (10 px) to the right before one camera. The field learns this from
    rendering gradients.
    """
    gaussians = flat_cloud()
    blobs = {"log_scales": torch.full((9, 3), -2.5), "logit_opacities": torch.full((9,), 2.0)}
    gaussians = gaussians.replace(**{name: x.requires_grad_() for name, x in blobs.items()})
    planes = {"resolution": 3, "levels": (1,), "channels": 16, "width": 64}
    rates = {
        "hexplane": {**planes, "lr_planes": 0.05, "lr_decoder": 0.01},
        "mlp": {"lr": 0.01, "width": 32},
    }
    options = tiny_options(kind, everything=False).model_copy(
        update=rates.get(kind, {"lr_means": 0.01})
    )
    steps = 150
    run = begun(gaussians, times=TIMES[::3], deform=options, motion_sparsity=0.0)
    run.training.schedule = DeformSchedule(0, 0, 0, 0, (), RateSchedule(steps))
    shift = torch.tensor([0.3, 0.0, 0.0])
    times = [(7 * i % 11) / 10 for i in range(steps)]
    for step, time in enumerate(times, start=1):
        truth = gaussians.detach().replace(means=gaussians.means.detach() + (time - 0.5) * shift)
        drawn = run.time_step(time, step).gaussians
        images = [render(x, camera()).rgb for x in (drawn, truth)]
        (images[0] - images[1]).abs().mean().backward()
        run.after_step(step)
    for time in (0.1, 0.5, 0.9):
        found = run.drawn_at(time).means - gaussians.means.detach()
        # one camera sees no depth
        assert (found.mean(0) - (time - 0.5) * shift)[:2].norm() < 0.2 * 0.3


def test_motion_sparsity_is_the_mean_length_in_extents() -> None:
    gaussians = flat_cloud()
    run = begun(gaussians, motion_sparsity=0.5)
    move(run, torch.arange(9.0))
    penalty = run.time_step(1.0, FINE + 1).penalties["motion sparsity"]
    assert float(penalty.detach()) == pytest.approx(0.5 * 4.0, rel=1e-5)
    assert begun(gaussians).time_step(1.0, FINE + 1).penalties == {}


def test_all_gaussians_may_enter_the_field() -> None:
    """Without differences from the static model, and without a search for rigid bodies."""

    def searched(_: Gaussians) -> None:
        raise AssertionError

    gaussians = flat_cloud()
    run = new_run(gaussians, select_moving=False)
    run.training.capture = replace(run.training.capture, frame_stack=searched)
    assert run.grow(FINE) is not None
    assert run.scene.moving.tolist() == list(range(len(gaussians)))


def test_noise_of_training_times_falls_to_zero_in_half_of_the_run() -> None:
    run = begun(flat_cloud())
    move(run, torch.ones(9))  # from -1 at time 0 to 1 at time 1
    noisy = begun(flat_cloud(), deform=MlpField(time_noise=0.5))
    noisy.scene = run.scene

    def deviations(step: int) -> torch.Tensor:
        without = run.time_step(0.5, step).gaussians.means[0, 0]
        found = [noisy.time_step(0.5, step).gaussians.means[0, 0] for _ in range(200)]
        return (torch.stack(found) - without).detach()

    expected = 2 * 0.5 * (1 - 2 * 5 / STEPS) / len(TIMES)
    assert float(deviations(5).std()) == pytest.approx(expected, rel=0.2)
    assert not deviations(STEPS // 2).any()


def test_rate_of_positions_may_start_to_decay_with_motion() -> None:
    starts = [
        begun(flat_cloud(), static_decay=decays).training.means_decay_from
        for decays in (True, False)
    ]
    assert starts == [0, FINE]


# --- freezing
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("in_place", "kept"), [(True, [2, 3]), (False, [0, 2, 3])])
def test_fixed_cameras_freeze_unchanged_gaussians(in_place: bool, kept: list[int]) -> None:
    """Four Gaussians move far. Two of them look like the temporal median in the images."""
    static = 0.2 * DynamicModel().motion_threshold
    moving = 0.3 * DynamicModel().motion_threshold
    errors = alike(torch.tensor([static, moving, moving, moving]))
    gaussians = flat_cloud(4)
    run = begun(gaussians, static_errors=lambda _: errors, has_fixed_cameras=in_place)
    move(run, torch.tensor([0.1, 0.0, 0.1, 0.1]))
    run.after_step(SPLIT)
    assert run.scene.rows.tolist() == kept


def test_only_visibly_moving_gaussians_stay_moving() -> None:
    """A pixel covers 0.03 units, so 0.3 px are 0.009 units."""
    gaussians = flat_cloud()
    run = begun(gaussians)
    speeds = torch.tensor([0.0, 0.1, 0.0085, 0.0095, -0.0095, -0.0085, 0.0, 5.0, 1e-6])
    move(run, speeds)
    before = {time: run.drawn_at(time) for time in TIMES}
    run.after_step(SPLIT)
    assert run.scene.rows.tolist() == [1, 3, 4, 7]
    assert run.scene.num_moving == 4
    assert torch.equal(speeds_of(run), speeds[run.scene.rows])
    px_size = DISTANCE / FOCAL
    for time, old in before.items():
        stray = (run.drawn_at(time).means - old.means).norm(dim=1) / px_size
        assert stray.max() < THRESHOLD
        assert stray[run.scene.rows].max() < 1e-5
    assert all(x.requires_grad and x.is_leaf for x in gaussians.tensors().values())


def test_freezing_bakes_a_constant_offset_into_the_canonical_gaussians() -> None:
    gaussians = flat_cloud()
    run = begun(gaussians)
    assert run.scene.field is not None
    move(run, torch.full((9,), 0.005))
    moved_at = run.drawn_at(0.5)
    run.after_step(SPLIT)
    assert run.scene.field is None
    for name, x in run.drawn_at(0.9).tensors().items():
        torch.testing.assert_close(x, moved_at.tensors()[name], rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_frozen(kind: str) -> None:
    """Remaining rows keep their motion, except for control nodes, which are added and removed."""
    gaussians = flat_cloud()
    run = begun(gaussians, deform=tiny_options(kind), freeze_below_px=1.0)
    assert run.scene.field is not None
    run.drawn_at(0.4)
    stir(run.scene.field, 0.02)
    old = run.drawn_at(0.4)
    run.after_step(SPLIT)
    if kind != "control_nodes":
        new = run.drawn_at(0.4)
        torch.testing.assert_close(
            new.means[run.scene.rows], old.means[run.scene.rows], rtol=0, atol=1e-5
        )
    assert run.drawn_at(0.4).means.isfinite().all()


# --- following
# -------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_copies_of_moving_gaussians_move(data: st.DataObject) -> None:
    """Each copy has the trajectory of its ancestor after any sequence of edits."""
    gaussians = flat_cloud()
    run = begun(gaussians)
    moves = torch.tensor(data.draw(st.lists(st.booleans(), min_size=9, max_size=9)))
    identity = torch.arange(1.0, 10.0)  # the speed tells the ancestor
    move(run, torch.where(moves, identity, 0.0))
    frozen = data.draw(st.booleans(), label="frozen before")
    if frozen:
        run.after_step(SPLIT)
    ancestor = torch.arange(9)
    for _ in range(data.draw(st.integers(1, 3))):
        source = torch.tensor(
            data.draw(st.lists(st.integers(0, len(ancestor) - 1), max_size=14)), dtype=torch.long
        )
        is_new = torch.tensor(
            data.draw(st.lists(st.booleans(), min_size=len(source), max_size=len(source)))
        )
        edit = TopologyEdit(source, is_new.bool())
        gaussians = Gaussians(
            **{name: edit.apply(x.detach()).clone() for name, x in gaussians.tensors().items()}
        )
        run.after_step(FINE + 1, EditResult(edit))
        ancestor = ancestor[source]
        if len(ancestor) == 0:
            break
    shift = (run.drawn_at(1.0).means - gaussians.means)[:, 0]
    torch.testing.assert_close(
        shift, torch.where(moves, identity, 0.0)[ancestor], rtol=0, atol=1e-5
    )
    followed = moves[ancestor] if frozen else torch.ones(len(ancestor), dtype=torch.bool)
    assert torch.equal(run.scene.rows, torch.nonzero(followed)[:, 0])
    if run.scene.field is not None:
        assert torch.equal(
            speeds_of(run), torch.where(moves, identity, 0.0)[ancestor[run.scene.rows]]
        )
    assert run.scene.num_moving == (0 if run.scene.field is None else len(speeds_of(run)))


# --- state
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("phase", ["coarse", "fine", "split"])
def test_training_state_round_trip(kind: str, phase: str) -> None:
    gaussians = flat_cloud()
    deform = tiny_options(kind)
    run = (
        new_run(gaussians, deform=deform) if phase == "coarse" else begun(gaussians, deform=deform)
    )
    if phase != "coarse":
        assert run.scene.field is not None
        run.drawn_at(0.4)
        stir(run.scene.field, 0.1)
    if phase == "split":
        run.after_step(SPLIT)
    other = new_run(gaussians, deform=deform)
    stored = {name: x.clone() for name, x in run.model_state.items()}
    other.scene = other.training.restore(gaussians, stored)
    assert other.model_state.keys() == run.model_state.keys()
    assert all(torch.equal(x, other.model_state[name]) for name, x in run.model_state.items())
    assert other.scene.num_moving == run.scene.num_moving
    for time in (0.0, 0.4):
        for name, x in run.drawn_at(time).tensors().items():
            assert torch.equal(x, other.drawn_at(time).tensors()[name]), name
    assert other.training.restore(gaussians, {}).field is None


# --- fixed cameras
# -------------------------------------------------------------------------------------------------


def test_motion_starts_at_changes_of_fixed_cameras() -> None:
    """Free primitives start without random Gaussians, with all times, and the ball at its position
    at each time.
    """
    times = tuple(i / 7 for i in range(8))
    footage = filmed(lambda t: [Ball((0.0, 0.1, 1.6 * t - 0.8))], times)
    errors = alike(torch.tensor(ERRORS))
    begin = partial(
        new_run, flat_cloud(), times, deform=FreeField(), num_random_moving=800, full=FINE + 20
    )
    run = begin(static_errors=lambda _: errors, motion_threshold=0.1, time_window=0.2)
    run.training.capture = replace(run.training.capture, fixed_clips=lambda: footage)
    result = run.grow(FINE)
    assert result is not None
    assert result.message is not None
    assert "found motion at 8 of 8 times" in result.message
    assert run.training.trains_on(0.0, FINE + 1)
    copies = 3 * len(times)  # of the static Gaussians that move: one for each time
    assert copies < run.scene.num_moving <= copies + 2 * 800
    for time in times:
        now = run.drawn_at(time).select(run.scene.moving[copies:])
        ball = now.means[now.opacities > 0.5]
        assert len(ball) > 50
        assert (ball.median(0).values - torch.tensor([0.0, 0.1, 1.6 * time - 0.8])).norm() < 0.1
    scene = begin().training.restore(run.scene.gaussians, run.model_state)
    torch.testing.assert_close(scene.at(0.3).means, run.scene.at(0.3).means)
