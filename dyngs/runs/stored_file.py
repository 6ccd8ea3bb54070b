"""The file ``scene.dyngs``: a header, tensors as integers in LZMA, a checksum.

    8 bytes   b"dyngs\\x00\\x01\\n", the last but one is the version
    4 bytes   length of the header, little endian
    header    LZMA2 of JSON: ``Header``
    data      of the tensors in the order of the header, then zeros
    32 bytes  SHA-256 of all before

Tensors have the names of checkpoints (``gaussians.means``, ``model.rows``), but for the harmonics,
which are stored as ``gaussians.sh_base`` (N, 3) and ``gaussians.sh_rest`` (N, K - 1, 3).

Nothing in it is run. The checksum finds accidents; everything in the header is checked besides, and
no more memory is taken than a file of this size can need.
"""

from __future__ import annotations

import hashlib
import lzma
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from dyngs.core.errors import DyngsError, printable, require_regular
from dyngs.core.gaussians import storage_order
from dyngs.core.state import tensors_of
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.io.write import atomic_file
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
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


_SAMPLE = 2**15  # number of values by which the layout of an array is chosen
_FEW = 512  # number of values below which the layout is not changed
_MAX_PLANES = 8
_SMALLEST_DICTIONARY = 2**12
_LARGEST_DICTIONARY = 2**24


@dataclass(frozen=True)
class Packing:
    """The way an array of integers was packed into bytes."""

    axis: int  # differences along it are stored, -1: the numbers themselves
    by_rows: bool  # rows follow each other, otherwise columns
    signed: bool  # there are negative numbers: 0, -1, 1, -2 ... are stored as 0, 1, 2, 3
    planes: int  # bytes per number; all lowest bytes come first

    def __post_init__(self) -> None:
        if not (-1 <= self.axis <= 1 and 1 <= self.planes <= _MAX_PLANES):
            raise ValueError(f"no such packing: {self}")


