"""Masks of a person by background subtraction for fixed cameras; the background is the temporal
median.

Local letters: F frames of one camera, H height, W width.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage

from dyngs.capture.sfm.frame_choice import FIXED_CAMERA_LIMIT, camera_displacement, small_brightness
from dyngs.core.errors import DyngsError, log_info
from dyngs.data.capture import Capture, Silhouette, View, group_by_camera, map_views
from dyngs.data.images.images import (
    area_downscale_uint8,
    read_image,
    target_size,
)
from dyngs.data.times import evenly_spaced
from dyngs.io.write import write_image

NOISE = 1.5  # least standard deviation of the background that is expected, grey levels
LOW, HIGH = 5.0, 12.0
"""Hysteresis thresholds in standard deviations: pixels above LOW belong to the person if connected
to pixels above HIGH."""
GAP = 0.006  # half the width of gaps that are closed, as a fraction of the image's longer side
OFTEN, MOST_STAYING = 0.4, 0.1
LEAST_ON_EDGES, LEAST_AREA = 0.8, 1e-3
"""Limits for reliable masks. Two walking people reach an edge fraction of 0.96 to 1.00, two on the
spot 0.56 to 0.79."""
LEAST_FRACTION = 0.1  # smaller parts than this fraction of the largest are left out
SHADE = (0.5, 0.97)  # range of brightness, as a fraction of the background's, that a shadow has
# largest spread of that fraction, of its mean, in a window where it is a shadow
SHADE_SPREAD = 0.08
_WINDOW = 5
_SMOOTH = 0.7
SEEN_BARE = 3  # number of images in which a background pixel must be visible
EDGE, HALF = 2, 0.45
"""Width of the rim of a mask in px, and the fraction of the largest nearby difference that a pixel
of the rim needs: pixels at the outline are mixed."""


@dataclass(frozen=True)
class MatteParams:
    """Estimation of alpha at outlines; lengths in heights of the person.

    Measured on people pasted before photos, with known alpha.
    """

    unsure: float = 0.02  # largest error of a detector's outline
    inside: float = 0.03  # distance inside the mask up to which pixels may be background
    # distance outside the mask up to which pixels may be of the person, in both passes
    outside: tuple[float, float] = (0.015, 0.01)
    core: float = 0.01  # distance from the outline at which pixels are certainly of the person
    colours: float = 0.008  # standard deviation of the average of their colours
    noise: float = 20.0  # grey levels, expected error of colours
    background_noise: float = 8.0  # weight of the variation of the background over time
    slope: float = 2.0  # of alpha: pixels that are almost covered count as covered
    smoothing: float = 0.0045  # standard deviation by which the outlines of masks are smoothed
    # steepness of smoothed outlines, so that about two pixels are partly covered, as in photos
    steepness: float = 1.6
    agreed: float = 0.8  # overlap (IoU) with the detector's mask below which it is kept


MATTE = MatteParams()


@dataclass(frozen=True)
class Background:
    """Background of a fixed camera, in grey levels.

    Attributes:
        colours: (H, W, 3) float32, median over time.
        noise: (H, W) float32, robust standard deviation over time of smoothed images, at least
            ``NOISE``.
    """

    colours: np.ndarray
    noise: np.ndarray


@dataclass(frozen=True)
class Separation:
    """Quality of the separation of a person from the background.

    Attributes:
        on_edges: fraction of the mask outlines where the image gradient exceeds that of the
            background, as at the outline of a visible person.
        area: median fraction of the image that the masks cover.
        staying: fraction of the mask pixels covered in more than ``OFTEN`` of the frames: the
            person stands there so long that the background may contain them.
    """

    on_edges: float
    area: float
    staying: float

    @property
    def is_clear(self) -> bool:
        """Whether the masks are reliable."""
        return (
            self.on_edges > LEAST_ON_EDGES
            and self.staying < MOST_STAYING
            and self.area > LEAST_AREA
        )


def background_of(images: np.ndarray) -> Background:
    """Estimate the background of a fixed camera from images (F, H, W, 3) uint8 spread over
    time."""
    colours = np.median(images, axis=0).astype(np.float32)
    away = np.stack([_away(colours, image) for image in images])
    noise = 1.4826 * np.median(away, axis=0)
    # where somebody passed often the spread is that of the person
    typical = float(np.median(noise))
    return Background(colours, np.clip(noise, max(NOISE, typical), 3 * max(NOISE, typical)))


def person_mask(background: Background, image: np.ndarray) -> np.ndarray:
    """Return the foreground mask (H, W) bool of an image (H, W, 3) uint8.

    Shadows, where the image is a nearly constant multiple of the background, are removed. Holes
    are filled, as clothes may resemble the background.
    """
    away = _difference(background, image)
    sure = ndimage.binary_opening(away > HIGH, iterations=1)
    seen = ndimage.binary_propagation(sure, mask=away > LOW) & ~_shadow(background, image)
    radius = max(1, round(GAP * max(away.shape)))
    # Closing with room around, so that who is cut off by the border is not eaten from there.
    padded = np.pad(seen, 2 * radius, mode="edge")
    closed = ndimage.binary_closing(padded, _disc(radius))[
        2 * radius : -2 * radius, 2 * radius : -2 * radius
    ]
    opened = ndimage.binary_opening(ndimage.binary_fill_holes(closed), _disc(1))
    rim = opened & np.logical_not(ndimage.binary_erosion(opened, iterations=EDGE, border_value=1))
    opened = opened & np.logical_not(
        rim & (away < HALF * ndimage.maximum_filter(away, 2 * EDGE + 1))
    )
    labels = np.empty(opened.shape, np.int32)
    if not ndimage.label(opened, output=labels):
        return opened
    sizes = np.bincount(labels.ravel())[1:]
    return np.isin(labels, 1 + np.flatnonzero(sizes >= LEAST_FRACTION * sizes.max()))


def soften_outline(mask: np.ndarray) -> np.ndarray:
    """Return alpha (H, W) of a mask (H, W) bool, without noise of single pixels at the outline."""
    blurred = ndimage.gaussian_filter(mask.astype(np.float32), MATTE.smoothing * _height(mask))
    return (0.5 + MATTE.steepness * (blurred - 0.5)).clip(0, 1)


def estimate_alpha(
    images: np.ndarray, masks: np.ndarray, others: np.ndarray | None = None
) -> np.ndarray | None:
    """Return alpha (F, H, W) of a person from a detector's masks and the background of a fixed
    camera; None if the camera moves.

    Near the outline, alpha is the difference from the background, relative to that of the person's
    colours nearby. The background of a pixel is the median of the images in which the detector is
    sure to see no person. Masks are only softened where fewer than ``SEEN_BARE`` of these exist,
    and in images where the results disagree, as when other people pass.

    Args:
        images: (F, H, W, 3) uint8, of one camera.
        masks: (F, H, W) bool.
        others: (F, H, W) bool, where other people are and masks are kept; None: nowhere.
    """
    static = np.where(masks[..., None], np.median(images, axis=0).astype(np.uint8), images)
    if camera_moves(static):
        return None
    heights = [_height(mask) for mask in masks if mask.any()]
    radius = max(2, round(MATTE.unsure * float(np.mean(heights)))) if heights else 2
    near: np.ndarray = np.stack(
        [ndimage.binary_dilation(mask, iterations=radius) for mask in masks]
    ).astype(bool)
    num_bare = np.logical_not(near).sum(0)
    known = num_bare >= SEEN_BARE
    bare = np.ma.masked_array(images, np.broadcast_to(near[..., None], images.shape))
    colours = np.ma.median(bare, axis=0).filled(0).astype(np.float32)
    # Where a camera shakes or leaves move, edges of the background are unreliable: the noise is
    # the upper quartile over the images without the person, and the largest of the neighbours.
    away = np.where(near, np.inf, np.stack([_away(colours, image) for image in images]))
    away.sort(axis=0)
    quartile = (0.75 * (num_bare - 1)).clip(0).astype(np.int64)
    noise = np.take_along_axis(away, quartile[None], 0)[0]
    noise = np.where(known, noise, NOISE).clip(NOISE).astype(np.float32)
    background = Background(colours, ndimage.maximum_filter(noise, 5))
    result = np.zeros(masks.shape, np.float32)
    for i, (image, mask) in enumerate(zip(images, masks, strict=True)):
        core = _inner(mask, MATTE.core)
        if not core.any():
            result[i] = soften_outline(mask)
            continue
        usable = known if others is None else known & ~others[i]
        shadow = _shadow(background, image) & ~mask
        first = _alpha(background, image, mask, usable, shadow, MATTE.outside[0])
        found = ndimage.binary_opening(first > 0.5)
        labels, _ = ndimage.label(found)  # pyright: ignore[reportGeneralTypeIssues]
        sizes = np.bincount(labels[core & found], minlength=labels.max() + 1)
        found &= (sizes > LEAST_FRACTION * sizes.max())[labels]
        if (found & mask).sum() > MATTE.agreed * (found | mask).sum():
            result[i] = _alpha(background, image, found, usable, shadow, MATTE.outside[1])
        else:
            result[i] = soften_outline(mask)
    return result


def _alpha(
    background: Background,
    image: np.ndarray,
    mask: np.ndarray,
    usable: np.ndarray,
    shadow: np.ndarray,
    outside: float,
) -> np.ndarray:
    """Return alpha (H, W) of a mask (H, W), estimated from colours near its outline."""
    soft = soften_outline(mask)
    height = _height(mask)
    core = _inner(mask, MATTE.core).astype(np.float32)
    # Average colour of the person nearby.
    sigma = max(MATTE.colours * height, 1.0)
    weights = ndimage.gaussian_filter(core, sigma)
    sums = ndimage.gaussian_filter(image * core[..., None], (sigma, sigma, 0))
    nearest = ndimage.distance_transform_edt(
        weights < 1e-3, return_distances=False, return_indices=True
    )
    colours = (sums / weights.clip(1e-6)[..., None])[tuple(np.asarray(nearest))]
    contrast = np.square(colours - background.colours).sum(-1)
    difference = np.square(image - background.colours).sum(-1)
    ratio = np.sqrt(difference / contrast.clip(1.0))
    ratio = (0.5 + MATTE.slope * (ratio - 0.5)).clip(0, 1)
    ratio[shadow] = 0
    noise = np.square(MATTE.noise) + np.square(MATTE.background_noise * background.noise)
    confidence = contrast / (contrast + noise)
    near = (_distance(mask) <= MATTE.inside * height) & (
        _distance(~mask) <= max(outside * height, 2)
    )
    alpha = np.where(near & usable, confidence * ratio + (1 - confidence) * soft, soft)
    # Noise of single pixels.
    return ndimage.median_filter(alpha, 3)


def _height(mask: np.ndarray) -> int:
    """Return the number of rows from the top to the bottom of a mask (H, W)."""
    return int(np.ptp(mask.any(1).nonzero()[0])) + 1 if mask.any() else 0


def _inner(mask: np.ndarray, distance: float) -> np.ndarray:
    """Return the pixels (H, W) of a mask that are further than ``distance``, in heights of the
    person, from its outline."""
    return _distance(mask) > max(distance * _height(mask), 2)


def _distance(mask: np.ndarray) -> np.ndarray:
    """Return the distance (H, W), px, of pixels in a mask from those outside."""
    return np.asarray(ndimage.distance_transform_edt(mask))


def camera_moves(images: np.ndarray) -> bool:
    """Whether the camera of images (F, H, W, 3) uint8 moves."""
    return (
        camera_displacement(np.stack([small_brightness(image) for image in images]))
        > FIXED_CAMERA_LIMIT
    )


def measure_separation(background: Background, images: np.ndarray, masks: np.ndarray) -> Separation:
    """Measure how well masks (F, H, W) bool separate a person in images (F, H, W, 3) uint8."""
    on_edges = []
    slope = _slope(background.colours)
    for image, mask in zip(images, masks, strict=True):
        outline = ndimage.binary_dilation(mask) & np.logical_not(
            ndimage.binary_erosion(mask, border_value=1)
        )
        if outline.any():
            on_edges.append(float((_slope(image.astype(np.float32)) > slope)[outline].mean()))
    if not on_edges:
        return Separation(0.0, 0.0, 0.0)
    often = masks.mean(0) > OFTEN
    staying = float((masks & often).sum() / masks.sum())
    area = float(np.median(masks.mean((1, 2))))
    return Separation(float(np.mean(on_edges)), area, staying)


def _difference(background: Background, image: np.ndarray) -> np.ndarray:
    return _away(background.colours, image) / background.noise


def _away(colours: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the largest difference (H, W) of any channel, smoothed, grey levels."""
    return np.abs(ndimage.gaussian_filter(image - colours, (_SMOOTH, _SMOOTH, 0))).max(-1)


