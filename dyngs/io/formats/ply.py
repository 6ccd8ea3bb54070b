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

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from dyngs.core.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.order import morton_order
from dyngs.io.formats.packing import (
    logit,
    pack_fractions,
    smallest_three,
    unpack_fractions,
    whole_rotations,
)
from dyngs.io.formats.ply_header import PlyHeader, header_bytes, read_header
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
        header = read_header(file, path)
        if "packed_position" in header.vertex_names:
            gaussians = _read_compressed(header, file, path)
        else:
            degree = _degree(header, path)
            gaussians = _gaussians(header.read_element(file, path), degree)
    return described(SplatFile(gaussians, comments=header.comments), path)


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


def _degree(header: PlyHeader, path: Path) -> int:
    present = set(header.vertex_names)
    missing = [name for name in _REQUIRED if name not in present]
    if missing:
        shown = " ".join(missing[:6]) + (
            f" and {len(missing) - 6} more" if len(missing) > 6 else ""
        )
        raise DyngsError(f"{path}: is not a 3DGS .ply, its vertices have no {shown}")
    rest = {name for name in present if name.startswith("f_rest_")}
    if len(rest) not in _DEGREE_OF_REST or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        allowed = ", ".join(map(str, _DEGREE_OF_REST))
        raise DyngsError(
            f"{path}: its f_rest properties (there are {len(rest)}) must be f_rest_0.. in counts {allowed}"
        )
    return _DEGREE_OF_REST[len(rest)]


def _gaussians(rows: np.ndarray, degree: int) -> Gaussians:
    def columns(names: Sequence[str], dtype: type[np.floating] = np.float32) -> torch.Tensor:
        out = np.empty((len(rows), len(names)), dtype=dtype)
        with np.errstate(over="ignore"):
            # doubles beyond float32 become Inf and are reported as such
            for i, name in enumerate(names):
                out[:, i] = rows[name]
        return torch.from_numpy(out)

    terms = num_sh_terms(degree) - 1
    rest = (
        columns([f"f_rest_{i}" for i in range(3 * terms)])
        .reshape(len(rows), 3, terms)
        .transpose(1, 2)
    )
    return Gaussians(
        means=columns(("x", "y", "z"), np.float64),
        quats=unit_rotations(columns(_ROT)),
        log_scales=columns(_SCALE),
        logit_opacities=columns(("opacity",))[:, 0],
        sh=torch.cat([columns(_DC)[:, None], rest], dim=1).contiguous(),
    )


def _read_compressed(header: PlyHeader, file: BinaryIO, path: Path) -> Gaussians:
    """Return the Gaussians of a compressed .ply; colours and logits may be infinite."""
    missing = [name for name in _PACKED if name not in header.vertex_names]
    if missing or "chunk" not in header.names:
        raise DyngsError(
            f"{path}: is a compressed .ply without {' '.join(missing) or 'chunks'}; export it again"
        )
    chunks = header.read_element(file, path, "chunk")
    vertices = header.read_element(file, path, "vertex")
    count = len(vertices)
    if len(chunks) * _PER_CHUNK < count:
        raise DyngsError(f"{path}: has {len(chunks)} chunks for {count} Gaussians; export it again")
    require_count(path, count, 16 * count, 16)
    words = {name: vertices[name].astype(np.uint32) for name in _PACKED}

    def ranged(fractions: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
        ends = (
            _columns(chunks, [f"{end}_{axis}" for axis in axes], path) for end in ("min", "max")
        )
        low, high = (x[np.arange(count) // _PER_CHUNK] for x in ends)
        with np.errstate(all="ignore"):  # ranges of others may be NaN or infinite
            return (low + fractions * (high - low)).astype(np.float32)

    colour = unpack_fractions(words["packed_color"], _BITS_4)
    rgb = ranged(colour[:, :3], _COLOUR) if "min_r" in (chunks.dtype.names or ()) else colour[:, :3]
    base = ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None]
    return Gaussians(
        means=torch.from_numpy(
            ranged(unpack_fractions(words["packed_position"], _BITS_3), _POSITION)
        ),
        quats=torch.from_numpy(whole_rotations(words["packed_rotation"])),
        log_scales=torch.from_numpy(
            ranged(unpack_fractions(words["packed_scale"], _BITS_3), _SIZE)
        ),
        logit_opacities=torch.from_numpy(logit(colour[:, 3])),
        sh=torch.from_numpy(np.concatenate([base, _read_rest(header, file, path, count)], axis=1)),
    )


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


def _read_rest(header: PlyHeader, file: BinaryIO, path: Path, count: int) -> np.ndarray:
    if "sh" not in header.names:
        return np.zeros((count, 0, 3), np.float32)
    table = header.read_element(file, path, "sh")
    names = [f"f_rest_{i}" for i in range(len(table.dtype.names or ()))]
    if len(table) != count or _DEGREE_OF_REST.get(len(names), 4) > 3:
        raise DyngsError(
            f"{path}: its element sh has {len(table)} rows of {len(names)} numbers; export it again"
        )
    coded = _columns(table, names, path)
    fraction = np.where(coded == 0, 0, np.where(coded == 255, 1, (coded + 0.5) / 256))
    return (
        ((fraction - 0.5) * _SH_RANGE).reshape(count, 3, -1).transpose(0, 2, 1).astype(np.float32)
    )


def _columns(table: np.ndarray, names: Sequence[str], path: Path) -> np.ndarray:
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise DyngsError(f"{path}: is a compressed .ply without {missing[0]}; export it again")
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)
