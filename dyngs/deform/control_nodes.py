"""Control nodes on cubic splines: sparse rigid motions that Gaussians follow, without a network.

After SC-GS (Huang et al. 2024) and Dynamic 3D Gaussians (Luiten et al. 2024): nodes carry rigid
motions, neighbours move as rigidly as possible, and motion outside the trained times continues at
constant velocity. Each image updates four neighbouring control points per spline, so that poses
with few images share them.

Local letters: S nodes, P control points.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, add_prefix, move_to_device, select_prefix
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.deform.field import (
    MAX_KEY_TIMES,
    DeformationField,
    FieldSetup,
    Offsets,
    build_offsets,
    head_sizes,
    select_rows,
)
from dyngs.deform.keys import ControlNodesField
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.nodes import SPAN, node_penalties, spline_motion
from dyngs.ops.quaternions import identity_quat, rotate
from dyngs.ops.skinning import blend_skinning

FOLLOWED = 4  # nodes that a Gaussian follows


@dataclass(frozen=True)
class Nodes:
    """Control nodes, and the nodes that each of M points follows."""

    positions: Tensor  # (S, 3) canonical positions
    # (S,) radius of influence, world units: mean distance to the nearest other nodes
    radii: Tensor
    followed: Tensor  # (M, B) node indices, nearest first

    def weights(self, means: Tensor) -> Tensor:
        """Return skinning weights (M, B): normalised Gaussians of distance, without gradient."""
        apart = (means.detach()[:, None] - self.positions[self.followed]).square().sum(-1)
        return torch.softmax(-0.5 * apart / self.radii[self.followed].square(), dim=1)


def build_nodes(positions: Tensor, means: Tensor) -> Nodes:
    """Return nodes at ``positions`` (S, 3), S >= 1, followed by the points ``means`` (M, 3)."""
    count = min(FOLLOWED, len(positions))
    distances, _ = _nearest(positions, positions, count)
    radii = distances[:, 1:].mean(1) if count > 1 else torch.ones(1, device="cpu")
    floor = max(1e-6 * float(radii.max()), 1e-12)
    _, followed = _nearest(positions, means, count)
    return Nodes(positions, radii.clamp_min(floor).to(positions), followed.to(positions.device))


def _nearest(places: Tensor, points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return distances and indices (M, count), on the CPU, of the ``places`` (S, 3) nearest to
    ``points`` (M, 3)."""
    from scipy.spatial import KDTree

    tree, queried = (x.detach().double().cpu().numpy() for x in (places, points))
    ranks: Any = range(1, count + 1)
    distances, indices = KDTree(tree).query(queried, k=ranks)
    return torch.from_numpy(distances), torch.from_numpy(indices)


def farthest_points(points: Tensor, count: int, taken: Tensor) -> Tensor:
    """Select at most ``count`` of ``points`` (M, 3) by farthest point sampling, away from
    ``taken``.

    No two selected points coincide with each other or with ``taken`` (S, 3). If that is empty, the
    first point is the one nearest to the mean.
    """
    points = points.detach().double()
    picked: list[int] = []
    if len(taken):
        nearest, _ = _nearest(taken, points, 1)
        apart = nearest[:, 0].to(points.device).square()
    else:
        # largest at the mean
        squared_distances = (points - points.mean(0)).square().sum(1)
        apart = (
            2 * torch.cat([squared_distances, squared_distances.new_zeros(1)]).max()
            - squared_distances
        ).clamp_min(1e-300)
    while len(picked) < min(count, len(points)):
        farthest = int(apart.argmax())
        if float(apart[farthest]) <= 0:
            break
        picked.append(farthest)
        apart = torch.minimum(apart, (points - points[farthest]).square().sum(1))
    return torch.tensor(picked, dtype=torch.long, device=points.device)


def blend_node_motion(
    nodes: Nodes, means: Tensor, motion: Tensor, values: Tensor, heads: Mapping[str, int]
) -> Offsets:
    """Blend node motions into offsets of the points ``means`` (M, 3) (linear blend skinning).

    x' = sum_b w_b (R_b (x - p_b) + p_b + d_b) with ``motion`` (S, 7); differentiable in x with
    constant weights. ``values`` (S, D) of all other ``heads`` (sizes by name, in order) are
    blended alike.
    """
    moved, blended = blend_skinning(
        means, nodes.positions, nodes.radii, nodes.followed, motion, values
    )
    return build_offsets(moved, blended, heads)