def _shadow(background: Background, image: np.ndarray) -> np.ndarray:
    """Return where (H, W) the image is a darkened background."""
    smooth = ndimage.gaussian_filter(image.astype(np.float32), (_SMOOTH, _SMOOTH, 0))
    ground = ndimage.gaussian_filter(background.colours, (_SMOOTH, _SMOOTH, 0))
    ratio = smooth.mean(-1) / np.maximum(ground.mean(-1), 1.0)
    mean = ndimage.uniform_filter(ratio, _WINDOW)
    spread = np.sqrt(np.maximum(ndimage.uniform_filter(ratio**2, _WINDOW) - mean**2, 0.0))
    colour = np.abs(smooth - ratio[..., None] * ground).max(-1) < LOW * background.noise
    shaded = (mean > SHADE[0]) & (mean < SHADE[1]) & (spread < SHADE_SPREAD * mean) & colour
    return ndimage.binary_opening(shaded, _disc(1))


def _slope(colours: np.ndarray) -> np.ndarray:
    """Return the largest gradient (H, W) over the channels of colours (H, W, 3), grey levels per
    pixel."""
    smooth = ndimage.gaussian_filter(colours, (1.0, 1.0, 0))
    down, across = np.gradient(smooth, axis=(0, 1))
    return np.hypot(down, across).max(-1)


