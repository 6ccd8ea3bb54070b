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
from pathlib import Path

import numpy as np
import torch

from dyngs.core.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.core.gaussians import Gaussians, morton_order
from dyngs.io.fields import require_at_most
from dyngs.io.formats.packing import (
    logit,
    pack_fractions,
    pack_rotations,
    unpack_fractions,
    unpack_rotations,
)
from dyngs.io.formats.splat_file import (
    MAX_GAUSSIANS,
    MAX_LOG_SCALE,
    SplatFile,
    header_comments,
    parse_comments,
    unit_rotations,
)

_DEGREE_OF_REST = {3 * (num_sh_terms(degree) - 1): degree for degree in range(MAX_SH_DEGREE + 1)}
_DC = tuple(f"f_dc_{i}" for i in range(3))
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROT = tuple(f"rot_{i}" for i in range(4))
_POSITION: tuple[str, ...] = ("x", "y", "z")
_REQUIRED = (*_POSITION, *_DC, "opacity", *_SCALE, *_ROT)
# SuperSplat's compressed .ply takes 16 bytes per Gaussian, in chunks of 256 that share their
# ranges. Elements: chunk (smallest and largest position, logarithm of the scale and colour), vertex
# (four packed uint32) and, with harmonics, sh (a byte per number, channel-major, from -4 to 4).
_PER_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SIZE = ("scale_x", "scale_y", "scale_z")
_COLOUR = ("r", "g", "b")
_BITS_3 = (11, 10, 11)
_BITS_4 = (8, 8, 8, 8)
_SH_RANGE = 8.0
_MOST_LOG = 20.0


def read_ply(path: Path) -> SplatFile:
    """Read a binary little-endian .ply, plain or compressed, with properties in any order and
    without a check of their values.

    Means of a plain .ply are float64. Scalar types other than float32 are converted; other
    properties, and elements other than ``vertex``, are skipped.
    """
    elements, comments = read_elements(path)
    if "vertex" not in elements:
        raise ValueError("it has no vertices, or unsupported list properties")
    vertices = elements["vertex"]
    require_at_most(path, len(vertices), MAX_GAUSSIANS, "Gaussians")
    is_compressed = "packed_position" in (vertices.dtype.names or ())
    gaussians = _unpacked(elements) if is_compressed else _gaussians(vertices)
    return parse_comments(SplatFile(gaussians, comments=comments))


def write_ply(path: Path, splat: SplatFile) -> None:
    """Write a plain .ply, not atomically."""
    gaussians = splat.gaussians.detach().to(device="cpu", dtype=torch.float32)
    sh = gaussians.sh
    normals = torch.zeros_like(gaussians.means)
    numbers = [gaussians.means, normals, sh[:, 0], sh[:, 1:].transpose(1, 2).flatten(1)]
    numbers += [gaussians.logit_opacities[:, None], gaussians.log_scales, gaussians.quats]
    table = torch.cat(numbers, dim=1).numpy().astype("<f4")
    rest = [f"f_rest_{i}" for i in range(3 * (sh.shape[1] - 1))]
    names = ("x", "y", "z", "nx", "ny", "nz", *_DC, *rest, "opacity", *_SCALE, *_ROT)
    with open(path, "wb") as file:
        file.write(
            header_bytes(
                [("vertex", len(table), [("float", name) for name in names])],
                header_comments(splat),
            )
        )
        file.write(np.ascontiguousarray(table).data)


