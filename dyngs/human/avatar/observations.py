"""Neighbours on a body, and what images show of it: colours of the first Gaussians, and how much of
each is seen. Local letter: N points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

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
    pose_blend_offsets,
)
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.skinning import apply_transforms, blend_transforms, joint_transforms

# least cosine between the skinning weights of points that belong to the same part of the body
_SAME_JOINTS = 0.5
_LOOKED_AT = 4  # points that are looked at, over the number of requested neighbours


def nearest_neighbours(points: Tensor, count: int = 5) -> Tensor:
    """Return the rows (Q, count) int64 of the nearest other points of each of ``points`` (Q, 3),
    nearest first.

    Points may coincide; none is its own neighbour. There are at most Q - 1 columns.
    """
    from scipy.spatial import KDTree

    num_points = len(points)
    count = min(count, num_points - 1)
    if count < 1:
        return torch.zeros(num_points, 0, dtype=torch.long, device=points.device)
    positions = points.detach().double().cpu().numpy()
    found = np.asarray(KDTree(positions).query(positions, k=count + 1)[1])
    own = found == np.arange(num_points)[:, None]
    own[~own.any(1), -1] = True  # more than ``count`` points coincide: drop the last one
    return torch.from_numpy(found[~own].reshape(num_points, count)).long().to(points.device)


def same_part_neighbours(points: Tensor, weights: Tensor, count: int = 5) -> Tensor:
    """Return the rows (Q, count) int64 of the nearest other points that follow the same joints,
    nearest first.

    They do where the cosine between their skinning weights (Q, J) is above a half, among four times
    ``count`` points around each; where fewer do, the point itself is in their place. At most Q - 1
    columns.
    """
    near = nearest_neighbours(points, _LOOKED_AT * count)
    unit = torch.nn.functional.normalize(weights, dim=1)
    if not near.shape[1]:
        return near
    cosines = [(unit * unit.index_select(0, column)).sum(1) for column in near.unbind(1)]
    others = torch.stack(cosines, dim=1) <= _SAME_JOINTS
    own = torch.arange(len(points), device=near.device)[:, None]
    order = others.int().sort(dim=1, stable=True).indices[:, :count]
    return torch.where(others, own, near).gather(1, order)


_SHORTEST = 1e-6  # added to all distances, squared: points that coincide pull each other nowhere


def rigidity_errors(
    means: Tensor, moved: Tensor, points: Tensor, near: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """Return mean squares () of changes of the distance to a neighbour, and of unlike offsets;
    differentiable.

    ``means`` (N, 3) at rest, which are offset from ``points`` (N, 3), are ``moved`` (N, 3) to a
    pose, in a world with ``scale`` () units per unit of theirs; ``near`` (N,) are rows of their
    neighbours.
    """
    # Numbers of one kind lie side by side: sums over rows of three are slow in torch.
    columns = (x.T.contiguous() for x in (means, moved, means - points))
    rest, posed, uneven = (x - x.index_select(1, near) for x in columns)
    before, after = ((x.square().sum(0) + _SHORTEST**2).sqrt() for x in (rest, posed))
    strain = after / scale - before
    return strain.square().mean(), uneven.square().sum() / len(near)


# sightings (see sightings) at which a Gaussian's own values count as much as what is around it
HALF_CONFIDENCE_VIEWS = 1.0
MIRROR_CONFIDENCE = 0.9  # trust in the other side of the body, where that was seen
# trust in a Gaussian's own values below which it is counted as unseen in the line for people
LOW_CONFIDENCE = 0.5
_NEIGHBOURS = 8
_SAME_PLACE = 1.5
"""Distance from the mirrored anchor, in sides of its texel, within which a Gaussian is its mirror
image."""
_OWN = 1e-6  # least weight of own values, which decides where nothing around is seen either
_SURE = 1e-3  # least doubt in own values, so that the numbers stay in range
_RESIDUAL, _MAX_ROUNDS = 1e-5, 1000
"""Largest residual of the linear system at which its solution is good enough, and bound on the
rounds it takes."""


@torch.no_grad()
def effective_view_counts(
    drawn: Iterable[tuple[Gaussians, Cameras]], sizes: Tensor, scale: float, options: RenderOptions
) -> Tensor:
    """Return (N,) sums over views of the squared fraction of each Gaussian's texel that is seen
    there.

    Gaussians too faint to be drawn have infinity: the images made them so. ``drawn`` are the
    Gaussians in the pose of each view, and its camera; ``sizes`` (N,) sides of the texels, m;
    ``scale`` world units per metre.
    """
    total = torch.zeros_like(sizes)
    for gaussians, camera in drawn:
        opacity = gaussians.opacities
        pose = camera.cam_from_world[0].to(opacity)
        focal = camera.intrinsics[0, 0, 0].to(opacity)
        depth = (gaussians.means @ pose[2, :3] + pose[2, 3]).clamp_min(options.near)
        seen = contributions(gaussians, camera, options)[0] / opacity.clamp_min(options.alpha_min)
        total += (seen / (sizes * scale * focal / depth).square()).square()
        total[opacity <= options.alpha_min] = torch.inf
    return total


def visibility_confidence(seen: Tensor) -> Tensor:
    """Return the trust (N,) in [0, 1] in values learned from so many sightings (N,)."""
    return 1 - HALF_CONFIDENCE_VIEWS / (seen + HALF_CONFIDENCE_VIEWS)


def filled(
    gaussians: Gaussians, anchors: Anchors, weights: Tensor, middle: float, trust: Tensor
) -> dict[str, Tensor]:
    """Return new ``sh``, ``means`` and ``logit_opacities`` of N Gaussians at rest; the same where
    trust is 1.

    Offsets, opacities and colours are mixed with those of the mirror image; base colours are made
    like those of linked neighbours. ``weights`` (N, J) are the template's; ``middle`` is x of the
    plane of symmetry, m; ``trust`` (N,) in [0, 1].
    """
    other, mixed, known = mirror_blend_weights(anchors, middle, trust)
    fraction = mixed[:, None]
    away = gaussians.means - anchors.points
    flipped = away[other] * away.new_tensor([-1.0, 1.0, 1.0])
    opacity = gaussians.logit_opacities[:, None]
    sh = gaussians.sh.clone()
    colour = torch.lerp(sh[:, 0], sh[other, 0], fraction)
    sh[:, 0] = smooth_over_neighbours(colour, known, anchors, weights)
    sh[:, 1:] *= trust[:, None, None]
    return {
        "sh": sh,
        "means": anchors.points + torch.lerp(away, flipped, fraction),
        "logit_opacities": torch.lerp(opacity, opacity[other], fraction)[:, 0],
    }


def mirror_blend_weights(
    anchors: Anchors, middle: float, trust: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows (N,) of the mirror images, the fractions (N,) to mix of their values, and trust
    (N,) in the mixture.

    ``middle`` is x of the plane of symmetry, m; ``trust`` (N,) is that in own values.
    """
    other, is_image = find_mirror_gaussians(anchors, middle)
    borrowed = (1 - trust) * trust[other] * is_image * MIRROR_CONFIDENCE
    known = trust + borrowed
    return other, borrowed / known.clamp_min(_OWN), known


