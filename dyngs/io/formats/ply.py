"""The standard 3DGS ``.ply``, one vertex per Gaussian, parameters as optimised; and SuperSplat's
compressed one.

Layout written (binary little endian, float32)::

    x y z  nx ny nz (zeros)  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

``opacity`` is a logit, ``scale`` a natural logarithm, ``rot`` a quaternion wxyz; ``f_rest`` is
channel-major: all red terms, then green, then blue. Header comments say what the numbers leave
open: ``SplatRenderMode: default|mip`` (how to render the file), ``SH degree``, ``eps2d`` (the 2D
low-pass variance), ``up`` (the axis that points up), ``turned`` and ``world_offset`` (from the axes
of the capture to those of the file: see ``SplatFile``).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from dyngs.core.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.core.gaussians import Gaussians, morton_order
from dyngs.io.formats.packing import (
    logit,
    pack_fractions,
    smallest_three,
    unpack_fractions,
    whole_rotations,
)
from dyngs.io.formats.splat_file import (
    MOST_LOG_SCALE,
    SplatFile,
    described,
    header_comments,
    require_count,
    unit_rotations,
)

_DEGREE_OF_REST = {3 * (num_sh_terms(degree) - 1): degree for degree in range(MAX_SH_DEGREE + 1)}
_DC = tuple(f"f_dc_{i}" for i in range(3))
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROT = tuple(f"rot_{i}" for i in range(4))
_REQUIRED = ("x", "y", "z", *_DC, "opacity", *_SCALE, *_ROT)
# SuperSplat's compressed .ply takes 16 bytes per Gaussian, in chunks of 256 that share their
# ranges. Elements: chunk (smallest and largest position, logarithm of the scale and colour), vertex
# (four packed uint32) and, with harmonics, sh (a byte per number, channel-major, from -4 to 4).
_PER_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_POSITION = ("x", "y", "z")
_SIZE = ("scale_x", "scale_y", "scale_z")
_COLOUR = ("r", "g", "b")
_BITS_3 = (11, 10, 11)
_BITS_4 = (8, 8, 8, 8)
_SH_RANGE = 8.0
_MOST_LOG = 20.0


def read_ply(path: Path) -> SplatFile:
    """Read a .ply, plain or compressed, binary or ascii, whatever its values are; properties may
    have any order.

    Means of a plain .ply are float64. Scalar types other than float32 are converted; other
    properties, and elements other than ``vertex``, are skipped.
    """
    with open(path, "rb") as file:
        header = read_header(file)
        if "packed_position" in dict(header.elements["vertex"][1]):
            gaussians = _read_compressed(header, file, path)
        else:
            gaussians = _gaussians(header.read(file, "vertex"))
    return described(SplatFile(gaussians, comments=header.comments))


def write_ply(
    path: Path, splat: SplatFile, columns: Mapping[str, np.ndarray] | None = None
) -> None:
    """Write a plain .ply, not atomically.

    ``columns`` are further properties (N,) by name, written as float32 after all others, which
    ``read_ply`` skips.
    """
    more = columns or {}
    gaussians = splat.gaussians.detach().to(device="cpu", dtype=torch.float32)
    sh = gaussians.sh
    normals = torch.zeros_like(gaussians.means)
    numbers = [gaussians.means, normals, sh[:, 0], sh[:, 1:].transpose(1, 2).flatten(1)]
    numbers += [gaussians.logit_opacities[:, None], gaussians.log_scales, gaussians.quats]
    table = np.column_stack([torch.cat(numbers, dim=1).numpy(), *more.values()]).astype("<f4")
    rest = [f"f_rest_{i}" for i in range(3 * (sh.shape[1] - 1))]
    names = ("x", "y", "z", "nx", "ny", "nz", *_DC, *rest, "opacity", *_SCALE, *_ROT, *more)
    with open(path, "wb") as file:
        file.write(
            header_bytes(
                [("vertex", len(table), [("float", name) for name in names])],
                header_comments(splat),
            )
        )
        file.write(np.ascontiguousarray(table).data)


def _gaussians(rows: np.ndarray) -> Gaussians:
    present = rows.dtype.names or ()
    missing = [name for name in _REQUIRED if name not in present]
    rest_names = [name for name in present if name.startswith("f_rest_")]
    if missing or len(rest_names) not in _DEGREE_OF_REST:
        raise ValueError(
            f"it is no 3DGS .ply: its vertices have no {' '.join(missing[:6])}"
            if missing
            else f"{len(rest_names)} f_rest properties are of no degree that is known"
        )

    def columns(names: Sequence[str], dtype: type[np.floating] = np.float32) -> torch.Tensor:
        out = np.empty((len(rows), len(names)), dtype=dtype)
        with np.errstate(over="ignore"):
            # doubles beyond float32 become Inf and are reported as such
            for i, name in enumerate(names):
                out[:, i] = rows[name]
        return torch.from_numpy(out)

    terms = len(rest_names) // 3
    rest = columns([f"f_rest_{i}" for i in range(3 * terms)])
    sh = [columns(_DC)[:, None], rest.reshape(len(rows), 3, terms).transpose(1, 2)]
    return Gaussians(
        means=columns(("x", "y", "z"), np.float64),
        quats=unit_rotations(columns(_ROT)),
        log_scales=columns(_SCALE),
        logit_opacities=columns(("opacity",))[:, 0],
        sh=torch.cat(sh, dim=1).contiguous(),
    )


def _read_compressed(header: PlyHeader, file: BinaryIO, path: Path) -> Gaussians:
    """Return the Gaussians of a compressed .ply; colours and logits may be infinite."""
    if "chunk" not in header.elements:
        raise ValueError("it is a compressed .ply without chunks")
    chunks = header.read(file, "chunk")
    vertices = header.read(file, "vertex")
    count = len(vertices)
    require_count(path, count, 16 * count, 16)

    def columns(axes: tuple[str, ...], end: str) -> np.ndarray:
        found = np.stack([chunks[f"{end}_{axis}"].astype(np.float32) for axis in axes], axis=1)
        return found[np.arange(count) // _PER_CHUNK]

    def ranged(fractions: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
        low = columns(axes, "min")
        high = columns(axes, "max")
        with np.errstate(all="ignore"):  # ranges of others may be NaN or infinite
            return (low + fractions * (high - low)).astype(np.float32)

    position, rotation, size, colour = (vertices[name].astype(np.uint32) for name in _PACKED)
    rgba = unpack_fractions(colour, _BITS_4)
    has_ranges = "min_r" in (chunks.dtype.names or ())
    rgb = ranged(rgba[:, :3], _COLOUR) if has_ranges else rgba[:, :3]
    sh = ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None]
    if "sh" in header.elements:
        sh = np.concatenate([sh, _rest(header.read(file, "sh"))], axis=1)
    return Gaussians(
        means=torch.from_numpy(ranged(unpack_fractions(position, _BITS_3), _POSITION)),
        quats=torch.from_numpy(whole_rotations(rotation)),
        log_scales=torch.from_numpy(ranged(unpack_fractions(size, _BITS_3), _SIZE)),
        logit_opacities=torch.from_numpy(logit(rgba[:, 3])),
        sh=torch.from_numpy(sh),
    )


def _rest(table: np.ndarray) -> np.ndarray:
    """Return the harmonics (N, K - 1, 3) of the element sh."""
    names = [f"f_rest_{i}" for i in range(len(table.dtype.names or ()))]
    if _DEGREE_OF_REST.get(len(names), 4) > 3:
        raise ValueError(f"its element sh has {len(names)} numbers in a row")
    coded = np.stack([table[name].astype(np.float32) for name in names], axis=1)
    fraction = np.where(coded == 0, 0, np.where(coded == 255, 1, (coded + 0.5) / 256))
    rest = ((fraction - 0.5) * _SH_RANGE).reshape(len(table), 3, -1)
    return rest.transpose(0, 2, 1).astype(np.float32)


def write_compressed(path: Path, splat: SplatFile) -> None:
    """Write a compressed .ply, Gaussians in an order that keeps neighbours in one chunk, harmonics
    up to degree 3."""
    gaussians = splat.gaussians.select(
        torch.from_numpy(morton_order(splat.gaussians.means.numpy()))
    )
    n = len(gaussians)
    sh = gaussians.sh.numpy()
    starts = np.arange(0, n, _PER_CHUNK)
    chunk_of = np.arange(n) // _PER_CHUNK
    ranges = []
    fractions = []
    log_scales = gaussians.log_scales.numpy().clip(-_MOST_LOG, min(_MOST_LOG, MOST_LOG_SCALE))
    for values in (gaussians.means.numpy(), log_scales, sh[:, 0] * SH_C0 + 0.5):
        low = np.minimum.reduceat(values, starts)
        high = np.maximum.reduceat(values, starts)
        ranges += [low, high]
        span = np.where(high > low, high - low, 1)
        fractions.append((values - low[chunk_of]) / span[chunk_of])
    words = [
        pack_fractions(fractions[0], _BITS_3),
        smallest_three(gaussians.quats.numpy()),
        pack_fractions(fractions[1], _BITS_3),
        pack_fractions(
            np.concatenate([fractions[2], gaussians.opacities.numpy()[:, None]], axis=1), _BITS_4
        ),
    ]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(n, -1)
    coded = np.clip(np.trunc((rest / _SH_RANGE + 0.5) * 256), 0, 255).astype(np.uint8)
    names = [
        ("float", f"{end}_{x}")
        for axes in (_POSITION, _SIZE, _COLOUR)
        for end in ("min", "max")
        for x in axes
    ]
    elements = [("chunk", len(starts), names), ("vertex", n, [("uint", name) for name in _PACKED])]
    if rest.shape[1]:
        elements.append(("sh", n, [("uchar", f"f_rest_{i}") for i in range(rest.shape[1])]))
    with open(path, "wb") as file:
        file.write(header_bytes(elements, header_comments(splat)))
        file.write(np.concatenate(ranges, axis=1).astype("<f4").tobytes())
        file.write(np.stack(words, axis=1).astype("<u4").tobytes())
        file.write(coded.tobytes())


_SCALARS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_MOST_HEADER_BYTES = 1 << 20


@dataclass(frozen=True)
class PlyHeader:
    """The header of a .ply."""

    byte_order: str  # "<", ">" or, for ascii, ""
    # of all elements in file order: their number, and names and types of the properties; a list
    # property has no type
    elements: dict[str, tuple[int, list[tuple[str, str]]]]
    comments: tuple[str, ...]
    data_start: int  # offset of the first byte after the header

    def read(self, file: BinaryIO, name: str) -> np.ndarray:
        """Read an element as a structured array (N,).

        Raises ValueError: the file is truncated, or list properties hide where the element is.
        """
        count, properties = self.elements[name]
        order = list(self.elements)
        before = order[: order.index(name)]
        if any(not kind for own in (*before, name) for _, kind in self.elements[own][1]):
            raise ValueError(f"it has list properties in or before its {name}: no 3DGS .ply")
        # The shortest possible row of text is one character and one separator per value.
        skipped = sum(self.elements[own][0] * self._row(own).itemsize for own in before)
        wanted = skipped + count * self._row(name).itemsize
        available = file.seek(0, os.SEEK_END) - self.data_start
        if available < (wanted if self.byte_order else wanted - 1):
            raise ValueError(f"it is truncated: {wanted} bytes needed, {available} found")
        if self.byte_order:
            file.seek(self.data_start + skipped)
            return np.fromfile(file, self._row(name), count)
        file.seek(self.data_start)
        for _ in range(sum(self.elements[own][0] for own in before)):
            file.readline()
        table = np.loadtxt(file, np.float64, max_rows=count, ndmin=2)
        if table.shape != (count, len(properties)):
            raise ValueError(f"its {name} should be {count} rows of {len(properties)} numbers")
        return table.view([(key, "f8") for key, _ in properties])[:, 0]

    def _row(self, name: str) -> np.dtype:
        """Return the type of a row of an element; of text, of its shortest one."""
        return np.dtype(
            [
                (key, self.byte_order + kind if self.byte_order else "S2")
                for key, kind in self.elements[name][1]
            ]
        )


def read_header(file: BinaryIO) -> PlyHeader:
    """Read the header of a .ply opened at its start. Raises ValueError with the wrong line."""
    if file.readline(16).rstrip(b"\r\n") != b"ply":
        raise ValueError("it does not start with 'ply'")
    byte_order: str | None = None
    elements: dict[str, tuple[int, list[tuple[str, str]]]] = {}
    properties: list[tuple[str, str]] | None = None
    comments: list[str] = []
    while True:
        raw = file.readline(_MOST_HEADER_BYTES)
        if not raw.endswith(b"\n") or file.tell() > _MOST_HEADER_BYTES:
            raise ValueError("its header has no end_header, or is longer than 1 MB")
        line = raw.decode("utf-8", errors="replace").strip()
        match line.split():
            case ["end_header"]:
                break
            case ["comment" | "obj_info" as word, *_]:
                comments.append(line[len(word) :].strip())
            case ["format", word, _] if word in _BYTE_ORDERS and byte_order is None:
                byte_order = _BYTE_ORDERS[word]
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                properties = []
                elements[name] = int(count), properties
            case ["property", "list", _, _, name] if properties is not None:
                properties.append((name, ""))
            case ["property", kind, name] if properties is not None and kind in _SCALARS:
                properties.append((name, _SCALARS[kind]))
            case []:
                pass
            case _:
                raise ValueError(f"bad .ply header line {line!r:.60}")
    if byte_order is None:
        raise ValueError("its header names no format")
    if "vertex" not in elements:
        raise ValueError("it has no vertices")
    return PlyHeader(byte_order, elements, tuple(comments), file.tell())


def header_bytes(
    elements: Sequence[tuple[str, int, Sequence[tuple[str, str]]]], comments: Iterable[str] = ()
) -> bytes:
    """Return the header of a binary little-endian .ply.

    ``elements``: name, count, and properties as (type, name), such as ("float", "x").
    ``comments``: lines of ASCII.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {comment}" for comment in comments]
    for name, count, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {own}" for kind, own in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def double_ply(xyz: np.ndarray, rgb: np.ndarray, faces: np.ndarray | None = None) -> bytes:
    """Return a .ply of coloured points (V, 3) in float64, or of a mesh with triangles (F, 3).

    ``rgb``: (V, 3) uint8.
    """
    rows = np.empty(len(xyz), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    rows["xyz"] = xyz
    rows["rgb"] = rgb
    properties = [
        *(("double", name) for name in "xyz"),
        *(("uchar", name) for name in ("red", "green", "blue")),
    ]
    elements = [("vertex", len(rows), properties)]
    if faces is None:
        return header_bytes(elements) + rows.tobytes()
    corners = np.empty(len(faces), [("count", "u1"), ("rows", "<i4", 3)])
    corners["count"] = 3
    corners["rows"] = faces
    elements.append(("face", len(faces), [("list uchar int", "vertex_indices")]))
    return header_bytes(elements) + rows.tobytes() + corners.tobytes()
