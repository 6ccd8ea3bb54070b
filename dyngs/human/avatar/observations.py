"""Colours and visibility of body Gaussians in the training images, and filling of unseen regions.

Also neighbour search on the body surface and the regularisers between neighbours. Symbols: N points
or Gaussians, J joints.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, contributions
from dyngs.human.avatar.posing import (
    Anchors,
    BodyPose,
    Skeleton,
    frame_pose,
)
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.skinning import apply_transforms, blend_transforms, joint_transforms

# Cosine between skinning weights above which two points belong to the same body part.
_SAME_PART_COSINE = 0.5
_CANDIDATES_PER_NEIGHBOUR = 4


def same_part_neighbours(points: Tensor, weights: Tensor, count: int = 5) -> Tensor:
    """Return the indices (N, count) int64 of the nearest points of the same body part.

    Two points belong to the same part if the cosine between their skinning weights (N, J) is above
    0.5. Among the 4 ``count`` nearest points; missing neighbours are replaced by the point itself.
    """
    from scipy.spatial import KDTree

    positions = points.detach().double().cpu().numpy()
    # The first rank is the point itself, or one at the same place.
    ranks: Any = np.arange(_CANDIDATES_PER_NEIGHBOUR * count) + 2
    nearest = np.asarray(KDTree(positions).query(positions, k=ranks)[1])
    indices = torch.arange(len(points), device=points.device)[:, None]
    candidates = torch.from_numpy(nearest).long().to(points.device)
    # SciPy marks missing neighbours by the number of points.
    candidates = torch.where(candidates < len(points), candidates, indices)
    directions = torch.nn.functional.normalize(weights, dim=1)
    cosines = [
        (directions * directions.index_select(0, column)).sum(1) for column in candidates.unbind(1)
    ]
    is_other_part = torch.stack(cosines, dim=1) <= _SAME_PART_COSINE
    order = is_other_part.int().sort(dim=1, stable=True).indices[:, :count]
    return torch.where(is_other_part, indices, candidates).gather(1, order)


_MIN_DISTANCE = 1e-6  # keeps the gradient of the distance between coincident points finite


def rigidity_errors(
    means: Tensor, moved: Tensor, points: Tensor, neighbours: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the as-rigid-as-possible error () and the smoothness error (); differentiable.

    The first is the mean squared change, by posing, of the distance to a neighbour. The second is
    the mean squared difference between the offsets of neighbours from their anchors.

    Args:
        means: (N, 3) in the rest pose.
        moved: (N, 3) the same means in a pose, in world units.
        points: (N, 3) anchors of the means in the rest pose.
        neighbours: (N,) index of one neighbour of each.
        scale: () world units per unit of ``means``.
    """
    # Numbers of one kind lie side by side: sums over rows of three are slow in torch.
    columns = (x.T.contiguous() for x in (means, moved, means - points))
    rest, posed, offset_changes = (x - x.index_select(1, neighbours) for x in columns)
    rest_distances, posed_distances = (
        (x.square().sum(0) + _MIN_DISTANCE**2).sqrt() for x in (rest, posed)
    )
    strain = posed_distances / scale - rest_distances
    return strain.square().mean(), offset_changes.square().sum() / len(neighbours)


# Effective number of views at which a Gaussian's own values and its surroundings weigh the same.
HALF_CONFIDENCE_VIEWS = 1.0
MIRROR_CONFIDENCE = 0.9  # factor on the confidence of values from the mirrored side of the body
LOW_CONFIDENCE = 0.5  # below it a Gaussian counts as unseen in the log message
_NEIGHBOURS = 8
_MAX_MIRROR_TEXELS = 1.5
"""Largest distance, in texel sides, between a mirrored anchor and its counterpart."""
_MIN_OWN_WEIGHT = 1e-6  # keeps own values where neither a Gaussian nor its neighbours were seen
_MIN_DOUBT = 1e-3  # limits the weight of own values to 1000
_RESIDUAL, _MAX_ITERATIONS = 1e-5, 1000
"""Tolerance and iteration limit of the conjugate gradient solver."""


@torch.no_grad()
def effective_view_counts(
    posed: Iterable[tuple[Gaussians, Cameras]], sizes: Tensor, scale: float, options: RenderOptions
) -> Tensor:
    """Return (N,) sums over views of the squared visible fraction of each Gaussian's texel.

    Gaussians that training made too faint to be rendered get infinity, so that they are not filled.

    Args:
        posed: Gaussians in the pose of each view, with the camera of that view.
        sizes: (N,) sides of the texels, m.
        scale: world units per metre.
        options: of the renderer.
    """
    total = torch.zeros_like(sizes)
    for gaussians, camera in posed:
        opacity = gaussians.opacities
        pose = camera.cam_from_world[0].to(opacity)
        focal = camera.intrinsics[0, 0, 0].to(opacity)
        depth = (gaussians.means @ pose[2, :3] + pose[2, 3]).clamp_min(options.near)
        visible_pixels = contributions(gaussians, camera, options)[0] / opacity.clamp_min(
            options.alpha_min
        )
        total += (visible_pixels / (sizes * scale * focal / depth).square()).square()
        total[opacity <= options.alpha_min] = torch.inf
    return total


