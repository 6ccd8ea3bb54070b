"""The standard 3DGS ``.ply``: one vertex per Gaussian, parameters as optimised.

Layout written (binary little endian, float32)::

    x y z  nx ny nz (zeros)  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

``opacity`` is a logit, ``scale`` a natural logarithm, ``rot`` a quaternion wxyz; ``f_rest`` is channel-major: all red
terms, then green, then blue. Header comments say what the numbers leave open: ``SplatRenderMode: default|mip`` (how to
render the file), ``SH degree``, ``eps2d`` (the 2D low-pass variance), ``up`` (the axis that points up), ``turned`` and
``world_offset`` (from the axes of the capture to those of the file: see ``SplatFile``).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from dyngs.conventions import MAX_SH_DEGREE, RasterizeMode, num_sh_terms
from dyngs.errors import DyngsError, reading
from dyngs.files.write import atomic_file
from dyngs.gaussians import Gaussians
from dyngs.splats.compressed_ply import is_compressed, read_compressed, write_compressed
from dyngs.splats.ply_header import PlyHeader, header_bytes, read_header
from dyngs.splats.splat_file import Nonfinite, SplatFile, described, drawable, header_comments, unit_rotations

__all__ = ["read_ply", "read_raw", "write_compressed", "write_ply", "write_raw"]

_DEGREE_OF_REST = {3 * (num_sh_terms(degree) - 1): degree for degree in range(MAX_SH_DEGREE + 1)}


def write_ply(
    path: Path | str,
    gaussians: Gaussians,
    mode: RasterizeMode = RasterizeMode.CLASSIC,
    comments: Iterable[str] = (),
    *,
    eps2d: float | None = None,
    world_offset: Sequence[float] | np.ndarray | None = None,
    columns: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Write Gaussians as .ply, atomically: an old file stays until the new one is complete. Return the path.

    ``path``: file to write; its folder is created. ``gaussians``: N >= 1 Gaussians, SH degree 0 to 4; any 3D filter
    must be fused into them already. ``mode``: noted in the header, as viewers must render an antialiased model with
    opacity compensation. ``comments``: further header comments, one line of ASCII each. ``eps2d``: 2D low-pass variance
    (px^2) to note in the header. ``world_offset``: (3,) offset to note in the header; zeros are not noted. ``columns``:
    further properties (N,) by name, written as float32 after all others; ``read_ply`` skips them. Raises DyngsError: no
    Gaussians, non-finite values, or the file cannot be written.
    """
    path = Path(path)
    more = columns or {}
    table = np.column_stack([_table(gaussians), *(x.astype("<f4") for x in more.values())])
    if len(table) == 0:
        raise DyngsError(f"{path}: not written, there are no Gaussians")
    bad = int((~np.isfinite(table).all(axis=1)).sum())
    if bad:
        raise DyngsError(f"{path}: not written, {bad} of {len(table)} Gaussians have non-finite values")
    x, y, z = (0.0, 0.0, 0.0) if world_offset is None else map(float, world_offset)
    notes = header_comments(SplatFile(gaussians, mode, eps2d, (x, y, z)))
    header = _header([*notes, *comments], len(table), gaussians.sh.shape[1], tuple(more))
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        file.write(header)
        file.write(table.data)
    return path


def read_ply(path: Path | str, *, nonfinite: Nonfinite = "error") -> SplatFile:
    """Read a 3DGS .ply, plain or compressed by SuperSplat, binary or ascii, with properties in any order.

    ``path``: the file, with or without normals and extra properties. Scalar types other than float32 are converted;
    elements other than ``vertex`` are skipped. ``nonfinite``: as in ``dyngs.splats.formats.read_splats``. Raises
    DyngsError: not a splat file, truncated, empty or non-finite; nothing large is allocated before the vertex count has
    been compared with the size of the file.
    """
    path = Path(path)
    with reading(path):
        return drawable(read_raw(path), path, nonfinite)