def spline_basis(places: Tensor, pieces: int) -> Tensor:
    """Return weights (K, pieces + 3), float64, of a uniform cubic B-spline at ``places`` (K,) in
    [0, 1]."""
    from scipy.interpolate import BSpline

    degree = SPAN - 1
    knots = np.arange(-degree, pieces + SPAN) / pieces
    clamped = places.double().clamp(0, 1).cpu().numpy()
    basis = BSpline.design_matrix(clamped, knots, degree).toarray()
    return torch.from_numpy(basis).to(places.device)


LR = {"quats": 6e-3, "log_scales": 1e-3, "logit_opacities": 1e-2, "colors": 2e-3}
"""Learning rates of node attributes other than positions."""
LR_DECAY = 0.2  # ratio of the last to the first learning rate
PIECES_PER_TIME = 0.3
"""Spline pieces per training time; more overfit single images, fewer lag behind fast motion."""
SMOOTHNESS = 0.01  # weight of the squared node acceleration, in node spacings


class ControlNodes(DeformationField):
    """Offsets from nodes on uniform cubic B-splines of time, blended over the Gaussians that
    follow.

    Nodes are placed at the first call. After each topology edit, nodes without followers are
    dropped, and new nodes start at the Gaussians farthest from any node, with the motion
    interpolated there.
    """

    def __init__(
        self, options: ControlNodesField, setup: FieldSetup, generator: torch.Generator
    ) -> None:
        self.options = options.resolve_nodes()
        self.setup = setup
        self.num_pieces = options.pieces or min(
            max(1, round(PIECES_PER_TIME * setup.num_times)), MAX_KEY_TIMES
        )
        self.buffers = {"positions": torch.zeros(0, 3, device="cpu")}
        self.parameters = self._untrained(0)

    def with_state(self, tensors: Mapping[str, Tensor]) -> ControlNodes:
        buffers = select_prefix(tensors, "buffers")
        count = len(buffers["positions"])
        require_tensor("positions", buffers["positions"], (count, 3))
        if "radii" in buffers or "followed" in buffers:
            require_positive("radii", require_tensor("radii", buffers["radii"], (count,)))
        for name, length in (("followed", self.setup.num_moving), ("neighbours", count)):
            if name in buffers:
                require_indices(name, buffers[name], (length, None), count)
        field = copy.copy(self)
        lengths = dict.fromkeys(head_sizes(self.options), count)
        field.parameters = self._untrained(0).with_state(select_prefix(tensors, "learned"), lengths)
        field.buffers = buffers
        return field

    def state(self) -> State:
        own = {"followed": Role.PER_MOVING, "neighbours": Role.TRAINING}
        buffers = {
            name: StateTensor(x, own.get(name, Role.SHARED)) for name, x in self.buffers.items()
        }
        return super().state() | add_prefix("buffers", buffers)

    @property
    def num_values(self) -> int:
        return self.parameters.num_values + sum(x.numel() for x in self.buffers.values())

    def apply_edit(self, edit: TopologyEdit) -> ControlNodes:
        field = copy.copy(self)
        field.buffers = {
            n: edit.apply(x) if n == "followed" else x for n, x in self.buffers.items()
        }
        return field

    def invalidate(self) -> None:
        self.buffers.pop("followed", None)

    def to(self, device: torch.device | str) -> ControlNodes:
        field = super().to(device)
        field.buffers = move_to_device(self.buffers, device)
        return field

    @property
    def num_nodes(self) -> int:
        return len(self.buffers["positions"])

    @property
    def num_points(self) -> int:
        return self.num_pieces + SPAN - 1

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        if not len(means):  # also without nodes
            return self.offsets_of_nodes(time).select(slice(0))
        return self._at(means, time, rows)[0]

    def in_training(self, means: Tensor, time: float) -> tuple[Offsets, dict[str, Tensor]]:
        if not len(means):
            return super().in_training(means, time)
        offsets, motion = self._at(means, time, None)
        return offsets, self._penalties(motion)

    def penalties(self, time: float) -> dict[str, Tensor]:
        return self._penalties(spline_motion(self._heads(), time)[0])

    def _at(self, means: Tensor, time: float, rows: Tensor | None) -> tuple[Offsets, Tensor]:
        """Return ``offsets`` and the motion (S, 7) of the nodes."""
        nodes = self.update_nodes(means)
        motion, values = spline_motion(self._heads(), time)
        nodes = replace(nodes, followed=select_rows(nodes.followed, rows))
        means = select_rows(means, rows)
        return blend_node_motion(nodes, means, motion, values, head_sizes(self.options)), motion

    def _penalties(self, motion: Tensor) -> dict[str, Tensor]:
        """Return the regularisers: node acceleration and as-rigid-as-possible, in squared node
        spacings."""
        if self.num_nodes < 2:
            return {}
        places, radii, near = (self.buffers[name] for name in ("positions", "radii", "neighbours"))
        acceleration, strain = node_penalties(
            places, radii, near, motion, self.parameters["means"]
        ).unbind()
        return {
            "node acceleration": SMOOTHNESS * acceleration,
            "node rigidity": self.options.rigidity * strain,
        }

    @torch.no_grad()
    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        """Extrapolate at constant velocity, that of the last two intervals.

        The outermost control point of the window ``seen`` is extrapolated too, unless the window
        ends the clip, because it hardly affects the window.
        """
        last = self.num_points - 1
        low = 0 if seen[0] <= 0 else math.floor(seen[0] * self.num_pieces) + 1
        high = last if seen[1] >= 1 else math.ceil(seen[1] * self.num_pieces) + SPAN - 3
        reach = min(2, high - low)
        device = self.setup.center.device
        after = torch.arange(1, last - high + 1, device=device)[:, None]
        before = torch.arange(low, 0, -1, device=device)[:, None]
        ends = (high, -reach, slice(high + 1, None), after), (low, reach, slice(low), before)
        for x in self.parameters.values().values():
            for edge, inward, outside, gaps in ends:
                pace = (x[:, edge] - x[:, edge + inward]) / max(reach, 1)
                x[:, outside] = x[:, edge, None] + gaps * pace[:, None]

    def offsets_of_nodes(self, time: float) -> Offsets:
        motion, values = spline_motion(self._heads(), time)
        return build_offsets(motion[:, :3], values, head_sizes(self.options))

    def _untrained(self, count: int) -> Parameters:
        sizes = head_sizes(self.options)
        device = self.setup.center.device
        tensors = {
            name: torch.zeros(count, self.num_points, size, device=device)
            for name, size in sizes.items()
        }
        assert self.options.lr_means is not None
        rates = {"means": self.options.lr_means * self.setup.extent} | LR
        return Parameters(tensors, rates, LR_DECAY)

    def _heads(self) -> list[Tensor | None]:
        return [self.parameters.get(field.name) for field in fields(Offsets)]

    def update_nodes(self, means: Tensor) -> Nodes:
        """Return the nodes that ``means`` (M, 3) follow; place them first if necessary."""
        if "followed" not in self.buffers:
            self._place_nodes(means.detach())
        return Nodes(self.buffers["positions"], self.buffers["radii"], self.buffers["followed"])

    @torch.no_grad()
    def _place_nodes(self, means: Tensor) -> None:
        """Drop nodes without followers, add nodes where they are missing, and assign ``means`` (M,
        3)."""
        old = self.buffers["positions"]
        kept = torch.zeros(0, dtype=torch.long, device=means.device)
        if len(old):
            kept = build_nodes(old, means).followed[:, 0].unique()
        added = farthest_points(means, self.options.nodes - len(kept), old[kept])
        source = torch.cat([kept, torch.zeros(len(added), dtype=torch.long, device=kept.device)])
        is_new = torch.arange(len(source), device=source.device) >= len(kept)
        started = self._motion_at(means[added])
        splines = self.parameters.values()
        values = {name: torch.cat([x[kept], started[name]]) for name, x in splines.items()}
        self.parameters = self.parameters.reorder(values, source, is_new)
        positions = torch.cat([old[kept], means[added]])
        nodes = build_nodes(positions, means)
        around = build_nodes(positions, positions).followed[:, 1:]
        buffers = {"radii": nodes.radii, "followed": nodes.followed, "neighbours": around}
        self.buffers = {"positions": positions} | buffers

    def _motion_at(self, points: Tensor) -> dict[str, Tensor]:
        """Return control points (S', P, size) by head, interpolated from the present nodes at
        ``points``."""
        splines = self.parameters.values()
        if not self.num_nodes or not len(points):
            return {name: x.new_zeros(len(points), *x.shape[1:]) for name, x in splines.items()}
        nodes = build_nodes(self.buffers["positions"], points)
        weights = nodes.weights(points)
        started = {
            name: torch.einsum("mb,mbpd->mpd", weights, x[nodes.followed])
            for name, x in splines.items()
        }
        if "quats" in splines:
            arms = (points[:, None] - nodes.positions[nodes.followed])[:, :, None].expand(
                -1, -1, self.num_points, -1
            )
            turns = splines["quats"][nodes.followed]
            swing = rotate(turns + identity_quat(turns), arms) - arms
            started["means"] = started["means"] + torch.einsum("mb,mbpd->mpd", weights, swing)
        return started
