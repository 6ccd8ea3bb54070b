"""Priors compared with the images before any training: each must explain them better than its
simplest substitute."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.geometry import focus_point
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced
from dyngs.training.priors.used import DepthForm, values_of

PAIRS = 12  # Pairs of images that are compared
MARGIN = 0.97  # A prior must lower the error at least to this fraction of its substitute's
_CHANGED = 0.1  # Flow is judged at this fraction of the pixels: those that change most
_SIDE = 96  # Images are shrunk to about this for depth: hundreds of guesses are compared
_DEPTHS = 14
_RANGE = 6.0  # Nearest and farthest guess, as a factor of the distance to what the cameras look at


@dataclass(frozen=True)
class Agreement:
    """Mean photometric errors (0 to 1) over pairs of images."""

    error: float
    without: float
    pairs: int

    @property
    def holds(self) -> bool:
        """Return whether the prior explains the images better; not where nothing could be
        compared."""
        return self.pairs > 0 and self.error < MARGIN * self.without


def flow_agreement(pairs: Sequence[tuple[Image, Image]]) -> Agreement:
    """Compare flow with no motion, with its reverse, and with the same displacements at other
    places.

    Only where images change most: elsewhere no motion is always right. There, displacements at
    random help a little, too, which is why they are a substitute.
    """
    sums = torch.zeros(4, device="cpu")
    count = 0
    for first, second in pairs:
        if first.flow is None:
            continue
        known = first.flow.isfinite().all(-1)
        before, after = (p.rgb_premultiplied for p in (first, second))
        change = torch.where(known, (before - after).abs().mean(-1), -1.0)
        number = int(_CHANGED * int(known.sum()))
        if number < 2:
            continue
        chosen = change.flatten().topk(number).indices
        flow = first.flow.reshape(-1, 2)[chosen]
        places = _centers(before)[chosen]
        wanted = before.reshape(-1, 3)[chosen]
        for i, moved in enumerate((flow, torch.zeros_like(flow), -flow, flow.roll(number // 2, 0))):
            sums[i] += (_sampled(after, places + moved) - wanted).abs().mean()
        count += 1
    given, *others = (float(x) / max(count, 1) for x in sums)
    return Agreement(given, min(others), count)


def track_agreement(pairs: Sequence[tuple[Image, Image, Tensor, Tensor]]) -> Agreement:
    """Compare colours at both ends of tracks with those at the ends of other tracks."""
    given = shuffled = 0.0
    for first, second, start, end in pairs:
        before, after = (_blurred(p.rgb_premultiplied) for p in (first, second))
        wanted = _sampled(before, start)
        given += float((_sampled(after, end) - wanted).abs().mean())
        shuffled += float(
            (_sampled(after, end.roll(max(len(end) // 2, 1), 0)) - wanted).abs().mean()
        )
    count = max(len(pairs), 1)
    return Agreement(given / count, shuffled / count, len(pairs))


def depth_agreement(
    triples: Sequence[tuple[Image, Image, Image]], distance: float
) -> tuple[DepthForm, Agreement]:
    """Compare depth maps with one depth for a whole image; return what they are affine in, and the
    agreement.

    Scale and shift, and the one depth, are those that warp the first image's second neighbour onto
    it best; the third one then judges them.
    """
    sums = torch.zeros(3, device="cpu")
    count = 0
    kinds: tuple[DepthForm, DepthForm] = ("depth", "inverse")
    for views in triples:
        first, second, third = (_small(p) for p in views)
        if first.depth is None or not bool((first.depth > 0).any()):
            continue
        guesses = [list(_aligned_guesses(first.depth, kind, distance)) for kind in kinds]
        constant = [torch.full_like(first.depth, z) * (first.depth > 0) for z in _depths(distance)]
        for i, tried in enumerate((*guesses, constant)):
            best = min(tried, key=lambda depth: float(_warp_errors(first, second, depth).mean()))
            sums[i] += float(_warp_errors(first, third, best).mean())
        count += 1
    plain, inverse, constant_error = (float(x) / max(count, 1) for x in sums)
    kind = kinds[int(inverse < plain)]
    return kind, Agreement(min(plain, inverse), constant_error, count)


def mask_agreement(pairs: Sequence[tuple[Image, Image]], distance: float) -> Agreement:
    """Compare what masks call still with what they call moving: how far a still world explains
    another image of it.

    Each pixel may choose its depth. What stands is found on its epipolar line in the other image;
    from a camera that stands, too, at its own place.
    """
    still = moving = 0.0
    count = 0
    for views in pairs:
        first, second = (_small(p) for p in views)
        if first.moves is None or not 0 < float(first.moves.mean()) < 1:
            continue
        tried = [
            _warp_errors(first, second, torch.full_like(first.moves, z)) for z in _depths(distance)
        ]
        error = torch.stack(tried).amin(0)
        moves = first.moves.flatten()
        moving += float((error * moves).sum() / moves.sum())
        still += float((error * (1 - moves)).sum() / (1 - moves).sum())
        count += 1
    return Agreement(still / max(count, 1), moving / max(count, 1), count)


def spread_pairs(indices: Sequence[int]) -> list[int]:
    """Return at most ``PAIRS`` of the indices, evenly chosen."""
    return [indices[i] for i in evenly_spaced(len(indices), PAIRS)]


def _depths(distance: float) -> list[float]:
    return [distance * _RANGE ** (2 * i / (_DEPTHS - 1) - 1) for i in range(_DEPTHS)]


def _aligned_guesses(given: Tensor, kind: DepthForm, distance: float) -> Iterator[Tensor]:
    """Yield the map aligned so that its near and far end lie at every pair of guesses."""
    known = given > 0
    values = values_of(given, kind)
    low, high = (float(values[known].quantile(q)) for q in (0.05, 0.95))
    fraction = (values - low) / max(high - low, 1e-12)
    ends = sorted(values_of(torch.tensor(_depths(distance), device="cpu"), kind).tolist())
    for i, begin in enumerate(ends):
        for end in ends[i + 1 :]:
            at = (begin + fraction * (end - begin)).clamp(0.3 * begin, 3 * end)
            yield torch.where(known, at if kind == "depth" else 1 / at, 0.0)


def _warp_errors(first: Image, second: Image, depth: Tensor) -> Tensor:
    """Return differences of an image from another one that is warped to it by ``depth`` (H, W),
    where that is known.

    (P,) means over channels, for the pixels with a depth, row by row.
    """
    known = (depth > 0).flatten()
    here = first.cameras
    there = second.cameras
    k = here.intrinsics[0]
    rays = (_centers(first.rgb_premultiplied)[known] - k[:2, 2]) / k.diagonal()[:2]
    local = torch.cat([rays, torch.ones_like(rays[:, :1])], 1) * depth.flatten()[known, None]
    between = there.cam_from_world[0] @ torch.linalg.inv(here.cam_from_world[0])
    moved = local @ between[:3, :3].T + between[:3, 3]
    focal = there.intrinsics[0].diagonal()[:2]
    center = there.intrinsics[0][:2, 2]
    places = moved[:, :2] / moved[:, 2:].clamp_min(1e-6) * focal + center
    size = places.new_tensor([there.width, there.height])
    inside = (moved[:, 2] > 0) & ((places > 0) & (places < size)).all(1)
    error = (
        (_sampled(second.rgb_premultiplied, places) - first.rgb_premultiplied.reshape(-1, 3)[known])
        .abs()
        .mean(1)
    )
    # What leaves the image costs as much as a mean pixel: otherwise the best warp would show
    # nothing.
    outside = (first.rgb_premultiplied - first.rgb_premultiplied.mean((0, 1))).abs().mean()
    return torch.where(inside, error, outside)


def _small(image: Image) -> Image:
    return image.shrunk(max(1, math.ceil(max(image.cameras.width, image.cameras.height) / _SIDE)))


def _centers(pixels: Tensor) -> Tensor:
    y, x = (torch.arange(n, device=pixels.device) + 0.5 for n in pixels.shape[:2])
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)


def _sampled(pixels: Tensor, places: Tensor) -> Tensor:
    height, width = pixels.shape[:2]
    grid = (2 * places / places.new_tensor([width, height]) - 1)[None, None]
    image = pixels.permute(2, 0, 1)[None]
    return torch.nn.functional.grid_sample(image, grid, padding_mode="border", align_corners=False)[
        0, :, 0
    ].T


def _blurred(pixels: Tensor) -> Tensor:
    image = torch.nn.functional.pad(pixels.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")
    return torch.nn.functional.avg_pool2d(image, 3, 1)[0].permute(1, 2, 0)


def distance_to_scene(cameras: Sequence[Cameras]) -> float | None:
    """Return the median distance of cameras from the point that they look at, None where their axes
    are parallel."""
    poses = torch.linalg.inv(torch.cat([c.cam_from_world for c in cameras]).double())
    focus = focus_point(poses.numpy())
    if focus is None:
        return None
    return float((poses[:, :3, 3] - torch.from_numpy(focus)).norm(dim=1).median())
