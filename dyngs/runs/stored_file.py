"""The compressed scene file ``scene.dyngs``: quantised tensors in LZMA, and a checksum.

    8 bytes   b"dyngs\\x00\\x01\\n"; byte 7 is the version
    4 bytes   length of the header, little endian
    header    ``_Header`` as JSON in LZMA2
    data      of the tensors in the order of the header, then zeros
    32 bytes  SHA-256 of all preceding bytes

Tensors have their names in checkpoints (``gaussians.means``, ``model.rows``), except for the K
spherical harmonics: ``gaussians.sh_base`` (N, 3) and ``gaussians.sh_rest`` (N, K - 1, 3).

Files may be untrusted: they contain no code, the header is validated, and the memory to read one is
bounded by its size. The checksum only detects accidental damage.
"""

from __future__ import annotations

import hashlib
import lzma
import math
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from dyngs.core.errors import DyngsError, describe_error, require_regular_file
from dyngs.core.gaussians import storage_order
from dyngs.core.state import strip_roles
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.io.write import atomic_file
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo, parse_info
from dyngs.models.renderable import Renderable
from dyngs.ops.quaternions import quat_product, unit_quats

LIMIT = 2**20  # bound on the magnitude of the integers; larger values are stored as float32
SMALLEST_STEP, LARGEST_STEP = 2.0**-100, 2.0**60
ROTATION_STEP = 1 / 32
"""Coarsest step for rotations, at which the omitted scalar part is still the largest component."""
SPARSE_ROUNDING = 0.35
"""Rounding offset of higher harmonics: below 0.5, it favours zeros, which compress best."""


def round_step_down(step: float) -> float:
    """Return the largest allowed step that does not exceed ``step``, or the smallest one."""
    fraction, exponent = math.frexp(min(max(step, SMALLEST_STEP), LARGEST_STEP))
    return math.ldexp(math.floor(8 * fraction) / 8, exponent)


Steps = float | np.ndarray  # quantisation step: one for all values, or an array that broadcasts


