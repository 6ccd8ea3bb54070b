"""Where the field of a capture lies, and the rays of cameras through it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor

from dyngs.baselines.fields.keys import FieldModel
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import focus_point, fraction_in_front, inverse_rigid
from dyngs.data.loader import Image
from dyngs.data.scene_space import extent_of
from dyngs.ops.rays import Space

MOST_CASCADES = 7  # Cubes of surroundings: the outermost is 64 times the innermost
# Along an axis of a single cube, and of each of several: looking at all takes a while
CELLS, FAR_CELLS = 128, 64
BESIDE = 1.25
"""Half the side of an innermost cube that holds the cameras, in the farthest distances of one from
its middle."""
SEEN_FAR = 0.02  # Fraction of the sparse points that may lie outside of the outermost cube


def space_of(model: FieldModel, cells: int | None, capture: Capture) -> Space:
    """Return the space of the field of ``capture``.

    An object before a background lies in a cube around the point that the cameras look at, as large
    as what all of them frame. So does the innermost cube of other captures, with others around it
    for what is far away; where the cameras do not look at one point it holds the cameras.

    Args:
        cells: of each cube along an axis; None: as suits their number.

    Raises:
        DyngsError: nothing tells depth, or much lies too far away.
    """
    views = capture.splits["train"]
    requested = None if model.half_extent is None else model.half_extent / capture.world_scale
    poses = np.stack([inverse_rigid(view.cam_from_world) for view in views])
    centres = poses[:, :3, 3]
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if not extent_of(centres):
        raise DyngsError(
            "the capture has a single camera position, from which a field cannot tell depth: give more images, or a "
            "capture whose camera moves"
        )
    focus = focus_point(poses)
    looked_at = focus if focus is not None and fraction_in_front(poses, focus) > 0.5 else None
    far = model.surroundings == "always" or (model.surroundings == "auto" and not capture.has_alpha)
    if not far:
        middle = centres.mean(axis=0) if looked_at is None else looked_at
        return _space(middle, requested or _framed(views, middle), 1, cells)
    middle = centres.mean(axis=0)
    if looked_at is not None and np.linalg.norm(looked_at - middle) < 2 * spread:
        middle = looked_at
    beside = BESIDE * float(np.abs(centres - middle).max())
    framed = beside if middle is not looked_at else min(beside, _framed(views, middle))
    half = requested or framed
    return _space(middle, half, _cascades(capture, middle, half), cells)


def _space(middle: np.ndarray, half: float, cascades: int, cells: int | None) -> Space:
    if not (math.isfinite(half) and half > 0 and np.isfinite(middle).all()):
        raise DyngsError("the cameras of the capture frame no common space: give model.half_extent")
    x, y, z = (float(value) for value in middle)
    return Space((x, y, z), float(half), cascades, cells or (CELLS if cascades == 1 else FAR_CELLS))


def _framed(views: Sequence[View], middle: np.ndarray) -> float:
    """Return half the side of the cube around ``middle`` that images frame, the median over
    views."""
    halves = []
    for view in views:
        x, y, z = view.cam_from_world[:3, :3] @ middle + view.cam_from_world[:3, 3]
        focal = min(view.intrinsics[0, 0] / view.width, view.intrinsics[1, 1] / view.height)
        halves.append(float(np.linalg.norm([x, y, z])) * 0.5 / float(focal))
    return float(np.median(halves))


def _cascades(capture: Capture, middle: np.ndarray, half: float) -> int:
    """Return the number of cubes that hold the sparse points; all where there are none."""
    if capture.points is None or not len(capture.points.xyz):
        return MOST_CASCADES
    norms = np.abs(capture.points.xyz - middle).max(axis=1) / half
    needed = 1 + math.ceil(math.log2(max(float(np.quantile(norms, 1 - SEEN_FAR)), 1.0)))
    if needed > MOST_CASCADES + 3:
        raise DyngsError(
            f"the points of the capture lie up to {2.0 ** (needed - 1):.0f} times as far away as its cameras are apart "
            f"and a field holds {2 ** (MOST_CASCADES - 1)} times: give model.half_extent"
        )
    return min(max(needed + 1, 2), MOST_CASCADES)  # what is behind the points, too


def part_of(image: Image, pixels: Tensor) -> Image:
    """Return ``pixels`` (R,) of an image alone, (1, R), with the camera of the whole; without
    maps."""

    def taken(x: Tensor | None) -> Tensor | None:
        return None if x is None else x.flatten(0, 1)[pixels][None]

    rgb = image.rgb_premultiplied.flatten(0, 1)[pixels][None]
    return replace(
        image,
        rgb_premultiplied=rgb,
        alpha=taken(image.alpha),
        mask=taken(image.mask),
        moves=None,
        labels=None,
        depth=None,
        flow=None,
    )
