"""The standard 3DGS ``.ply``: one vertex per Gaussian, parameters as optimised.

Layout written (binary little endian, float32)::

    x y z  nx ny nz (zeros)  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

``opacity`` is a logit, ``scale`` a natural logarithm, ``rot`` a quaternion wxyz; ``f_rest`` is channel-major: all red
terms, then green, then blue. Header comments say what the numbers leave open: ``SplatRenderMode: default|mip`` (how to
render the file), ``SH degree``, ``eps2d`` (the 2D low-pass variance), ``up`` (the axis that points up), ``turned`` and
``world_offset`` (from the axes of the capture to those of the file: see ``SplatFile``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from dyngs.conventions import MAX_SH_DEGREE, num_sh_terms
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.splats.compressed_ply import is_compressed, read_compressed, write_compressed
from dyngs.splats.ply_header import PlyHeader, header_bytes, read_header
from dyngs.splats.splat_file import SplatFile, described, header_comments, unit_rotations

__all__ = ["read_ply", "write_compressed", "write_ply"]

_DEGREE_OF_REST = {3 * (num_sh_terms(degree) - 1): degree for degree in range(MAX_SH_DEGREE + 1)}


def read_ply(path: Path) -> SplatFile:
    """Read a .ply, plain or compressed, binary or ascii, whatever its values are; properties may have any order.

    Scalar types other than float32 are converted; other properties, and elements other than ``vertex``, are skipped.
    """
    with open(path, "rb") as file:
        header = read_header(file, path)
        if is_compressed(header):
            gaussians = read_compressed(header, file, path)
        else:
            degree = _check_properties(header, path)
            gaussians = _gaussians(header.read_element(file, path), degree)
    return described(SplatFile(gaussians, comments=header.comments), path)


def write_ply(path: Path, splat: SplatFile, columns: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a plain .ply, not atomically.

    ``columns`` are further properties (N,) by name, written as float32 after all others, which ``read_ply`` skips.
    """
    more = columns or {}
    table = np.column_stack([_table(splat.gaussians), *(x.astype("<f4") for x in more.values())])
    rest = [f"f_rest_{i}" for i in range(3 * (splat.gaussians.sh.shape[1] - 1))]
    names = ("x", "y", "z", "nx", "ny", "nz", *_DC, *rest, "opacity", *_SCALE, *_ROT, *more)
    with open(path, "wb") as file:
        file.write(header_bytes([("vertex", len(table), [("float", name) for name in names])], header_comments(splat)))
        file.write(table.data)


def _table(gaussians: Gaussians) -> np.ndarray:
    """Return (N, P) little-endian float32, columns in the order of the module's layout."""
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


_DC = tuple(f"f_dc_{i}" for i in range(3))
_SCALE = tuple(f"scale_{i}" for i in range(3))
_ROT = tuple(f"rot_{i}" for i in range(4))
_REQUIRED = ("x", "y", "z", *_DC, "opacity", *_SCALE, *_ROT)


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