def packed(whole: np.ndarray) -> tuple[Packing, bytes]:
    """Return the smallest of some ways to store ``whole`` (int64, any shape) as bytes."""
    if whole.size < _FEW:
        packing, plain = _laid_out(whole, -1, by_rows=True)
        return packing, compressed(plain)
    sample = whole[: max(_SAMPLE // max(whole[:1].size, 1), 64)]
    axes = [-1, *(axis for axis in range(min(whole.ndim, 2)) if whole.shape[axis] > 1)]
    ways = [
        (axis, by_rows)
        for axis in axes
        for by_rows in ((True, False) if whole.ndim > 1 else (True,))
    ]
    sizes = [
        len(compressed(_laid_out(sample, axis, by_rows)[1], quick=True)) for axis, by_rows in ways
    ]
    packing, plain = _laid_out(whole, *ways[int(np.argmin(sizes))])
    return packing, compressed(plain)


def unpacked(packing: Packing, data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Return int64 numbers of ``shape``. Raises DyngsError if the bytes do not hold that many
    numbers."""
    count = math.prod(shape)
    plain = np.frombuffer(decompressed(data, packing.planes * count), dtype=np.uint8).reshape(
        packing.planes, count
    )
    stored = np.zeros(count, dtype=np.uint64)
    for index, plane in enumerate(plain):
        stored |= plane.astype(np.uint64) << np.uint64(8 * index)
    if packing.signed:
        stored = stored >> np.uint64(1) ^ (np.uint64(0) - (stored & np.uint64(1)))
    whole = stored.view(np.int64)
    if not packing.by_rows and count:
        whole = whole.reshape(-1, shape[0]).T
    whole = whole.reshape(shape)
    return (
        whole
        if packing.axis < 0 or packing.axis >= len(shape)
        else np.cumsum(whole, axis=packing.axis)
    )


def compressed(plain: bytes, *, room: int | None = None, quick: bool = False) -> bytes:
    """Return ``plain`` as LZMA2 without headers.

    ``room``: the size that it will be read with, where that is not its own.
    """
    return lzma.compress(
        plain, format=lzma.FORMAT_RAW, filters=_filters(1 if quick else 6, room or len(plain))
    )


def decompressed(data: bytes, size: int, *, exact: bool = True) -> bytes:
    """Return the ``size`` bytes that ``data`` holds (at most so many, if not ``exact``); never
    takes memory for more.

    Raises DyngsError: there are not so many, or something else follows them.
    """
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_filters(6, size))
    try:
        plain = decoder.decompress(data, max_length=size + 1)
    except (lzma.LZMAError, EOFError):
        raise DyngsError("its data cannot be decoded") from None
    if len(plain) > size or (exact and len(plain) < size) or not decoder.eof or decoder.unused_data:
        raise DyngsError("its data is not as long as it says")
    return plain


def _laid_out(whole: np.ndarray, axis: int, by_rows: bool) -> tuple[Packing, bytes]:
    if axis >= 0:
        whole = np.diff(whole, axis=axis, prepend=np.int64(0))
    signed = bool((whole < 0).any())
    stored = (whole << 1 ^ whole >> 63 if signed else whole).view(np.uint64)
    stored = stored.ravel() if by_rows else stored.reshape(len(stored), -1).T.ravel()
    planes = max(1, (int(stored.max(initial=0)).bit_length() + 7) // 8)
    plain = b"".join(
        (stored >> np.uint64(8 * index)).astype(np.uint8).tobytes() for index in range(planes)
    )
    return Packing(axis, by_rows, signed, planes), plain


def _filters(preset: int, size: int) -> list[dict[str, int]]:
    """Return LZMA2 filters with a dictionary for ``size`` bytes: a larger one only costs time and
    memory."""
    dictionary = min(
        max(1 << max(size - 1, 1).bit_length(), _SMALLEST_DICTIONARY), _LARGEST_DICTIONARY
    )
    return [
        {
            "id": lzma.FILTER_LZMA2,
            "preset": preset,
            "dict_size": dictionary,
            "lc": 4,
            "lp": 0,
            "pb": 0,
        }
    ]


MAGIC = b"dyngs\x00\x01\n"
MAX_HEADER = 2**20
FREE_VALUES = 2**22
VALUES_PER_BYTE = 64  # largest number of values in any file, and of further values per byte of it
_CHECKSUM = 32
_FAR_BYTES = 16  # bytes of an index and a value
_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        torch.float16,
        torch.float32,
        torch.float64,
        torch.int32,
        torch.int64,
        torch.uint8,
        torch.bool,
    )
}
_DAMAGED = "damaged or cut off, its checksum differs; copy it again, or export it again"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Info(_Part):
    """``CheckpointInfo``."""

    step: int
    extent: float
    world_offset: tuple[float, float, float]
    background: str
    rasterize_mode: str
    world_scale: float = 1.0


class _Entry(_Part):
    """A tensor: fields of ``Coding`` and ``Packing``, bytes of its numbers, and how many values are
    out of reach."""

    name: str
    dtype: str
    shape: tuple[Annotated[int, Field(ge=0, le=2**40)], ...] = Field(max_length=8)
    kind: TensorKind
    step: float
    by_coarseness: bool
    axis: int
    by_rows: bool
    signed: bool
    planes: int
    size: int = Field(ge=0)
    far: int = Field(ge=0)

    @property
    def stored_shape(self) -> tuple[int, ...]:
        """Shape of the stored integers: rotations are stored as three."""
        return (*self.shape[:-1], 3) if self.kind is TensorKind.ROTATION else self.shape


class _Header(_Part):
    info: _Info
    tensors: tuple[_Entry, ...]


def write_scene(path: Path, data: bytes) -> None:
    """Write the bytes of ``encoded`` atomically. Raises DyngsError for a full disk and the like."""
    with atomic_file(path, durable=True) as temporary:
        temporary.write_bytes(data)


def read_scene(path: Path) -> Checkpoint:
    """Return the checkpoint in a file: the tensors that drawing needs.

    Raises DyngsError: a file that is missing, truncated, altered, or of another version; one line
    that names it.
    """
    require_regular(path)
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror or error})") from None
    except DyngsError as error:
        raise DyngsError(f"{path}: {error}") from None


def encoded(
    info: CheckpointInfo,
    scene: Renderable,
    steps: Mapping[str, float],
    coarseness: Tensor | None = None,
) -> bytes:
    """Return the bytes of a file; the same for what was read from it. Raises DyngsError: a value is
    not finite.

    ``steps`` are of groups of tensors, see ``dyngs.compress.measure``; others are stored in half
    precision. ``coarseness`` (N,) uint8 of the Gaussians, see ``coarseness_of``; None: all are
    stored alike.
    """
    kept = (
        _ordered(scene, steps, coarseness) if isinstance(scene, GaussianScene) else drawable(scene)
    )
    scale = None if coarseness is None else checked_coarseness(kept[COARSENESS], len(coarseness))
    entries = []
    blocks = []
    for name in sorted(kept):
        coding = coding_of(name, kept[name], steps, by_coarseness=scale is not None)
        entry, block = _stored(name, kept[name], coding, scale)
        entries.append(entry)
        blocks.append(block)
    header = compressed(
        _Header(info=_Info(**asdict(info)), tensors=tuple(entries)).model_dump_json().encode(),
        room=MAX_HEADER,
    )
    body = b"".join([MAGIC, len(header).to_bytes(4, "little"), header, *blocks])
    num_values = sum(math.prod(entry.shape) for entry in entries)
    body += bytes(max(0, (num_values - FREE_VALUES) // VALUES_PER_BYTE + 1 - len(body)))
    return body + hashlib.sha256(body).digest()


def _ordered(
    scene: GaussianScene, steps: Mapping[str, float], coarseness: Tensor | None
) -> dict[str, Tensor]:
    """Return the tensors of ``drawable``, and ``coarseness``, in the order in which Gaussians are
    stored."""
    means = scene.gaussians.means.detach()
    if not bool(means.isfinite().all()):
        raise DyngsError("means is not finite; it cannot be stored")
    edit = stored_edit(scene, restored(means, coding_of("gaussians.means", means, steps)).numpy())
    more = {} if coarseness is None else {COARSENESS: edit.apply(coarseness)}
    return drawable(scene.edited(edit)) | more


def decoded(data: bytes) -> Checkpoint:
    """Return the checkpoint in the bytes of a file. Raises DyngsError: anything but what
    ``encoded`` makes."""
    if data[: len(MAGIC)] != MAGIC:
        is_other = data.startswith(MAGIC[:6]) and len(data) > len(MAGIC)
        raise DyngsError(
            "written by another version of dyngs" if is_other else "not a stored scene of dyngs"
        )
    body = data[:-_CHECKSUM]
    checksum = data[-_CHECKSUM:]
    if hashlib.sha256(body).digest() != checksum:
        raise DyngsError(_DAMAGED)
    start = len(MAGIC) + 4
    end = start + int.from_bytes(body[len(MAGIC) : start], "little")
    try:
        header = _Header.model_validate_json(decompressed(body[start:end], MAX_HEADER, exact=False))
        num_values = sum(math.prod(entry.shape) for entry in header.tensors)
        if num_values > FREE_VALUES + VALUES_PER_BYTE * len(body):
            raise DyngsError(f"it claims {num_values} values, more than a file of its size holds")
        tensors: dict[str, Tensor] = {}
        for entry in header.tensors:
            block = body[end : end + entry.size + _FAR_BYTES * entry.far]
            end += entry.size + _FAR_BYTES * entry.far
            tensors[entry.name] = _tensor(entry, block, tensors.get(COARSENESS))
        if any(body[end:]) or end > len(body):
            raise DyngsError("it holds something else than its header says")
        full = completed(tensors)
    except KeyError as missing:
        raise DyngsError(f"it lacks {printable(str(missing), 60)}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DyngsError(f"its header is wrong at {where or 'its start'}: {first['msg']}") from None
    except (ValueError, OverflowError, RuntimeError, IndexError) as error:
        raise DyngsError(f"its tensors are wrong: {str(error).splitlines()[0]}") from None
    return Checkpoint(CheckpointInfo(**header.info.model_dump()), full)


def _stored(
    name: str, x: Tensor, coding: Coding, coarseness: np.ndarray | None
) -> tuple[_Entry, bytes]:
    whole = to_whole(x, coding, coarseness)
    packing, block = packed(whole.numbers)
    entry = _Entry(
        name=name,
        dtype=str(x.dtype).removeprefix("torch."),
        shape=tuple(x.shape),
        kind=coding.kind,
        step=coding.step,
        by_coarseness=coding.by_coarseness,
        size=len(block),
        far=len(whole.far),
        **asdict(packing),
    )
    return entry, block + whole.far.astype("<i8").tobytes()


def _tensor(entry: _Entry, block: bytes, coarseness: Tensor | None) -> Tensor:
    packing = Packing(entry.axis, entry.by_rows, entry.signed, entry.planes)
    numbers = unpacked(packing, block[: entry.size], entry.stored_shape)
    far = np.frombuffer(block[entry.size :], dtype="<i8").astype(np.int64).reshape(entry.far, 2)
    coding = Coding(entry.kind, entry.step, entry.by_coarseness)
    rows = (
        checked_coarseness(coarseness, entry.shape[0])
        if entry.by_coarseness and coarseness is not None
        else None
    )
    return from_whole(Whole(numbers, far), coding, _DTYPES[entry.dtype], rows)