def _disc(radius: int) -> np.ndarray:
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return rows**2 + columns**2 <= radius**2 + radius


SAMPLES = 41  # images of a camera whose median is the background
LEAST = 8  # least number of images of a camera
SIDE = 960  # longest side of the images that are compared, px
_MOVES = "moves, so its background is unknown; give masks of the person (--masks)"
_ADVICE = "give masks of the person (--masks)"


@dataclass(frozen=True)
class _Camera:
    """Views of one fixed camera, in order of time, compared at ``size`` (width, height); ``where``:
    for messages."""

    where: str
    views: tuple[View, ...]
    size: tuple[int, int]

    def image(self, path: Path) -> np.ndarray:
        """Return an image (H, W, 3) uint8 of this camera at that size."""
        first = self.views[0]
        pixels = read_image(path, (first.width, first.height))[..., :3]
        if pixels.shape[:2] != (first.height, first.width):
            raise DyngsError(
                f"{path}: is {pixels.shape[1]}x{pixels.shape[0]}, images of its camera "
                f"{first.width}x{first.height}; take it with the same camera"
            )
        return area_downscale_uint8(pixels, *self.size).numpy()


def add_background_masks(
    capture: Capture, folder: Path, log: Callable[[str], None] = log_info
) -> Capture:
    """Segment the person in a capture of fixed cameras; masks are written to ``folder``.

    Raises DyngsError for a moving camera, too few images, or no visible foreground, with advice.
    """
    silhouettes: dict[str, Silhouette] = {}
    found: list[Separation] = []
    for camera in _fixed_cameras(capture):
        paths = [view.image_path for view in camera.views]
        sampled = np.stack([camera.image(paths[i]) for i in evenly_spaced(len(paths), SAMPLES)])
        if camera_moves(sampled):
            raise DyngsError(f"{camera.where}: the camera {_MOVES}")
        background = background_of(sampled)
        masks = np.stack([person_mask(background, image) for image in sampled])
        found.append(measure_separation(background, sampled, masks))
        if not found[-1].is_clear:
            raise DyngsError(
                f"{camera.where}: no person stands out from the background, or the person stays "
                f"in one place, so that the background is never visible ({found[-1].staying:.0%} "
                f"of the mask pixels are covered most of the time, {found[-1].on_edges:.0%} of "
                f"the outlines lie on image edges); {_ADVICE}"
            )
        for view in camera.views:
            name = re.sub(r"[^A-Za-z0-9_-]", "_", view.name)
            target = folder / f"{name}.{len(silhouettes):06d}.png"
            mask = person_mask(background, camera.image(view.image_path))
            write_image(target, resize_mask(mask, view.height, view.width))
            silhouettes[view.name] = Silhouette(target, "white")
    worst = min(found, key=lambda one: one.on_edges)
    log(
        f"masks by background subtraction: {worst.on_edges:.0%} of the outlines lie on image "
        f"edges, images, the person covers {worst.area:.1%} of them"
    )
    splits = map_views(
        capture.splits, lambda view: replace(view, silhouette=silhouettes[view.name])
    )
    return capture.replace(splits=splits, has_alpha=True)


def _fixed_cameras(capture: Capture) -> list[_Camera]:
    """Return the cameras of a capture, all of which stand."""
    cameras = []
    for number, views in group_by_camera(capture.splits).items():
        where = f"{capture.root}, camera {number}"
        first = views[0]
        poses = np.stack([view.cam_from_world for view in views])
        sizes = {(view.width, view.height) for view in views}
        if not np.allclose(poses, poses[0], atol=1e-6) or len(sizes) > 1:
            raise DyngsError(f"{where} {_MOVES}")
        if len(views) < LEAST:
            raise DyngsError(
                f"{where}: has {len(views)} images, too few to estimate the background; {_ADVICE}"
            )
        size = target_size(first.width, first.height, 1.0, SIDE)
        cameras.append(_Camera(where, tuple(views), size))
    return cameras


def resize_mask(mask: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the mask as grey levels (height, width, 1) uint8, bilinear."""
    values = torch.from_numpy(mask.astype(np.float32))[None, None]
    sized = torch.nn.functional.interpolate(
        values, (height, width), mode="bilinear", align_corners=False
    )
    return (sized[0, 0, :, :, None] * 255).round().to(torch.uint8).numpy()
