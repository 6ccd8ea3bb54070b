"""Lists of numbers in one deflated block of bytes, as ``data.js`` reads them.

Local letters: R rows, D columns.
"""

from __future__ import annotations

import base64
import zlib
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

CHUNK = 256
"""Rows of a list that share a range for each column: neighbours in space are alike."""


class Lists:
    """A block of bytes to which lists are added, and where they lie in it.

    Attributes:
        layout: by name what ``data.js`` needs to know.
    """

    def __init__(self) -> None:
        self.layout: dict[str, dict[str, Any]] = {}
        self._parts: list[bytes] = []
        self._size = 0

    def quantised(self, name: str, values: NDArray[np.float32], bits: Literal[8, 16]) -> None:
        """Add ``values`` (R, D) as 8 or 16 bits each: low + step * q, of each chunk and column.

        The error is at most half a step: the range of the chunk over 510 or 131,070.
        """
        rows, columns = values.shape
        count = -(-rows // CHUNK)
        ranges = np.zeros((count, columns, 2), dtype="<f4")
        quantised = np.zeros((rows, columns), dtype=np.uint16)
        for i in range(count):
            part = slice(i * CHUNK, (i + 1) * CHUNK)
            low, high = values[part].min(0), values[part].max(0)
            step = ((high.astype(np.float64) - low) / (2**bits - 1)).astype(np.float32)
            ranges[i] = np.stack([low, step], axis=1)
            relative = (values[part].astype(np.float64) - low) / np.where(step > 0, step, 1)
            quantised[part] = relative.round().clip(0, 2**bits - 1)
        planes = [quantised >> 8, quantised & 255] if bits == 16 else [quantised]
        bytes_of = np.stack([plane.T.astype(np.uint8) for plane in planes], axis=1)  # (D, planes, R)
        self._add(name, ranges.tobytes() + bytes_of.tobytes(), "quantised", values.shape, bits=bits, chunk=CHUNK)

    def exact(self, name: str, values: NDArray[Any]) -> None:
        """Add ``values`` (R, D) as they are: uint8, uint16 or float32."""
        kind = values.dtype.name
        if kind not in ("uint8", "uint16", "float32"):
            raise ValueError(f"{name}: a list of {kind} cannot be added")
        self._add(name, values.astype(values.dtype.newbyteorder("<")).tobytes(), kind, values.shape)

    @property
    def size(self) -> int:
        """Number of bytes before they are deflated."""
        return self._size

    def text(self) -> str:
        """Return the block, deflated, in base64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode("ascii")

    def _add(self, name: str, data: bytes, kind: str, shape: tuple[int, ...], **more: int) -> None:
        rows, columns = shape
        self.layout[name] = {"kind": kind, "rows": rows, "columns": columns, "at": self._size, **more}
        self._parts.append(data)
        self._size += len(data)
