"""How tensors are kept: by their names, within their steps, and what is out of reach exactly."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from moving_scene import camera
from scipy.spatial.transform import Rotation
from tiny_fields import ALL_KINDS, cloud, stirred_field, tiny_options

from dyngs.core.errors import DyngsError
from dyngs.core.state import select_prefix
from dyngs.deform.keys import DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.runs.stored_file import (
    FIXED_STEPS,
    LARGEST_HALF,
    LIMIT,
    MAX_COARSENESS,
    ROTATION_STEP,
    Coding,
    choose_coding,
    dequantize_tensor,
    opacities_from_grid,
    opacities_to_grid,
    pack_integers,
    quantize_tensor,
    rotations_from_grid,
    rotations_to_grid,
    round_step_down,
    sort_axes,
    step_group,
    storage_edit,
    tensors_to_store,
    to_checkpoint_tensors,
    to_grid,
    unpack_integers,
)


def read_again(
    x: torch.Tensor, coding: Coding, coarseness: np.ndarray | None = None
) -> torch.Tensor:
    """``x`` as a file gives it back: through bytes, laid out as ``pack_integers`` chose."""
    numbers, far = quantize_tensor(x, coding, coarseness)
    packing, data = pack_integers(numbers)
    back = unpack_integers(packing, data, numbers.shape)
    return dequantize_tensor(back, far, coding, str(x.dtype).removeprefix("torch."), coarseness)


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
    group = step_group(name, x)
    coding = choose_coding(
        name, x, {} if group is None else {group: step}, by_coarseness=by_coarseness
    )
    rows = np.arange(len(x)) % (MAX_COARSENESS + 1) if coding.by_coarseness else None
    error = (read_again(x, coding, rows).double() - x.double()).abs()
    if coding.kind == "exact":
        assert torch.equal(error, torch.zeros_like(error))
    elif coding.kind == "half":
        assert float(x.abs().max()) <= LARGEST_HALF
        assert bool((error <= 2.0**-11 * x.double().abs() + 2.0**-25).all())
    else:
        steps = torch.as_tensor(coding.steps(rows, x.ndim)).double()
        fraction = 0.65 if coding.kind == "sparse" else 0.5
        assert round_step_down(coding.step) == coding.step
        assert bool((error <= fraction * steps * (1 + 1e-12)).all())
        assert bool((error[(x.double().abs() >= LIMIT * steps)] == 0).all())


ROWS = (0, 2, 3, 6)


def moving(kind: str) -> tuple[DynamicScene, DynamicModel]:
    """A scene of which some Gaussians move, and its model."""
    field = stirred_field(kind, len(ROWS))
    scene = DynamicScene(
        gaussians=cloud(9), training_times=(0.0, 1.0), field=field, moving=torch.tensor(ROWS)
    )
    return scene, DynamicModel(deform=tiny_options(kind))


def stored(scene: GaussianScene) -> dict[str, torch.Tensor]:
    """Return the tensors that a file stores for a scene, in file order."""
    return tensors_to_store(scene.apply_edit(storage_edit(scene, scene.gaussians.means.numpy())))


def read(tensors: dict[str, torch.Tensor], model: DynamicModel) -> DynamicScene:
    """The scene of what a file holds."""
    full = to_checkpoint_tensors(tensors)
    return DynamicScene.from_state(
        model, Gaussians(**select_prefix(full, "gaussians")), select_prefix(full, "model")
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


def test_non_finite_values_are_refused() -> None:
    gaussians = cloud(3)
    gaussians.means[1, 1] = torch.nan
    with pytest.raises(DyngsError, match="means is not finite"):
        tensors_to_store(StaticScene(gaussians=gaussians))


FLOATS = st.floats(-(2.0**100), 2.0**100, width=32)
STEPS = st.floats(1e-20, 1e10).map(round_step_down)
QUATS = nps.arrays(
    np.float32, st.tuples(st.integers(0, 8), st.just(4)), elements=st.floats(-10, 10, width=32)
)


def covariances(quats: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """(N, 3, 3) of Gaussians, by scipy."""
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix() * np.exp(log_scales)[:, None]
    return turns @ turns.transpose(0, 2, 1)


@given(st.floats(1e-25, 1e15))
def test_steps_are_the_next_smaller_ones(step: float) -> None:
    found = round_step_down(step)
    assert found <= step < found * 1.25 + 1e-300
    assert round_step_down(found) == found
    assert math.frexp(found)[0] * 8 in (4, 5, 6, 7)


@given(nps.arrays(np.float32, st.integers(0, 20), elements=FLOATS), STEPS)
def test_grid_is_near_and_stable(values: np.ndarray, step: float) -> None:
    whole, far = to_grid(values, step)
    back = (whole * step).astype(np.float32)
    assert (np.abs(back.astype(float) - values)[~far] <= step / 2).all()
    assert (np.abs(values[far]) >= (LIMIT - 2) * step).all()
    again, _ = to_grid(back, step)
    assert np.array_equal(whole, again)


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


@given(QUATS, st.floats(1e-5, ROTATION_STEP).map(round_step_down))
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


@pytest.mark.parametrize(
    "order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)]
)
def test_sorting_axes_keeps_the_gaussian(order: tuple[int, int, int]) -> None:
    quats = np.random.default_rng(2).normal(size=(1, 4))
    log_scales = np.array([[-2.0, -1.0, 0.5]])[:, order]
    turned, ordered = sort_axes(quats, log_scales)
    assert ordered.tolist() == [[-2.0, -1.0, 0.5]]
    np.testing.assert_allclose(
        covariances(turned, ordered), covariances(quats, log_scales), atol=1e-12
    )