def find_mirror_gaussians(anchors: Anchors, middle: float) -> tuple[Tensor, Tensor]:
    """Return (N,) rows of the Gaussians nearest to positions mirrored at x = ``middle``, and if
    they are near (N,)."""
    from scipy.spatial import KDTree

    points = anchors.points.detach().double().cpu().numpy()
    mirrored = points * [-1, 1, 1] + [2 * middle, 0, 0]
    away, rows = KDTree(points).query(mirrored)
    is_near = torch.from_numpy(np.asarray(away)).to(anchors.size) < _SAME_PLACE * anchors.size
    return torch.from_numpy(np.asarray(rows)).long().to(anchors.points.device), is_near


def smooth_over_neighbours(
    values: Tensor, trust: Tensor, anchors: Anchors, weights: Tensor
) -> Tensor:
    """Return values (N, C) that are like those of linked neighbours, and like ``values`` where
    there is trust.

    They minimize the sum of trust / (1 - trust) (x_i - v_i)^2 over Gaussians, and of w_ij (x_i -
    x_j)^2 over neighbours that follow the same joints, where w falls with their distance; by
    conjugate gradients.
    """
    from scipy.sparse import csr_array, diags_array
    from scipy.sparse.linalg import cg

    count = len(values)
    given = values.detach().double().cpu().numpy()
    # a link to itself changes nothing
    near = same_part_neighbours(anchors.points, weights, _NEIGHBOURS)
    if not near.shape[1]:
        return values
    steps = (anchors.points[near] - anchors.points[:, None]).norm(dim=-1) / anchors.size[:, None]
    strength = (1 / (1 + steps.square())).double().cpu().numpy()
    rows = np.repeat(np.arange(count), near.shape[1])
    links = csr_array((strength.ravel(), (rows, near.cpu().numpy().ravel())), (count, count))
    links = links.maximum(links.T)
    sure = trust.detach().double().cpu().numpy()
    own = sure / np.maximum(1 - sure, _SURE) + _OWN
    diagonal = np.asarray(links.sum(1)).ravel() + own
    system = diags_array(diagonal) - links
    jacobi = diags_array(1 / diagonal)
    columns = [
        cg(system, own * x, x0=x, rtol=0, atol=_RESIDUAL, maxiter=_MAX_ROUNDS, M=jacobi)[0]
        for x in given.T
    ]
    found = torch.from_numpy(np.stack(columns, axis=1)).to(values)
    return torch.where(trust[:, None] > 1 - _SURE, values, found)