def to_grid(
    values: np.ndarray, step: Steps, rounding: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Quantise ``values`` to int32 multiples of ``step``.

    ``rounding`` is added to magnitudes before rounding down.

    Returns:
        the multiples, and a mask of values beyond ``LIMIT``, whose multiples are 0.
    """
    scaled = np.asarray(values, dtype=np.float64) / step
    far = ~(np.abs(scaled) < LIMIT - 1)
    scaled[far] = 0
    return (np.sign(scaled) * np.floor(np.abs(scaled) + rounding)).astype(np.int32), far


def opacities_to_grid(logits: np.ndarray, step: float) -> np.ndarray:
    """Return int32 multiples of ``step`` nearest to the opacities of ``logits``."""
    opacities = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -700, 700)))
    return np.floor(opacities / step + 0.5).astype(np.int32)


def opacities_from_grid(whole: np.ndarray, step: float) -> np.ndarray:
    """Return float64 logits of quantised opacities.

    Opacity 0 becomes an eighth of a step, which is not drawn, and 1 slightly less, so that logits
    are finite.
    """
    opacities = np.clip(whole.astype(np.float64) * step, step / 8, 1 - step / 64)
    return np.log(opacities) - np.log1p(-opacities)


def rotations_to_grid(quats: np.ndarray, step: float) -> np.ndarray:
    """Quantise rotations of Gaussians to (N, 3) int32 multiples of ``step``.

    Half turns about its own axes do not change a Gaussian. Of the four equivalent quaternions, one
    with a (nearly) largest scalar part is chosen, and only its vector part is stored. A zero
    quaternion is the identity. Quantising the decoded result again does not change it. ``step``: at
    most ``ROTATION_STEP``.
    """
    before = None
    while True:
        unit = _unit(quats)
        size = np.abs(unit)
        size[:, 0] += 4 * step
        turned = _product(unit, np.eye(4)[size.argmax(1)])
        whole, _ = to_grid(np.where(turned[:, :1] < 0, -turned, turned)[:, 1:], step)
        # The loop ends: each new choice raises the scalar part by more than rounding lowers it.
        if before is not None and np.array_equal(whole, before):
            return whole
        before = whole
        quats = rotations_from_grid(whole, step)


def rotations_from_grid(whole: np.ndarray, step: float) -> np.ndarray:
    """Return (N, 4) unit quaternions wxyz, float64, from quantised vector parts (N, 3)."""
    vector = whole.astype(np.float64) * step
    scalar = np.sqrt(np.clip(1 - np.square(vector).sum(1), 0, None))
    return np.concatenate([scalar[:, None], vector], axis=1)


_ROOT = math.sqrt(0.5)
_AXIS_TURNS = {
    5: (1.0, 0.0, 0.0, 0.0),
    7: (_ROOT, _ROOT, 0.0, 0.0),
    21: (_ROOT, 0.0, _ROOT, 0.0),
    11: (_ROOT, 0.0, 0.0, _ROOT),
    15: (0.5, 0.5, 0.5, 0.5),
    19: (0.5, -0.5, -0.5, -0.5),
}
"""Rotations wxyz that permute the axes, up to signs. Keys are permutations as base-3 numbers."""


def sort_axes(quats: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the same N Gaussians with their shortest axis first and their longest last.

    ``quats``: (N, 4) wxyz; zero is the identity. ``log_scales``: (N, 3).
    """
    order = np.argsort(log_scales, axis=1, kind="stable")
    turns = np.zeros((27, 4))
    turns[list(_AXIS_TURNS)] = list(_AXIS_TURNS.values())
    turned = _product(_unit(quats), turns[order @ (9, 3, 1)])
    return turned, np.take_along_axis(log_scales, order, axis=1)


def _unit(quats: np.ndarray) -> np.ndarray:
    """Return (N, 4) float64 of unit length; zero becomes the identity."""
    return unit_quats(torch.from_numpy(quats).double()).numpy()


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return quat_product(torch.from_numpy(left), torch.from_numpy(right)).numpy()


Kind = Literal["exact", "half", "grid", "sparse", "opacity", "rotation"]
"""Ways to convert the values of a tensor to integers."""

TRIANGLES = "triangles.points"  # only scenes of triangles have this tensor
# Largest log2 factor by which colour steps of hardly visible Gaussians are enlarged
MAX_COARSENESS = 6
COARSENESS = "gaussians.coarseness"
_KINDS: dict[str, Kind] = {
    "gaussians.quats": "rotation",
    "gaussians.logit_opacities": "opacity",
    "gaussians.sh_rest": "sparse",
    "model.field.learned.sh_time": "sparse",
    "triangles.harmonics": "sparse",
}
# Smallest and largest steps; the smallest one for rotations keeps the integers within LIMIT.
_LIMITS = {"rotation": (2.0**-19, ROTATION_STEP), "opacity": (2.0**-12, 1 / 8)}
FEW = 64  # tensors with at most this many values are stored exactly
LARGEST_HALF = 65504.0  # largest finite float16
FILTER_STD = "model.filter_std"  # stored in half precision: it spans orders of magnitude
NODE_RADII = "model.field.buffers.radii"
"""Radii of control nodes are stored exactly, since they must not be rounded to 0."""
FIXED_STEPS = {
    "model.anchors.points": 2.0**-9,
    "model.anchors.size": 2.0**-13,
    "model.anchors.height": 2.0**-10,
    "model.anchors.uv": 2.0**-9,
    "model.anchors.barycentric": 2.0**-6,
}
"""Steps of an avatar's anchors on the body template, m or fractions, which hardly affect images."""


class Coding(NamedTuple):
    """Kind and precision with which one tensor is stored."""

    kind: Kind
    step: float = 0.0  # quantisation step; 0 for exact and half
    by_coarseness: bool = False  # the step of row i is ``2 ** coarseness[i]`` times as large

    def steps(self, coarseness: np.ndarray | None, num_axes: int) -> Steps:
        """Return the step, or (N, 1, ...) steps with ``num_axes`` axes."""
        if not self.by_coarseness:
            return self.step
        if coarseness is None:
            raise ValueError("the coarseness of its rows is missing")
        return (self.step * 2.0 ** coarseness.astype(np.float64)).reshape(-1, *[1] * (num_axes - 1))


def tensors_to_store(scene: Renderable) -> dict[str, Tensor]:
    """Return the tensors that rendering needs, in an equivalent form that compresses better.

    The axes of Gaussians are sorted by length, except where a deformation field changes single
    axes. Raises DyngsError: a value is not finite, or there are neither Gaussians nor triangles.
    """
    kept = strip_roles(scene.drawing_state())
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
    names = ("gaussians.quats", "gaussians.log_scales")
    found = sort_axes(*(kept[name][sorts].numpy() for name in names))
    for name, values in zip(names, found, strict=True):
        kept[name] = kept[name].clone()
        kept[name][sorts] = torch.from_numpy(values).to(kept[name])
    return kept


def to_checkpoint_tensors(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert stored tensors to those of a checkpoint without training state.

    Raises KeyError: a tensor of Gaussians is missing. ValueError: their shapes do not match.
    Triangles are validated when the scene is restored.
    """
    full = dict(tensors)
    if TRIANGLES in full:
        return full
    base = full.pop("gaussians.sh_base")
    full["gaussians.sh"] = torch.cat([base[:, None], full.pop("gaussians.sh_rest")], dim=1)
    # The constructor validates the shapes.
    Gaussians(**{field.name: full[f"gaussians.{field.name}"] for field in fields(Gaussians)})
    return full


def storage_edit(scene: GaussianScene, means: np.ndarray) -> TopologyEdit:
    """Return the edit that sorts Gaussians so that spatial neighbours have adjacent rows.

    Gaussians that a field deforms come first. ``means``: (N, 3) after quantisation, so that storing
    a file again keeps the order.
    """
    return TopologyEdit.select(torch.from_numpy(storage_order(means, scene.offset_rows.numpy())))


def step_group(name: str, x: Tensor) -> str | None:
    """Return the name of the group of tensors that share a step; None if it has no free step.

    Tensors whose names differ only in a final number share a group.
    """
    if x.dtype != torch.float32 or name in (FILTER_STD, NODE_RADII) or name in FIXED_STEPS:
        return None
    if x.numel() <= FEW and not name.startswith("gaussians."):
        return None
    return name.rstrip("0123456789")


def choose_coding(
    name: str, x: Tensor, steps: Mapping[str, float], *, by_coarseness: bool = False
) -> Coding:
    """Return the coding of a tensor.

    ``steps``: largest step by group, or by name for tensors without a group. A step of 0 stores
    exact values. Groups without an entry are stored in half precision.
    """
    group = step_group(name, x)
    if name == NODE_RADII or steps.get(group or name) == 0:
        return Coding("exact")
    if name in FIXED_STEPS:
        return Coding("grid", FIXED_STEPS[name])
    if group is None or group not in steps:
        fits = x.dtype == torch.float32 and x.numel() > FEW and float(x.abs().max()) <= LARGEST_HALF
        return Coding("half" if fits else "exact")
    kind = _KINDS.get(name, "grid")
    low, high = _LIMITS.get(kind, (SMALLEST_STEP, LARGEST_STEP))
    step = round_step_down(min(max(steps[group], low), high))
    # If more than an eighth of the values exceed the integer range, all are stored exactly.
    if kind in ("grid", "sparse") and int((x.abs() >= LIMIT * step).sum()) > x.numel() / 8:
        return Coding("exact")
    return Coding(kind, step, by_coarseness and name.startswith("gaussians.sh_"))


def quantize_tensor(
    x: Tensor, coding: Coding, coarseness: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``x`` as integers, and its values that exceed the integer range.

    ``coarseness``: (N,) log2 factors of the steps of its rows.

    Returns:
        int64 numbers of the shape of ``x``, or (N, 3) for rotations; and (K, 2) int64: flat index
        and float32 bits of each value out of range.
    """
    values = x.detach().contiguous().numpy()
    far = np.zeros((0, 2), dtype=np.int64)
    if coding.kind == "rotation":
        numbers = rotations_to_grid(values, coding.step)
    elif coding.kind == "opacity":
        numbers = opacities_to_grid(values, coding.step)
    elif coding.kind in ("grid", "sparse"):
        rounding = SPARSE_ROUNDING if coding.kind == "sparse" else 0.5
        numbers, out = to_grid(values, coding.steps(coarseness, values.ndim), rounding)
        index = np.flatnonzero(out)
        bits = values.astype(np.float32).ravel()[index].view(np.int32)
        far = np.stack([index, bits.astype(np.int64)], axis=1)
    else:
        numbers = values.astype(np.float16) if coding.kind == "half" else values
        if numbers.dtype.kind == "f":
            numbers = numbers.view(f"i{numbers.itemsize}")
    return numbers.astype(np.int64), far


def dequantize_tensor(
    numbers: np.ndarray,
    far: np.ndarray,
    coding: Coding,
    dtype: str,
    coarseness: np.ndarray | None = None,
) -> Tensor:
    """Return the tensor that ``quantize_tensor`` encoded; the inverse of that function.

    ``dtype``: such as "float32". Raises ValueError, OverflowError, IndexError: invalid numbers.
    """
    # Numbers that were packed by columns are not contiguous.
    numbers = np.ascontiguousarray(numbers)
    if coding.kind == "rotation":
        values = rotations_from_grid(numbers, coding.step)
    elif coding.kind == "opacity":
        values = opacities_from_grid(numbers, coding.step)
    elif coding.kind in ("grid", "sparse"):
        steps = coding.steps(coarseness, numbers.ndim)
        values = np.asarray(numbers.astype(np.float64) * steps, dtype=np.float32)
        values.reshape(-1)[far[:, 0]] = far[:, 1].astype(np.int32).view(np.float32)
    else:
        stored = np.dtype("float16" if coding.kind == "half" else dtype)
        is_float = stored.kind == "f"
        values = numbers.astype(f"i{stored.itemsize}").view(stored) if is_float else numbers
    return torch.from_numpy(np.asarray(values.astype(dtype)))


def round_trip(x: Tensor, coding: Coding, coarseness: np.ndarray | None = None) -> Tensor:
    """Return ``x`` after quantisation and dequantisation."""
    whole = quantize_tensor(x, coding, coarseness)
    return dequantize_tensor(*whole, coding, _dtype_name(x), coarseness)


def _dtype_name(x: Tensor) -> str:
    return str(x.dtype).removeprefix("torch.")


class Packing(NamedTuple):
    """The way an array of integers was packed into bytes."""

    axis: int  # axis along which differences are stored; -1: the numbers themselves
    by_rows: bool  # row-major, otherwise column-major
    signed: bool  # zigzag coding: 0, -1, 1, -2 ... are stored as 0, 1, 2, 3
    planes: int  # bytes per number; the lowest bytes of all numbers come first


def pack_integers(whole: np.ndarray) -> tuple[Packing, bytes]:
    """Compress int64 numbers of any shape with the packing that gives the fewest bytes.

    Large arrays are tried by a sample of their rows.
    """
    best = -1, True
    if whole.size >= 512:
        sample = whole[: max(2**15 // max(whole[:1].size, 1), 64)]
        axes = [-1, *(axis for axis in range(min(whole.ndim, 2)) if whole.shape[axis] > 1)]
        orders = (True, False) if whole.ndim > 1 else (True,)
        ways = [(axis, by_rows) for axis in axes for by_rows in orders]
        best = min(
            ways, key=lambda way: len(compress_lzma(_pack_with(sample, *way)[1], quick=True))
        )
    packing, plain = _pack_with(whole, *best)
    return packing, compress_lzma(plain)


def unpack_integers(packing: Packing, data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Return int64 numbers of ``shape``; the inverse of ``pack_integers``.

    Raises DyngsError: the bytes contain another number of values.
    """
    count = math.prod(shape)
    plain = np.frombuffer(decompress_lzma(data, packing.planes * count), dtype=np.uint8)
    wide = np.zeros((count, 8), np.uint8)
    wide[:, : packing.planes] = plain.reshape(packing.planes, count).T
    stored = wide.view("<u8")[:, 0].astype(np.uint64)
    if packing.signed:
        stored = stored >> np.uint64(1) ^ (np.uint64(0) - (stored & np.uint64(1)))
    whole = stored.view(np.int64)
    if not packing.by_rows and count:
        whole = whole.reshape(-1, shape[0]).T
    whole = whole.reshape(shape)
    return np.cumsum(whole, axis=packing.axis) if 0 <= packing.axis < len(shape) else whole


def compress_lzma(plain: bytes, *, room: int | None = None, quick: bool = False) -> bytes:
    """Return ``plain`` as LZMA2 without headers.

    ``room``: the ``size`` that the reader will pass to ``decompress_lzma``, if it is larger.
    """
    filters = _filters(1 if quick else 6, room or len(plain))
    return lzma.compress(plain, format=lzma.FORMAT_RAW, filters=filters)


def decompress_lzma(data: bytes, size: int, *, exact: bool = True) -> bytes:
    """Return the decompressed bytes, which must be ``size``, or at most ``size`` if not ``exact``.

    Memory is bounded by ``size``. Raises DyngsError: another length, or trailing bytes.
    """
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_filters(6, size))
    try:
        plain = decoder.decompress(data, max_length=size + 1)
    except (lzma.LZMAError, EOFError):
        raise DyngsError("its data cannot be decoded") from None
    if len(plain) > size or (exact and len(plain) < size) or not decoder.eof or decoder.unused_data:
        raise DyngsError("its data has another length than stated")
    return plain


def _pack_with(whole: np.ndarray, axis: int, by_rows: bool) -> tuple[Packing, bytes]:
    if axis >= 0:
        whole = np.diff(whole, axis=axis, prepend=np.int64(0))
    signed = bool((whole < 0).any())
    stored = (whole << 1 ^ whole >> 63 if signed else whole).view(np.uint64)
    stored = stored.ravel() if by_rows else stored.reshape(len(stored), -1).T.ravel()
    planes = max(1, (int(stored.max(initial=0)).bit_length() + 7) // 8)
    plain = stored.astype("<u8").view(np.uint8).reshape(-1, 8)[:, :planes].T.tobytes()
    return Packing(axis, by_rows, signed, planes), plain


def _filters(preset: int, size: int) -> list[dict[str, int]]:
    """Return LZMA2 filters with a dictionary for ``size`` bytes: a larger one only costs time and
    memory."""
    dictionary = min(max(1 << max(size - 1, 1).bit_length(), 2**12), 2**24)
    method = lzma.FILTER_LZMA2
    return [{"id": method, "preset": preset, "dict_size": dictionary, "lc": 4, "lp": 0, "pb": 0}]


MAGIC = b"dyngs\x00\x01\n"
MAX_HEADER = 2**20
# Bound on the values that a reader accepts: FREE_VALUES + VALUES_PER_BYTE per byte of the file
FREE_VALUES = 2**22
VALUES_PER_BYTE = 64


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Entry(_Strict):
    """Header of a tensor: its fields of ``Coding`` and ``Packing``, the ``size`` of its packed
    numbers in bytes, and the number of values out of range (``far``)."""

    name: str
    dtype: Literal["float16", "float32", "float64", "int32", "int64", "uint8", "bool"]
    shape: tuple[Annotated[int, Field(ge=0, le=2**40)], ...] = Field(max_length=8)
    kind: Kind
    step: float
    by_coarseness: bool
    axis: int
    by_rows: bool
    signed: bool
    planes: int = Field(ge=1, le=8)
    size: int = Field(ge=0)
    far: int = Field(ge=0)


class _Header(_Strict):
    info: dict[str, Any]  # ``CheckpointInfo``
    tensors: tuple[_Entry, ...]


def write_scene(path: Path, data: bytes) -> None:
    """Write the bytes of ``encode_scene`` atomically. Raises DyngsError: the disk is full, ..."""
    with atomic_file(path, durable=True) as temporary:
        temporary.write_bytes(data)


def read_scene(path: Path) -> Checkpoint:
    """Return the checkpoint in a file, with the tensors that rendering needs.

    Raises DyngsError: the file is missing, truncated, altered, or of another version.
    """
    require_regular_file(path)
    try:
        return decode_scene(path.read_bytes())
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror or error})") from None
    except DyngsError as error:
        raise DyngsError(f"{path}: {error}") from None


def encode_scene(
    info: CheckpointInfo,
    scene: Renderable,
    steps: Mapping[str, float],
    coarseness: Tensor | None = None,
) -> bytes:
    """Return the bytes of a scene file. Encoding a decoded file again gives the same bytes.

    Args:
        steps: largest steps of groups of tensors, see ``choose_coding``.
        coarseness: (N,) uint8 of the Gaussians, see ``dyngs.compress.measure.compute_coarseness``.
            None uses the same colour step for all.

    Raises:
        DyngsError: a value is not finite.
    """
    kept = tensors_to_store(scene)
    rows = None
    if isinstance(scene, GaussianScene):
        means = kept["gaussians.means"]
        near = round_trip(means, choose_coding("gaussians.means", means, steps))
        edit = storage_edit(scene, near.numpy())
        kept = tensors_to_store(scene.apply_edit(edit))
        if coarseness is not None:
            kept[COARSENESS] = edit.apply(coarseness)
            rows = kept[COARSENESS].numpy()
    entries = []
    blocks = []
    for name in sorted(kept):
        coding = choose_coding(name, kept[name], steps, by_coarseness=rows is not None)
        entry, block = encode_tensor(name, kept[name], coding, rows)
        entries.append(entry)
        blocks.append(block)
    return assemble_file(asdict(info), entries, blocks)


def encode_tensor(
    name: str, x: Tensor, coding: Coding, rows: np.ndarray | None = None
) -> tuple[_Entry, bytes]:
    """Return the header entry of a tensor, and its bytes. ``rows``: (N,) coarseness."""
    numbers, far = quantize_tensor(x, coding, rows)
    packing, block = pack_integers(numbers)
    own = {"name": name, "dtype": _dtype_name(x), "shape": tuple(x.shape)}
    own |= {"size": len(block), "far": len(far)}
    entry = _Entry.model_validate(own | coding._asdict() | packing._asdict())
    return entry, block + far.astype("<i8").tobytes()


def assemble_file(info: dict[str, Any], entries: list[_Entry], blocks: list[bytes]) -> bytes:
    """Return the bytes of a file. ``info``: fields of ``CheckpointInfo``."""
    header = _Header(info=info, tensors=tuple(entries)).model_dump_json()
    packed_header = compress_lzma(header.encode(), room=MAX_HEADER)
    size = len(packed_header).to_bytes(4, "little")
    body = b"".join([MAGIC, size, packed_header, *blocks])
    num_values = sum(math.prod(entry.shape) for entry in entries)
    body += bytes(max(0, (num_values - FREE_VALUES) // VALUES_PER_BYTE + 1 - len(body)))
    return body + hashlib.sha256(body).digest()


def decode_scene(data: bytes) -> Checkpoint:
    """Return the checkpoint in the bytes of a file; the inverse of ``encode_scene``.

    Raises DyngsError: the bytes are invalid.
    """
    if data[: len(MAGIC)] != MAGIC:
        is_other = data.startswith(MAGIC[:6]) and len(data) > len(MAGIC)
        raise DyngsError(
            "written by another version of dyngs" if is_other else "not a stored scene of dyngs"
        )
    body = data[:-32]
    if hashlib.sha256(body).digest() != data[-32:]:
        raise DyngsError(
            "damaged or cut off, its checksum differs; copy it again, or export it again"
        )
    start = len(MAGIC) + 4
    end = start + int.from_bytes(body[len(MAGIC) : start], "little")
    try:
        header = _Header.model_validate_json(
            decompress_lzma(body[start:end], MAX_HEADER, exact=False)
        )
        num_values = sum(math.prod(entry.shape) for entry in header.tensors)
        if num_values > FREE_VALUES + VALUES_PER_BYTE * len(body):
            raise DyngsError(
                f"its header has {num_values} values, too many for the size of the file"
            )
        tensors: dict[str, Tensor] = {}
        for entry in header.tensors:
            block = body[end : end + entry.size + 16 * entry.far]
            end += entry.size + 16 * entry.far
            tensors[entry.name] = _tensor(entry, block, tensors.get(COARSENESS))
        if any(body[end:]) or end > len(body):
            raise DyngsError("its data does not match its header")
        return Checkpoint(parse_info(header.info), to_checkpoint_tensors(tensors))
    except (ValueError, KeyError, TypeError, OverflowError, RuntimeError, IndexError) as error:
        raise DyngsError(f"its contents are wrong: {describe_error(error)}") from None


def _tensor(entry: _Entry, block: bytes, coarseness: Tensor | None) -> Tensor:
    # rotations are stored as three integers
    shape = (*entry.shape[:-1], 3) if entry.kind == "rotation" else entry.shape
    packing = Packing(entry.axis, entry.by_rows, entry.signed, entry.planes)
    numbers = unpack_integers(packing, block[: entry.size], shape)
    far = np.frombuffer(block[entry.size :], dtype="<i8").astype(np.int64).reshape(entry.far, 2)
    coding = Coding(entry.kind, entry.step, entry.by_coarseness)
    rows = None if coarseness is None else coarseness.clamp(0, MAX_COARSENESS).numpy()
    return dequantize_tensor(numbers, far, coding, entry.dtype, rows)
