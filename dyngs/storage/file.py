"""The file ``scene.dyngs``: a header, the tensors one after the other, a checksum.

    8 bytes   b"dyngs\\x00\\x01\\n", the last but one is the version
    4 bytes   length of the header, little endian
    header    LZMA2 of JSON: ``Header``
    data      of the tensors in the order of the header, then zeros
    32 bytes  SHA-256 of all before

Nothing in it is run. The checksum finds accidents; everything in the header is checked besides, and no more memory is
taken than a file of this size can need.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from dyngs.errors import DyngsError, printable, require_regular
from dyngs.files.write import atomic_file
from dyngs.gaussians.scene import GaussianScene
from dyngs.storage.coding import Packing, compressed, decompressed, packed, unpacked
from dyngs.storage.tensors import (
    COARSENESS,
    Coding,
    Kind,
    Whole,
    checked_coarseness,
    coding_of,
    completed,
    drawable,
    from_whole,
    group_of,
    restored,
    stored_edit,
    to_whole,
)

MAGIC = b"dyngs\x00\x01\n"
MAX_HEADER = 2**20
FREE_VALUES, VALUES_PER_BYTE = 2**22, 64
"""Largest number of values in any file, and of further values per byte of it."""
_CHECKSUM = 32
_FAR_BYTES = 16
"""Bytes of an index and a value."""
_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (torch.float16, torch.float32, torch.float64, torch.int32, torch.int64, torch.uint8, torch.bool)
}
_DAMAGED = "damaged or cut off, its checksum differs; copy it again, or export it again"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class SceneInfo(_Part):
    """Metadata of a checkpoint; see ``dyngs.training.state.CheckpointInfo``."""

    step: int
    extent: float
    world_offset: tuple[float, float, float]
    background: str
    rasterize_mode: str


class _Entry(_Part):
    """A tensor: fields of ``Coding`` and ``Packing``, bytes of its numbers, and how many values are out of reach."""

    name: str
    dtype: str
    shape: tuple[Annotated[int, Field(ge=0, le=2**40)], ...] = Field(max_length=8)
    kind: Kind
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
        return (*self.shape[:-1], 3) if self.kind is Kind.ROTATION else self.shape


class _Header(_Part):
    info: SceneInfo
    tensors: tuple[_Entry, ...]


@dataclass(frozen=True)
class StoredScene:
    """Contents of a .dyngs file.

    Attributes:
        info: about the run.
        tensors: of a checkpoint, those that drawing needs.
        steps: of each group of tensors that is quantised.
        sizes: bytes of each tensor as stored.
        num_bytes: of the file.
    """

    info: SceneInfo
    tensors: dict[str, Tensor]
    steps: dict[str, float]
    sizes: dict[str, int]
    num_bytes: int


def write_scene(path: Path, data: bytes) -> None:
    """Write the bytes of ``encoded`` atomically. Raises DyngsError for a full disk and the like."""
    with atomic_file(path, durable=True) as temporary:
        temporary.write_bytes(data)


def read_scene(path: Path) -> StoredScene:
    """Return the scene in a file.

    Raises:
        DyngsError: a file that is missing, truncated, altered, or of another version; one line that names it.
    """
    require_regular(path)
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror or error})") from None
    except DyngsError as error:
        raise DyngsError(f"{path}: {error}") from None


def encoded(
    info: SceneInfo, scene: GaussianScene, steps: Mapping[str, float], coarseness: Tensor | None = None
) -> bytes:
    """Return the bytes of a file; the same for what was read from it.

    Args:
        info: about the run.
        scene: N Gaussians; what only training needs is left out.
        steps: of groups of tensors, see ``dyngs.storage.precision``; others are stored in half precision.
        coarseness: (N,) uint8 of the Gaussians, see ``coarseness_of``; None: all are stored alike.

    Raises:
        DyngsError: a value is not finite.
    """
    means = scene.gaussians.means.detach()
    if not bool(means.isfinite().all()):
        raise DyngsError("means is not finite; it cannot be stored")
    edit = stored_edit(scene, restored(means, coding_of("gaussians.means", means, steps)).numpy())
    kept, scale = drawable(scene.edited(edit)), None
    if coarseness is not None:
        kept[COARSENESS] = edit.apply(coarseness)
        scale = checked_coarseness(kept[COARSENESS], len(means))
    entries, blocks = [], []
    for name in sorted(kept):
        coding = coding_of(name, kept[name], steps, by_coarseness=scale is not None)
        entry, block = _stored(name, kept[name], coding, scale)
        entries.append(entry)
        blocks.append(block)
    header = compressed(_Header(info=info, tensors=tuple(entries)).model_dump_json().encode(), room=MAX_HEADER)
    body = b"".join([MAGIC, len(header).to_bytes(4, "little"), header, *blocks])
    num_values = sum(math.prod(entry.shape) for entry in entries)
    body += bytes(max(0, (num_values - FREE_VALUES) // VALUES_PER_BYTE + 1 - len(body)))
    return body + hashlib.sha256(body).digest()


def decoded(data: bytes) -> StoredScene:
    """Return the scene in the bytes of a file.

    Raises:
        DyngsError: anything but what ``encoded`` makes.
    """
    if data[: len(MAGIC)] != MAGIC:
        is_other = data.startswith(MAGIC[:6]) and len(data) > len(MAGIC)
        raise DyngsError("written by another version of dyngs" if is_other else "not a stored scene of dyngs")
    body, checksum = data[:-_CHECKSUM], data[-_CHECKSUM:]
    if hashlib.sha256(body).digest() != checksum:
        raise DyngsError(_DAMAGED)
    start = len(MAGIC) + 4
    end = start + int.from_bytes(body[len(MAGIC) : start], "little")
    try:
        header = _Header.model_validate_json(decompressed(body[start:end], MAX_HEADER, exact=False))
        _require_small(header, len(body))
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
    sizes = {entry.name: entry.size + _FAR_BYTES * entry.far for entry in header.tensors}
    return StoredScene(header.info, full, _steps(header, tensors), sizes, len(data))


def _steps(header: _Header, tensors: Mapping[str, Tensor]) -> dict[str, float]:
    """Return the steps that would store the tensors again unchanged; 0 for tensors stored exactly without need."""
    steps: dict[str, float] = {}
    for entry in header.tensors:
        x = tensors[entry.name]
        group = group_of(entry.name, x) or entry.name
        if entry.step or (entry.kind is Kind.EXACT and coding_of(entry.name, x, {}).kind is not Kind.EXACT):
            steps[group] = max(entry.step, steps.get(group, 0.0))
    return steps


def _stored(name: str, x: Tensor, coding: Coding, coarseness: np.ndarray | None) -> tuple[_Entry, bytes]:
    """Return the header entry of a tensor, and its data."""
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
    rows = checked_coarseness(coarseness, entry.shape[0]) if entry.by_coarseness and coarseness is not None else None
    return from_whole(Whole(numbers, far), coding, _DTYPES[entry.dtype], rows)


def _require_small(header: _Header, num_bytes: int) -> None:
    num_values = sum(math.prod(entry.shape) for entry in header.tensors)
    if num_values > FREE_VALUES + VALUES_PER_BYTE * num_bytes:
        raise DyngsError(f"it claims {num_values} values, more than a file of its size holds")
