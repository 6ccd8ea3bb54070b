"""The captured person, and the first Gaussians on its template, in the colours of images. Local
letter: N points."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors, skinning_weights
from dyngs.human.avatar.neighbours import mirrored_trust, smoothed, trust_in
from dyngs.human.avatar.posing import BodyPose, PoseBlendShapes, Skeleton, frame_pose, rest_offsets
from dyngs.human.body.skinning import apply_transforms, blend_transforms, joint_transforms
from dyngs.human.motion.motion import CapturedMotion

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
        column, row, in_frame = _nearest_pixels(world, image.cameras)
        covered = in_frame.float() if image.alpha is None else image.alpha[row, column] * in_frame
        towards = torch.nn.functional.normalize(image.cameras.centers[0] - world, dim=1)
        facing = (towards * torch.nn.functional.normalize(turned, dim=1)).sum(1).clamp_min(
            0
        ) ** FACING_EXPONENT
        colour += facing[:, None] * in_frame[:, None] * image.rgb_premultiplied[row, column]
        weight += facing * covered
    seen = weight > 1e-3
    return torch.where(seen[:, None], colour / weight.clamp_min(1e-3)[:, None], 0.5).clamp(
        0, 1
    ), weight


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


def _nearest_pixels(world: Tensor, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Return column and row (N,) of the pixel of each point, clamped, and whether it is in the
    frame."""
    pixels, _, in_frame = project_points(world, camera)
    size = pixels.new_tensor([camera.width, camera.height])
    column, row = pixels.floor().nan_to_num().clamp(pixels.new_zeros(2), size - 1).long().unbind(1)
    return column, row, in_frame


@dataclass(frozen=True)
class Subject:
    """A person in a capture: the template's skeleton, the anchors of the first N Gaussians, the
    poses of the images.

    ``shapes`` are the template's pose blend shapes, None where it has none.
    """

    skeleton: Skeleton
    anchors: Anchors
    motion: CapturedMotion
    shapes: PoseBlendShapes | None = None


def in_colours_of(
    gaussians: Gaussians, normals: Tensor, subject: Subject, images: Iterable[Image]
) -> Gaussians:
    """Return the first Gaussians, on the texels of ``subject``, in the colours of some images.

    What these do not face gets colours of the other side of the body and from around it.
    ``normals`` (N, 3) are those of the surface at rest.
    """
    anchors = subject.anchors
    rows = subject.motion.rows

    def shown() -> Iterator[tuple[Image, BodyPose, Tensor]]:
        for image in images:
            pose = frame_pose(subject.motion.clip, rows[image.frame or 0])
            offsets = rest_offsets(anchors, pose, subject.shapes)
            yield image, pose, anchors.points if offsets is None else anchors.points + offsets

    sh = gaussians.sh.clone()
    weights = skinning_weights(anchors, len(subject.skeleton.joints))
    colours, seen = observed_colours(normals, weights, subject.skeleton, shown())
    middle = float(subject.skeleton.joints[0, 0])
    trust = trust_in(seen)
    other, fraction, known = mirrored_trust(anchors, middle, trust)
    colours = smoothed(
        torch.lerp(colours, colours[other], fraction[:, None]), known, anchors, weights
    )
    sh[:, 0] = (colours - 0.5) / SH_C0
    return gaussians.replace(sh=sh)
