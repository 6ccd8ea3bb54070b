"""Motion detection: errors of a static model in the images, or motion masks of the capture."""

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
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, Shader, render

# Difference from the median image (mean over channels) from which a pixel counts as changed.
CHANGE_THRESHOLD = 0.06
MIN_SAME = 3  # fewest images of a fixed camera for a median image
# Moving parts differ from the median in at least three of ten images, occluded parts in fewer.
TYPICAL_QUANTILE = 0.7
VIEWS_PER_CAMERA = 8  # images per fixed camera that are compared
MIN_WEIGHT = 1e-3  # sum of weights, in pixels, from which a Gaussian is visible in an image


@dataclass(frozen=True)
class StaticErrors:
    """Errors of a static scene in the images, per Gaussian."""

    peak: Tensor  # (N,) large if anything moves here: this Gaussian or an occluder
    typical: Tensor  # (N,) large if this Gaussian moves


def static_errors(
    gaussians_at: Callable[[float], Gaussians],
    images: Sequence[Image],
    options: RenderOptions,
    background: Tensor,
    shader_at: Callable[[float], Shader | None] = lambda _: None,
    mask_error: float = 1.0,
) -> StaticErrors:
    """Compute the errors of a static scene in the images, per Gaussian.

    e_vi = |sum_p w_vip (expected - truth)| / sum_p w_vip with w = alpha T for image v, mean over
    channels. Signed errors are summed over the pixels of a Gaussian: unresolved detail cancels, an
    object that appears or disappears does not. Both sums are gradients of the blended image by a
    constant colour. Masked pixels are ignored; Gaussians that are visible nowhere get 0.

    The expected image depends on the capture. With motion masks, the error of a pixel is its mask,
    and images without mask are ignored; ``mask_error`` is the error of a Gaussian that is half
    inside masks. Fixed cameras with at least ``MIN_SAME`` images use their median image. In both
    cases ``peak`` is the maximum and ``typical`` the ``TYPICAL_QUANTILE`` of e_vi over the images
    that show the Gaussian. Otherwise the rendering is expected, and both are the mean weighted by
    sum_p w_vip, because an unfinished static model errs everywhere.
    """
    masked = [x for x in images if x.motion_mask is not None]
    expected = {} if masked else _median_images(images, background)
    compared = masked or [x for x in images if _camera_key(x) in expected] or images
    results: list[tuple[Tensor, Tensor]] = []
    for image in compared:
        time = image.time or 0.0
        gaussians = gaussians_at(time).detach()
        truth = image.composite(background)
        if image.motion_mask is not None:
            error = (2 * mask_error * image.motion_mask)[..., None].expand_as(truth)
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
        results.append((signed.abs().mean(1), weight[:, 0]))
    errors, weights = (torch.stack(x) for x in zip(*results, strict=True))
    if not masked and not expected:
        mean = errors.sum(0) / weights.sum(0).clamp_min(1e-6)
        return StaticErrors(mean, mean)
    shows = weights > MIN_WEIGHT
    ordered = torch.where(shows, errors / weights.clamp_min(MIN_WEIGHT), 0.0).sort(0, True).values
    rank = ((1 - TYPICAL_QUANTILE) * shows.sum(0)).long().clamp_max(len(ordered) - 1)
    return StaticErrors(ordered[0], ordered.gather(0, rank[None])[0])


def weighted_sums(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions, images: Sequence[Tensor]
) -> list[Tensor]:
    """Return, per image (H, W, 3), the sums (N, 3) over its pixels weighted by each Gaussian.

    Computed as gradients of the blended image by a constant colour.
    """
    flat = torch.zeros(len(gaussians), 1, 3, requires_grad=True, device=gaussians.means.device)
    blended = render(gaussians.replace(sh=flat), cameras, options).rgb[0]
    return [
        torch.autograd.grad(blended, flat, image, retain_graph=True)[0][:, 0] for image in images
    ]


def group_fixed_cameras(views: Sequence[View]) -> list[list[int]]:
    """Return the view indices of each fixed camera with at least ``MIN_SAME`` views."""
    return [seen for seen in static_cameras(views) if len(seen) >= MIN_SAME]


def select_comparison_views(views: Sequence[View], limit: int = 50) -> list[int]:
    """Return indices of at most ``limit`` evenly spaced views; at least ``MOMENTS`` per fixed
    camera."""
    cameras = group_fixed_cameras(views)
    if not cameras:
        return evenly_spaced(len(views), limit)
    chosen = [cameras[i] for i in evenly_spaced(len(cameras), max(limit // VIEWS_PER_CAMERA, 1))]
    return [seen[i] for seen in chosen for i in evenly_spaced(len(seen), limit // len(chosen))]


def _median_images(images: Sequence[Image], background: Tensor) -> dict[bytes, Tensor]:
    """Return the median image (H, W, 3) of each fixed camera with enough images."""
    same: dict[bytes, list[Tensor]] = {}
    for image in images:
        same.setdefault(_camera_key(image), []).append(image.composite(background))
    return {
        key: torch.stack(seen).median(0).values
        for key, seen in same.items()
        if len(seen) >= MIN_SAME
    }


def _camera_key(image: Image) -> bytes:
    """Return a key that is equal for images of the same camera pose, up to rounding."""
    cameras = image.cameras
    return b"".join(
        x.round(decimals=6).cpu().numpy().tobytes()
        for x in (cameras.cam_from_world, cameras.intrinsics)
    )


def otsu_threshold(scores: Tensor) -> float:
    """Return Otsu's threshold of ``scores`` (N,) (Otsu 1979); infinite if all scores are equal."""
    from skimage.filters import threshold_otsu

    if not len(scores) or float(scores.min()) == float(scores.max()):
        return float("inf")
    return float(threshold_otsu(scores.cpu().numpy()))


@torch.no_grad()
def changed_fraction(cameras: Sequence[Sequence[Tensor]]) -> float:
    """Return the fraction of pixels that differ from the median image of their camera.

    Images are first matched to the median in brightness, because exposure changes are not motion,
    and averaged over 2x2 pixels against noise.
    """
    differing = total = 0
    for images in cameras:
        smooth = [avg_pool2d(image.movedim(2, 0), 2, ceil_mode=True) for image in images]
        typical = torch.stack(smooth).median(0).values
        for image in smooth:
            gap = image - typical
            gap = gap - gap.flatten(1).median(1).values[:, None, None]
            differing += int((gap.abs().mean(0) > CHANGE_THRESHOLD).sum())
            total += gap[0].numel()
    return differing / max(total, 1)
