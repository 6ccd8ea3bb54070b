"""Who is to be predicted: the template in a person's shape, its texels, and which views show the most of it.

Local letters: P texels, K scaffolds, V views, M vertices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import HumanModel
from dyngs.data.capture import Capture, View
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import texel_gaussians
from dyngs.human.avatar.posing import BodyPose, Skeleton, frame_pose, pose_blend_shapes
from dyngs.human.avatar.subject import Subject
from dyngs.human.motion.captured import captured_motion
from dyngs.human.template.atlas import Texels, atlas_texels
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.load import rest_shape
from dyngs.human.template.mesh import vertex_normals


@dataclass(frozen=True)
class CapturedPerson:
    """A person of whom there are pictures.

    Attributes:
        name: of the capture, for messages.
        body: the template in the person's shape, which is its only one.
        normals: (M, 3) of its vertices.
        texels: P, of that shape.
        heights: (K,) of the scaffolds, m, ascending.
        gaussians: K P grey discs, those of one scaffold after those of another.
        subject: skeleton, poses, and the anchors of ``gaussians``.
        views: with pictures, in the order of the capture's ``train``.
    """

    name: str
    body: BodyTemplate
    normals: Tensor
    texels: Texels
    heights: tuple[float, ...]
    gaussians: Gaussians
    subject: Subject
    views: tuple[View, ...]

    def posing(self, view: View) -> BodyPose:
        """The pose in which ``view`` shows the person."""
        row = self.subject.footage.frames.index(-1 if view.frame is None else view.frame)
        return frame_pose(self.subject.footage.clip, row)


def captured_person(capture: Capture, model: HumanModel, body: BodyTemplate) -> CapturedPerson:
    """The person of a capture, on the template ``body``.

    Raises:
        DyngsError: a capture without body parameters, without silhouettes, or a view without parameters.
    """
    if capture.body is None:
        raise DyngsError(f"{capture.root}: has no body parameters, which a prediction needs; see docs/human.md")
    if not capture.has_alpha:
        raise DyngsError(f"{capture.root}: the pictures have no silhouettes; give them alpha, see docs/human.md")
    given, views = capture.body["train"], capture.splits["train"]
    vertices, joints = rest_shape(body, torch.from_numpy(given.betas).float())
    texels = atlas_texels(body, model.resolution, vertices)
    heights = tuple(sorted(set(model.scaffold_heights)))
    gaussians, anchors = texel_gaussians(texels, heights, 0)
    filmed = captured_motion(capture.root, given, views, joints)
    shape = {"shape_dirs": None, "joint_shape_dirs": None, "expression_dirs": None, "joint_expression_dirs": None}
    return CapturedPerson(
        name=capture.root.name,
        body=replace(body, vertices=vertices, joints=joints, **shape),
        normals=torch.from_numpy(vertex_normals(vertices.double().numpy(), body.faces.numpy())).float(),
        texels=texels,
        heights=heights,
        gaussians=gaussians,
        subject=Subject(Skeleton(joints, body.parents), anchors, filmed, pose_blend_shapes(body)),
        views=views,
    )


def spread_views(sitter: CapturedPerson, count: int, first: int | None = None) -> list[int]:
    """Indices of ``count`` views that see as much of the person as possible, ascending.

    Of one moment, the first with the most views, where that has enough; else of all. They maximize the mean over texels
    of the cosine at which the best view would see each, if nothing hid it in rest pose; found by exchanging one after
    the other.

    Args:
        sitter: the person.
        count: at least 1; all views where there are no more.
        first: a view that is to be among them, whose moment is then chosen.
    """
    views = sitter.views
    frames = [view.frame for view in views]
    frame = max(dict.fromkeys(frames), key=frames.count) if first is None else frames[first]
    allowed = [i for i, own in enumerate(frames) if own == frame]
    if len(allowed) < count:
        allowed = list(range(len(views)))
    if len(allowed) <= count:
        return allowed
    normals = sitter.texels.normals[:: max(1, len(sitter.texels) // 1000)]
    cosines = normals @ torch.stack([_direction(sitter, views[i]) for i in allowed], dim=1)
    start = [] if first is None else [allowed.index(first)]
    chosen = start + _best(cosines, start, count - len(start))
    for _ in range(count):
        before = list(chosen)
        for place in range(len(start), count):
            chosen[place] = _best(cosines, chosen[:place] + chosen[place + 1 :], 1)[0]
        if chosen == before:
            break
    return sorted(allowed[i] for i in chosen)


def named_views(sitter: CapturedPerson, names: Sequence[str]) -> list[int]:
    """Indices of the views of these names, or whose pictures are named so.

    Raises:
        DyngsError: one that is not there, or twice.
    """
    files = [view.image_path.name for view in sitter.views]
    known = {name: i for i, name in enumerate(files) if files.count(name) == 1}
    known |= {view.name: i for i, view in enumerate(sitter.views)}
    for name in names:
        if name not in known:
            raise DyngsError(f"{sitter.name}: no training view is {name!r}; the first is {sitter.views[0].name!r}")
    found = [known[name] for name in names]
    if len(set(found)) < len(found):
        raise DyngsError(f"{sitter.name}: a view is named twice; name each once")
    return found


def _best(cosines: Tensor, others: list[int], count: int) -> list[int]:
    """Of the columns of ``cosines`` (P, V) those that add most to ``others``, one after the other."""
    chosen: list[int] = []
    for _ in range(count):
        taken = others + chosen
        seen = cosines[:, taken].amax(1, keepdim=True) if taken else cosines.new_zeros(len(cosines), 1)
        gain = torch.maximum(cosines, seen).clamp_min(0).mean(0)
        gain[taken] = -1
        chosen.append(int(gain.argmax()))
    return chosen


def _direction(sitter: CapturedPerson, view: View) -> Tensor:
    """(3,) unit vector from the pelvis to the camera, in the frame of the body at rest."""
    posing = sitter.posing(view)
    pose = torch.from_numpy(view.cam_from_world).float()
    center = -pose[:3, :3].T @ pose[:3, 3]
    pelvis = posing.scale * sitter.subject.skeleton.joints[0] + posing.trans
    return torch.nn.functional.normalize(posing.rotations[0].T @ (center - pelvis), dim=0)