def _gaussians(rows: np.ndarray) -> Gaussians:
    from numpy.lib.recfunctions import structured_to_unstructured

    present = rows.dtype.names or ()
    count = sum(name.startswith("f_rest_") for name in present)
    missing = [name for name in _REQUIRED if name not in present]
    if missing or count not in _DEGREE_OF_REST:
        raise ValueError(
            f"not a 3DGS .ply: vertices have no {' '.join(missing[:6])}"
            if missing
            else f"{count} f_rest properties do not match any supported SH degree"
        )
    names = ["opacity", *_SCALE, *_ROT, *_DC, *(f"f_rest_{i}" for i in range(count))]
    with np.errstate(over="ignore"):
        # doubles beyond float32 become Inf and are reported as such
        table = structured_to_unstructured(rows[names], np.float32)
        means = structured_to_unstructured(rows[list(_POSITION)], np.float64)
    columns = torch.from_numpy(np.ascontiguousarray(table))
    rest = columns[:, 11:].reshape(len(rows), 3, count // 3).transpose(1, 2)
    return Gaussians(
        means=torch.from_numpy(np.ascontiguousarray(means)),
        quats=unit_rotations(columns[:, 4:8]),
        log_scales=columns[:, 1:4].contiguous(),
        logit_opacities=columns[:, 0].contiguous(),
        sh=torch.cat([columns[:, None, 8:11], rest], dim=1).contiguous(),
    )


def _unpacked(elements: Mapping[str, np.ndarray]) -> Gaussians:
    """Return the Gaussians of a compressed .ply; colours and logits may be infinite."""
    chunks = elements["chunk"]
    vertices = elements["vertex"]
    chunk_of = np.arange(len(vertices)) // _PER_CHUNK

    def ranged(fractions: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
        low, high = (
            np.stack([chunks[f"{end}_{axis}"] for axis in axes], axis=1)[chunk_of]
            for end in ("min", "max")
        )
        with np.errstate(all="ignore"):  # ranges of others may be NaN or infinite
            return (low + fractions * (high - low)).astype(np.float32)

    position, rotation, size, colour = (vertices[name].astype(np.uint32) for name in _PACKED)
    rgba = unpack_fractions(colour, _BITS_4)
    has_ranges = "min_r" in (chunks.dtype.names or ())
    rgb = ranged(rgba[:, :3], _COLOUR) if has_ranges else rgba[:, :3]
    sh = ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None]
    if "sh" in elements:
        sh = np.concatenate([sh, _rest(elements["sh"])], axis=1)
    return Gaussians(
        means=torch.from_numpy(ranged(unpack_fractions(position, _BITS_3), _POSITION)),
        quats=torch.from_numpy(unpack_rotations(rotation)),
        log_scales=torch.from_numpy(ranged(unpack_fractions(size, _BITS_3), _SIZE)),
        logit_opacities=torch.from_numpy(logit(rgba[:, 3])),
        sh=torch.from_numpy(sh),
    )


def _rest(table: np.ndarray) -> np.ndarray:
    """Return the harmonics (N, K - 1, 3) of the element sh."""
    names = [f"f_rest_{i}" for i in range(len(table.dtype.names or ()))]
    if _DEGREE_OF_REST.get(len(names), 4) > 3:
        raise ValueError(f"its element 'sh' has {len(names)} values per row")
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
    log_scales = gaussians.log_scales.numpy().clip(-_MOST_LOG, min(_MOST_LOG, MAX_LOG_SCALE))
    for values in (gaussians.means.numpy(), log_scales, sh[:, 0] * SH_C0 + 0.5):
        low = np.minimum.reduceat(values, starts)
        high = np.maximum.reduceat(values, starts)
        ranges += [low, high]
        span = np.where(high > low, high - low, 1)
        fractions.append((values - low[chunk_of]) / span[chunk_of])
    words = [
        pack_fractions(fractions[0], _BITS_3),
        pack_rotations(gaussians.quats.numpy()),
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
_MOST_HEADER_BYTES = 1 << 20


def read_elements(path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Return the elements of a binary little-endian .ply as structured arrays (N,), and its
    comments.

    An element with list properties, and those behind it, are left out. Raises ValueError: a header
    that is wrong, or the file is truncated.
    """
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    comments: list[str] = []
    found: dict[str, np.ndarray] = {}
    with open(path, "rb") as file:
        if file.readline(16).rstrip(b"\r\n") != b"ply":
            raise ValueError("it does not start with 'ply'")
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
                case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count):
                    elements.append((name, int(count), []))
                case ["property", "list", *_, name] if elements:
                    elements[-1][2].append((name, "O"))
                case ["property", kind, name] if elements and kind in _SCALARS:
                    elements[-1][2].append((name, f"<{_SCALARS[kind]}"))
                case ["format", "binary_little_endian", _] | []:
                    pass
                case _:
                    raise ValueError(f"unsupported header line {line!r:.60}")
        size = os.fstat(file.fileno()).st_size
        for name, count, properties in elements:
            row = np.dtype(properties)
            if row.hasobject:
                break
            wanted = file.tell() + count * row.itemsize
            if wanted > size:
                raise ValueError(f"it is truncated: {wanted} bytes needed, {size} found")
            found[name] = np.fromfile(file, row, count)
    return found, tuple(comments)


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


def encode_ply(xyz: np.ndarray, rgb: np.ndarray, faces: np.ndarray | None = None) -> bytes:
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