def visibility_confidence(view_counts: Tensor) -> Tensor:
    """Return the confidence (N,) in [0, 1] of values learned from (N,) effective view counts."""
    return 1 - HALF_CONFIDENCE_VIEWS / (view_counts + HALF_CONFIDENCE_VIEWS)


def fill_unseen(
    gaussians: Gaussians, anchors: Anchors, weights: Tensor, middle: float, confidence: Tensor
) -> dict[str, Tensor]:
    """Return new ``sh``, ``means`` and ``logit_opacities`` of N Gaussians in the rest pose.

    Offsets, opacities and colours are blended with those of the mirrored Gaussian, and base colours
    are smoothed over neighbours. Values with confidence 1 stay the same.

    Args:
        gaussians: N in the rest pose.
        anchors: of the Gaussians.
        weights: (N, J) skinning weights of the template.
        middle: x of the body's plane of symmetry, m.
        confidence: (N,) in [0, 1].
    """
    mirrored, blend, combined = mirror_blend_weights(anchors, middle, confidence)
    fraction = blend[:, None]
    offsets = gaussians.means - anchors.points
    mirrored_offsets = offsets[mirrored] * offsets.new_tensor([-1.0, 1.0, 1.0])
    opacity = gaussians.logit_opacities[:, None]
    sh = gaussians.sh.clone()
    colour = torch.lerp(sh[:, 0], sh[mirrored, 0], fraction)
    sh[:, 0] = smooth_over_neighbours(colour, combined, anchors, weights)
    sh[:, 1:] *= confidence[:, None, None]
    return {
        "sh": sh,
        "means": anchors.points + torch.lerp(offsets, mirrored_offsets, fraction),
        "logit_opacities": torch.lerp(opacity, opacity[mirrored], fraction)[:, 0],
    }


