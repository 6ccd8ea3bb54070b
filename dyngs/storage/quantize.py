"""Quantisation of numbers to integers and back, with a given step.

Steps are 4, 5, 6 or 7 times a power of two and whole numbers stay below ``LIMIT``, so that the products are exact in
float32: what was decoded is encoded to the same integers again, on any machine.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from dyngs.ops.quaternions import quat_product

LIMIT = 2**20  # bound on the magnitude of the integers; larger values are stored as they are
SMALLEST_STEP, LARGEST_STEP = 2.0**-100, 2.0**60
NEAREST, SPARSE = 0.5, 0.35
"""Added before rounding down: to the nearest integer, or biased to zero, which costs least to store."""
ROTATION_STEP = 1 / 32  # coarsest step for rotations, at which the component left out stays the largest
FINEST_ROTATION = 2.0**-19  # finest step for rotations, at which the components of a unit quaternion are within LIMIT
OPACITY_STEPS = 2.0**-12, 1 / 8  # finest and coarsest step for opacities


def step_below(step: float) -> float:
    """Return the largest allowed step that does not exceed ``step``, or the smallest one."""
    fraction, exponent = math.frexp(min(max(step, SMALLEST_STEP), LARGEST_STEP))
    return math.ldexp(math.floor(8 * fraction) / 8, exponent)


def is_step(step: float) -> bool:
    """Return whether ``step`` is one of those allowed."""
    return SMALLEST_STEP <= step <= LARGEST_STEP and step_below(step) == step


Steps = float | np.ndarray  # one step for all, or one per row, of a shape that broadcasts


def to_grid(values: np.ndarray, step: Steps, rounding: float = NEAREST) -> tuple[np.ndarray, np.ndarray]:
    """Return int32 multiples of ``step`` nearest to ``values``, and where they are out of reach (there they are 0).

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
    """Return float64 logits; finite, as 0 becomes an eighth of a step (not drawn) and 1 a little less than 1."""
    opacities = np.clip(from_grid(whole, step), step / 8, 1 - step / 64)
    return np.log(opacities) - np.log1p(-opacities)


def rotations_to_grid(quats: np.ndarray, step: float) -> np.ndarray:
    """Return (N, 3) int32 multiples of ``step``: vector parts of unit quaternions with an about largest scalar part.

    Half turns about its own axes do not change a Gaussian: of the four quaternions that they make, one with a large
    scalar part is taken. A zero quaternion is the identity. Coded again, the result stays the same. ``quats``: (N, 4)
    wxyz, of any length. ``step``: at most ``ROTATION_STEP``.
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
    return _product(_unit(quats), turns[order @ (9, 3, 1)]), np.take_along_axis(log_scales, order, axis=1)


_HALF, _ROOT = 0.5, math.sqrt(0.5)
_AXIS_TURNS = {
    (0, 1, 2): (1.0, 0.0, 0.0, 0.0),
    (0, 2, 1): (_ROOT, _ROOT, 0.0, 0.0),
    (2, 1, 0): (_ROOT, 0.0, _ROOT, 0.0),
    (1, 0, 2): (_ROOT, 0.0, 0.0, _ROOT),
    (1, 2, 0): (_HALF, _HALF, _HALF, _HALF),
    (2, 0, 1): (_HALF, -_HALF, -_HALF, -_HALF),
}
"""For each order of the axes, the rotation wxyz whose columns are the axes in this order, up to signs."""


def _scalar_largest(quats: np.ndarray, margin: float) -> np.ndarray:
    """Return (N, 4) unit quaternions of the same axes, scalar part positive, at most ``margin`` below the largest."""
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
