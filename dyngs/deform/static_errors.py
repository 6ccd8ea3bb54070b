"""What may move: errors of a static model in the images, or motion masks that the capture has in
place of these."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dyngs.core.camera import Cameras
from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced, static_cameras
from dyngs.deform.fixed_cameras.hulls import median_image
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, Shader, render

# Difference from the median image, mean over channels, from which a pixel shows something else
DIFFERS = 0.06
MIN_SAME = 3  # Fewest images of one camera whose median shows what is still
# What moves differs from the median in three of ten images or more; what is hidden at times, in
# fewer
USUAL = 0.7
MOMENTS = 8  # Images of one camera that are compared
SHOWS = 1e-3  # Sum of weights, in pixels, from which a Gaussian counts as visible in an image


@dataclass(frozen=True)
class StaticErrors:
    """Errors of a static scene in the images, per Gaussian."""

    peak: Tensor  # (N,) large where anything moves, be it this Gaussian or what hides it at times
    typical: Tensor  # (N,) large where this moves


def static_errors(
    gaussians_at: Callable[[float], Gaussians],
    images: Sequence[Image],
    options: RenderOptions,
    background: Tensor,
    shader_at: Callable[[float], Shader | None] = lambda _: None,
    sure: float = 1.0,
) -> StaticErrors:
    """Return the errors of a static scene in the images, where each Gaussian is seen.

    e_vi = |sum_p w_vip (expected - truth)| / sum_p w_vip with w = alpha T for each image v, a mean
    over channels. Errors of one view are summed with their sign over what a Gaussian covers: detail
    that is not yet resolved cancels, a thing that has come or gone does not. Both sums come from
    passes back through the blending of a constant colour. Masked pixels do not count; a Gaussian
    that shows nowhere has 0.

    Where images have motion masks, the error of a pixel is its mask instead, and images without one
    do not count; ``sure`` is the error of a Gaussian half of which lies in masks. Where cameras stay
    in place, what is expected of one with ``MIN_SAME`` images or more is their median, which holds
    whatever is still exactly as it is. In both cases ``most`` is the largest, ``usual`` the
    ``USUAL`` quantile of e_vi over images in which a Gaussian shows. Else the rendering is expected,
    and both are the mean, weighted by sum_p w_vip: a still model that is not yet right errs too.
    """
    masked = [x for x in images if x.moves is not None]
    expected = {} if masked else _median_images(images, background)
    looked_at = masked or [x for x in images if _camera_key(x) in expected] or images
    found: list[tuple[Tensor, Tensor]] = []
    for image in looked_at:
        time = image.time or 0.0
        gaussians = gaussians_at(time).detach()
        truth = image.composite(background)
        if image.moves is not None:
            error = (2 * sure * image.moves)[..., None].expand_as(truth)
        elif expected:
            error = expected[_camera_key(image)] - truth
        else:
            with torch.no_grad():
                drawn = render(
                    gaussians,
                    image.cameras,
                    options,
                    background=background,
                    shader=shader_at(time),
                )
            error = drawn.rgb[0] - truth
        counts = (
            torch.ones_like(truth) if image.mask is None else image.mask[..., None].expand_as(truth)
        )
        signed, weight = weighted_sums(gaussians, image.cameras, options, [error * counts, counts])
        found.append((signed.abs().mean(1), weight[:, 0]))
    errors, weights = (torch.stack(x) for x in zip(*found, strict=True))
    if not masked and not expected:
        mean = errors.sum(0) / weights.sum(0).clamp_min(1e-6)
        return StaticErrors(mean, mean)
    shows = weights > SHOWS
    ordered = torch.where(shows, errors / weights.clamp_min(SHOWS), 0.0).sort(0, True).values
    rank = ((1 - USUAL) * shows.sum(0)).long().clamp_max(len(ordered) - 1)
    return StaticErrors(ordered[0], ordered.gather(0, rank[None])[0])


def weighted_sums(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions, images: Sequence[Tensor]
) -> list[Tensor]:
    """Return, for each image (H, W, 3), the (N, 3) sums over its pixels, times the blending weight
    of each Gaussian.

    By passes back through the blending of a constant colour.
    """
    flat = torch.zeros(len(gaussians), 1, 3, requires_grad=True, device=gaussians.means.device)
    blended = render(gaussians.replace(sh=flat), cameras, options).rgb[0]
    return [
        torch.autograd.grad(blended, flat, image, retain_graph=True)[0][:, 0] for image in images
    ]


def group_fixed_cameras(views: Sequence[View]) -> list[list[int]]:
    """Return the indices of the views of each fixed camera that took ``MIN_SAME`` views or more."""
    return [seen for seen in static_cameras(views) if len(seen) >= MIN_SAME]


def select_comparison_views(views: Sequence[View], limit: int = 50) -> list[int]:
    """Return indices of at most ``limit`` views, evenly chosen; of fixed cameras, ``MOMENTS`` of
    each or more."""
    cameras = group_fixed_cameras(views)
    if not cameras:
        return evenly_spaced(len(views), limit)
    chosen = [cameras[i] for i in evenly_spaced(len(cameras), max(limit // MOMENTS, 1))]
    return [seen[i] for seen in chosen for i in evenly_spaced(len(seen), limit // len(chosen))]


def _median_images(images: Sequence[Image], background: Tensor) -> dict[bytes, Tensor]:
    """Return the median image (H, W, 3) of each camera with enough images."""
    same: dict[bytes, list[Tensor]] = {}
    for image in images:
        same.setdefault(_camera_key(image), []).append(image.composite(background))
    return {key: median_image(seen) for key, seen in same.items() if len(seen) >= MIN_SAME}


def _camera_key(image: Image) -> bytes:
    """Return a key that is equal for images from the same camera pose, but for rounding."""
    cameras = image.cameras
    return b"".join(
        x.round(decimals=6).cpu().numpy().tobytes()
        for x in (cameras.cam_from_world, cameras.intrinsics)
    )


def otsu_threshold(scores: Tensor) -> float:
    """Return the threshold between two groups of ``scores`` (N,) (Otsu 1979); infinite where all
    are equal."""
    from skimage.filters import threshold_otsu

    if not len(scores) or float(scores.min()) == float(scores.max()):
        return float("inf")
    return float(threshold_otsu(scores.cpu().numpy()))


@torch.no_grad()
def changed_fraction(cameras: Sequence[Sequence[Tensor]]) -> float:
    """Return the fraction of pixels that differ from the median image of their camera.

    Each image is first brought to the brightness of the median (changing exposure is no motion) and
    averaged over 2x2 pixels, against noise.
    """
    differing = total = 0
    for images in cameras:
        smooth = [avg_pool2d(image.movedim(2, 0), 2, ceil_mode=True) for image in images]
        typical = torch.stack(smooth).median(0).values
        for image in smooth:
            gap = image - typical
            gap = gap - gap.flatten(1).median(1).values[:, None, None]
            differing += int((gap.abs().mean(0) > DIFFERS).sum())
            total += gap[0].numel()
    return differing / max(total, 1)
