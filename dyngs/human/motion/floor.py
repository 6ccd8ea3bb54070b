"""A motion moved up or down so that the body stands on the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from dyngs.human.motion.motion import Motion, frame_chunks
from dyngs.human.pose.skinning import axis_angle_to_matrix, joint_transforms
from dyngs.human.template.body import BodyTemplate


def place_on_floor(motion: Motion, body: BodyTemplate) -> Motion:
    """The motion of 55 joints moved up or down as a whole: the lowest vertex of its mean shape comes to y = 0.

    Pose blendshapes, which are millimetres, are not considered.
    """
    lowest = _lowest(motion.for_joints(len(body.joints)).poses, body) * motion.scale + motion.trans[:, 1]
    trans = motion.trans.clone()
    trans[:, 1] -= lowest.min()
    return replace(motion, trans=trans)


def _lowest(poses: Tensor, body: BodyTemplate) -> Tensor:
    """(F,) smallest y of the vertices in the poses (F, J, 3), of blended transforms of which only row y is needed."""
    followed = body.weights.nonzero(as_tuple=True)
    points = torch.cat([body.vertices, torch.ones_like(body.vertices[:, :1])], dim=1)
    shares = (body.weights[followed][:, None] * points[followed[0]]).double().numpy()
    columns = (4 * followed[1][:, None] + torch.arange(4)).numpy()
    vertex = followed[0].repeat_interleave(4).numpy()
    height = csr_array((shares.ravel(), (vertex, columns.ravel())), shape=(len(points), 4 * len(body.joints)))
    lowest = []
    for part in frame_chunks(len(poses)):
        rows = (
            joint_transforms(body.joints, body.parents, axis_angle_to_matrix(poses[part]))[:, :, 1]
            .flatten(1)
            .double()
            .numpy()
        )
        lowest += [(height @ few.T).min(axis=0) for few in np.array_split(rows, range(64, len(rows), 64))]
    return torch.from_numpy(np.concatenate(lowest)).to(poses.dtype)
