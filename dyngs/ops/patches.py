"""Quadratic triangular Bezier patches: values at places on them, which of them images show, and images of these.

P patches, N places, V views. A place is (u, v), w = 1 - u - v; control points (i, j, k), i + j + k = 2, belong to
u^i v^j w^k, in the order 200, 110, 101, 020, 011, 002 (csrc/math/bezier.hpp). The blending is that of BG-Triangle (Wu
et al. 2025) but for one thing: weights of patches at a pixel are normalised to one, because what a z-buffer shows does
not overlap; composited over each other, two halves on either side of an edge would let light through.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.errors import DyngsError
from dyngs.ops.checks import check_number, check_size, check_tensors
from dyngs.ops.native import num_threads
from dyngs.ops.registration import Gradient, empty_like, launch, register

NUM_POINTS = 6  # of a quadratic patch
SEGMENTS = 6  # Of an edge: 36 flat faces (Wu et al. 2025)
SIGMA = 0.7  # Standard deviation of the Gaussians, px
RADIUS = 2.0  # Of outlines, px
MOST_SEGMENTS, MOST_CHANNELS, MOST_RADIUS = 64, 8, 8.0

Along = Literal["u", "v"]
_BASES: dict[Along | None, int] = {None: 0, "u": -1, "v": -2}


def lattice_size(segments: int) -> int:
    """Return the number of points of a triangular lattice with so many segments along an edge."""
    return (segments + 1) * (segments + 2) // 2


def lattice(segments: int) -> tuple[Tensor, Tensor]:
    """Return (K, 2) float64 places of a lattice's points, in their order, and (segments^2, 3) faces, facing alike."""
    uv = [(i / segments, j / segments) for i in range(segments, -1, -1) for j in range(segments - i, -1, -1)]

    def index(i: int, j: int) -> int:
        row = segments - i
        return row * (row + 1) // 2 + row - j

    faces: list[tuple[int, int, int]] = []
    for i in range(segments):
        for j in range(segments - i):
            faces.append((index(i, j), index(i + 1, j), index(i, j + 1)))
            if i + j + 2 <= segments:
                faces.append((index(i + 1, j + 1), index(i, j + 1), index(i + 1, j)))
    return torch.tensor(uv, dtype=torch.float64, device="cpu"), torch.tensor(faces, device="cpu")


def _values(values: Tensor, ids: Tensor, uv: Tensor, basis: int) -> Tensor:
    out = values.new_empty(ids.shape[0], values.shape[2])
    launch(values, "patch_values_forward", uv, ids, values, basis, out, num_threads())
    return out


def _values_backward(like: Tensor, ids: Tensor, uv: Tensor, grad: Tensor, basis: int) -> Tensor:
    g_values = empty_like(like)
    launch(grad, "patch_values_backward", uv, ids, grad, basis, g_values, num_threads())
    return g_values


values_backward_op = register("patch_values_backward", _values_backward, devices=("cpu",))


def _save_values(ctx: Any, inputs: tuple[Any, ...], _: Tensor) -> None:
    values, ids, uv, ctx.basis = inputs
    ctx.save_for_backward(values, ids, uv)


