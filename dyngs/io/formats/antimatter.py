"""The ``.splat`` of antimatter15's viewer: 32 bytes per Gaussian, no header, no harmonics.

Three float32 of the centre, three of the linear scales, red, green, blue and opacity as bytes, and
the rotation wxyz as bytes around 128.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dyngs.core.conventions import SH_C0
from dyngs.core.errors import DyngsError
from dyngs.io.fields import require_at_most
from dyngs.io.formats.splat_file import MAX_GAUSSIANS, SplatFile, from_linear

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read_antimatter(path: Path) -> SplatFile:
    """Read a .splat. Raises DyngsError if its size is not that of whole Gaussians."""
    size = path.stat().st_size
    if size % _ROW.itemsize:
        raise DyngsError(
            f"{path}: truncated: {size:,} bytes are not a multiple of {_ROW.itemsize} (.splat)"
        )
    require_at_most(path, size // _ROW.itemsize, MAX_GAUSSIANS, "Gaussians")
    rows = np.fromfile(path, _ROW)
    rgba = rows["rgba"].astype(np.float32) / 255
    quats = (rows["quats"].astype(np.float32) - 128) / 128
    sh = (rgba[:, None, :3] - 0.5) / SH_C0
    return SplatFile(from_linear(rows["means"], quats, rows["scales"], rgba[:, 3], sh))


def write_antimatter(path: Path, splat: SplatFile) -> None:
    """Write a .splat, large and opaque Gaussians first, so that viewers that show a part show the
    most of it."""
    gaussians = splat.gaussians
    weight = gaussians.log_scales.double().sum(1).exp() * gaussians.opacities
    gaussians = gaussians.select(torch.argsort(weight, descending=True, stable=True))
    rows = np.zeros(len(gaussians), _ROW)
    rows["means"], rows["scales"] = gaussians.means.numpy(), gaussians.scales.numpy()
    colours = torch.cat([gaussians.base_rgb, gaussians.opacities[:, None]], dim=1)
    rows["rgba"] = (colours.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    rows["quats"] = (gaussians.quats * 128 + 128).round().clamp(0, 255).to(torch.uint8).numpy()
    path.write_bytes(rows.tobytes())
