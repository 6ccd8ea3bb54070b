"""Control nodes that move along cubic splines: no network, and a cost that hardly grows with the
Gaussians.

After SC-GS (Huang et al. 2024) and Dynamic 3D Gaussians (Luiten et al. 2024): nodes carry rigid
motions, neighbours move alike, and a motion that leaves the times seen so far goes on at constant
velocity.

Every image moves four neighbouring control points of each spline: poses that few images show are
shared by many.

Local letters: S nodes, P control points.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, move_to_device, part_of, add_prefix
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.deform.field import (
    MAX_KEY_TIMES,
    DeformationField,
    FieldSetup,
    Offsets,
    head_sizes,
    offsets_of,
    select_rows,
)
from dyngs.deform.keys import ControlNodesField
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.nodes import SPAN, cubic_fractions, node_penalties, spline_motion
from dyngs.ops.quaternions import identity_quat, rotate
from dyngs.ops.skinning import blend_skinning

if TYPE_CHECKING:
    from scipy.spatial import KDTree

FOLLOWED = 4  # Nodes that a Gaussian follows


@dataclass(frozen=True)
class Nodes:
    """Control nodes, and the ones that each of M points follows."""

    positions: Tensor  # (S, 3) canonical
    radii: Tensor  # (S,) of influence, world units: the mean distance to the nearest other nodes
    followed: Tensor  # (M, B) indices of the nodes that each point follows, nearest first

    def weights(self, means: Tensor) -> Tensor:
        """Return (M, B) weights of the followed nodes: Gaussians of the distance, normalised;
        constant in ``means``."""
        apart = (means.detach()[:, None] - self.positions[self.followed]).square().sum(-1)
        return torch.softmax(-0.5 * apart / self.radii[self.followed].square(), dim=1)


def nodes_at(positions: Tensor, means: Tensor) -> Nodes:
    """Return the nodes at ``positions`` (S, 3), at least one, followed by the points ``means`` (M,
    3)."""
    tree = _tree(positions)
    count = min(FOLLOWED, len(positions))

    def nearest(points: Tensor, which: int) -> Tensor:
        """Return (M, count) distances (0) to the nearest nodes, or their indices (1)."""
        numbers = points.detach().double().cpu().numpy()
        ranks: Any = range(1, count + 1)
        return torch.from_numpy(tree.query(numbers, k=ranks)[which])

    radii = nearest(positions, 0)[:, 1:].mean(1) if count > 1 else torch.ones(1, device="cpu")
    floor = max(1e-6 * float(radii.max()), 1e-12)
    followed = nearest(means, 1).to(positions.device)
    return Nodes(positions, radii.clamp_min(floor).to(positions), followed)


def farthest_points(points: Tensor, count: int, taken: Tensor) -> Tensor:
    """Return indices of at most ``count`` ``points`` (M, 3), each the farthest from those before it
    and from ``taken``.

    None coincides with another or with one of ``taken`` (S, 3). Without those, the first is nearest
    to the mean.
    """
    points = points.detach().double()
    picked: list[int] = []
    if len(taken):
        nearest, _ = _tree(taken).query(points.cpu().numpy())
        apart = torch.from_numpy(nearest).to(points.device).square()
    else:
        # largest at the mean
        stray = (points - points.mean(0)).square().sum(1)
        apart = (2 * torch.cat([stray, stray.new_zeros(1)]).max() - stray).clamp_min(1e-300)
    while len(picked) < min(count, len(points)):
        farthest = int(apart.argmax())
        if float(apart[farthest]) <= 0:
            break
        picked.append(farthest)
        apart = torch.minimum(apart, (points - points[farthest]).square().sum(1))
    return torch.tensor(picked, dtype=torch.long, device=points.device)


def follow(
    nodes: Nodes, means: Tensor, motion: Tensor, values: Tensor, heads: Mapping[str, int]
) -> Offsets:
    """Return offsets of the points ``means`` (M, 3) from the nodes' ``motion`` (S, 7) and
    ``values`` (S, D).

    A node turns what follows it about its own place: x' = sum_b w_b (R_b (x - p_b) + p_b + d_b);
    differentiable in x, the weights taken as constant. The values of all other ``heads``, names and
    sizes in order, are blended alike.
    """
    moved, blended = blend_skinning(
        means, nodes.positions, nodes.radii, nodes.followed, motion, values
    )
    return offsets_of(moved, blended, heads)


def rotate_by_offsets(offsets: Tensor, vectors: Tensor) -> Tensor:
    """Return (..., 3) ``vectors`` turned by the rotations identity + ``offsets`` (..., 4), of any
    length."""
    return rotate(offsets + identity_quat(offsets), vectors)


def _tree(points: Tensor) -> KDTree:
    from scipy.spatial import KDTree

    return KDTree(points.double().cpu().numpy())


def spline_basis(places: Tensor, pieces: int) -> Tensor:
    """Return (K, pieces + 3) float64 weights of the control points of a uniform cubic B-spline at
    ``places`` (K,).

    Places lie in [0, 1], which the pieces share evenly.
    """
    scaled = places.double().clamp(0, 1) * pieces
    piece = scaled.long().clamp_max(pieces - 1)
    weights = torch.stack(cubic_fractions(scaled - piece), dim=1)
    basis = torch.zeros(len(places), pieces + SPAN - 1, dtype=torch.float64, device=places.device)
    return basis.scatter_(1, piece[:, None] + torch.arange(SPAN, device=places.device), weights)


NOTHING = torch.zeros(0, 3, device="cpu")
LR = {"quats": 6e-3, "log_scales": 1e-3, "logit_opacities": 1e-2, "colors": 2e-3}
"""Learning rates of the nodes' attributes other than positions."""
LR_DECAY = 0.2  # Ratio of the last to the first learning rate
PIECES_PER_TIME = 0.3
"""Pieces of the splines per training time. With more, poses follow single images; with fewer, they
lag behind."""
SMOOTHNESS = 0.01  # Weight of the nodes' squared acceleration, in node spacings


