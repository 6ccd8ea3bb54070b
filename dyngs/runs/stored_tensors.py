"""The tensors that a .dyngs file stores of a scene, and their conversion to integers and back.

They have the names of checkpoints (``gaussians.means``, ``model.rows``), but for the harmonics,
which are stored as ``gaussians.sh_base`` (N, 3) and ``gaussians.sh_rest`` (N, K - 1, 3).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from enum import Enum

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.core.gaussians import storage_order
from dyngs.core.state import tensors_of
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.models.renderable import Renderable
from dyngs.ops.quaternions import quat_product

LIMIT = 2**20  # bound on the magnitude of the integers; larger values are stored as they are
SMALLEST_STEP = 2.0**-100
LARGEST_STEP = 2.0**60
NEAREST, SPARSE = 0.5, 0.35
"""Added before rounding down: to the nearest integer, or biased to zero, which costs least to
store."""
# coarsest step for rotations, at which the component left out stays the largest
ROTATION_STEP = 1 / 32
# finest step for rotations, at which the components of a unit quaternion are within LIMIT
FINEST_ROTATION = 2.0**-19
OPACITY_STEPS = 2.0**-12, 1 / 8  # finest and coarsest step for opacities


def step_below(step: float) -> float:
    """Return the largest allowed step that does not exceed ``step``, or the smallest one."""
    fraction, exponent = math.frexp(min(max(step, SMALLEST_STEP), LARGEST_STEP))
    return math.ldexp(math.floor(8 * fraction) / 8, exponent)


def is_step(step: float) -> bool:
    """Return whether ``step`` is one of those allowed."""
    return SMALLEST_STEP <= step <= LARGEST_STEP and step_below(step) == step


Steps = float | np.ndarray  # one step for all, or one per row, of a shape that broadcasts


def to_grid(
    values: np.ndarray, step: Steps, rounding: float = NEAREST
) -> tuple[np.ndarray, np.ndarray]:
    """Return int32 multiples of ``step`` nearest to ``values``, and where they are out of reach
    (there they are 0).

    ``rounding``: ``NEAREST`` or ``SPARSE``.
    """
    scaled = np.asarray(values, dtype=np.float64) / step
    far = ~(np.abs(scaled) < LIMIT - 1)
    scaled[far] = 0
    return (np.sign(scaled) * np.floor(np.abs(scaled) + rounding)).astype(np.int32), far


def from_grid(whole: np.ndarray, step: Steps) -> np.ndarray:
    """Return float64 values, exact in float32."""
    return whole.astype(np.float64) * step


def opacities_to_grid(logits: np.ndarray, step: float) -> np.ndarray:
    """Return int32 multiples of ``step`` nearest to the opacities of ``logits``."""
    opacities = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -700, 700)))
    return np.floor(opacities / step + 0.5).astype(np.int32)


def opacities_from_grid(whole: np.ndarray, step: float) -> np.ndarray:
    """Return float64 logits; finite, as 0 becomes an eighth of a step (not drawn) and 1 a little
    less than 1."""
    opacities = np.clip(from_grid(whole, step), step / 8, 1 - step / 64)
    return np.log(opacities) - np.log1p(-opacities)


def rotations_to_grid(quats: np.ndarray, step: float) -> np.ndarray:
    """Return (N, 3) int32 multiples of ``step``: vector parts of unit quaternions with an about
    largest scalar part.

    Half turns about its own axes do not change a Gaussian: of the four quaternions one with a large
    scalar part is taken. A zero quaternion is the identity. Coded again, the result stays the same.
    ``step``: at most ``ROTATION_STEP``.
    """
    turned = quats.astype(np.float64)
    while True:
        whole, _ = to_grid(_scalar_largest(turned, 4 * step)[:, 1:], step)
        turned = rotations_from_grid(whole, step)
        # A turn gains four steps of the scalar part, rounding loses fewer: this ends.
        again, _ = to_grid(_scalar_largest(turned, 4 * step)[:, 1:], step)
        if np.array_equal(whole, again):
            return whole


def rotations_from_grid(whole: np.ndarray, step: float) -> np.ndarray:
    """Return (N, 4) unit quaternions wxyz, float64."""
    vector = from_grid(whole, step)
    scalar = np.sqrt(np.clip(1 - np.square(vector).sum(1), 0, None))
    return np.concatenate([scalar[:, None], vector], axis=1)


def sorted_axes(quats: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same N Gaussians with their shortest axis first and their longest last.

    ``quats``: (N, 4) wxyz; zero is the identity. ``log_scales``: (N, 3).
    """
    order = np.argsort(log_scales, axis=1, kind="stable")
    turns = np.zeros((27, 4))
    for (first, second, third), turn in _AXIS_TURNS.items():
        turns[9 * first + 3 * second + third] = turn
    return _product(_unit(quats), turns[order @ (9, 3, 1)]), np.take_along_axis(
        log_scales, order, axis=1
    )


