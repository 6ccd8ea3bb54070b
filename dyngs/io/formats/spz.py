"""Niantic's ``.spz``: 20 bytes per Gaussian and one per number of the harmonics, compressed.

Versions 2 and 3 are one gzip stream of a 16-byte header and the attributes one after the other;
version 4, which is only read, is a 32-byte header, a table of sizes, and a Zstandard stream per
attribute, which needs ``pip install 'dyngs[zstd]'``. y is up: axes are right, up, back; files
that state other ones are refused.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from dyngs.core.conventions import MAX_SH_DEGREE, RasterizeMode, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.gaussians import Gaussians
from dyngs.io.fields import require_at_most
from dyngs.io.formats.packing import logit, restore_largest, split_largest
from dyngs.io.formats.splat_file import MAX_GAUSSIANS, SplatFile, unit_rotations

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_WHOLE_HEADER = 32  # bytes, of version 4
_ANTIALIASED, _HAS_EXTENSIONS = 1, 2
_COORDINATE_SYSTEM = 0xADBE0003  # type of Adobe's extension that states one
_STANDARD = 4  # x points right, y up, z back
_MOST_EXTENSION_BYTES = 1 << 16
_MOST_BYTES = 1 << 31
_COLOUR_SCALE = 0.15
_FRACTION_BITS, _MOST_FRACTION_BITS = 16, 24
_ROOT_HALF = float(np.sqrt(0.5))
_TOP = (1 << 9) - 1


def read_spz(path: Path) -> SplatFile:
    """Read a .spz of version 2 to 4.

    Raises DyngsError or ValueError: it is damaged, states other axes, or asks for too much
    memory.
    """
    data = path.read_bytes()
    is_gzip = data[:2] == b"\x1f\x8b"
    head = _inflated(data, _HEADER.size) if is_gzip else data[: _HEADER.size]
    magic, version, count, degree, bits, flags, streams = _HEADER.unpack(head)
    if magic != _MAGIC or version not in ((2, 3) if is_gzip else (4,)):
        raise ValueError("not a .spz file of version 2 to 4")
    if degree > MAX_SH_DEGREE or bits > _MOST_FRACTION_BITS:
        raise ValueError(f"unsupported SH degree {degree} or {bits} fractional bits")
    rows = {"means": 9, "alphas": 1, "colours": 3, "scales": 3, "quats": 3 if version < 3 else 4}
    rows["sh"] = 3 * (num_sh_terms(degree) - 1)
    total = count * sum(rows.values())
    require_at_most(path, count, MAX_GAUSSIANS, "Gaussians")
    require_at_most(path, total, _MOST_BYTES, "bytes of Gaussians")
    if is_gzip:
        more = _MOST_EXTENSION_BYTES if flags & _HAS_EXTENSIONS else 0
        content = _inflated(data, _HEADER.size + total + more)[_HEADER.size :]
        extensions = content[total:]
    else:
        start = int.from_bytes(data[16:20], "little")
        extensions = data[_WHOLE_HEADER:start] if flags & _HAS_EXTENSIONS else b""
        content = _decoded(path, data[start:], streams, total)
    parts = {}
    begin = 0
    for name, size in rows.items():
        parts[name] = np.frombuffer(content, np.uint8, count * size, begin).reshape(count, size)
        begin += count * size
    _require_standard_axes(extensions)
    return _splat(parts, bits, flags)


def _inflated(data: bytes, most: int) -> bytes:
    """Return at most ``most`` bytes of a gzip stream; where it ends there, its checksum has been
    compared."""
    stream = zlib.decompressobj(31)
    content = stream.decompress(data, most)
    if not stream.decompress(stream.unconsumed_tail, 1) and not stream.eof:
        raise ValueError("truncated gzip stream")
    return content


def _decoded(path: Path, data: bytes, streams: int, most: int) -> bytes:
    """Return the attributes of version 4, at most ``most`` bytes: a table of sizes comes first."""
    try:
        import zstandard
    except ImportError:
        raise DyngsError(
            f"{path}: a .spz of version 4 needs the package zstandard: pip install 'dyngs[zstd]'"
        ) from None
    content = b""
    begin = 16 * streams
    for packed, size in struct.iter_unpack("<QQ", data[:begin]):
        part = data[begin : begin + packed]
        decoder = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        with decoder.stream_reader(part) as stream:
            content += stream.read(min(size, most - len(content)))
        begin += packed
    return content


def write_spz(path: Path, splat: SplatFile) -> None:
    """Write a .spz of version 3.

    Raises DyngsError: the scene is so large that no fixed point with 24 bits holds its positions.
    """
    gaussians = splat.gaussians
    means = gaussians.means.double().numpy()
    extent = float(np.abs(means).max())
    octave = int(np.floor(np.log2(max(extent, 2.0**-_MOST_FRACTION_BITS))))
    # As fine as needed: more bits for scenes smaller than 1, fewer for what would leave 24 bits.
    fraction_bits = min(
        22 - octave, max(_FRACTION_BITS, _FRACTION_BITS - octave), _MOST_FRACTION_BITS
    )
    if fraction_bits < 0:
        raise DyngsError(f".spz stores positions up to 8e6, but the scene reaches {extent:.2g}")
    fixed = np.clip(np.round(means * (1 << fraction_bits)), -(1 << 23) + 1, (1 << 23) - 1).astype(
        "<i4"
    )
    sh = gaussians.sh[:, 1:].numpy()
    # 5 bits, 6 for degree 1; Niantic's default is one less: -5 dB
    step = np.full((sh.shape[1], 1), 8, np.float32)
    step[:3] = 4
    coded_sh = np.clip(np.round(sh * 128 / step) * step + 128, 0, 255).astype(np.uint8)
    colours = gaussians.sh[:, 0].numpy() * (_COLOUR_SCALE * 255) + 0.5 * 255
    flags = _ANTIALIASED if splat.mode is RasterizeMode.ANTIALIASED else 0
    parts = [
        _HEADER.pack(_MAGIC, 3, len(gaussians), gaussians.sh_degree, fraction_bits, flags, 0),
        fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes(),
        _as_bytes(gaussians.opacities.numpy() * 255),
        _as_bytes(colours),
        _as_bytes((gaussians.log_scales.numpy() + 10) * 16),
        _packed_rotations(gaussians.quats.numpy()).astype("<u4").tobytes(),
        coded_sh.tobytes(),
    ]
    compressor = zlib.compressobj(6, zlib.DEFLATED, 31)
    path.write_bytes(b"".join([*map(compressor.compress, parts), compressor.flush()]))


def _require_standard_axes(extensions: bytes) -> None:
    """Raise ValueError if the extensions (type, size and value each) state other axes."""
    start = 0
    while start < len(extensions):
        kind, size = struct.unpack_from("<II", extensions, start)
        value = extensions[start + 8 : start + 8 + size]
        start += 8 + size
        if start > len(extensions):
            raise ValueError("its extensions are damaged")
        system = int.from_bytes(value, "little")
        if kind == _COORDINATE_SYSTEM and system not in (0, _STANDARD):
            raise ValueError(f"coordinate system {system} is not supported, only {_STANDARD} (RUB)")


def _splat(parts: Mapping[str, np.ndarray], fraction_bits: int, flags: int) -> SplatFile:
    """Return the contents, given the bytes (N, D) of the attributes."""
    count = len(parts["alphas"])
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[:, :, 1:] = parts["means"].reshape(count, 3, 3)
    means = (wide.view("<i4")[:, :, 0] >> 8).astype(np.float32) / float(1 << fraction_bits)
    if parts["quats"].shape[1] == 3:  # version 2
        axes = parts["quats"].astype(np.float32) / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - np.square(axes).sum(axis=1, keepdims=True)))
        quats = unit_rotations(torch.from_numpy(np.concatenate([w, axes], axis=1)))
    else:
        quats = torch.from_numpy(_unpacked_rotations(parts["quats"].ravel().view("<u4")))
    base = (parts["colours"].astype(np.float32) / 255 - 0.5) / _COLOUR_SCALE
    sh = np.concatenate([base, (parts["sh"].astype(np.float32) - 128) / 128], axis=1)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        quats=quats,
        log_scales=torch.from_numpy(parts["scales"].astype(np.float32) / 16 - 10),
        logit_opacities=torch.from_numpy(logit(parts["alphas"][:, 0].astype(np.float32) / 255)),
        sh=torch.from_numpy(sh.astype(np.float32).reshape(count, -1, 3)),
    )
    is_antialiased = flags & _ANTIALIASED
    mode = RasterizeMode.ANTIALIASED if is_antialiased else RasterizeMode.CLASSIC
    return SplatFile(gaussians, mode)


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    """Return (N,) uint32: which of xyzw is largest in 2 bits, the sign and 9 bits of each of the
    others."""
    largest, others = split_largest(quats[:, [1, 2, 3, 0]])
    size = np.minimum(np.abs(others) / _ROOT_HALF * _TOP + 0.5, _TOP).astype(np.uint32)
    coded = size | ((others < 0).astype(np.uint32) << np.uint32(9))
    words = largest.astype(np.uint32)
    for column in coded.T:
        words = (words << np.uint32(10)) | column
    return words


def _unpacked_rotations(words: np.ndarray) -> np.ndarray:
    fields = np.stack(
        [(words >> np.uint32(shift)) & np.uint32(1023) for shift in (20, 10, 0)], axis=1
    )
    size = (fields & np.uint32(_TOP)).astype(np.float32) / _TOP * _ROOT_HALF
    others = np.where(fields >> np.uint32(9), -size, size)
    return restore_largest(words >> np.uint32(30), others)[:, [3, 0, 1, 2]]


def _as_bytes(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()
