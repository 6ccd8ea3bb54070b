"""A captured person to predict: the template in the person's shape, its texels, and the choice of
views.

Local letters: P texels, K scaffolds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import texel_gaussians
from dyngs.human.avatar.observations import Subject
from dyngs.human.avatar.posing import BodyPose, Skeleton, frame_pose, pose_blend_shapes
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import rest_shape
from dyngs.human.body.mesh import vertex_normals
from dyngs.human.keys import HumanPredictorModel
from dyngs.human.motion.motion import captured_motion


@dataclass(frozen=True)
class CapturedPerson:
    """A person with images, as input of a prediction."""

    name: str  # of the capture, for messages
    body: BodyTemplate  # the template in the person's shape, without a shape space
    normals: Tensor  # (M, 3) unit normals of its vertices
    texels: Texels  # P, of that shape
    mirror: Tensor  # (P,) index of the texel at the mirror image of each
    heights: tuple[float, ...]  # (K,) of the scaffolds, m, ascending
    gaussians: Gaussians  # K P grey discs, ordered by scaffold
    subject: Subject  # skeleton, poses, and the anchors of ``gaussians``
    views: tuple[View, ...]  # with images, in the order of the split ``train``

    def pose_in(self, view: View) -> BodyPose:
        """Return the pose of the person in ``view``."""
        motion = self.subject.motion
        return frame_pose(motion.clip, motion.rows[-1 if view.frame is None else view.frame])


def captured_person(
    capture: Capture, model: HumanPredictorModel, body: BodyTemplate
) -> CapturedPerson:
    """Return the person of a capture, on the template ``body``.

    Raises DyngsError: a capture without body parameters, without silhouettes, or a view without
    parameters.
    """
    if capture.body is None:
        raise DyngsError(
            f"{capture.root}: has no body parameters, which a prediction needs; see docs/human.md"
        )
    if not capture.has_alpha:
        raise DyngsError(
            f"{capture.root}: the images have no silhouettes; give them alpha, see docs/human.md"
        )
    given = capture.body["train"]
    views = capture.splits["train"]
    vertices, joints = rest_shape(body, given)
    texels = atlas_texels(body, model.resolution, vertices)
    heights = tuple(sorted(set(model.scaffold_heights)))
    gaussians, anchors = texel_gaussians(texels, heights, 0)
    captured = captured_motion(capture.root, given, views, joints)
    shape = {
        "shape_dirs": None,
        "joint_shape_dirs": None,
        "expression_dirs": None,
        "joint_expression_dirs": None,
    }
    return CapturedPerson(
        name=capture.root.name,
        body=replace(body, vertices=vertices, joints=joints, **shape),
        normals=torch.from_numpy(
            vertex_normals(vertices.double().cpu().numpy(), body.faces.cpu().numpy())
        ).to(vertices),
        texels=texels,
        mirror=mirror_texels(texels),
        heights=heights,
        gaussians=gaussians,
        subject=Subject(Skeleton(joints, body.parents), anchors, captured, pose_blend_shapes(body)),
        views=views,
    )


def spread_views(person: CapturedPerson, count: int, first: int | None = None) -> list[int]:
    """Return the indices, ascending, of ``count`` views that see as much of the person as possible.

    The views are of one frame, the first with the most views, if it has enough; else of all frames.
    They maximize the mean over texels of the best view's cosine between normal and view direction,
    in the rest pose and without occlusion; found greedily, then by exchanging one view after the
    other. All views if there are fewer than ``count``; the view ``first`` must be among them, and
    its frame is chosen.
    """
    views = person.views
    frames = [view.frame for view in views]
    frame = max(dict.fromkeys(frames), key=frames.count) if first is None else frames[first]
    allowed = [i for i, own in enumerate(frames) if own == frame]
    if len(allowed) < count:
        allowed = list(range(len(views)))
    if len(allowed) <= count:
        return allowed
    normals = person.texels.normals[:: max(1, len(person.texels) // 1000)]
    cosines = normals @ torch.stack([_direction(person, views[i]) for i in allowed], dim=1)
    start = [] if first is None else [allowed.index(first)]
    chosen = start + _best(cosines, start, count - len(start))
    for _ in range(count):
        before = list(chosen)
        for place in range(len(start), count):
            chosen[place] = _best(cosines, chosen[:place] + chosen[place + 1 :], 1)[0]
        if chosen == before:
            break
    return sorted(allowed[i] for i in chosen)


def _best(cosines: Tensor, others: list[int], count: int) -> list[int]:
    """Return the columns of ``cosines`` (P, V) that add most to ``others``, chosen greedily."""
    chosen: list[int] = []
    for _ in range(count):
        taken = others + chosen
        seen = (
            cosines[:, taken].amax(1, keepdim=True) if taken else cosines.new_zeros(len(cosines), 1)
        )
        gain = torch.maximum(cosines, seen).clamp_min(0).mean(0)
        gain[taken] = -1
        chosen.append(int(gain.argmax()))
    return chosen


def _direction(person: CapturedPerson, view: View) -> Tensor:
    """Return the unit vector (3,) from the pelvis to the camera, in the axes of the body at
    rest."""
    pose = person.pose_in(view)
    cam_from_world = torch.from_numpy(view.cam_from_world).to(pose.trans)
    center = -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
    pelvis = pose.scale * person.subject.skeleton.joints[0] + pose.trans
    return torch.nn.functional.normalize(pose.rotations[0].T @ (center - pelvis), dim=0)


_NEAREST = 16  # seen texels that an unseen one takes its colour from
_TURN = 0.1  # metres that count as much as a turn of the normal by 60 degrees
_SOFT = 0.01  # distance added, m, so that the very nearest texel does not decide alone
_UNKNOWN = 0.5


def mirror_texels(texels: Texels) -> Tensor:
    """Return the index (P,) of the texel nearest to the mirror image of each one, at rest."""
    positions = _positions(texels)
    found = KDTree(positions).query(positions * np.array([-1.0, 1, 1, -1, 1, 1]))[1]
    return torch.from_numpy(np.asarray(found, dtype=np.int64)).to(texels.index.device)


def colours_nearby(texels: Texels, rgb: Tensor, seen: Tensor) -> Tensor:
    """Return ``rgb`` (P, 3) where ``seen`` (P,) is positive, elsewhere the mean of seen texels that
    are near at rest.

    Weights fall with the squared distance, and grow with the cosine at which a texel is seen;
    normals count, too, so that the sole is not coloured like the instep. 0.5 if nothing is seen.
    """
    is_seen = (seen > 0).cpu().numpy()
    if not is_seen.any():
        return torch.full_like(rgb, _UNKNOWN)
    if is_seen.all():
        return rgb
    positions = _positions(texels)
    known = np.flatnonzero(is_seen)
    count = min(_NEAREST, len(known))
    found = KDTree(positions[known]).query(positions[~is_seen], k=count)
    # one neighbour comes without its axis
    distance, near = (np.asarray(x).reshape(-1, count) for x in found)
    rows = torch.from_numpy(known[near.astype(np.int64)]).to(rgb.device)
    weight = seen[rows] / (torch.from_numpy(distance).to(rgb) + _SOFT).square()
    filled = rgb.clone()
    filled[torch.from_numpy(~is_seen).to(rgb.device)] = (weight[..., None] * rgb[rows]).sum(
        1
    ) / weight.sum(1)[:, None]
    return filled


def _positions(texels: Texels) -> np.ndarray:
    """Return the positions and scaled normals (P, 6) of the texels at rest, m."""
    return torch.cat([texels.points, _TURN * texels.normals], dim=1).double().cpu().numpy()