def mirror_blend_weights(
    anchors: Anchors, middle: float, confidence: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return how to blend each of N Gaussians with its mirrored counterpart.

    Args:
        anchors: of the Gaussians.
        middle: x of the plane of symmetry, m.
        confidence: (N,) of the Gaussians' own values.

    Returns:
        Indices (N,) of the counterparts, their fractions (N,) in the blend, and the confidence
        (N,) of the blend.
    """
    mirrored, has_counterpart = find_mirror_gaussians(anchors, middle)
    borrowed = (1 - confidence) * confidence[mirrored] * has_counterpart * MIRROR_CONFIDENCE
    combined = confidence + borrowed
    return mirrored, borrowed / combined.clamp_min(_MIN_OWN_WEIGHT), combined


def find_mirror_gaussians(anchors: Anchors, middle: float) -> tuple[Tensor, Tensor]:
    """Return the Gaussian (N,) nearest to each position mirrored at x = ``middle``, and whether it
    is close enough (N,) to be the counterpart."""
    from scipy.spatial import KDTree

    points = anchors.points.detach().double().cpu().numpy()
    mirrored = points * [-1, 1, 1] + [2 * middle, 0, 0]
    distances, nearest = KDTree(points).query(mirrored)
    is_near = (
        torch.from_numpy(np.asarray(distances)).to(anchors.size) < _MAX_MIRROR_TEXELS * anchors.size
    )
    return torch.from_numpy(np.asarray(nearest)).long().to(anchors.points.device), is_near


def smooth_over_neighbours(
    values: Tensor, confidence: Tensor, anchors: Anchors, weights: Tensor
) -> Tensor:
    """Smooth ``values`` (N, C) over neighbours, keeping those with high ``confidence`` (N,).

    Minimises sum_i c_i / (1 - c_i) (x_i - v_i)^2 + sum_ij w_ij (x_i - x_j)^2 by conjugate
    gradients, over neighbours of the same body part; w falls with their distance.
    """
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.csgraph import laplacian
    from scipy.sparse.linalg import cg

    count = len(values)
    given = values.detach().double().cpu().numpy()
    # Points without enough neighbours link to themselves, which has no effect.
    neighbours = same_part_neighbours(anchors.points, weights, _NEIGHBOURS)
    distances = (anchors.points[neighbours] - anchors.points[:, None]).norm(dim=-1) / anchors.size[
        :, None
    ]
    link_weights = (1 / (1 + distances.square())).double().cpu().numpy()
    rows = np.repeat(np.arange(count), neighbours.shape[1])
    links = csr_array(
        (link_weights.ravel(), (rows, neighbours.cpu().numpy().ravel())), (count, count)
    )
    links = links.maximum(links.T)
    known = confidence.detach().double().cpu().numpy()
    own_weight = known / np.maximum(1 - known, _MIN_DOUBT) + _MIN_OWN_WEIGHT
    system = laplacian(links) + diags_array(own_weight)
    jacobi = diags_array(1 / system.diagonal())
    columns = [
        cg(system, own_weight * x, x0=x, rtol=0, atol=_RESIDUAL, maxiter=_MAX_ITERATIONS, M=jacobi)[
            0
        ]
        for x in given.T
    ]
    smooth = torch.from_numpy(np.stack(columns, axis=1)).to(values)
    return torch.where(confidence[:, None] > 1 - _MIN_DOUBT, values, smooth)


FACING_EXPONENT = 4
"""Exponent of the cosine between normal and view direction in colour weights; frontal views count
most."""


@torch.no_grad()
def observed_colours(
    normals: Tensor,
    weights: Tensor,
    skeleton: Skeleton,
    observations: Iterable[tuple[Image, BodyPose, Tensor]],
) -> tuple[Tensor, Tensor]:
    """Return the mean colours (N, 3) of surface points over images, and their total weights (N,).

    Frontal views weigh most; occlusion is ignored. Points that face no camera are grey.

    Args:
        normals: (N, 3) in the rest pose.
        weights: (N, J) skinning weights.
        skeleton: in the rest pose.
        observations: image, body pose, and points (N, 3) in the rest pose, of each view.
    """
    count = len(normals)
    device = normals.device
    colour = torch.zeros(count, 3, device=device)
    weight = torch.zeros(count, device=device)
    for image, pose, points in observations:
        transforms = blend_transforms(
            weights, joint_transforms(skeleton.joints, skeleton.parents, pose.rotations)
        )
        world = pose.scale * apply_transforms(transforms, points) + pose.trans
        posed_normals = (transforms[..., :3] * normals[:, None]).sum(-1)
        pixels, _, in_frame = project_points(world, image.cameras)
        last = pixels.new_tensor([image.cameras.width, image.cameras.height]) - 1
        column, row = (
            pixels.floor().nan_to_num().clamp(torch.zeros_like(last), last).long().unbind(1)
        )
        covered = in_frame.float() if image.alpha is None else image.alpha[row, column] * in_frame
        to_camera = torch.nn.functional.normalize(image.cameras.centers[0] - world, dim=1)
        posed_normals = torch.nn.functional.normalize(posed_normals, dim=1)
        facing = (to_camera * posed_normals).sum(1).clamp_min(0) ** FACING_EXPONENT
        colour += facing[:, None] * in_frame[:, None] * image.rgb_premultiplied[row, column]
        weight += facing * covered
    is_observed = weight > 1e-3
    mean = torch.where(is_observed[:, None], colour / weight.clamp_min(1e-3)[:, None], 0.5)
    return mean.clamp(0, 1), weight


def project_points(world: Tensor, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Project points (N, 3); return pixels (N, 2), x and y, depth (N,) and in-frame mask (N,)."""
    pose = camera.cam_from_world[0].to(world)
    intrinsics = camera.intrinsics[0].to(world)
    in_camera = world @ pose[:3, :3].T + pose[:3, 3]
    pixels = (in_camera @ intrinsics.T)[:, :2] / in_camera[:, 2:].clamp_min(1e-6)
    depth = in_camera[:, 2]
    size = pixels.new_tensor([camera.width, camera.height])
    return pixels, depth, (depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)


def colour_from_images(
    scene: HumanScene, rows: Mapping[int, int], normals: Tensor, images: Iterable[Image]
) -> HumanScene:
    """Return the scene with its Gaussians coloured from images.

    Unobserved regions get colours of the mirrored side of the body and of their neighbours.

    Args:
        scene: with N Gaussians.
        rows: row of the clip by frame number.
        normals: (N, 3) of the surface in the rest pose.
        images: of the person, with frame numbers.
    """
    anchors = scene.anchors

    def observations() -> Iterator[tuple[Image, BodyPose, Tensor]]:
        for image in images:
            pose = frame_pose(scene.clip, rows[image.frame or 0])
            points = anchors.points
            if scene.shapes is not None:
                points = points + scene.shapes.offsets(anchors, pose.rotations)
            yield image, pose, points

    sh = scene.gaussians.sh.clone()
    weights = scene.template_weights()
    colours, total_weights = observed_colours(normals, weights, scene.skeleton, observations())
    middle = float(scene.skeleton.joints[0, 0])
    mirrored, fraction, combined = mirror_blend_weights(
        anchors, middle, visibility_confidence(total_weights)
    )
    colours = torch.lerp(colours, colours[mirrored], fraction[:, None])
    sh[:, 0] = (smooth_over_neighbours(colours, combined, anchors, weights) - 0.5) / SH_C0
    return replace(scene, gaussians=scene.gaussians.replace(sh=sh))
