"""Tile binning and alpha blending of splats."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.native import num_threads
from dyngs.ops.projection import Projection
from dyngs.ops.registration import (
    REMEDY,
    Backward,
    Struct,
    call_core,
    check_memory,
    check_number,
    check_size,
    empty_like,
    register,
    shapes_only,
)

TILE = 16
MAX_CHANNELS = 40
MAX_ENTRIES = 2**31 - 1
LARGEST_ALPHA = 1 - 2.0**-20
"""Largest alpha for which float32 keeps enough transmittance to restore it in the backward pass."""
# Values per (Gaussian, tile) pair in the backward pass, besides colour gradients.
MOMENTS = 6


@dataclass(frozen=True)
class BlendOptions:
    """Thresholds of alpha blending (3DGS); minima of 0 give exact blending."""

    alpha_min: float = 1 / 255  # Gaussians with less alpha are skipped at a pixel
    alpha_max: float = 0.99  # alpha is clamped to this value, without gradient beyond
    transmittance_min: float = 1e-4  # blending stops before the transmittance falls below
    absgrad: bool = False  # also sum absolute gradients of the 2D means into the probe

    def __post_init__(self) -> None:
        check_number("alpha_min", self.alpha_min, 0, 1)
        check_number("alpha_max", self.alpha_max, 0, LARGEST_ALPHA)
        check_number("transmittance_min", self.transmittance_min, 0, 1)

    @property
    def thresholds(self) -> list[float]:
        return [self.alpha_min, self.alpha_max, self.transmittance_min]


@dataclass(frozen=True)
class TileEntries:
    """The E pairs of tiles and overlapping splats, sorted by view, tile, depth and index."""

    tile_offsets: Tensor  # (V T + 1,) int64, first pair of each tile
    # (2 V N,) int32, begin and end of each splat's slots in a buffer of E records
    slot_ranges: Tensor
    gaussians: Tensor  # (E,) int32, view * N + Gaussian
    slots: Tensor  # (E,) int32, slot of the pair

    def tensors(self) -> list[Tensor]:
        return [self.tile_offsets, self.slot_ranges, self.gaussians, self.slots]

    @property
    def tiles_per_gaussian(self) -> Tensor:
        """(V N,) int32."""
        begin, end = self.slot_ranges.view(-1, 2).unbind(1)
        return end - begin


@dataclass(frozen=True)
class Boundaries:
    """Weights of Gaussians near the outlines of patches, in one view (Wu et al. 2025).

    There is one Gaussian per covered pixel, on the patch that the pixel shows. The samples of
    pixels with another patch or nothing beside them, diagonals included, are on the outline of the
    patch. At a pixel, alpha is multiplied by a weight. rho is the distance in ``radius`` from the
    nearest sample on the outline of the Gaussian's patch (the first pixel's of several). The weight
    is 2^rho / 2 if the pixel shows the patch, else 1 - 2^rho / 2; 1 and 0 if rho >= 1. Samples
    nearer than 0.1 px have no gradient.
    """

    rows: Tensor  # (H, W) int32 Gaussian of each pixel; -1: none
    ids: Tensor  # (N,) int32 its patch
    samples: Tensor  # (N, 2) px, its place
    radius: float  # px


@dataclass(frozen=True)
class BlendedImages:
    """V blended images of D channels."""

    color: Tensor  # (V, H, W, D), background composited
    # (V, H, W) in [0, 1], visible fraction of the background; 1 - alpha
    transmittance: Tensor


def _settings(size: list[int], thresholds: list[float]) -> Struct:
    check_size(*size)
    return Struct("BlendSettings", (*size, *thresholds, num_threads()))


def _arrays(*splats: Tensor) -> Struct:
    return Struct(
        "SplatArraysF32" if splats[0].dtype == torch.float32 else "SplatArraysF64", splats
    )


def _bin_tiles(
    splats: list[Tensor], depths: Tensor, size: list[int], thresholds: list[float]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    if shapes_only():
        return _unknown_entries(depths, size)
    settings = _settings(size, thresholds)
    try:
        entries = call_core(depths, "bin_tiles", _arrays(*splats), depths, settings, MAX_ENTRIES)
    except DyngsError as error:
        raise DyngsError(f"render refused: {error}; {REMEDY}") from None
    tile_offsets, slot_ranges, gaussians, slots = (
        x if isinstance(x, Tensor) else torch.from_numpy(x) for x in entries
    )
    slot_ranges, gaussians, slots = (x.view(torch.int32) for x in (slot_ranges, gaussians, slots))
    return tile_offsets.view(torch.int64), slot_ranges, gaussians, slots


def _unknown_entries(depths: Tensor, size: list[int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the shapes for tracing, with an unknown number of pairs."""
    entries = torch.library.get_ctx().new_dynamic_size()
    tiles = ((size[0] + TILE - 1) // TILE) * ((size[1] + TILE - 1) // TILE)
    views, n = depths.shape
    return (
        depths.new_empty(views * tiles + 1, dtype=torch.int64),
        depths.new_empty(2 * views * n, dtype=torch.int32),
        depths.new_empty(entries, dtype=torch.int32),
        depths.new_empty(entries, dtype=torch.int32),
    )


bin_tiles_op = register("bin_tiles", _bin_tiles)


def _image(colors: Tensor, size: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    check_size(*size)
    views = colors.shape[0]
    channels = colors.shape[2]
    needed = views * size[0] * size[1] * ((channels + 1) * colors.element_size() + 4)
    check_memory(
        needed, f"{views} image(s) of {size[0]}x{size[1]} px with {channels} channels", colors
    )
    shape = (views, size[1], size[0])
    image = colors.new_empty(*shape, channels)
    return image, colors.new_empty(shape), colors.new_empty(shape, dtype=torch.int32)


def _blend(
    means2d: Tensor,
    factors: Tensor,
    opacities: Tensor,
    colors: Tensor,
    background: Tensor | None,
    probe: Tensor | None,
    samples: Tensor | None,
    radii: Tensor,
    tile_offsets: Tensor,
    slot_ranges: Tensor,
    gaussians: Tensor,
    slots: Tensor,
    size: list[int],
    thresholds: list[float],
    absgrad: bool,
    patches: list[Tensor],
    radius: float,
) -> tuple[Tensor, Tensor, Tensor]:
    image = _image(colors, size)
    splats = _arrays(means2d, factors, opacities, radii)
    entries = (tile_offsets, slot_ranges, gaussians, slots)
    settings = _settings(size, thresholds)
    given = splats, colors, background, entries, settings, (*image, None), 0
    call_core(colors, "rasterize_forward", *given, *_boundaries(samples, patches, radius))
    return image


def _boundaries(samples: Tensor | None, patches: list[Tensor], radius: float) -> list[object]:
    return [] if samples is None else [(*patches, samples, radius)]


def _blend_backward(x: Backward) -> Sequence[Tensor | None]:
    means2d, factors, opacities, colors, background, _, samples, radii = x.inputs[:8]
    *entries, size, thresholds, absgrad, patches, radius = x.inputs[8:]
    transmittance, stop = x.outputs
    by_color, by_transmittance = x.grads
    pairs = entries[3].shape[0]
    fields = MOMENTS + colors.shape[2] + 2 * absgrad
    check_memory(
        pairs * fields * colors.element_size(),
        f"the gradients of {pairs} (Gaussian, tile) pairs",
        colors,
    )
    out = [empty_like(y) for y in (means2d, factors, opacities, colors)]
    by_probe = means2d.new_empty(*opacities.shape, 4) if x.needs[5] else None
    given = _arrays(means2d, factors, opacities, radii), colors, background, tuple(entries)
    settings = _settings(size, thresholds)
    images = by_color, by_transmittance, transmittance, stop
    by_samples = None if samples is None else empty_like(samples)
    results = (*out, by_probe), absgrad, *_boundaries(samples, patches, radius)
    more = [] if by_samples is None else [by_samples]
    call_core(colors, "rasterize_backward", *given, settings, images, *results, *more)
    by_background = None
    if x.needs[4]:
        by_background = torch.einsum("vhw,vhwd->vd", transmittance, by_color)
    return *out, by_background, by_probe, by_samples


blend_op = register(
    "blend",
    _blend,
    _blend_backward,
    "means2d factors opacities colors background probe samples",
    keeps=[1, 2],
    constant=[2],
)


def _tally(
    splats: list[Tensor],
    colors: Tensor,
    background: Tensor | None,
    entries: list[Tensor],
    size: list[int],
    thresholds: list[float],
    kind: int,
) -> tuple[Tensor, Tensor, Tensor]:
    sums = empty_like(splats[2])
    image = *_image(colors, size), sums
    settings = _settings(size, thresholds)
    given = _arrays(*splats), colors, background, tuple(entries), settings, image, kind
    call_core(colors, "rasterize_forward", *given)
    return sums, image[0], image[1]


tally_op = register("tally", _tally)


def bin_tiles(
    projection: Projection,
    opacities: Tensor,
    size: tuple[int, int],
    options: BlendOptions = BlendOptions(),
) -> TileEntries:
    """Sort the splats of each 16x16 tile by depth; arguments as for ``rasterize``."""
    check_size(*size)  # before torch, which rejects integers from 2^63 on
    with torch.no_grad():
        splats = [projection.means2d, projection.factors, opacities, projection.radii]
        return TileEntries(*bin_tiles_op(splats, projection.depths, list(size), options.thresholds))


def rasterize(
    projection: Projection,
    opacities: Tensor,
    colors: Tensor,
    size: tuple[int, int],
    *,
    background: Tensor | None = None,
    probe: Tensor | None = None,
    options: BlendOptions = BlendOptions(),
    entries: TileEntries | None = None,
    boundaries: Boundaries | None = None,
) -> BlendedImages:
    """Blend the splats front to back into V images of D channels.

    Differentiable in means2d, factors, opacities, colors, background and the samples of
    ``boundaries``, which need the CPU, one view and no ``probe``. ``opacities`` (V, N), already
    compensated; ``colors`` (V, N, D), D up to 40; ``background`` (V, D), None: black.
    ``probe`` (V, N, 4) zeros, whose gradient is that of the 2D means in px and, with ``absgrad``,
    the sum of its absolute values over pixels. ``entries``: result of ``bin_tiles`` for the same
    splats. Raises DyngsError for too many channels, sides above 2^23 px, too many (Gaussian, tile)
    pairs, or mismatched ``entries``.
    """
    if not 1 <= colors.shape[-1] <= MAX_CHANNELS:
        raise DyngsError(
            f"colors have {colors.shape[-1]} channels; 1 to {MAX_CHANNELS} can be blended in one call"
        )
    check_size(*size)
    if entries is None:
        entries = bin_tiles(projection, opacities, size, options)
    color, transmittance, _ = blend_op(
        projection.means2d,
        projection.factors,
        opacities,
        colors,
        background,
        probe,
        None if boundaries is None else boundaries.samples.contiguous(),
        projection.radii,
        entries.tile_offsets,
        entries.slot_ranges,
        entries.gaussians,
        entries.slots,
        list(size),
        options.thresholds,
        options.absgrad,
        [] if boundaries is None else [boundaries.rows, boundaries.ids],
        0.0 if boundaries is None else boundaries.radius,
    )
    return BlendedImages(color, transmittance)


class Tally(IntEnum):
    """Per-Gaussian sums that ``tally`` computes; values as in csrc/core/api.hpp."""

    WEIGHTS = 1
    """blending weights, alpha times transmittance"""
    PIXELS = 2
    """pixels that the Gaussian was blended into"""
    LANES = 3
    """pixels evaluated for the Gaussian"""
    SQUARED_SLOPES = 4
    """squares of the derivative of the image, its channels added up, with respect to G, the value
    of the 2D Gaussian there (Tu et al. 2026)"""


def tally(
    projection: Projection,
    opacities: Tensor,
    size: tuple[int, int],
    kind: Tally,
    options: BlendOptions = BlendOptions(),
    *,
    colors: Tensor | None = None,
    background: Tensor | None = None,
) -> Tensor:
    """Return (V, N) sums over pixels of the quantity ``kind``, for every Gaussian; not
    differentiable.

    Other arguments as for ``rasterize``; colours and background matter to ``SQUARED_SLOPES`` only.
    """
    colors = torch.zeros_like(opacities)[..., None] if colors is None else colors
    return blend_and_tally(
        projection, opacities, colors, size, kind, options, background=background
    )[1]


def blend_and_tally(
    projection: Projection,
    opacities: Tensor,
    colors: Tensor,
    size: tuple[int, int],
    kind: Tally,
    options: BlendOptions = BlendOptions(),
    *,
    background: Tensor | None = None,
) -> tuple[BlendedImages, Tensor]:
    """Return what ``rasterize`` and ``tally`` do, of one pass; not differentiable."""
    entries = bin_tiles(projection, opacities, size, options)
    splats = [projection.means2d, projection.factors, opacities, projection.radii]
    with torch.no_grad():
        sums, color, transmittance = tally_op(
            splats, colors, background, entries.tensors(), list(size), options.thresholds, int(kind)
        )
    return BlendedImages(color, transmittance), sums