FACING_EXPONENT = 4
"""Exponent of the cosine between normal and view direction in the weights of colours: frontal views
count most."""


@torch.no_grad()
def observed_colours(
    normals: Tensor,
    weights: Tensor,
    skeleton: Skeleton,
    shown: Iterable[tuple[Image, BodyPose, Tensor]],
) -> tuple[Tensor, Tensor]:
    """Return mean colours (N, 3) of points of a body in images, weighted to frontal views, and sums
    (N,) of weights.

    Points that no image faces are grey. Occlusion is ignored. ``normals`` (N, 3) are at rest,
    ``weights`` (N, J) skin; ``shown`` are images, body poses, and the points (N, 3) at rest for
    each pose.
    """
    count = len(normals)
    device = normals.device
    colour = torch.zeros(count, 3, device=device)
    weight = torch.zeros(count, device=device)
    for image, pose, points in shown:
        transforms = blend_transforms(
            weights, joint_transforms(skeleton.joints, skeleton.parents, pose.rotations)
        )
        world = pose.scale * apply_transforms(transforms, points) + pose.trans
        turned = (transforms[..., :3] * normals[:, None]).sum(-1)
        pixels, _, in_frame = project_points(world, image.cameras)
        last = pixels.new_tensor([image.cameras.width, image.cameras.height]) - 1
        column, row = (
            pixels.floor().nan_to_num().clamp(torch.zeros_like(last), last).long().unbind(1)
        )
        covered = in_frame.float() if image.alpha is None else image.alpha[row, column] * in_frame
        towards = torch.nn.functional.normalize(image.cameras.centers[0] - world, dim=1)
        turned = torch.nn.functional.normalize(turned, dim=1)
        facing = (towards * turned).sum(1).clamp_min(0) ** FACING_EXPONENT
        colour += facing[:, None] * in_frame[:, None] * image.rgb_premultiplied[row, column]
        weight += facing * covered
    seen = weight > 1e-3
    mean = torch.where(seen[:, None], colour / weight.clamp_min(1e-3)[:, None], 0.5)
    return mean.clamp(0, 1), weight


def project_points(world: Tensor, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Return column and row (N, 2) in pixels, depth (N,), and whether in the frame (N,), of points
    (N, 3)."""
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
    """Return a person whose Gaussians are in the colours of some images.

    What these do not face gets colours of the other side of the body and from around it. ``rows``
    are those of the clip by frame; ``normals`` (N, 3) are those of the surface at rest.
    """
    anchors = scene.anchors

    def shown() -> Iterator[tuple[Image, BodyPose, Tensor]]:
        for image in images:
            pose = frame_pose(scene.clip, rows[image.frame or 0])
            offsets = pose_blend_offsets(anchors, pose, scene.shapes)
            yield image, pose, anchors.points if offsets is None else anchors.points + offsets

    sh = scene.gaussians.sh.clone()
    weights = scene.template_weights()
    colours, seen = observed_colours(normals, weights, scene.skeleton, shown())
    middle = float(scene.skeleton.joints[0, 0])
    other, fraction, known = mirror_blend_weights(anchors, middle, visibility_confidence(seen))
    colours = torch.lerp(colours, colours[other], fraction[:, None])
    sh[:, 0] = (smooth_over_neighbours(colours, known, anchors, weights) - 0.5) / SH_C0
    return replace(scene, gaussians=scene.gaussians.replace(sh=sh))
