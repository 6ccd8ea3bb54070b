"""Maps that belong to images: depth, optical flow, labels, silhouettes; sampled at the nearest
pixel."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.capture import Silhouette, View
from dyngs.data.images.images import read_image, read_raw
from dyngs.data.images.lens import LensMap, undistort_points
from dyngs.io.containment import check_inside, check_size
from dyngs.io.numpy_files import read_hdf5, read_map

MILLIMETRE = 1e-3  # unit of maps in whole numbers, as in nerfstudio
_FARTHEST = 1e9
_NEAREST = 1e-9


def read_depth(path: Path) -> Tensor:
    """Read a depth map as (h, w) float32; 0 = unknown (NaN, infinity or <= 0 in the file).

    Integer images (16-bit PNG, TIFF) are in millimetres and become metres. Floats (``.exr``,
    ``.npy``, ``.npz`` with one array or one named ``depth``) are unchanged. The first channel is
    used.
    """
    if path.suffix.lower() in (".npy", ".npz"):
        values = read_map(path, "depth")
        unit = 1.0
    else:
        values, is_integer = read_raw(path)
        unit = MILLIMETRE if is_integer else 1.0
    if values.ndim == 3:
        values = values[..., 0]
    if values.ndim != 2 or not values.size:
        raise DyngsError(
            f"{path}: a depth map must be (height, width), got {values.shape}; export it again"
        )
    depth = np.where(np.isfinite(values), values, 0.0) * unit
    known = (depth > _NEAREST) & (depth < _FARTHEST)
    return torch.as_tensor(np.where(known, depth, 0.0).astype(np.float32), device="cpu")


def read_labels(path: Path) -> Tensor:
    """Read a label image as (h, w) int64, 0 = none: grey levels, or one label per colour, without
    alpha."""
    values = np.nan_to_num(read_raw(path)[0]).clip(0, 65535).astype(np.int64)
    colours = values[..., : 1 if values.shape[-1] < 3 else 3]
    return torch.as_tensor(colours @ (1 << 16 * np.arange(colours.shape[-1])), device="cpu")


_MAGIC = 202021.25
_LONGEST = 1e5  # longer displacements in pixels mean "unknown"; Middlebury writes more than 1e9


def read_flow(path: Path) -> Tensor:
    """Read a flow field as (h, w, 2) float32 displacements (x, y) in pixels, NaN = unknown.

    Formats: ``.npy``, ``.npz`` with one array or one named ``flow``, or ``.flo`` (Baker et al.
    2011, Middlebury).
    """
    values = _read_flo(path) if path.suffix.lower() == ".flo" else read_map(path, "flow")
    if values.ndim != 3 or values.shape[2] != 2 or not values.size:
        raise DyngsError(
            f"{path}: a flow field must be (height, width, 2), got {values.shape}; export it again"
        )
    known = (np.abs(values) < _LONGEST).all(-1, keepdims=True)  # phrased so that NaN fails it
    return torch.as_tensor(np.where(known, values, np.nan).astype(np.float32), device="cpu")


def _read_flo(path: Path) -> np.ndarray:
    """Read width, height and float32 displacements, little endian, row by row."""
    if not check_inside(path).is_file():
        raise DyngsError(f"{path}: no such flow field; restore it or remove it from the capture")
    with (
        wrap_read_errors(path, "it must be a .flo file of Middlebury; export it again"),
        path.open("rb") as file,
    ):
        magic, width, height = struct.unpack("<fii", file.read(12))
        if magic != _MAGIC or width < 1 or height < 1:
            raise ValueError("its first bytes are not those of a .flo file")
        check_size(path, width, height)
        values = np.frombuffer(file.read(8 * width * height), "<f4")
        return values.reshape(height, width, 2)


MASKS = "masks"
"""Name of the data set of masks in an HDF5 file."""


def apply_silhouette(pixels: Tensor, silhouette: Silhouette) -> Tensor:
    """Set the alpha of ``pixels`` (H, W, 3 or 4) uint8 to the silhouette; returns (H, W, 4),
    straight alpha."""
    alpha = _read_alpha(silhouette)
    if alpha.shape != pixels.shape[:2]:
        raise DyngsError(
            f"{silhouette.path}: the mask is {alpha.shape[1]}x{alpha.shape[0]} but its image is "
            f"{pixels.shape[1]}x{pixels.shape[0]}; make them the same size"
        )
    if pixels.shape[-1] == 4:
        alpha = (alpha.float() * pixels[..., 3].float() / 255).round().to(torch.uint8)
    return torch.cat([pixels[..., :3], alpha[..., None]], dim=-1)


def _read_alpha(silhouette: Silhouette) -> Tensor:
    """Read the silhouette as (H, W) uint8 alpha, 255 on the person."""
    if silhouette.row is None:
        levels = read_image(silhouette.path)[..., :3]
        levels = (
            levels.amax(-1)
            if silhouette.person == "nonzero"
            else levels.float().mean(-1).round().to(torch.uint8)
        )
    else:
        row = read_hdf5(silhouette.path, MASKS, silhouette.row)
        if row.ndim != 2 or row.dtype not in (np.uint8, np.bool_):
            raise DyngsError(
                f"{silhouette.path}: '{MASKS}' must hold bytes in the shape (F, H, W); export it "
                "again"
            )
        levels = torch.as_tensor(row.astype(np.uint8), device="cpu")
    if silhouette.person == "nonzero":
        return (levels > 0).to(torch.uint8) * 255
    return 255 - levels if silhouette.person == "black" else levels


def silhouette_box(alpha: Tensor, above: float = 0.0) -> tuple[slice, slice] | None:
    """Return rows and columns of the bounding box of alpha (H, W) above a limit, None if empty."""
    shown = alpha > above
    rows, columns = (torch.nonzero(shown.any(axis))[:, 0] for axis in (1, 0))
    return (
        (slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1))
        if len(rows)
        else None
    )


def nearest_positions(width: int, height: int, grid: Tensor | None = None) -> Tensor:
    """Return the pixel centres of a (height, width) image, (height, width, 2) in [-1, 1] between
    edges.

    With ``LensMap.grid``, their positions in the distorted image.
    """
    x, y = ((2 * torch.arange(n, device="cpu") + 1) / n - 1 for n in (width, height))
    positions = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    return positions if grid is None else sample_nearest(grid, positions)


def sample_nearest(values: Tensor, positions: Tensor) -> Tensor:
    """Sample ``values`` (h, w, D) at the nearest pixels to ``positions`` (H, W, 2) in [-1, 1]."""
    size = values.new_tensor([values.shape[1], values.shape[0]])
    index = ((positions + 1) / 2 * size).floor().long()
    x, y = (index[..., i].clamp(0, values.shape[1 - i] - 1) for i in (0, 1))
    return values[y, x]


def resize_flow(flow: Tensor, width: int, height: int) -> Tensor:
    """Resize ``flow`` (H, W, 2) to (height, width, 2) and scale it to pixels of the result."""
    scale = flow.new_tensor([width / flow.shape[1], height / flow.shape[0]])
    return sample_nearest(flow, nearest_positions(width, height)) * scale


def flow_at(flow: Tensor, view: View, size: tuple[int, int], lens_map: LensMap | None) -> Tensor:
    """Return the flow of the undistorted image of ``size`` (width, height), in its pixels.

    Both ends of the flow are undistorted with ``lens_map``, if any; NaN where it is not valid.
    """
    if lens_map is None:
        return resize_flow(flow, *size)
    stored = flow.new_tensor([view.width, view.height])
    start = (nearest_positions(view.width, view.height) + 1) / 2 * stored
    at = (lens_map.grid + 1) / 2 * stored
    end = undistort_points(view.lens, view.intrinsics, at + sample_nearest(flow, lens_map.grid))
    return resize_flow(torch.where(lens_map.valid[..., None], end - start, torch.nan), *size)
