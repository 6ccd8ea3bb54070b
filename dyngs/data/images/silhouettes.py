"""Silhouettes of people: masks in images or HDF5 files that become the alpha of an image."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import Silhouette
from dyngs.data.images.images import read_image
from dyngs.errors import DyngsError
from dyngs.files.hdf5 import read_hdf5

MASKS = "masks"
"""Name of the data set of masks in an HDF5 file."""


def cut_out(pixels: Tensor, silhouette: Silhouette) -> Tensor:
    """Return the (H, W, 4) uint8 image of the person alone, straight alpha, from ``pixels`` (H, W, 3 or 4) uint8.

    Raises:
        DyngsError: the silhouette is missing, damaged or of another size.
    """
    alpha = _read_alpha(silhouette)
    if alpha.shape != pixels.shape[:2]:
        raise DyngsError(
            f"{silhouette.path}: the mask is {alpha.shape[1]}x{alpha.shape[0]} but its image is {pixels.shape[1]}x"
            f"{pixels.shape[0]}; make them the same size"
        )
    if pixels.shape[-1] == 4:
        alpha = (alpha.float() * pixels[..., 3].float() / 255).round().to(torch.uint8)
    return torch.cat([pixels[..., :3], alpha[..., None]], dim=-1)


def _read_alpha(silhouette: Silhouette) -> Tensor:
    """Read the silhouette as (H, W) uint8 alpha, 255 where the person is."""
    if silhouette.row is None:
        levels = read_image(silhouette.path)[..., :3]
        levels = levels.amax(-1) if silhouette.person == "nonzero" else levels.float().mean(-1).round().to(torch.uint8)
    else:
        row = read_hdf5(silhouette.path, MASKS, silhouette.row)
        if row.ndim != 2 or row.dtype not in (np.uint8, np.bool_):
            raise DyngsError(f"{silhouette.path}: '{MASKS}' must hold bytes in the shape (F, H, W); export it again")
        levels = torch.as_tensor(row.astype(np.uint8), device="cpu")
    if silhouette.person == "nonzero":
        return (levels > 0).to(torch.uint8) * 255
    return 255 - levels if silhouette.person == "black" else levels


def silhouette_box(alpha: Tensor, above: float = 0.0) -> tuple[slice, slice] | None:
    """Return rows and columns of the smallest box around the pixels of alpha (H, W) above a limit; None without any."""
    shown = alpha > above
    rows, columns = (torch.nonzero(shown.any(axis))[:, 0] for axis in (1, 0))
    return (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)) if len(rows) else None
