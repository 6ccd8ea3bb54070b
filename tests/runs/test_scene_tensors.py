"""How tensors are kept: by their names, within their steps, and what is out of reach exactly."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from moving_scene import camera
from scipy.spatial.transform import Rotation
from tiny_fields import ALL_KINDS, cloud, stirred_field, tiny_options

from dyngs.config import DynamicModel
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, part_of
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.avatar.corrections import new_corrections
from dyngs.human.avatar.posing import Skeleton
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.motion import MotionClip
from dyngs.runs.scene_file import packed, unpacked
from dyngs.runs.scene_tensors import (
    COARSENESS,
    FIXED_STEPS,
    LARGEST_HALF,
    LIMIT,
    MAX_COARSENESS,
    OPACITY_STEPS,
    ROTATION_STEP,
    SPARSE,
    Coding,
    TensorKind,
    Whole,
    checked_coarseness,
    coding_of,
    completed,
    drawable,
    from_grid,
    from_whole,
    group_of,
    is_step,
    opacities_from_grid,
    opacities_to_grid,
    restored,
    rotations_from_grid,
    rotations_to_grid,
    sorted_axes,
    step_below,
    stored_edit,
    to_grid,
    to_whole,
)


def test_names_decide() -> None:
    x = torch.ones(100, 3)
    groups = ("gaussians.means", "gaussians.sh_rest", "model.field.learned.weight")
    steps: dict[str, float] = dict.fromkeys(groups, 0.01)
    assert coding_of("gaussians.means", x, steps).kind is TensorKind.GRID
    assert coding_of("gaussians.sh_rest", x, steps).kind is TensorKind.SPARSE
    assert coding_of("model.field.learned.weight12", x, steps).kind is TensorKind.GRID
    assert coding_of("model.field.learned.space0", x, steps).kind is TensorKind.HALF
    assert coding_of("model.field.learned.space0", 1e6 * x, steps).kind is TensorKind.EXACT
    assert (
        coding_of("model.field.box", torch.ones(2, 3), {"model.field.box": 1.0}).kind
        is TensorKind.EXACT
    )
    assert coding_of("model.rows", torch.arange(100), {}).kind is TensorKind.EXACT
    assert group_of("model.times", torch.ones(100, dtype=torch.float64)) is None


@pytest.mark.parametrize(
    "dtype", [torch.int64, torch.int32, torch.uint8, torch.bool, torch.float32, torch.float64]
)
def test_exact_is_exact(dtype: torch.dtype) -> None:
    x = (torch.randn(5, 4, generator=torch.Generator().manual_seed(0)) * 3).abs().to(dtype)
    back = restored(x, Coding(TensorKind.EXACT))
    assert back.dtype == dtype
    assert torch.equal(back, x)


def test_half_has_eleven_bits() -> None:
    x = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    assert ((restored(x, Coding(TensorKind.HALF)) - x).abs() <= 2.0**-11 * x.abs() + 2.0**-24).all()


def test_far_values_are_exact() -> None:
    x = torch.tensor([0.3, 1e30, -3e8, 5.0])
    whole = to_whole(x, Coding(TensorKind.GRID, 0.5))
    assert whole.far[:, 0].tolist() == [1, 2]
    assert from_whole(whole, Coding(TensorKind.GRID, 0.5), torch.float32).tolist() == [
        0.5,
        *x[1:].tolist(),
    ]


def test_what_hardly_shows_is_stored_more_coarsely() -> None:
    x = torch.full((3, 2), 0.7)
    back = restored(x, Coding(TensorKind.GRID, 0.125, by_coarseness=True), np.array([0, 1, 3]))
    torch.testing.assert_close(back[:, 0], torch.tensor([0.75, 0.75, 1.0]))
    with pytest.raises(ValueError, match="lacks"):
        restored(x, Coding(TensorKind.GRID, 0.125, by_coarseness=True))


@pytest.mark.parametrize("values", [torch.tensor([0, 7]), torch.tensor([-1, 0]), torch.tensor([0])])
def test_coarseness_is_checked(values: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="coarseness"):
        checked_coarseness(values, 2)


@given(
    st.sampled_from(list(TensorKind)),
    st.floats(allow_nan=True, allow_infinity=True) | st.just(0.03125),
    st.booleans(),
)
@settings(deadline=None, max_examples=40)
def test_a_coding_is_sound_or_refused(kind: TensorKind, step: float, by_coarseness: bool) -> None:
    try:
        coding = Coding(kind, step, by_coarseness)
    except ValueError:
        return
    x = torch.tensor([[1.0, 0.5, -0.5, 0.0]]).repeat(2, 1)
    back = restored(x, coding, np.array([0, 1]))
    assert torch.isfinite(back).all()


def test_coarseness_is_no_group() -> None:
    assert group_of(COARSENESS, torch.zeros(100, dtype=torch.uint8)) is None


def read_again(
    x: torch.Tensor, coding: Coding, coarseness: np.ndarray | None = None
) -> torch.Tensor:
    """``x`` as a file gives it back: through bytes, laid out as ``packed`` chose."""
    whole = to_whole(x, coding, coarseness)
    packing, data = packed(whole.numbers)
    numbers = unpacked(packing, data, whole.numbers.shape)
    return from_whole(Whole(numbers, whole.far), coding, x.dtype, coarseness)


def test_far_values_are_exact_in_columns_too() -> None:
    """Columns that repeat make ``packed`` lay the numbers out by columns."""
    x = torch.arange(3.0).repeat(400, 1) * 100
    x[7, 1] = 3e9
    x[399, 2] = -4e20
    whole = to_whole(x, Coding(TensorKind.GRID, 0.5))
    packing, data = packed(whole.numbers)
    assert not packing.by_rows
    numbers = unpacked(packing, data, (400, 3))
    assert torch.equal(
        from_whole(Whole(numbers, whole.far), Coding(TensorKind.GRID, 0.5), torch.float32), x
    )


NUMBERS = st.floats(-3, 3, width=32) | st.floats(width=32, allow_nan=False, allow_infinity=False)
SHAPES = st.lists(st.integers(0, 40), min_size=1, max_size=4).filter(
    lambda shape: np.prod(shape) <= 20_000
)
NAMES = st.sampled_from(
    [f"gaussians.{name}" for name in ("means", "log_scales", "sh_base", "sh_rest")]
    + ["model.field.learned.space0", "model.filter_std", "model.masks.times", *FIXED_STEPS]
)


@st.composite
def tensors_of_some_kind(draw: st.DrawFn) -> torch.Tensor:
    """Of any shape: columns or rows that repeat, values of any size among ordinary ones."""
    shape = draw(SHAPES)
    pool = np.array(draw(st.lists(NUMBERS, min_size=1, max_size=8)), dtype=np.float32)
    generator = np.random.default_rng(draw(st.integers(0, 9)))
    x = (
        generator.choice(pool, shape)
        if draw(st.booleans())
        else np.broadcast_to(generator.choice(pool, shape[1:]), shape)
    )
    return torch.from_numpy(x.astype(np.float32))


@given(tensors_of_some_kind(), NAMES, st.floats(1e-9, 1e9), st.booleans())
@settings(deadline=None, max_examples=150)
def test_any_tensor_comes_back_within_its_bound(
    x: torch.Tensor, name: str, step: float, by_coarseness: bool
) -> None:
    """Half a step (0.65 of one where zero is preferred), 11 bits where there is no step; exact
    where out of reach."""
    group = group_of(name, x)
    coding = coding_of(name, x, {} if group is None else {group: step}, by_coarseness=by_coarseness)
    rows = np.arange(len(x)) % (MAX_COARSENESS + 1) if coding.by_coarseness else None
    error = (read_again(x, coding, rows).double() - x.double()).abs()
    if coding.kind is TensorKind.EXACT:
        assert torch.equal(error, torch.zeros_like(error))
    elif coding.kind is TensorKind.HALF:
        assert float(x.abs().max()) <= LARGEST_HALF
        assert bool((error <= 2.0**-11 * x.double().abs() + 2.0**-25).all())
    else:
        steps = torch.as_tensor(coding.steps(rows, x.ndim)).double()
        fraction = 0.65 if coding.kind is TensorKind.SPARSE else 0.5
        assert is_step(coding.step)
        assert bool((error <= fraction * steps * (1 + 1e-12)).all())
        assert bool((error[(x.double().abs() >= LIMIT * steps)] == 0).all())


@given(
    st.sampled_from(
        [torch.int64, torch.int32, torch.uint8, torch.bool, torch.float64, torch.float16]
    ),
    st.data(),
)
@settings(deadline=None, max_examples=60)
def test_any_other_tensor_comes_back_as_it_was(dtype: torch.dtype, source: st.DataObject) -> None:
    shape = source.draw(SHAPES)
    bits = np.random.default_rng(source.draw(st.integers(0, 9))).integers(
        -(2**63), 2**63, shape, dtype=np.int64
    )
    bits = bits if source.draw(st.booleans()) else np.broadcast_to(bits[:1], shape).copy()
    x = torch.from_numpy(bits)
    x = (x.view(dtype) if dtype.itemsize == 8 else x.to(dtype)).nan_to_num()
    coding = coding_of("model.anything", x, {})
    assert coding.kind is TensorKind.EXACT
    assert torch.equal(read_again(x, coding), x)


@given(tensors_of_some_kind(), st.floats(1e-9, 1.0))
@settings(deadline=None, max_examples=60)
def test_any_rotation_and_any_opacity_comes_back(x: torch.Tensor, step: float) -> None:
    quats = x.reshape(-1)[: x.numel() // 4 * 4].reshape(-1, 4)
    coding = coding_of("gaussians.quats", quats, {"gaussians.quats": step})
    unit = torch.nn.functional.normalize(read_again(quats, coding).double(), dim=1)
    wide = torch.where(quats.any(1, keepdim=True), quats, torch.tensor([1.0, 0, 0, 0])).double()
    wide = wide / wide.abs().amax(1, keepdim=True)
    before, after = (_axes(q) for q in (torch.nn.functional.normalize(wide, dim=1), unit))
    assert bool(((before - after).abs() <= 4 * coding.step + 1e-6).all())
    coding = coding_of("gaussians.logit_opacities", x, {"gaussians.logit_opacities": step})
    error = (read_again(x, coding).double().sigmoid() - x.double().sigmoid()).abs()
    assert bool((error <= 0.5 * coding.step + 1e-7).all())


def _axes(quats: torch.Tensor) -> torch.Tensor:
    """(N, 3, 3) projectors onto the axes of unit quaternions wxyz: the same for all signs of the
    axes."""
    w, x, y, z = quats.unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    turns = torch.stack(rows, dim=1).unflatten(1, (3, 3))
    return torch.einsum("nik,njk->nkij", turns, turns).flatten(1)


@given(st.integers(65, 300), st.floats(1e-12, 1e-3))
def test_radii_are_never_rounded_to_nothing(count: int, smallest: float) -> None:
    """Also where steps are coarse and one is tiny beside the others."""
    radii = torch.linspace(smallest, 1.0, count)
    name = "model.field.buffers.radii"
    assert group_of(name, radii) is None
    assert torch.equal(restored(radii, coding_of(name, radii, {name: 0.5})), radii)


ROWS = (0, 2, 3, 6)


def moving(kind: str) -> tuple[DynamicScene, DynamicModel]:
    """A scene of which some Gaussians move, and its model."""
    field = stirred_field(kind, len(ROWS))
    scene = DynamicScene(
        gaussians=cloud(9), seen_at=(0.0, 1.0), field=field, moving=torch.tensor(ROWS)
    )
    return scene, DynamicModel(deform=tiny_options(kind))


def stored(scene: GaussianScene) -> dict[str, torch.Tensor]:
    """What a file holds of a scene, in its order."""
    return drawable(scene.edited(stored_edit(scene, scene.gaussians.means.numpy())))


def read(tensors: dict[str, torch.Tensor], model: DynamicModel) -> DynamicScene:
    """The scene of what a file holds."""
    full = completed(tensors)
    return DynamicScene.restored(
        model, Gaussians(**part_of(full, "gaussians")), part_of(full, "model")
    )


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_the_stored_form_looks_the_same(kind: str) -> None:
    scene, model = moving(kind)
    kept = stored(scene)
    assert not [name for name in kept if "exp_avg" in name]
    again = read(kept, model)
    for time in (0.0, 0.7):
        # Blending goes by depth, not by order: what differs is the last bits of turned axes.
        torch.testing.assert_close(
            again.render(camera(), time).rgb, scene.render(camera(), time).rgb, atol=1e-5, rtol=0
        )


def test_what_moves_is_in_front_and_followed() -> None:
    scene, _ = moving("control_nodes")
    kept = stored(scene)
    assert kept["model.rows"].tolist() == list(range(len(ROWS)))
    place = {tuple(mean): i for i, mean in enumerate(scene.gaussians.means.tolist())}
    came_from = [
        ROWS.index(place[tuple(mean)]) for mean in kept["gaussians.means"][: len(ROWS)].tolist()
    ]
    name = "model.field.buffers.followed"
    assert torch.equal(kept[name], scene.state()[name].tensor[came_from])


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_training_state_is_left_out(kind: str) -> None:
    scene, _ = moving(kind)
    for_training = {name for name, x in scene.state().items() if x.role is Role.TRAINING}
    assert any("exp_avg" in name for name in for_training)
    assert for_training.isdisjoint(drawable(scene))
    still = StaticScene(gaussians=scene.gaussians)
    assert {name for name in drawable(still) if not name.startswith("gaussians.")} == set()


def person(weights: torch.Tensor, corrections: torch.Tensor) -> HumanScene:
    """Two Gaussians on the first two of 24 joints, with learned corrections of their weights (2,
    2)."""
    times = torch.zeros(1).double()
    poses = torch.zeros(1, 24, 3)
    zeros = torch.zeros(2)
    clip = MotionClip(times, poses, torch.zeros(1, 3), torch.ones(1))
    anchors = Anchors(
        points=torch.zeros(2, 3),
        size=torch.ones(2),
        joints=torch.tensor([[0, 1], [0, 1]]),
        weights=weights,
        face=zeros.long(),
        barycentric=torch.ones(2, 3) / 3,
        uv=torch.zeros(2, 2),
        height=zeros,
    )
    skeleton = Skeleton(torch.zeros(24, 3), (-1, *[0] * 23))
    learned = new_corrections(clip, skeleton, anchors)
    learned.values()["weights"].copy_(corrections)
    gaussians = cloud(2).replace(sh=torch.zeros(2, 1, 3))
    return HumanScene(
        gaussians=gaussians, anchors=anchors, skeleton=skeleton, clip=clip, learned=learned
    )


def test_corrections_of_skinning_weights_are_applied() -> None:
    weights = torch.tensor([[0.75, 0.25], [1.0, 0.0]])
    corrections = torch.tensor([[0.0, 3.0]]).log1p().repeat(2, 1)
    full = completed(drawable(person(weights, corrections)))
    torch.testing.assert_close(
        full["model.anchors.weights"], torch.tensor([[3 / 7, 4 / 7], [1.0, 0.0]])
    )
    again = HumanScene.restored(Gaussians(**part_of(full, "gaussians")), part_of(full, "model"))
    assert not again.learned["weights"].any()


def test_what_is_not_finite_is_refused() -> None:
    gaussians = cloud(3)
    gaussians.means[1, 1] = torch.nan
    with pytest.raises(DyngsError, match="means is not finite"):
        drawable(StaticScene(gaussians=gaussians))


def masked() -> tuple[DynamicScene, DynamicModel]:
    """As ``moving``; each Gaussian is seen at one of three key times."""
    scene, model = moving("control_nodes")
    masks = VisibilityMasks.pack(
        (0.0, 0.5, 1.0), torch.arange(9)[None] % 3 == torch.arange(3)[:, None]
    )
    return replace(scene, masks=masks), model


def test_masks_follow_their_gaussians() -> None:
    scene, model = masked()
    kept = stored(scene)
    assert not torch.equal(kept["gaussians.means"], scene.gaussians.means)
    again = read(kept, model)
    for time in (0.1, 0.8):
        expected = scene.render(camera(), time).rgb
        torch.testing.assert_close(again.render(camera(), time).rgb, expected, atol=1e-5, rtol=0)
        assert not torch.allclose(scene.unmasked().render(camera(), time).rgb, expected, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("times", torch.tensor(0.5)),
        ("times", torch.tensor([0.0, 0.5, 0.5])),
        ("times", torch.tensor([0.0, 1.0])),
        ("bits", torch.zeros(3, 1, dtype=torch.uint8)),
        ("bits", torch.zeros(3, 2, dtype=torch.int64)),
        ("count", torch.tensor([8])),
        ("count", torch.tensor([[9, 9]])),
    ],
)
def test_masks_of_other_gaussians_are_refused(name: str, value: torch.Tensor) -> None:
    scene, model = masked()
    kept = stored(scene)
    read(kept, model)
    with pytest.raises(ValueError, match="masks are not those of the Gaussians"):
        read(kept | {f"model.masks.{name}": value}, model)


FLOATS = st.floats(-(2.0**100), 2.0**100, width=32)
STEPS = st.floats(1e-20, 1e10).map(step_below)
QUATS = nps.arrays(
    np.float32, st.tuples(st.integers(0, 8), st.just(4)), elements=st.floats(-10, 10, width=32)
)


def covariances(quats: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """(N, 3, 3) of Gaussians, by scipy."""
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix() * np.exp(log_scales)[:, None]
    return turns @ turns.transpose(0, 2, 1)


@given(st.floats(1e-25, 1e15))
def test_steps_are_the_next_smaller_ones(step: float) -> None:
    found = step_below(step)
    assert found <= step < found * 1.25 + 1e-300
    assert is_step(found)
    assert step_below(found) == found
    assert math.frexp(found)[0] * 8 in (4, 5, 6, 7)


@given(nps.arrays(np.float32, st.integers(0, 20), elements=FLOATS), STEPS)
def test_grid_is_near_and_stable(values: np.ndarray, step: float) -> None:
    whole, far = to_grid(values, step)
    back = from_grid(whole, step).astype(np.float32)
    assert (np.abs(back.astype(float) - values)[~far] <= step / 2).all()
    assert (np.abs(values[far]) >= (LIMIT - 2) * step).all()
    again, _ = to_grid(back, step)
    assert np.array_equal(whole, again)


def test_sparse_rounding_prefers_zero() -> None:
    whole, _ = to_grid(np.array([0.6, -0.6, 0.7, 1.7]), 1.0, SPARSE)
    assert whole.tolist() == [0, 0, 1, 2]


@given(
    nps.arrays(np.float32, st.integers(0, 20), elements=FLOATS),
    st.sampled_from((2**-12, 5 * 2**-8, 7 * 2**-6, 1 / 8)),
)
def test_opacities_are_finite_near_and_stable(logits: np.ndarray, step: float) -> None:
    whole = opacities_to_grid(logits, step)
    back = opacities_from_grid(whole, step).astype(np.float32)
    assert np.isfinite(back).all()
    before, after = (1 / (1 + np.exp(-np.clip(x.astype(float), -700, 700))) for x in (logits, back))
    assert (np.abs(before - after) <= 0.63 * step).all()  # half a step, and an eighth at the ends
    assert np.array_equal(whole, opacities_to_grid(back, step))


def test_what_is_not_drawn_stays_so() -> None:
    for step in OPACITY_STEPS:
        hidden = opacities_from_grid(opacities_to_grid(np.array([-1e4]), step), step)
        assert 1 / (1 + math.exp(-hidden[0])) <= step / 8 * (1 + 1e-9)


@given(QUATS, st.floats(1e-5, ROTATION_STEP).map(step_below))
@settings(deadline=None, max_examples=40)
def test_rotations_are_stable_and_turn_axes_into_axes(quats: np.ndarray, step: float) -> None:
    whole = rotations_to_grid(quats, step)
    back = rotations_from_grid(whole, step).astype(np.float32)
    assert np.array_equal(whole, rotations_to_grid(back, step))
    usable = np.linalg.norm(quats.astype(float), axis=1) > 1e-3
    scales = np.tile([0.0, -1.0, -2.0], (int(usable.sum()), 1))
    exact = covariances(quats[usable], scales)
    coarse = covariances(back[usable], scales)
    assert (
        np.abs(exact - coarse).max(initial=0) < 8 * step
    )  # sqrt(3)/2 step, over a scalar part of 3/8, twice the angle


def test_zero_quaternions_are_the_identity() -> None:
    assert rotations_from_grid(
        rotations_to_grid(np.zeros((1, 4)), ROTATION_STEP), ROTATION_STEP
    ).tolist() == [[1, 0, 0, 0]]


@pytest.mark.parametrize(
    "order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
)
def test_sorting_axes_keeps_the_gaussian(order: tuple[int, int, int]) -> None:
    quats = np.random.default_rng(2).normal(size=(1, 4))
    log_scales = np.array([[-2.0, -1.0, 0.5]])[:, order]
    turned, ordered = sorted_axes(quats, log_scales)
    assert ordered.tolist() == [[-2.0, -1.0, 0.5]]
    np.testing.assert_allclose(
        covariances(turned, ordered), covariances(quats, log_scales), atol=1e-12
    )