class ControlNodes(DeformationField):
    """Offsets of nodes, uniform cubic B-splines of time, blended into those of the Gaussians that
    follow them.

    Nodes are placed when first needed. Whenever the set of Gaussians has changed, nodes that
    nothing follows are dropped and new ones start, with the motion found there, where Gaussians are
    farthest from any.
    """

    def __init__(
        self, options: ControlNodesField, setup: FieldSetup, generator: torch.Generator
    ) -> None:
        self.options, self.setup = options, setup
        self.num_pieces = options.pieces or min(
            max(1, round(PIECES_PER_TIME * setup.num_times)), MAX_KEY_TIMES
        )
        self.buffers = {"positions": NOTHING}
        self.parameters = self._untrained(0)

    def with_state(self, tensors: Mapping[str, Tensor]) -> ControlNodes:
        buffers = part_of(tensors, "buffers")
        count = len(buffers["positions"])
        require_tensor("positions", buffers["positions"], (count, 3))
        if "radii" in buffers or "followed" in buffers:
            require_positive("radii", require_tensor("radii", buffers["radii"], (count,)))
        for name, length in (("followed", self.setup.num_moving), ("neighbours", count)):
            if name in buffers:
                require_indices(name, buffers[name], (length, None), count)
        field = copy.copy(self)
        lengths = dict.fromkeys(head_sizes(self.options), count)
        field.parameters = self._untrained(0).with_state(part_of(tensors, "learned"), lengths)
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
        if not len(means):  # whatever nodes there are
            return self.at(time).select(slice(0))
        return self._follow(means, rows, *self._motion(means, time))

    def in_training(self, means: Tensor, time: float) -> tuple[Offsets, dict[str, Tensor]]:
        if not len(means):
            return super().in_training(means, time)
        motion, values = self._motion(means, time)
        return self._follow(means, None, motion, values), self._penalties(motion)

    def penalties(self, time: float) -> dict[str, Tensor]:
        return self._penalties(spline_motion(self._heads(), time)[0])

    def _motion(self, means: Tensor, time: float) -> tuple[Tensor, Tensor]:
        self.nodes_for(means)
        return spline_motion(self._heads(), time)

    def _follow(
        self, means: Tensor, rows: Tensor | None, motion: Tensor, values: Tensor
    ) -> Offsets:
        nodes = self.nodes_for(means)
        nodes = replace(nodes, followed=select_rows(nodes.followed, rows))
        return follow(nodes, select_rows(means, rows), motion, values, head_sizes(self.options))

    def _penalties(self, motion: Tensor) -> dict[str, Tensor]:
        """Return the nodes' acceleration and their neighbours' deviation from rigid motion, in
        squared spacings."""
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
        """Go on at constant velocity, that of the last two intervals.

        The outermost point that a time in ``seen`` depends on counts as not seen, unless no time
        lies beyond: its share is too small.
        """
        last = self.num_points - 1
        low = 0 if seen[0] <= 0 else math.floor(seen[0] * self.num_pieces) + 1
        high = last if seen[1] >= 1 else math.ceil(seen[1] * self.num_pieces) + SPAN - 3
        reach = min(2, high - low)
        device = self.setup.center.device
        after = torch.arange(1, last - high + 1, device=device)[:, None]
        before = torch.arange(low, 0, -1, device=device)[:, None]
        for x in (self.parameters[name].data for name in head_sizes(self.options)):
            pace = (x[:, high] - x[:, high - reach]) / max(reach, 1)
            x[:, high + 1 :] = x[:, high, None] + after * pace[:, None]
            pace = (x[:, low] - x[:, low + reach]) / max(reach, 1)
            x[:, :low] = x[:, low, None] + before * pace[:, None]

    def at(self, time: float) -> Offsets:
        motion, values = spline_motion(self._heads(), time)
        return offsets_of(motion[:, :3], values, head_sizes(self.options))

    def _untrained(self, count: int) -> Parameters:
        sizes = head_sizes(self.options)
        device = self.setup.center.device
        tensors = {
            name: torch.zeros(count, self.num_points, size, device=device)
            for name, size in sizes.items()
        }
        rates = {"means": self.options.lr_means * self.setup.extent} | LR
        return Parameters(tensors, {name: rates[name] for name in sizes}, LR_DECAY)

    def _splines(self) -> dict[str, Tensor]:
        return {name: self.parameters[name].detach() for name in head_sizes(self.options)}

    def _heads(self) -> list[Tensor | None]:
        return [self.parameters.get(field.name) for field in fields(Offsets)]

    def nodes_for(self, means: Tensor) -> Nodes:
        """Return the nodes, placed among ``means`` (M, 3) if need be, which follow them."""
        if "followed" not in self.buffers:
            self._place(means.detach())
        return Nodes(self.buffers["positions"], self.buffers["radii"], self.buffers["followed"])

    @torch.no_grad()
    def _place(self, means: Tensor) -> None:
        """Drop nodes that nothing follows, add some where they are missing, and let ``means`` (M,
        3) follow."""
        old = self.buffers["positions"]
        kept = torch.zeros(0, dtype=torch.long, device=means.device)
        if len(old):
            kept = nodes_at(old, means).followed[:, 0].unique()
        added = farthest_points(means, self.options.nodes - len(kept), old[kept])
        source = torch.cat([kept, torch.zeros(len(added), dtype=torch.long, device=kept.device)])
        is_new = torch.arange(len(source), device=source.device) >= len(kept)
        started = self._motion_at(means[added])
        values = {name: torch.cat([x[kept], started[name]]) for name, x in self._splines().items()}
        self.parameters = self.parameters.reorder(values, source, is_new)
        self._assign(torch.cat([old[kept], means[added]]), means)

    def _assign(self, positions: Tensor, means: Tensor) -> None:
        nodes = nodes_at(positions, means)
        around = nodes_at(positions, positions).followed[:, 1:]
        found = {"radii": nodes.radii, "followed": nodes.followed, "neighbours": around}
        self.buffers = {"positions": positions} | found

    def _motion_at(self, points: Tensor) -> dict[str, Tensor]:
        """Return the control points (S', P, size), by head, that the present nodes give to
        ``points`` (S', 3)."""
        splines = self._splines()
        if not self.num_nodes or not len(points):
            return {name: x.new_zeros(len(points), *x.shape[1:]) for name, x in splines.items()}
        nodes = nodes_at(self.buffers["positions"], points)
        weights = nodes.weights(points)
        started = {
            name: torch.einsum("mb,mbpd->mpd", weights, x[nodes.followed])
            for name, x in splines.items()
        }
        if "quats" in splines:
            arms = (points[:, None] - nodes.positions[nodes.followed])[:, :, None].expand(
                -1, -1, self.num_points, -1
            )
            swing = rotate_by_offsets(splines["quats"][nodes.followed], arms) - arms
            started["means"] = started["means"] + torch.einsum("mb,mbpd->mpd", weights, swing)
        return started