def _values_gradient(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    values, ids, uv = ctx.saved_tensors
    return values_backward_op(values, ids, uv, grad.contiguous(), ctx.basis), None, None, None


values_op = register("patch_values", _values, devices=("cpu",), gradient=Gradient(_save_values, _values_gradient))


def patch_values(values: Tensor, ids: Tensor, uv: Tensor, along: Along | None = None) -> Tensor:
    """Return (N, C) values of patches at places on them, differentiable in ``values``; the same on any threads.

    Args:
        values: (P, 6, C) of control points.
        ids: (N,) int32 patch of each place.
        uv: (N, 2) places.
        along: None: the value; else its derivative along u or v, at the other held constant.
    """
    return _looked_up(values, ids, uv, NUM_POINTS, _BASES[along])


def lattice_values(values: Tensor, ids: Tensor, uv: Tensor, segments: int) -> Tensor:
    """Return (N, C): as ``patch_values`` of values (P, K, C) at the points of a lattice, linear between them."""
    if not 1 <= segments <= MOST_SEGMENTS:
        raise DyngsError(f"patches: a lattice has 1 to {MOST_SEGMENTS} segments, got {segments}")
    return _looked_up(values, ids, uv, lattice_size(segments), segments)


def _looked_up(values: Tensor, ids: Tensor, uv: Tensor, count: int, basis: int) -> Tensor:
    patches, _, channels = values.shape
    check_tensors("patches", {"values": (values, (patches, count, channels)), "uv": (uv, (len(ids), 2))})
    if ids.dtype != torch.int32:
        raise DyngsError(f"patches: ids must be int32, got {ids.dtype}")
    return values_op(values.contiguous(), ids.contiguous(), uv.contiguous().to(values.dtype), basis)


@torch.no_grad()
def visible_patches(points: Tensor, cameras: Cameras, near: float, segments: int = SEGMENTS) -> tuple[Tensor, Tensor]:
    """Return (V, H, W) int32 patch that each pixel shows, -1 for none, and (V, H, W, 2) where on it.

    A z-buffer of flat faces: perspective-correct, both sides, cut at ``near``; of several as near the first is shown.
    Patches with a point that is not finite are not. The same on any number of threads.

    Args:
        points: (P, 6, 3) control points, world.
        segments: of an edge; a patch is ``segments``^2 faces.
    """
    check_number("near", near, 1e-9)
    check_tensors("patches", {"points": (points, (len(points), NUM_POINTS, 3))})
    check_size(cameras.width, cameras.height)
    if not 1 <= segments <= MOST_SEGMENTS:
        raise DyngsError(f"patches: an edge has 1 to {MOST_SEGMENTS} segments, got {segments}")
    cameras = cameras.to(dtype=points.dtype)
    shape = len(cameras), cameras.height, cameras.width
    ids = torch.empty(shape, dtype=torch.int32, device=points.device)
    uv = points.new_empty(*shape, 2)
    pose, intrinsics = cameras.cam_from_world.contiguous(), cameras.intrinsics.contiguous()
    launch(points, "visible_patches", points.contiguous(), pose, intrinsics, segments, near, ids, uv, num_threads())
    return ids, uv


def _blend(
    means: Tensor, colours: Tensor, rows: Tensor, ids: Tensor, sigma: float, radius: float
) -> tuple[Tensor, Tensor, Tensor]:
    image = colours.new_empty(*rows.shape, colours.shape[1])
    out = image, colours.new_empty(rows.shape), colours.new_empty(rows.shape)
    launch(means, "blend_patches_forward", means, colours, rows, ids, (sigma, radius), out, num_threads())
    return out


def _blend_backward(
    inputs: list[Tensor], outputs: list[Tensor], grads: list[Tensor], sigma: float, radius: float
) -> tuple[Tensor, Tensor]:
    g_means, g_colours = empty_like(inputs[0]), empty_like(inputs[1])
    sizes, given = (sigma, radius), (tuple(outputs), tuple(grads))
    launch(inputs[0], "blend_patches_backward", *inputs, sizes, *given, g_means, g_colours, num_threads())
    return g_means, g_colours


blend_backward_op = register("blend_patches_backward", _blend_backward, devices=("cpu",))
"""Gradients by means and colours; ``inputs`` are the first four of ``blend_patches``."""


def _save_blend(ctx: Any, inputs: tuple[Any, ...], outputs: tuple[Tensor, ...]) -> None:
    *tensors, ctx.sigma, ctx.radius = inputs
    ctx.mark_non_differentiable(outputs[2])
    ctx.save_for_backward(*tensors, *outputs)


def _blend_gradient(ctx: Any, image: Tensor, transmittance: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
    saved = list(ctx.saved_tensors)
    grads = [image.contiguous(), transmittance.contiguous()]
    by_means, by_colours = blend_backward_op(saved[:4], saved[4:], grads, ctx.sigma, ctx.radius)
    return by_means, by_colours, None, None, None, None


blend_op = register("blend_patches", _blend, devices=("cpu",), gradient=Gradient(_save_blend, _blend_gradient))


@dataclass(frozen=True)
class Places:
    """The N places on patches that the pixels of V views show."""

    rows: Tensor  # (V, H, W) int32, which of them a pixel shows; -1: nothing
    ids: Tensor  # (N,) int32 patches
    uv: Tensor  # (N, 2)

    @staticmethod
    def of(ids: Tensor, uv: Tensor) -> Places:
        """Return the places of what ``visible_patches`` returned, view by view, row by row."""
        shown = ids >= 0
        rows = torch.where(shown, shown.flatten().cumsum(0).view(ids.shape) - 1, -1).to(torch.int32)
        return Places(rows, ids[shown], uv[shown])


def blend_patches(
    means: Tensor, colours: Tensor, places: Places, sigma: float = SIGMA, radius: float = RADIUS
) -> tuple[Tensor, Tensor]:
    """Return (V, H, W, C) images before black and (V, H, W) transmittance, differentiable once in means and colours.

    There is one isotropic Gaussian per pixel that shows something. A pixel is the mean of the Gaussians around it,
    weighted by their value there and by how much their patch counts there: 1 inside, a half at its outline, 0 outside,
    within ``radius`` of its nearest outline. Outlines are pixels next to one of another patch, or of none. Gradients
    reach the outlines' means. The same bits on any number of threads.

    Args:
        means: (N, 2) px, in the image that shows each place.
        colours: (N, C), C up to 8.
        sigma: standard deviation of the Gaussians, px.
    """
    count = len(places.ids)
    check_tensors("patches", {"means": (means, (count, 2)), "colours": (colours, (count, colours.shape[-1]))})
    check_number("sigma", sigma, 1e-3, MOST_RADIUS)
    check_number("radius", radius, 1e-3, MOST_RADIUS)
    if means.dtype != colours.dtype or colours.shape[1] > MOST_CHANNELS:
        raise DyngsError(f"patches: means and colours of one dtype, and at most {MOST_CHANNELS} channels")
    given = means.contiguous(), colours.contiguous(), places.rows, places.ids
    image, transmittance, _ = blend_op(*given, sigma, radius)
    return image, transmittance
