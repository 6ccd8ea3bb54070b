"""The person that is filmed, and the first Gaussians on its template: in the colours and silhouettes of images."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from torch import Tensor

from dyngs.conventions import SH_C0
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors, skinning_weights
from dyngs.human.avatar.observations import SurfacePoints, observe_points
from dyngs.human.avatar.posing import BodyPose, PoseBlendShapes, Skeleton, frame_pose, rest_offsets
from dyngs.human.motion.captured import CapturedMotion


@dataclass(frozen=True)
class Subject:
    """A person in a capture: the template's skeleton, the anchors of the first N Gaussians, the poses of the images.

    ``shapes`` are the template's pose blend shapes, None where it has none.
    """

    skeleton: Skeleton
    anchors: Anchors
    footage: CapturedMotion
    shapes: PoseBlendShapes | None = None


def first_look(
    gaussians: Gaussians, normals: Tensor, subject: Subject, images: Iterable[Image], carve: float
) -> tuple[Gaussians, Subject]:
    """Return the first Gaussians that lie inside the silhouettes, in the colours of the images.

    Gaussians above the lowest scaffold are kept if they lie inside the silhouette of a share ``carve`` of the images.

    Args:
        gaussians: N, on the scaffolds.
        normals: (N, 3) of the surface below them at rest.
        subject: whose anchors are those of ``gaussians``.
        images: some of those to train on.
    """
    clip, anchors, skeleton = subject.footage.clip, subject.anchors, subject.skeleton
    rows = subject.footage.rows
    shown = ((image, frame_pose(clip, rows[image.frame or 0])) for image in images)
    weights = skinning_weights(anchors, len(skeleton.joints))

    def offsets(posing: BodyPose) -> Tensor | None:
        return rest_offsets(anchors, weights, posing, subject.shapes, None)

    found = observe_points(SurfacePoints(anchors.points, normals, weights, offsets), skeleton, shown)
    sh = gaussians.sh.clone()
    sh[:, 0] = (found.rgb - 0.5) / SH_C0
    kept = (found.inside >= carve) | (anchors.height == anchors.height.amin())
    gaussians = gaussians.replace(sh=sh).select(kept)
    return gaussians, replace(subject, anchors=anchors.select(kept))