_HALF = 0.5
_ROOT = math.sqrt(0.5)
_AXIS_TURNS = {
    (0, 1, 2): (1.0, 0.0, 0.0, 0.0),
    (0, 2, 1): (_ROOT, _ROOT, 0.0, 0.0),
    (2, 1, 0): (_ROOT, 0.0, _ROOT, 0.0),
    (1, 0, 2): (_ROOT, 0.0, 0.0, _ROOT),
    (1, 2, 0): (_HALF, _HALF, _HALF, _HALF),
    (2, 0, 1): (_HALF, -_HALF, -_HALF, -_HALF),
}
"""For each order of the axes, the rotation wxyz whose columns are the axes in this order, up to
signs."""


def _scalar_largest(quats: np.ndarray, margin: float) -> np.ndarray:
    """Return (N, 4) unit quaternions of the same axes, scalar part positive, at most ``margin``
    below the largest."""
    unit = _unit(quats)
    size = np.abs(unit)
    size[:, 0] += margin
    half_turns = np.eye(4)[size.argmax(1)]
    turned = _product(unit, half_turns)
    return np.where(turned[:, :1] < 0, -turned, turned)


def _unit(quats: np.ndarray) -> np.ndarray:
    """Return (N, 4) float64 of unit length; zero becomes the identity."""
    wide = quats.astype(np.float64)
    length = np.sqrt(np.square(wide).sum(1, keepdims=True))
    return np.where(length > 0, wide / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return quat_product(torch.from_numpy(left), torch.from_numpy(right)).numpy()


class TensorKind(str, Enum):
    """Ways to convert values to integers."""

    EXACT = "exact"
    HALF = "half"
    GRID = "grid"
    SPARSE = "sparse"
    OPACITY = "opacity"
    ROTATION = "rotation"


FIELD = "model.field.learned."  # prefix of the learned tensors of a deformation field
TRIANGLES = "triangles.points"  # what a scene of triangles has in place of Gaussians
GAUSSIANS = tuple(field.name for field in fields(Gaussians))
# most octaves by which the colour steps of a hardly visible Gaussian exceed those of the others
MAX_COARSENESS = 6
COARSENESS = "gaussians.coarseness"
_BY_COARSENESS = ("gaussians.sh_base", "gaussians.sh_rest")
_KINDS = {
    "gaussians.quats": TensorKind.ROTATION,
    "gaussians.logit_opacities": TensorKind.OPACITY,
    "gaussians.sh_rest": TensorKind.SPARSE,
    "triangles.harmonics": TensorKind.SPARSE,
}
_LIMITS = {TensorKind.ROTATION: (SMALLEST_STEP, ROTATION_STEP), TensorKind.OPACITY: OPACITY_STEPS}
FEW = 64  # number of values up to which tensors are stored as they are
LARGEST_HALF = 65504.0
# largest fraction of values out of the integer range; with more, all are stored as they are
MOST_FAR = 1 / 8
RELATIVE = "model.filter_std"  # stored in half precision: it spans orders of magnitude
POSITIVE = "model.field.buffers.radii"
"""Stored as they are: a radius of influence that is rounded to 0 has no meaning, and there are
few."""
FIXED_STEPS = {
    "model.anchors.points": 2.0**-9,
    "model.anchors.size": 2.0**-13,
    "model.anchors.height": 2.0**-10,
    "model.anchors.uv": 2.0**-9,
    "model.anchors.barycentric": 2.0**-6,
}
"""Steps of a person's anchors on the template, m or shares: images hardly depend on them."""


@dataclass(frozen=True)
class Coding:
    """Kind and precision with which one tensor is stored."""

    kind: TensorKind  # of its numbers
    step: float = 0.0  # 0 for the kinds that have none
    by_coarseness: bool = False  # the step of row i is ``2 ** coarseness[i]`` times as large

    def __post_init__(self) -> None:
        has_step = self.kind not in (TensorKind.EXACT, TensorKind.HALF)
        low, high = _LIMITS.get(self.kind, (SMALLEST_STEP, LARGEST_STEP))
        fits = is_step(self.step) and low <= self.step <= high if has_step else self.step == 0
        if not fits or (
            self.by_coarseness and self.kind not in (TensorKind.GRID, TensorKind.SPARSE)
        ):
            raise ValueError(f"no such coding: {self}")

    def steps(self, coarseness: np.ndarray | None, num_axes: int) -> Steps:
        """Return the step, or one per row, broadcast to ``num_axes`` axes."""
        if not self.by_coarseness:
            return self.step
        if coarseness is None:
            raise ValueError("the coarseness of its rows lacks")
        return (self.step * 2.0 ** coarseness.astype(np.float64)).reshape(-1, *[1] * (num_axes - 1))


@dataclass(frozen=True)
class Whole:
    """A tensor as integers."""

    numbers: np.ndarray  # int64, the shape of the tensor; (N, 3) for rotations
    # (K, 2) int64, index into the flat numbers and float32 bits of the values that no whole number
    # reaches
    far: np.ndarray


def drawable(scene: Renderable) -> dict[str, Tensor]:
    """Return the tensors for drawing in an equivalent form that is cheaper to store: axes sorted by
    length.

    Not those of Gaussians whose axes a field changes one by one. Raises DyngsError: a value is not
    finite, or there are neither Gaussians nor triangles.
    """
    kept = tensors_of(scene.drawing_state())
    for name, x in kept.items():
        if x.is_floating_point() and not bool(torch.isfinite(x).all()):
            raise DyngsError(f"{name.partition('.')[2]} is not finite; it cannot be stored")
    if TRIANGLES in kept:
        return kept
    scene = require_gaussians(scene, "this scene")
    sh = kept.pop("gaussians.sh")
    kept |= {"gaussians.sh_base": sh[:, 0], "gaussians.sh_rest": sh[:, 1:]}
    sorts = torch.ones(len(sh), dtype=torch.bool, device=sh.device)
    sorts[scene.offset_rows] = False
    quats, log_scales = sorted_axes(
        kept["gaussians.quats"][sorts].numpy(), kept["gaussians.log_scales"][sorts].numpy()
    )
    for name, values in (("gaussians.quats", quats), ("gaussians.log_scales", log_scales)):
        kept[name] = kept[name].clone()
        kept[name][sorts] = torch.from_numpy(values).to(kept[name])
    return kept


def completed(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint that can be drawn, but not trained on, from stored ones.

    Raises KeyError: one is missing that every scene of Gaussians has. ValueError: the tensors of
    these do not fit together. Those of triangles are looked at where they are restored.
    """
    full = dict(tensors)
    if TRIANGLES in full:
        return full
    base = full.pop("gaussians.sh_base")
    rest = full.pop("gaussians.sh_rest")
    full["gaussians.sh"] = torch.cat([base[:, None], rest], dim=1)
    Gaussians(**{name: full[f"gaussians.{name}"] for name in GAUSSIANS})  # they must fit together
    return full


def stored_edit(scene: GaussianScene, means: np.ndarray) -> TopologyEdit:
    """Return the edit that puts Gaussians next to their neighbours in space, first those that a
    field moves.

    ``means``: (N, 3) as they will be read again, which decide the order.
    """
    return TopologyEdit.select(torch.from_numpy(storage_order(means, scene.offset_rows.numpy())))


def group_of(name: str, x: Tensor) -> str | None:
    """Return the name of the group that shares a step, without the number at its end; None where
    there is no step."""
    if x.dtype != torch.float32 or name in (RELATIVE, POSITIVE) or name in FIXED_STEPS:
        return None
    if x.numel() <= FEW and not name.startswith("gaussians."):
        return None
    return name.rstrip("0123456789")


def coding_of(
    name: str, x: Tensor, steps: Mapping[str, float], *, by_coarseness: bool = False
) -> Coding:
    """Return the coding of a tensor.

    ``steps``: group (or name, where it has none) to the largest step, 0 for none: stored as it is;
    a group that lacks is stored in half precision.
    """
    if name == POSITIVE or steps.get(group_of(name, x) or name) == 0:
        return Coding(TensorKind.EXACT)
    if name in FIXED_STEPS:
        return Coding(TensorKind.GRID, FIXED_STEPS[name])
    group = group_of(name, x)
    if group is None or group not in steps:
        fits = x.dtype == torch.float32 and x.numel() > FEW and float(x.abs().max()) <= LARGEST_HALF
        return Coding(TensorKind.HALF if fits else TensorKind.EXACT)
    kind = _KINDS.get(name, TensorKind.GRID)
    low, high = _LIMITS.get(kind, (SMALLEST_STEP, LARGEST_STEP))
    # files with finer ones are still read
    low = max(low, FINEST_ROTATION) if kind is TensorKind.ROTATION else low
    step = step_below(min(max(steps[group], low), high))
    if (
        kind in (TensorKind.GRID, TensorKind.SPARSE)
        and int((x.abs() >= LIMIT * step).sum()) > MOST_FAR * x.numel()
    ):
        return Coding(TensorKind.EXACT)
    return Coding(kind, step, by_coarseness and name in _BY_COARSENESS)


def to_whole(x: Tensor, coding: Coding, coarseness: np.ndarray | None = None) -> Whole:
    """Return ``x`` as integers; ``coarseness`` (N,) of its rows, where they have any."""
    values = x.detach().contiguous().numpy()
    far = np.zeros((0, 2), dtype=np.int64)
    if coding.kind is TensorKind.ROTATION:
        numbers = rotations_to_grid(values, coding.step)
    elif coding.kind is TensorKind.OPACITY:
        numbers = opacities_to_grid(values, coding.step)
    elif coding.kind in (TensorKind.GRID, TensorKind.SPARSE):
        steps = coding.steps(coarseness, values.ndim)
        numbers, out = to_grid(
            values, steps, SPARSE if coding.kind is TensorKind.SPARSE else NEAREST
        )
        index = np.flatnonzero(out)
        bits = values.astype(np.float32).ravel()[index].view(np.int32)
        far = np.stack([index, bits.astype(np.int64)], axis=1)
    else:
        numbers = _bits(values.astype(np.float16) if coding.kind is TensorKind.HALF else values)
    return Whole(numbers.astype(np.int64), far)


def from_whole(
    whole: Whole, coding: Coding, dtype: torch.dtype, coarseness: np.ndarray | None = None
) -> Tensor:
    """Return the tensor that ``to_whole`` turned into integers.

    Raises ValueError, OverflowError: numbers that ``to_whole`` does not make.
    """
    if coding.kind is TensorKind.ROTATION:
        return torch.from_numpy(rotations_from_grid(whole.numbers, coding.step)).to(dtype)
    if coding.kind is TensorKind.OPACITY:
        return torch.from_numpy(opacities_from_grid(whole.numbers, coding.step)).to(dtype)
    if coding.kind in (TensorKind.GRID, TensorKind.SPARSE):
        steps = coding.steps(coarseness, whole.numbers.ndim)
        # numbers that were laid out by columns are no flat array until they are copied into one
        values = np.ascontiguousarray(from_grid(whole.numbers, steps), dtype=np.float32)
        if (
            len(whole.far)
            and not 0 <= int(whole.far[:, 0].min()) <= int(whole.far[:, 0].max()) < values.size
        ):
            raise ValueError("a value lies outside its tensor")
        values.reshape(-1)[whole.far[:, 0]] = whole.far[:, 1].astype(np.int32).view(np.float32)
        return torch.from_numpy(values).to(dtype)
    stored = torch.float16 if coding.kind is TensorKind.HALF else dtype
    return _from_bits(whole.numbers, stored).to(dtype)


def restored(x: Tensor, coding: Coding, coarseness: np.ndarray | None = None) -> Tensor:
    """Return ``x`` as it is read back."""
    return from_whole(to_whole(x, coding, coarseness), coding, x.dtype, coarseness)


def checked_coarseness(values: Tensor, count: int) -> np.ndarray:
    """Return (N,) integers from 0 to ``MAX_COARSENESS``. Raises ValueError for anything else."""
    whole = values.to(torch.int64).numpy()
    if whole.shape != (count,) or (count and not 0 <= whole.min() <= whole.max() <= MAX_COARSENESS):
        raise ValueError("its coarseness is not one small number per Gaussian")
    return whole


def _bits(values: np.ndarray) -> np.ndarray:
    """Return int64 of the same shape: integers as they are, the bits of others."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    return values.view(f"i{values.itemsize}").astype(np.int64)


def _from_bits(numbers: np.ndarray, dtype: torch.dtype) -> Tensor:
    if not dtype.is_floating_point:
        return torch.from_numpy(np.ascontiguousarray(numbers)).to(dtype)
    bits = {2: torch.int16, 4: torch.int32, 8: torch.int64}[dtype.itemsize]
    return torch.from_numpy(np.ascontiguousarray(numbers)).to(bits).view(dtype)
