"""What pictures say about places on a posed body: how often they lie inside the silhouette, and their colour.

Local letters: N places, J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Picture
from dyngs.human.avatar.posing import BodyPose, Skeleton
from dyngs.human.pose.skinning import apply_transforms, blend_transforms, joint_transforms

_FACING = 4
"""Power of the cosine between normal and view that weights colours: who sees a place head-on, sees it truly."""


@dataclass(frozen=True)
class SurfacePoints:
    """N places on a body at rest, m.

    Attributes:
        points: (N, 3).
        normals: (N, 3) unit vectors outwards.
        weights: (N, J) skinning weights.
        offsets: (N, 3) m, or None, that a pose adds to the points; none at all where it is None.
    """

    points: Tensor
    normals: Tensor
    weights: Tensor
    offsets: Callable[[BodyPose], Tensor | None] | None = None

    def at_rest(self, posing: BodyPose) -> Tensor:
        """(N, 3) the points as they are before skinning to a pose, m."""
        offsets = None if self.offsets is None else self.offsets(posing)
        return self.points if offsets is None else self.points + offsets


@dataclass(frozen=True)
class PointObservations:
    """What pictures show where N places are.

    Attributes:
        inside: (N,) share of the pictures in whose silhouette a place lies; 1 where no picture has alpha, or where a
            place is never within the frame.
        rgb: (N, 3) mean colour in the pictures that face a place; grey where there is none.
    """

    inside: Tensor
    rgb: Tensor


@torch.no_grad()
def observe_points(
    places: SurfacePoints, skeleton: Skeleton, shown: Iterable[tuple[Picture, BodyPose]]
) -> PointObservations:
    """Where the pictures show the places, each in the pose of its picture. What hides what is not considered."""
    count = len(places.points)
    inside, looked, weight = (torch.zeros(count) for _ in range(3))
    colour = torch.zeros(count, 3)
    for picture, posing in shown:
        transforms = blend_transforms(
            places.weights, joint_transforms(skeleton.joints, skeleton.parents, posing.rotations)
        )
        world = posing.scale * apply_transforms(transforms, places.at_rest(posing)) + posing.trans
        normals = (transforms[..., :3] * places.normals[:, None]).sum(-1)
        column, row, in_frame = _pixels(world, picture.cameras)
        covered = in_frame.float() if picture.alpha is None else picture.alpha[row, column] * in_frame
        inside += (covered > 0.5).float()
        looked += in_frame
        towards = torch.nn.functional.normalize(picture.cameras.centers[0] - world, dim=1)
        facing = (towards * torch.nn.functional.normalize(normals, dim=1)).sum(1).clamp_min(0) ** _FACING
        colour += facing[:, None] * in_frame[:, None] * picture.rgb_premultiplied[row, column]
        weight += facing * covered
    seen = weight > 1e-3
    rgb = torch.where(seen[:, None], colour / weight.clamp_min(1e-3)[:, None], 0.5)
    return PointObservations(torch.where(looked > 0, inside / looked.clamp_min(1), 1.0), rgb.clamp(0, 1))


def _pixels(world: Tensor, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Column and row (N,) of the pixel in which each place is seen, clamped, and whether that is in the frame."""
    pose, intrinsics = camera.cam_from_world[0], camera.intrinsics[0]
    seen = world @ pose[:3, :3].T + pose[:3, 3]
    at = (seen @ intrinsics.T)[:, :2] / seen[:, 2:].clamp_min(1e-6)
    size = at.new_tensor([camera.width, camera.height])
    in_frame = (seen[:, 2] > 0) & (at >= 0).all(1) & (at < size).all(1)
    column, row = at.floor().nan_to_num().clamp(at.new_zeros(2), size - 1).long().unbind(1)
    return column, row, in_frame