def read_raw(path: Path) -> SplatFile:
    """Read a .ply as ``read_ply`` does, whatever its values are."""
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: cannot read: it is no file; name a 3DGS .ply")
    try:
        with open(path, "rb") as file:
            header = read_header(file, path)
            if is_compressed(header):
                gaussians = read_compressed(header, file, path)
            else:
                degree = _check_properties(header, path)
                gaussians = _gaussians(header.read_element(file, path), degree)
    except OSError as error:
        raise DyngsError(f"{path}: cannot read: {error.strerror or error}") from error
    return described(SplatFile(gaussians, comments=header.comments), path)


def write_raw(path: Path, splat: SplatFile) -> None:
    """Write a plain .ply, not atomically."""
    table = _table(splat.gaussians)
    with open(path, "wb") as file:
        file.write(_header(header_comments(splat), len(table), splat.gaussians.sh.shape[1]))
        file.write(table.data)


def _table(gaussians: Gaussians) -> np.ndarray:
    """Return (N, P) little-endian float32, columns in the order of ``_property_names``."""
    parts = {name: x.detach().cpu().float() for name, x in gaussians.tensors().items()}
    n = len(gaussians)
    columns = [
        parts["means"],
        torch.zeros(n, 3, device="cpu"),
        parts["sh"][:, 0],
        parts["sh"][:, 1:].transpose(1, 2).flatten(1),
        parts["logit_opacities"][:, None],
        parts["log_scales"],
        parts["quats"],
    ]
    return np.ascontiguousarray(torch.cat(columns, dim=1).numpy(), dtype="<f4")


def _property_names(num_terms: int) -> list[str]:
    rest = [f"f_rest_{i}" for i in range(3 * (num_terms - 1))]
    return ["x", "y", "z", "nx", "ny", "nz", *_DC, *rest, "opacity", *_SCALE, *_ROT]


_DC = tuple(f"f_dc_{i}" for i in range(3))
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROT = tuple(f"rot_{i}" for i in range(4))
_REQUIRED = ("x", "y", "z", *_DC, "opacity", *_SCALE, *_ROT)


def _header(comments: Iterable[str], count: int, num_terms: int, more: tuple[str, ...] = ()) -> bytes:
    names = (*_property_names(num_terms), *more)
    return header_bytes([("vertex", count, [("float", name) for name in names])], comments)


def _check_properties(header: PlyHeader, path: Path) -> int:
    present = set(header.vertex_names)
    missing = [name for name in _REQUIRED if name not in present]
    if missing:
        shown = " ".join(missing[:6]) + (f" and {len(missing) - 6} more" if len(missing) > 6 else "")
        raise DyngsError(f"{path}: is not a 3DGS .ply, its vertices have no {shown}")
    rest = {name for name in present if name.startswith("f_rest_")}
    if len(rest) not in _DEGREE_OF_REST or rest != {f"f_rest_{i}" for i in range(len(rest))}:
        allowed = ", ".join(map(str, _DEGREE_OF_REST))
        raise DyngsError(
            f"{path}: its f_rest properties (there are {len(rest)}) must be f_rest_0.. in counts {allowed}"
        )
    return _DEGREE_OF_REST[len(rest)]


def _gaussians(rows: np.ndarray, degree: int) -> Gaussians:
    def columns(names: Sequence[str]) -> torch.Tensor:
        out = np.empty((len(rows), len(names)), dtype=np.float32)
        with np.errstate(over="ignore"):  # doubles beyond float32 become Inf and are reported as such
            for i, name in enumerate(names):
                out[:, i] = rows[name]
        return torch.from_numpy(out)

    terms = num_sh_terms(degree) - 1
    rest = columns([f"f_rest_{i}" for i in range(3 * terms)]).reshape(len(rows), 3, terms).transpose(1, 2)
    return Gaussians(
        means=columns(("x", "y", "z")),
        quats=unit_rotations(columns(_ROT)),
        log_scales=columns(_SCALE),
        logit_opacities=columns(("opacity",))[:, 0],
        sh=torch.cat([columns(_DC)[:, None], rest], dim=1).contiguous(),
    )
