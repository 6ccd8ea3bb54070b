"""A motion moved up or down so that the body stands on the floor.

Local letters: F frames, J joints.
"""

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
    """Return the motion of 55 joints moved up or down as a whole, with its lowest vertex (mean shape) at y = 0.

    Pose blend shapes, which are millimetres, are ignored.
    """
    lowest = _lowest_heights(motion.for_joints(len(body.joints)).poses, body) * motion.scale + motion.trans[:, 1]
    trans = motion.trans.clone()
    trans[:, 1] -= lowest.min()
    return replace(motion, trans=trans)


def _lowest_heights(poses: Tensor, body: BodyTemplate) -> Tensor:
    """Return the smallest y (F,) of the vertices in poses (F, J, 3); only row y of the transforms is blended."""
    vertex, joint = body.weights.nonzero(as_tuple=True)
    points = torch.cat([body.vertices, torch.ones_like(body.vertices[:, :1])], dim=1)
    values = (body.weights[vertex, joint][:, None] * points[vertex]).double().cpu().numpy()
    columns = (4 * joint[:, None] + torch.arange(4, device=joint.device)).cpu().numpy()
    rows = vertex.repeat_interleave(4).cpu().numpy()
    height = csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(points), 4 * len(body.joints)))
    lowest = []
    for part in frame_chunks(len(poses)):
        transforms = joint_transforms(body.joints, body.parents, axis_angle_to_matrix(poses[part]))
        y_rows = transforms[:, :, 1].flatten(1).double().cpu().numpy()
        lowest += [(height @ few.T).min(axis=0) for few in np.array_split(y_rows, range(64, len(y_rows), 64))]
    return torch.from_numpy(np.concatenate(lowest)).to(poses)
