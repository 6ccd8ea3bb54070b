"""SuperSplat's compressed ``.ply``: 16 bytes per Gaussian, in chunks of 256 that share their ranges.

Elements ``chunk`` (smallest and largest position, logarithm of the scale and colour), ``vertex`` (four packed uint32)
and, with harmonics, ``sh`` (a byte per number, channel-major as in the plain .ply, from -4 to 4).
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from dyngs.conventions import SH_C0, num_sh_terms
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.order import morton_order
from dyngs.splats.packing import logit, pack_fractions, smallest_three, unpack_fractions, whole_rotations
from dyngs.splats.ply_header import PlyHeader, header_bytes
from dyngs.splats.splat_file import MOST_LOG_SCALE, SplatFile, header_comments, require_count

_PER_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_RANGES = {
    name: tuple(f"{end}_{axis}" for end in ("min", "max") for axis in axes)
    for name, axes in (
        ("position", ("x", "y", "z")),
        ("scale", ("scale_x", "scale_y", "scale_z")),
        ("colour", ("r", "g", "b")),
    )
}
_BITS_3 = (11, 10, 11)
_BITS_4 = (8, 8, 8, 8)
_SH_RANGE = 8.0
_MOST_LOG = 20.0
_DEGREE_OF_REST = {3 * (num_sh_terms(degree) - 1): degree for degree in range(4)}


def is_compressed(header: PlyHeader) -> bool:
    """Return whether a .ply is a compressed one."""
    return "packed_position" in header.vertex_names


def read_compressed(header: PlyHeader, file: BinaryIO, path: Path) -> Gaussians:
    """Return the Gaussians of a compressed .ply; colours and logits may be infinite.

    Raises DyngsError: properties or chunks are missing, or the file is cut off.
    """
    missing = [name for name in _PACKED if name not in header.vertex_names]
    if missing or "chunk" not in header.names:
        raise DyngsError(f"{path}: is a compressed .ply without {' '.join(missing) or 'chunks'}; export it again")
    chunks = header.read_element(file, path, "chunk")
    vertices = header.read_element(file, path, "vertex")
    if len(chunks) * _PER_CHUNK < len(vertices):
        raise DyngsError(f"{path}: has {len(chunks)} chunks for {len(vertices)} Gaussians; export it again")
    require_count(path, len(vertices), 16 * len(vertices), 16)
    chunk_of = np.arange(len(vertices)) // _PER_CHUNK

    def ranged(packed: str, name: str) -> np.ndarray:
        low, high = (_columns(chunks, names, path)[chunk_of] for names in (_RANGES[name][:3], _RANGES[name][3:]))
        fraction = unpack_fractions(vertices[packed].astype(np.uint32), _BITS_3)
        with np.errstate(all="ignore"):  # ranges of others may be NaN or infinite
            return (low + fraction * (high - low)).astype(np.float32)

    colour = unpack_fractions(vertices["packed_color"].astype(np.uint32), _BITS_4)
    rgb = colour[:, :3]
    if "min_r" in (chunks.dtype.names or ()):
        low, high = (
            _columns(chunks, names, path)[chunk_of] for names in (_RANGES["colour"][:3], _RANGES["colour"][3:])
        )
        with np.errstate(all="ignore"):
            rgb = low + rgb * (high - low)
    base = ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None]
    rest = _read_rest(header, file, path, len(vertices))
    return Gaussians(
        means=torch.from_numpy(ranged("packed_position", "position")),
        quats=torch.from_numpy(whole_rotations(vertices["packed_rotation"].astype(np.uint32))),
        log_scales=torch.from_numpy(ranged("packed_scale", "scale")),
        logit_opacities=torch.from_numpy(logit(colour[:, 3])),
        sh=torch.from_numpy(np.concatenate([base, rest], axis=1)),
    )


def write_compressed(path: Path, splat: SplatFile) -> None:
    """Write a compressed .ply, Gaussians in an order that keeps neighbours in one chunk, harmonics up to degree 3."""
    gaussians = splat.gaussians.select(torch.from_numpy(morton_order(splat.gaussians.means.numpy())))
    n = len(gaussians)
    starts = np.arange(0, n, _PER_CHUNK)
    chunk_of = np.arange(n) // _PER_CHUNK
    sh = gaussians.sh.numpy()
    kinds = {
        "position": (gaussians.means.numpy(), _BITS_3),
        "scale": (gaussians.log_scales.numpy().clip(-_MOST_LOG, min(_MOST_LOG, MOST_LOG_SCALE)), _BITS_3),
        "colour": (sh[:, 0] * SH_C0 + 0.5, _BITS_3),
    }
    ranges, fractions = [], {}
    for name, (values, _) in kinds.items():
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        ranges += [low, high]
        span = np.where(high > low, high - low, 1)
        fractions[name] = (values - low[chunk_of]) / span[chunk_of]
    alpha = gaussians.opacities.numpy()[:, None]
    words = [
        pack_fractions(fractions["position"], _BITS_3),
        smallest_three(gaussians.quats.numpy()),
        pack_fractions(fractions["scale"], _BITS_3),
        pack_fractions(np.concatenate([fractions["colour"], alpha], axis=1), _BITS_4),
    ]
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(n, -1)
    coded = np.clip(np.trunc((rest / _SH_RANGE + 0.5) * 256), 0, 255).astype(np.uint8)
    with open(path, "wb") as file:
        file.write(_header(splat, len(starts), n, rest.shape[1]))
        file.write(np.concatenate(ranges, axis=1).astype("<f4").tobytes())
        file.write(np.stack(words, axis=1).astype("<u4").tobytes())
        file.write(coded.tobytes())


def _header(splat: SplatFile, chunks: int, count: int, rest: int) -> bytes:
    ranges = [("float", name) for names in _RANGES.values() for name in names]
    elements = [("chunk", chunks, ranges), ("vertex", count, [("uint", name) for name in _PACKED])]
    if rest:
        elements.append(("sh", count, [("uchar", f"f_rest_{i}") for i in range(rest)]))
    return header_bytes(elements, header_comments(splat))


def _read_rest(header: PlyHeader, file: BinaryIO, path: Path, count: int) -> np.ndarray:
    if "sh" not in header.names:
        return np.zeros((count, 0, 3), np.float32)
    table = header.read_element(file, path, "sh")
    names = table.dtype.names or ()
    if len(table) != count or len(names) not in _DEGREE_OF_REST:
        raise DyngsError(f"{path}: its element sh has {len(table)} rows of {len(names)} numbers; export it again")
    coded = _columns(table, tuple(f"f_rest_{i}" for i in range(len(names))), path)
    fraction = np.where(coded == 0, 0, np.where(coded == 255, 1, (coded + 0.5) / 256))
    return ((fraction - 0.5) * _SH_RANGE).reshape(count, 3, -1).transpose(0, 2, 1).astype(np.float32)


def _columns(table: np.ndarray, names: tuple[str, ...], path: Path) -> np.ndarray:
    missing = [name for name in names if name not in (table.dtype.names or ())]
    if missing:
        raise DyngsError(f"{path}: is a compressed .ply without {missing[0]}; export it again")
    return np.stack([table[name].astype(np.float32) for name in names], axis=1)
