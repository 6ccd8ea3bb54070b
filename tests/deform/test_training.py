"""The dynamic model: its phases, where motion begins, what it freezes, how it follows changes of the set."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import look_around
from tiny_fields import KINDS, cloud, stir, tiny_options
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import DynamicModel, OptimConfig, TrajectoryField
from dyngs.data.loader import Picture
from dyngs.deform.field import FieldSetup
from dyngs.deform.fields import field_state, new_field
from dyngs.deform.residual import Residuals
from dyngs.deform.seeds import box_of
from dyngs.deform.training import DeformSchedule, DynamicScene, Surroundings4D
from dyngs.deform.window import TimeWindow
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.rendering import render
from dyngs.static.optimizer import GaussianOptimizer
from dyngs.static.rates import Rates
from dyngs.static.training import StaticScene

FINE, FULL, SPLIT, STEPS = 2, 4, 6, 20
TIMES = tuple(i / 20 for i in range(21))
FOCAL, DISTANCE = 100.0, 3.0
THRESHOLD = 0.3


def camera() -> Cameras:
    intrinsics = torch.tensor([[FOCAL, 0, 50], [0, FOCAL, 50], [0, 0, 1]])
    return Cameras(look_around(1, torch.float32), intrinsics[None], 100, 100)


def picture(time: float | None) -> Picture:
    return Picture("view", camera(), torch.zeros(100, 100, 3), None, None, time)


def flat_cloud(count: int = 9) -> Gaussians:
    """Gaussians at depth 3 of ``camera``, where a pixel covers 0.03 units."""
    means = torch.rand((count, 3), generator=torch.Generator().manual_seed(1)) - 0.5
    means[:, 2] = 0.0
    gaussians = cloud(count).replace(means=means)
    return Gaussians(**{name: x.clone().requires_grad_() for name, x in gaussians.tensors().items()})


def alike(errors: Tensor) -> Residuals:
    return Residuals(errors, errors)


def unmeasured(gaussians_at: Callable[[float], Gaussians]) -> Residuals:
    return alike(torch.zeros(len(gaussians_at(0.0))))


def new_scene(
    times: tuple[float, ...] = TIMES,
    residuals: Callable[[Callable[[float], Gaussians]], Residuals] = unmeasured,
    still: StaticScene | None = None,
    cameras_stay: bool = False,
    **options: object,
) -> DynamicScene:
    """A dynamic model; its field is a straight line per Gaussian unless told otherwise."""
    line = TrajectoryField(polynomial=1, fourier=0, move_rotations=False, move_scales=False)
    defaults = {"deform": line, "num_random_moving": 0, "motion_sparsity": 0.0, "freeze_below_px": THRESHOLD}
    capture = Surroundings4D(times, [camera()], 1.0, residuals, cameras_stay)
    schedule = DeformSchedule(FINE, FINE, FULL, FINE, (SPLIT,), Rates(STEPS))
    model = DynamicModel.model_validate(defaults | options)
    return DynamicScene(model, schedule, capture, still or StaticScene(), torch.Generator())


def begun(gaussians: Gaussians, **options: object) -> DynamicScene:
    """After the coarse phase, as if the errors had said that all of the Gaussians move."""
    scene = new_scene(**options)  # type: ignore[arg-type]
    setup = FieldSetup(*box_of(gaussians, 1.0), len(scene.times), len(gaussians), 1.0)
    field = new_field(scene.options.deform, setup, torch.Generator().manual_seed(0))
    state = {f"field.{name}": x.clone() for name, x in field_state(field, setup).items()}
    scene.load_state({**state, "rows": torch.arange(len(gaussians))})
    return scene


def move(scene: DynamicScene, speeds: Tensor) -> None:
    """Let Gaussian i go from -speeds[i] to speeds[i] along x, world units."""
    assert scene.field is not None
    scene.field.learned["means"].data[:, 0, 0] = speeds


def speeds_of(scene: DynamicScene) -> Tensor:
    assert scene.field is not None
    return scene.field.learned["means"].detach()[:, 0, 0]


def drawn_at(scene: DynamicScene, gaussians: Gaussians, time: float) -> Gaussians:
    return scene.gaussians_at(gaussians, picture(time), STEPS).gaussians.detach()


# --- phases -----------------------------------------------------------------------------------------------------------


def test_before_the_fine_phase_it_is_the_static_model() -> None:
    scene, gaussians = new_scene(residuals=lambda _: alike(torch.arange(9.0))), flat_cloud()
    for step in (1, FINE):
        assert scene.edit(gaussians, step - 1) is None
        drawn = scene.gaussians_at(gaussians, picture(0.3), step)
        assert drawn.gaussians is gaussians
        assert drawn.penalties == {}
        assert scene.num_moving(9) == 0
        scene.after_step(gaussians, step, None)
    scene.edit(gaussians, FINE)
    assert scene.num_moving(9) > 0
    assert torch.equal(drawn_at(scene, gaussians, 0.3).means, gaussians.means)


@pytest.mark.parametrize(("step", "tracks"), [(FINE + 2, True), (FINE + 3, False)])
def test_on_the_newest_views_only_the_motion_learns(step: int, tracks: bool) -> None:
    """What is new must not spoil the form before it is followed."""
    gaussians = flat_cloud()
    scene = begun(gaussians)
    scene.window = TimeWindow.around_middle(TIMES, 0.3, FINE, FINE, FINE + 10)
    scene.gaussians_at(gaussians, picture(0.6), step).gaussians.means.sum().backward()
    assert scene.field is not None
    assert scene.field.learned["means"].grad is not None
    assert (gaussians.means.grad is None) == tracks


# --- where motion begins ----------------------------------------------------------------------------------------------

ERRORS = (0.01, 0.3, 0.02, 0.35, 0.03, 0.0, 0.31, 0.02, 0.01)
"""Of a still model; 1, 3 and 6 stand out."""


def test_what_a_still_model_cannot_explain_moves() -> None:
    """And only after the last step of the coarse phase."""
    scene, gaussians = new_scene(residuals=lambda _: alike(torch.tensor(ERRORS))), flat_cloud()
    result = scene.edit(gaussians, FINE)
    assert scene.rows.tolist() == [1, 3, 6]
    assert scene.num_moving(9) == 3
    assert result is not None
    assert result.edit is not None
    assert result.edit.source.tolist() == list(range(9)), "without seeds the set stays"
    field = scene.field
    for step in (1, FINE + 1, FULL, SPLIT):
        assert scene.edit(gaussians, step) is None
    assert scene.field is field


@pytest.mark.parametrize(
    ("errors", "motion_threshold", "rows"),
    [
        (ERRORS, 0.5, []),
        ((0.0, 0.0, 0.0, 0.06, 0.3, 0.3, 0.3, 0.3, 0.4), 0.1, [4, 5, 6, 7, 8]),  # the groups part at 0.06
        ((0.0, 0.0, 0.3, 0.3, 0.3, 1.0, 1.0, 1.0, 1.0), 0.1, [*range(2, 9)]),  # at 0.3, but that is surely motion
        ((0.05,) * 9, 0.04, []),  # not well explained, but all alike
        ((0.12,) * 9, 0.04, [*range(9)]),
        ((0.0,) * 999 + (0.5,), 0.04, []),  # one in a thousand is noise
        ((0.0,) * 9, 0.0, []),
        ((0.0,) * 8 + (0.01,), 0.0, [8]),
    ],
)
def test_small_errors_are_no_motion(errors: tuple[float, ...], motion_threshold: float, rows: list[int]) -> None:
    """Where nothing stands out the model stays static: the same Gaussians, nothing added, no field."""
    scene = new_scene(
        residuals=lambda _: alike(torch.tensor(errors)), motion_threshold=motion_threshold, num_random_moving=5
    )
    gaussians = flat_cloud()
    result = scene.edit(gaussians, FINE)
    if rows:
        assert scene.rows.tolist() == [*rows, *range(9, 14)]
    else:
        assert (result, scene.field, scene.rows.tolist(), scene.num_moving(9)) == (None, None, [], 0)
        assert scene.state().keys() == {"times"}
        assert scene.gaussians_at(gaussians, picture(0.2), FINE + 1).gaussians is gaussians


@pytest.mark.parametrize("kind", KINDS)
def test_seeds_move_too(kind: str) -> None:
    scene = new_scene(residuals=lambda _: alike(torch.tensor(ERRORS)), num_random_moving=4, deform=tiny_options(kind))
    gaussians = flat_cloud()
    result = scene.edit(gaussians, FINE)
    assert result is not None
    optimizer = GaussianOptimizer(gaussians, OptimConfig())
    optimizer.apply(result)
    grown = optimizer.parameters
    assert scene.rows.tolist() == [1, 3, 6, 9, 10, 11, 12]
    assert scene.num_moving(len(grown)) == 7
    assert torch.equal(drawn_at(scene, grown, 0.3).means, grown.means.detach())
    assert scene.field is not None
    stir(scene.field)
    moved = (drawn_at(scene, grown, 0.3).means != drawn_at(scene, grown, 0.9).means).any(1)
    assert torch.equal(torch.nonzero(moved)[:, 0], scene.rows)


def test_the_filter_of_a_still_model_counts_the_seeds() -> None:
    """A checkpoint of that very step has as many values as Gaussians."""
    still = StaticScene([camera()])
    scene = new_scene(residuals=lambda _: alike(torch.tensor(ERRORS)), still=still, num_random_moving=4)
    gaussians = flat_cloud()
    scene.gaussians_at(gaussians, picture(0.3), FINE)
    assert len(scene.state()["filter_std"]) == 9
    scene.edit(gaussians, FINE)
    assert len(scene.state()["filter_std"]) == 13


# --- the field learns -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_field_learns_after_the_fine_phase(kind: str) -> None:
    """Gradients of what is drawn reach field and canonical Gaussians; ``after_step`` changes the field alone."""
    gaussians = flat_cloud()
    scene = begun(gaussians, deform=tiny_options(kind), motion_sparsity=0.1)
    for step in (FINE + 1, FINE + 2):
        drawn = scene.gaussians_at(gaussians, picture(0.7), step)
        (drawn.gaussians.means[:, 1].sum() + sum(drawn.penalties.values(), torch.zeros(()))).backward()
        canonical = gaussians.means.detach().clone()
        assert scene.after_step(gaussians, step, None) == 0
        assert torch.equal(gaussians.means, canonical)
    assert (drawn_at(scene, gaussians, 0.7).means[:, 1] < gaussians.means[:, 1]).all()
    assert set(drawn.penalties) == {"motion sparsity"} | {
        "hexplane": {"plane smoothness"},
        "control_nodes": {"node acceleration", "node rigidity"},
    }.get(kind, set())
    assert gaussians.means.grad is not None
    tolerance = 0.01 if kind == "control_nodes" else 1e-6  # nodes turn what follows them
    torch.testing.assert_close(gaussians.means.grad, torch.tensor([0.0, 2, 0]).expand(9, 3), rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", KINDS)
def test_motion_is_learned_from_pictures(kind: str) -> None:
    """Balls before one camera go 0.3 units (10 px) to the right: the field finds out, by the gradients of rendering."""
    gaussians = flat_cloud()
    blobs = {"log_scales": torch.full((9, 3), -2.5), "logit_opacities": torch.full((9,), 2.0)}
    gaussians = gaussians.replace(**{name: x.requires_grad_() for name, x in blobs.items()})
    planes = {"resolution": 3, "levels": (1,), "time_resolution": 4, "channels": 16, "width": 64}
    rates = {"hexplane": {**planes, "lr_planes": 0.05, "lr_decoder": 0.01}, "mlp": {"lr": 0.01, "width": 32}}
    options = tiny_options(kind, everything=False).model_copy(update=rates.get(kind, {"lr_means": 0.01}))
    steps = 150
    scene = begun(gaussians, deform=options, motion_sparsity=0.0)
    scene.schedule = DeformSchedule(0, 0, 0, 0, (), Rates(steps))
    shift = torch.tensor([0.3, 0.0, 0.0])
    times = [(7 * i % 11) / 10 for i in range(steps)]
    for step, time in enumerate(times, start=1):
        truth = gaussians.detach().replace(means=gaussians.means.detach() + (time - 0.5) * shift)
        drawn = scene.gaussians_at(gaussians, picture(time), step).gaussians
        pictures = [render(x, camera()).rgb for x in (drawn, truth)]
        (pictures[0] - pictures[1]).abs().mean().backward()
        scene.after_step(gaussians, step, None)
    for time in (0.1, 0.5, 0.9):
        found = drawn_at(scene, gaussians, time).means - gaussians.means.detach()
        assert (found.mean(0) - (time - 0.5) * shift)[:2].norm() < 0.2 * 0.3  # one camera sees no depth


def test_bad_gradients_of_the_field_are_counted() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians)
    assert scene.field is not None
    grad = torch.zeros(9, 1, 3)
    grad[4, 0, 1] = float("nan")
    scene.field.learned["means"].grad = grad
    assert scene.after_step(gaussians, FINE + 1, None) == 1
    assert scene.field.learned["means"].isfinite().all()


def test_it_trains_on_the_window() -> None:
    """Which opens where motion begins: before, all views are trained on."""
    scene = new_scene(times=tuple(i / 100 for i in range(101)), time_window=0.1)
    assert all(scene.trains_on(time, step) for time in (0.0, 0.5, 1.0, None) for step in (1, FINE, FULL))
    assert scene.trains_on(0.5, FINE + 1)
    assert not scene.trains_on(0.0, FINE + 1)
    assert not scene.trains_on(None, FINE + 1), "no time is time 0"


def test_motion_sparsity_is_the_mean_length_in_extents() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians, motion_sparsity=0.5)
    move(scene, torch.arange(9.0))
    penalty = scene.gaussians_at(gaussians, picture(1.0), FINE + 1).penalties["motion sparsity"]
    assert float(penalty.detach()) == pytest.approx(0.5 * 4.0, rel=1e-5)
    assert begun(gaussians).gaussians_at(gaussians, picture(1.0), FINE + 1).penalties == {}


def test_time_jitter_shrinks_and_stays_in_the_clip() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians, time_jitter=3.0)
    move(scene, torch.ones(9))

    def spread(step: int, time: float) -> tuple[float, float, float]:
        drawn = [scene.gaussians_at(gaussians, picture(time), step).gaussians.means.detach() for _ in range(60)]
        x = torch.stack([(means - gaussians.means.detach())[0, 0] for means in drawn])
        return float(x.std()), float(x.min()), float(x.max())

    first, later, last = (spread(step, 0.5)[0] for step in (FINE + 1, STEPS // 2, STEPS))
    assert first > later > last == 0.0
    assert first == pytest.approx(2 * 3 / 20 * (1 - (FINE + 1) / STEPS), rel=0.4)
    _, low, high = spread(FINE + 1, 1.0)
    assert -1 <= low < high <= 1 + 1e-6


# --- freezing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("in_place", "kept"), [(True, [2, 3]), (False, [0, 2, 3])])
def test_where_cameras_stay_nothing_moves_that_pictures_show_still(in_place: bool, kept: list[int]) -> None:
    """Four move by far, the fourth least; the pictures say of two that they are like the median."""
    still, moving = 0.2 * DynamicModel().motion_threshold, 0.3 * DynamicModel().motion_threshold
    errors = alike(torch.tensor([still, moving, moving, moving]))
    gaussians = flat_cloud(4)
    scene = begun(gaussians, residuals=lambda _: errors, cameras_stay=in_place)
    move(scene, torch.tensor([0.1, 0.0, 0.1, 0.1]))
    scene.after_step(gaussians, SPLIT, None)
    assert scene.rows.tolist() == kept


def test_freezing_keeps_just_what_is_seen_to_move() -> None:
    """A pixel covers 0.03 units: 0.3 px are 0.009."""
    gaussians = flat_cloud()
    scene = begun(gaussians)
    speeds = torch.tensor([0.0, 0.1, 0.0085, 0.0095, -0.0095, -0.0085, 0.0, 5.0, 1e-6])
    move(scene, speeds)
    before = {time: drawn_at(scene, gaussians, time) for time in TIMES}
    scene.after_step(gaussians, SPLIT, None)
    assert scene.rows.tolist() == [1, 3, 4, 7]
    assert scene.num_moving(9) == 4
    assert torch.equal(speeds_of(scene), speeds[scene.rows])
    px_size = DISTANCE / FOCAL
    for time, old in before.items():
        stray = (drawn_at(scene, gaussians, time).means - old.means).norm(dim=1) / px_size
        assert stray.max() < THRESHOLD
        assert stray[scene.rows].max() < 1e-5
    assert all(x.requires_grad and x.is_leaf for x in gaussians.tensors().values())


def test_freezing_bakes_a_constant_offset_into_the_canonical_gaussians() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians, deform=TrajectoryField(polynomial=1, fourier=0))
    assert scene.field is not None
    move(scene, torch.full((9,), 0.005))
    moved_at = drawn_at(scene, gaussians, 0.5)
    scene.after_step(gaussians, SPLIT, None)
    assert scene.field is None
    for name, x in drawn_at(scene, gaussians, 0.9).tensors().items():
        torch.testing.assert_close(x, moved_at.tensors()[name], rtol=0, atol=1e-6)


def test_where_nothing_moves_the_field_goes_for_good() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians)
    scene.after_step(gaussians, SPLIT, None)
    assert (scene.field, scene.rows.tolist(), scene.num_moving(9)) == (None, [], 0)
    assert scene.state().keys() == {"times"}
    assert scene.gaussians_at(gaussians, picture(0.2), SPLIT + 1).gaussians is gaussians
    scene.after_step(gaussians, SPLIT + 1, EditResult(TopologyEdit.select(torch.arange(9) < 5)))
    assert scene.field is None


def test_freezing_goes_on_at_the_next_split() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians)
    move(scene, torch.tensor([1.0, 0, 1, 0, 1, 0, 1, 0, 1]))
    scene.after_step(gaussians, SPLIT, None)
    move(scene, torch.tensor([0.0, 1, 1, 0, 1]))
    scene.after_step(gaussians, SPLIT, None)
    assert scene.rows.tolist() == [2, 4, 8]
    assert torch.equal(speeds_of(scene), torch.ones(3))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_frozen(kind: str) -> None:
    """Also where a network moves everything: what is left moves as before, except that nodes come and go."""
    gaussians = flat_cloud()
    scene = begun(gaussians, deform=tiny_options(kind), freeze_below_px=1.0)
    assert scene.field is not None
    drawn_at(scene, gaussians, 0.4)
    stir(scene.field, 0.02)
    old = drawn_at(scene, gaussians, 0.4)
    scene.after_step(gaussians, SPLIT, None)
    if kind != "control_nodes":
        new = drawn_at(scene, gaussians, 0.4)
        torch.testing.assert_close(new.means[scene.rows], old.means[scene.rows], rtol=0, atol=1e-5)
    assert drawn_at(scene, gaussians, 0.4).means.isfinite().all()


# --- following --------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_descendants_of_what_moves_move(data: st.DataObject) -> None:
    """After any sequence of edits; each with the curve of its ancestor."""
    gaussians = flat_cloud()
    scene = begun(gaussians)
    moves = torch.tensor(data.draw(st.lists(st.booleans(), min_size=9, max_size=9)))
    identity = torch.arange(1.0, 10.0)  # the speed tells the ancestor
    move(scene, torch.where(moves, identity, 0.0))
    frozen = data.draw(st.booleans(), label="frozen before")
    if frozen:
        scene.after_step(gaussians, SPLIT, None)
    ancestor = torch.arange(9)
    for _ in range(data.draw(st.integers(1, 3))):
        source = torch.tensor(data.draw(st.lists(st.integers(0, len(ancestor) - 1), max_size=14)), dtype=torch.long)
        is_new = torch.tensor(data.draw(st.lists(st.booleans(), min_size=len(source), max_size=len(source))))
        edit = TopologyEdit(source, is_new.bool())
        gaussians = Gaussians(**{name: edit.apply(x.detach()).clone() for name, x in gaussians.tensors().items()})
        scene.after_step(gaussians, FINE + 1, EditResult(edit))
        ancestor = ancestor[source]
        if len(ancestor) == 0:
            break
    shift = (drawn_at(scene, gaussians, 1.0).means - gaussians.means)[:, 0]
    torch.testing.assert_close(shift, torch.where(moves, identity, 0.0)[ancestor], rtol=0, atol=1e-5)
    followed = moves[ancestor] if frozen else torch.ones(len(ancestor), dtype=torch.bool)
    assert torch.equal(scene.rows, torch.nonzero(followed)[:, 0])
    if scene.field is not None:
        assert torch.equal(speeds_of(scene), torch.where(moves, identity, 0.0)[ancestor[scene.rows]])
    assert scene.num_moving(len(ancestor)) == (0 if scene.field is None else len(speeds_of(scene)))


def test_moments_of_new_rows_start_at_zero() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians)
    move(scene, torch.tensor([0.0, 1, 1, 1, 0, 0, 0, 0, 0]))
    scene.after_step(gaussians, SPLIT, None)
    assert scene.field is not None
    scene.field.learned["means"].grad = torch.ones(3, 1, 3)
    edit = TopologyEdit(torch.tensor([0, 1, 1, 2, 8, 3]), torch.tensor([False, False, True, False, True, True]))
    scene.after_step(gaussians, SPLIT + 1, EditResult(edit))
    assert scene.rows.tolist() == [1, 2, 3, 5]
    moments = scene.field.learned.state()["exp_avg.means"]
    assert moments.any(-1)[:, 0].tolist() == [True, False, True, False]


def test_a_reset_of_opacities_moves_no_rows() -> None:
    gaussians = flat_cloud()
    scene = begun(gaussians)
    move(scene, torch.ones(9))
    scene.after_step(gaussians, FINE + 1, EditResult(None, {"logit_opacities": torch.zeros(9)}))
    assert torch.equal(speeds_of(scene), torch.ones(9))


# --- state ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("phase", ["coarse", "fine", "split"])
def test_state_goes_round(kind: str, phase: str) -> None:
    gaussians, options = flat_cloud(), {"deform": tiny_options(kind)}
    scene = new_scene(**options) if phase == "coarse" else begun(gaussians, **options)
    if phase != "coarse":
        assert scene.field is not None
        drawn_at(scene, gaussians, 0.4)
        stir(scene.field, 0.1)
    if phase == "split":
        scene.after_step(gaussians, SPLIT, None)
    other = new_scene(**options)
    other.load_state({name: x.clone() for name, x in scene.state().items()})
    assert other.state().keys() == scene.state().keys()
    assert all(torch.equal(x, other.state()[name]) for name, x in scene.state().items())
    assert other.num_moving(9) == scene.num_moving(9)
    for time in (0.0, 0.4):
        for name, x in drawn_at(scene, gaussians, time).tensors().items():
            assert torch.equal(x, drawn_at(other, gaussians, time).tensors()[name]), name
    other.load_state({})
    assert other.field is None


# --- the box ----------------------------------------------------------------------------------------------------------


def test_the_box_holds_what_is_solid() -> None:
    """All but the outer percent of it, with a tenth to spare."""
    gaussians = cloud(300).replace(logit_opacities=torch.full((300,), 2.0))
    center, half_size = box_of(gaussians, 1.0)
    inside = ((gaussians.means - center).abs() <= half_size).all(1)
    assert inside.float().mean() > 0.93
    far = gaussians.means.clone()
    far[:2] = 1e6
    logits = gaussians.logit_opacities.clone()
    logits[2:40], far[2:40] = -10.0, -500.0
    bounded = box_of(gaussians.replace(means=far, logit_opacities=logits), 1.0)
    assert (bounded[1] < 1.5 * half_size).all()
