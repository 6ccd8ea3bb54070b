"""Skinning weights as a field on the surface: where bones meet, which joints a Gaussian may follow, and how it learns.

A template's weights end where its author thought that skin ends to follow a bone; sleeves, trouser legs and jackets do
not. Weights are learned one by one from few pixels in few poses: a field that is smooth learns them from many.

Local letters: N Gaussians, K joints that one follows, C neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.human.avatar.anchors import Anchors, heaviest_joints, skinning_weights
from dyngs.human.avatar.neighbours import nearest_neighbours

SHARE = 0.05
"""Part of the weights that is taken from around, so that a Gaussian can come to follow joints of its surroundings."""
REACH, LEARNS_FROM = 0.12, 0.07
"""Standard deviations of the surroundings that this share, and the gradients of weights, are averaged over, m."""
LEAST = 1e-3  # weight from which a joint counts
_NEAR = 0.055  # radius around a point, m, in which neighbours are, spread evenly: a few rounds reach far
_NEIGHBOURS = 8
_ALIKE = 0.1  # least cosine between the weights of neighbours: from thigh to thigh, and finger to finger, is not near


def spread(anchors: Anchors, num_joints: int) -> Anchors:
    """Return the anchors with a share of the weights averaged over the surface around; the heaviest joints of these."""
    near = _ring(anchors, num_joints)
    around = given = skinning_weights(anchors, num_joints)
    for _ in range(_rounds(anchors, near, REACH)):
        around = (around + around.index_select(0, near.flatten()).unflatten(0, near.shape).sum(1)) / (near.shape[1] + 1)
    joints, weights = heaviest_joints(torch.lerp(given, around, SHARE))
    return replace(anchors, joints=joints, weights=weights)


@dataclass(frozen=True)
class SurfaceMean:
    """The mean, over the surface around, of values (N, K) for the joints that Gaussians follow."""

    slots: Tensor  # (P,) of the N K values, those that count
    near: Tensor  # (P, C) rows of ``slots``: the same joint at the neighbours, P where one does not follow it
    rounds: int

    def __call__(self, values: Tensor) -> Tensor:
        """Return the means (N, K) of ``values`` (N, K); what does not count is 0."""
        flat = values.flatten()
        now = flat.index_select(0, self.slots)
        for _ in range(self.rounds):
            padded = torch.cat([now, now.new_zeros(1)])
            around = padded.index_select(0, self.near.flatten()).unflatten(0, self.near.shape).sum(1)
            now = (now + around) / (self.near.shape[1] + 1)
        return torch.zeros_like(flat).index_copy_(0, self.slots, now).unflatten(0, values.shape)


def surface_mean(anchors: Anchors, num_joints: int) -> SurfaceMean:
    """Return how values of the joints of Gaussians are averaged where they follow more than one."""
    near = _ring(anchors, num_joints)
    counts = (anchors.weights > LEAST) & (anchors.weights[:, :1] < 1 - LEAST)
    slots = counts.flatten().nonzero()[:, 0]
    row_of = torch.full((len(anchors), num_joints), len(slots), device=slots.device)
    gaussian, joint = slots // counts.shape[1], anchors.joints.flatten()[slots]
    row_of[gaussian, joint] = torch.arange(len(slots), device=slots.device)
    return SurfaceMean(slots, row_of[near[gaussian], joint[:, None]], _rounds(anchors, near, LEARNS_FROM))


def _ring(anchors: Anchors, num_joints: int) -> Tensor:
    """Return rows (N, C) of neighbours on the surface; a point itself where one would be far, or of another limb."""
    every = max(1, round(math.pi * (_NEAR / float(anchors.size.median())) ** 2 / _NEIGHBOURS))
    near = nearest_neighbours(anchors.points, every * _NEIGHBOURS)[:, every - 1 :: every]
    if not near.shape[1]:
        return near
    away = (anchors.points[near] - anchors.points[:, None]).norm(dim=-1)
    unit = torch.nn.functional.normalize(skinning_weights(anchors, num_joints), dim=1)
    alike = torch.stack([(unit * unit.index_select(0, column)).sum(1) for column in near.unbind(1)], dim=1)
    own = torch.arange(len(near), device=near.device)[:, None]
    return torch.where((away < 2 * _NEAR) & (alike > _ALIKE), near, own)


def _rounds(anchors: Anchors, near: Tensor, reach: float) -> int:
    """Return after how many rounds of means over a point and its neighbours a value has spread over ``reach``, m."""
    if not near.shape[1]:
        return 0
    step = (anchors.points[near] - anchors.points[:, None]).square().sum(-1).sum(1) / (near.shape[1] + 1)
    return max(1, round(reach**2 / float(step.median())))
