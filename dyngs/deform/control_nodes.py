"""Control nodes that move along cubic splines: no network, and a cost that hardly grows with the Gaussians.

After SC-GS (Huang et al. 2024) and Dynamic 3D Gaussians (Luiten et al. 2024): nodes carry rigid motions, neighbours
move alike, and a motion that leaves the times seen so far goes on at constant velocity.

Every image moves four neighbouring control points of each spline: poses that few images show are shared by many.

Local letters: S nodes, P control points.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.config import ControlNodesField
from dyngs.deform.decoder import head_sizes
from dyngs.deform.field import MAX_KEY_TIMES, FieldSetup, NetworkField, Offsets, chosen
from dyngs.deform.node_shifts import SeenShift, spline_changes
from dyngs.deform.nodes import FOLLOWED, Nodes, follow, nodes_at, nodes_of_label, spread_out, turned
from dyngs.deform.rigid_groups import (
    AGREES,
    ALONE,
    FEWEST,
    GROUP_TIMES,
    MOST,
    Bodies,
    GroupMotion,
    Poses,
    bound,
    carried,
    checked_shape,
    find_bodies,
    grouped_splines,
    is_alone,
    with_free,
    with_zero,
)
from dyngs.deform.spline_fit import SPAN, cubic_fractions, refitted, spline_basis
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.parameters import Parameters
from dyngs.ops.quaternions import identity_quat, unit_quats
from dyngs.ops.transfer import sent
from dyngs.state import Role, State, StateTensor, moved_to, part_of, prefixed, tensors_of
from dyngs.tensor_checks import require_indices, require_positive, require_tensor

NOTHING = torch.zeros(0, 3, device="cpu")
COMPARED_TIMES = 16
"""Times at which the paths of nodes are compared where some of them are to go."""
LR = {"quats": 6e-3, "log_scales": 1e-3, "logit_opacities": 1e-2, "colors": 2e-3}
"""Learning rates of the nodes' attributes other than positions."""
LR_DECAY = 0.2
"""Ratio of the last to the first learning rate."""
PIECES_PER_TIME = 0.3
"""Pieces of the splines per training time. With more, poses follow single images; with fewer, they lag behind."""
GROUP_PIECES_PER_TIME = 0.5
"""The same of the groups' splines: all that a body shows speaks for its pose."""
GROUP_RATES = {"group_quats": 3e-3, "binding": 2e-2}
"""Learning rates of rigid groups other than of their shifts."""
LEAST = 0.02
"""Least fraction of a second group from which a Gaussian is bound to it."""
RESIDUALS = 0.01
"""Weight of what the nodes of a rigid group move in its frame: squared, in node spacings."""
PER_GAUSSIAN = ("followed", "others", "bodies")
"""Buffers with a row per moving Gaussian."""


class ControlNodes(NetworkField):
    """Offsets of nodes, uniform cubic B-splines of time, blended into those of the Gaussians that follow them.

    Nodes are placed when first needed. Whenever the set of Gaussians has changed, nodes that nothing follows are
    dropped and new ones start, with the motion found there, where Gaussians are farthest from any.
    """

    def __init__(self, options: ControlNodesField, setup: FieldSetup, generator: torch.Generator) -> None:
        self.options, self.setup = options, setup
        self.num_pieces = options.pieces or min(max(1, round(PIECES_PER_TIME * setup.num_times)), MAX_KEY_TIMES)
        self.buffers = {"positions": NOTHING}
        self.parameters = self._untrained(0)

    def restored(self, tensors: Mapping[str, Tensor]) -> ControlNodes:
        buffers = part_of(tensors, "buffers")
        count, moving = len(buffers["positions"]), self.setup.num_moving
        require_tensor("positions", buffers["positions"], (count, 3))
        learned = part_of(tensors, "learned")
        field = copy.copy(self)
        if not self.options.pieces:  # as many as the motion needed, see ``started``
            num_points = learned["means"].shape[1] if learned["means"].ndim == 3 else 0
            field.num_pieces = min(max(1, num_points - SPAN + 1), MAX_KEY_TIMES)
        groups = None
        if "centers" in buffers:
            groups = checked_shape(buffers["centers"], learned["group_quats"])
            require_indices("labels", buffers["labels"], (count,), groups[0] + 1)
        own = field._extended(groups, moving)
        field.parameters = own.restored(learned, dict.fromkeys(head_sizes(self.options), count))
        if count and ("radii" in buffers or "followed" in buffers):  # both are found where nodes are first needed
            require_positive("radii", require_tensor("radii", buffers["radii"], (count,)))
        for name, length in (("followed", moving), ("others", moving), ("neighbours", count)):
            if name in buffers:
                require_indices(name, buffers[name], (length, None), count)
        if "bodies" in buffers:
            require_indices("bodies", buffers["bodies"], (moving, 2), len(buffers["centers"]) + 1)
        for name in ("followed", "others"):
            if name in buffers and not 1 <= buffers[name].shape[1] <= FOLLOWED:
                raise ValueError(f"'{name}' names {buffers[name].shape[1]} nodes for each Gaussian")
        field.buffers = buffers
        return field

    def started(self, positions: Tensor, splines: Mapping[str, Tensor]) -> ControlNodes:
        """Return an untrained field whose nodes lie at ``positions`` and already move along ``splines``.

        Nodes are still placed where Gaussians are far from any, and begin with the motion of those around them: where
        nothing should move at first, nodes that stand still must be among the given ones.

        Args:
            positions: (S, 3) canonical, no two alike.
            splines: by head, the control points (S, P, size); heads that are not given stay 0. P is the number of
                pieces, from now on that of all splines, plus 3.
        """
        field, count = copy.copy(self), len(positions)
        field.num_pieces = splines["means"].shape[1] - SPAN + 1
        field.parameters = field._untrained(count)
        for name, points in splines.items():
            field.parameters[name].data.copy_(points)
        field.buffers = {"positions": positions.detach().clone()}
        return field

    def state(self) -> State:
        own = dict.fromkeys(PER_GAUSSIAN, Role.PER_MOVING) | {"neighbours": Role.TRAINING}
        buffers = {name: StateTensor(x, own.get(name, Role.SHARED)) for name, x in self.buffers.items()}
        return super().state() | prefixed("buffers", buffers)

    @property
    def num_values(self) -> int:
        return self.parameters.num_values + sum(x.numel() for x in self.buffers.values())

    def edited(self, edit: TopologyEdit) -> ControlNodes:
        field = self.with_parameters(self.parameters.edited(Role.PER_MOVING, edit))
        field.buffers = {n: edit.apply(x) if n in PER_GAUSSIAN else x for n, x in self.buffers.items()}
        return field

    def regroup(self) -> None:
        """Place the nodes again, and assign Gaussians to them, when they are next needed."""
        if self.has_groups and "followed" in self.buffers:
            self.buffers["bodies"] = self._bodies()
        self.buffers.pop("followed", None)
        self.buffers.pop("others", None)

    def _bodies(self) -> Tensor:
        """Return (M, 2) labels of the groups that Gaussians follow; both are the same where it is only one."""
        own, other = (self.buffers["labels"][self.buffers[name][:, 0]] for name in ("followed", "others"))
        return torch.stack([own, torch.where(is_alone(self.parameters["binding"]), own, other)], dim=1)

    def to(self, device: torch.device | str) -> ControlNodes:
        field = super().to(device)
        field.buffers = moved_to(self.buffers, device)
        return field

    @torch.no_grad()
    def reduced(self, nodes: int, pieces: int, means: Tensor) -> ControlNodes:
        """Return a field of at most ``nodes`` of these nodes with ``pieces`` pieces each, for all of ``means`` (M, 3).

        Splines are fitted to the present ones. The nodes that stay are the farthest from each other in the root mean
        square of their distances over time: what moves alike keeps fewer. With other pieces Adam's moments begin anew.
        """
        self.nodes_for(means)
        old, times = self.buffers["positions"], torch.linspace(0, 1, COMPARED_TIMES, device="cpu").tolist()
        paths = torch.cat([old + self.at(time).means.detach() for time in times], dim=1)
        kept = (
            spread_out(paths, nodes, paths[:0]).sort().values
            if nodes < len(old)
            else torch.arange(len(old), device=old.device)
        )
        if self.has_groups:  # each keeps a node
            first = [torch.nonzero(self.buffers["labels"] == i)[:1, 0] for i in self.buffers["labels"].unique()]
            kept = torch.cat([kept, *first]).unique()
        options = self.options.model_copy(update={"nodes": nodes, "pieces": pieces})
        field = ControlNodes(options, self.setup, torch.Generator())
        splines = {name: refitted(x.detach()[kept], pieces) for name, x in self._splines().items()}
        is_new = torch.full((len(kept),), pieces != self.num_pieces, device=kept.device)
        extended = field._extended(self._group_shape, len(means))
        like = extended if pieces != self.num_pieces else self.parameters
        field.parameters = like.rearranged(splines, kept, is_new)
        if self.has_groups:
            others = {name: x for name, x in self.parameters.values().items() if name not in splines}
            state = tensors_of(field.parameters.state()) | others
            field.parameters = field.parameters.restored({name: x.clone() for name, x in state.items()})
        if self.has_groups:
            groups = {"labels": self.buffers["labels"][kept], "centers": self.buffers["centers"]}
            field.buffers |= groups | {"bodies": self._bodies()}
        field._assign(old[kept], means)
        return field

    @property
    def num_nodes(self) -> int:
        """Number of nodes that are placed."""
        return len(self.buffers["positions"])

    @property
    def num_points(self) -> int:
        """Number of control points of each spline."""
        return self.num_pieces + SPAN - 1

    def offsets(self, means: Tensor, time: float, rows: Tensor | None = None) -> Offsets:
        """See ``DeformationField.offsets``; differentiable in ``means``, which nodes turn about themselves."""
        if not len(means):  # whatever nodes there are
            return self.at(time).select(slice(0))
        nodes, now = self.nodes_for(means), self.at(time)
        others, binding = self.buffers.get("others"), self.parameters.get("binding")
        if rows is not None:
            nodes, means = nodes.followed_by(rows), means.index_select(0, rows)
        found = follow(nodes, means, now)
        if others is not None and binding is not None:
            others, binding = chosen(others, rows), chosen(binding, rows)
            found = bound(found, replace(nodes, followed=others), means, now, binding)
        return found

    def penalties(self, time: float) -> dict[str, Tensor]:
        """Return the nodes' acceleration and their neighbours' deviation from rigid motion, in squared spacings."""
        if len(self.buffers["positions"]) < 2:
            return {}
        penalties = {}
        if self.options.smoothness:
            bend = self.parameters["means"].diff(n=2, dim=1) / self.buffers["radii"][:, None, None]
            penalties["node acceleration"] = self.options.smoothness * bend.square().mean()
        if self.options.rigidity:
            penalties["node rigidity"] = self.options.rigidity * self._strain(self.at(time))
        if self.has_groups:
            penalties["node residuals"] = RESIDUALS * self._residual(self._local(time))
        return penalties

    @torch.no_grad()
    def extend(self, seen: tuple[float, float], soon: tuple[float, float]) -> None:
        """Go on at constant velocity, that of the last two intervals.

        The outermost point that a time in ``seen`` depends on counts as not seen, unless no time lies beyond: its share
        is too small.
        """
        last = self.num_points - 1
        low = 0 if seen[0] <= 0 else math.floor(seen[0] * self.num_pieces) + 1
        high = last if seen[1] >= 1 else math.ceil(seen[1] * self.num_pieces) + SPAN - 3
        reach, device = min(2, high - low), self.setup.center.device
        after = torch.arange(1, last - high + 1, device=device)[:, None]
        before = torch.arange(low, 0, -1, device=device)[:, None]
        for x in (points.data for points in self._splines().values()):
            x[:, high + 1 :] = x[:, high, None] + after * ((x[:, high] - x[:, high - reach]) / max(reach, 1))[:, None]
            x[:, :low] = x[:, low, None] + before * ((x[:, low] - x[:, low + reach]) / max(reach, 1))[:, None]

    @torch.no_grad()
    def shifted(self, means: Tensor, seen: Sequence[SeenShift]) -> ControlNodes | None:
        if self.has_groups or not self.options.block_matching or not seen:
            return None
        nodes = self.nodes_for(means)
        changed = self.parameters["means"].detach() + spline_changes(nodes, nodes.weights(means), seen, self.num_pieces)
        return self.with_parameters(self.parameters.restored(tensors_of(self.parameters.state()) | {"means": changed}))

    def at(self, time: float) -> Offsets:
        """Return the nodes' offsets at ``time``."""
        local = self._local(time)
        if not self.has_groups:
            return local
        labels, fractions = self.buffers["labels"], self._group_fractions(time)
        quats = unit_quats((fractions * self.parameters["group_quats"]).sum(1))
        motion = with_free(GroupMotion(quats, (fractions * self.parameters["group_shifts"]).sum(1)))
        own = GroupMotion(motion.quats[labels], motion.shifts[labels])
        return carried(local, self.buffers["positions"], with_zero(self.buffers["centers"])[labels], own)

    def _group_fractions(self, time: float) -> Tensor:
        """Return the weights (Q, 1) of the control points of the groups' splines at ``time``."""
        pieces = self.parameters["group_quats"].shape[1] - SPAN + 1
        fractions = spline_basis(torch.tensor([time], device="cpu"), pieces)[0, :, None]
        return sent(fractions.float(), self.setup.center.device)

    def _local(self, time: float) -> Offsets:
        """Return the nodes' offsets at ``time`` in the frames of their groups, if they have any."""
        place = min(max(time, 0.0), 1.0) * self.num_pieces
        piece = min(int(place), self.num_pieces - 1)
        fractions = sent(cubic_fractions(place - piece)[:, None], self.setup.center.device)
        parts = {n: (fractions * x[:, piece : piece + SPAN]).sum(1) for n, x in self._splines().items()}
        if "logit_opacities" in parts:
            parts["logit_opacities"] = parts["logit_opacities"][:, 0]
        return Offsets(**parts)

    def _untrained(self, count: int) -> Parameters:
        """Return the parameters of ``count`` nodes that stand still."""
        sizes, device = head_sizes(self.options), self.setup.center.device
        tensors = {name: torch.zeros(count, self.num_points, size, device=device) for name, size in sizes.items()}
        rates = {"means": self.options.lr_means * self.setup.extent} | LR
        return Parameters(tensors, {name: rates[name] for name in sizes}, LR_DECAY)

    def _splines(self) -> dict[str, Tensor]:
        """Return the control points (S, P, size) by head."""
        return {name: self.parameters[name] for name in head_sizes(self.options)}

    def nodes_for(self, means: Tensor) -> Nodes:
        """Return the nodes, placed among ``means`` (M, 3) if need be, which follow them."""
        if "followed" not in self.buffers:
            self._place(means.detach())
        return Nodes(self.buffers["positions"], self.buffers["radii"], self.buffers["followed"])

    @property
    def has_groups(self) -> bool:
        """Return whether nodes belong to rigid groups."""
        return "centers" in self.buffers

    @property
    def _group_shape(self) -> tuple[int, int] | None:
        """Return the number of groups and of control points of their splines; None without groups."""
        quats = self.parameters.get("group_quats")
        return None if quats is None else (quats.shape[0], quats.shape[1])

    @torch.no_grad()
    def with_groups(self, means: Tensor) -> ControlNodes | None:
        """Return the field with its nodes in rigid groups, moving ``means`` (M, 3) nearly as now; None: there are none.

        Of Gaussians that follow nodes of several groups, the two with most weight remain.
        """
        wanted = self.options.rigid_groups and self.options.move_rotations
        if self.has_groups or not wanted or not len(means):
            return None
        nodes, pieces = self.nodes_for(means), round(GROUP_PIECES_PER_TIME * self.setup.num_times)
        num_points = min(max(self.num_pieces, pieces), MAX_KEY_TIMES) + SPAN - 1
        times = torch.linspace(0, 1, 2 * num_points, device="cpu")
        now = [self.at(float(time)) for time in times]
        paths = nodes.positions.double() + torch.stack([x.means for x in now]).double()
        quats = torch.stack([x.quats for x in now if x.quats is not None]).double()
        counts = 1.0 + torch.bincount(nodes.followed[:, 0], minlength=len(nodes.positions)).double()
        extents, radii = (paths - paths.mean(0)).square().sum(-1).mean(0).sqrt(), nodes.radii.double()
        tolerances = AGREES * (radii + torch.minimum(extents, 2 * radii))
        sparse = paths[:: max(len(times) // GROUP_TIMES, 1)]
        bodies = find_bodies(nodes.positions.double(), sparse, tolerances, counts, (FEWEST, MOST))
        if not len(bodies):
            return None
        poses = Poses(times, nodes.positions.double(), paths, quats + identity_quat(quats))
        points = grouped_splines(bodies, poses, counts, (num_points, self.num_points))
        is_free = (bodies.labels == len(bodies))[:, None, None]
        for name in ("means", "quats"):
            points[name] = torch.where(is_free, self.parameters[name], points[name])
        return self._in_groups(nodes, means, bodies, points)

    def _in_groups(self, nodes: Nodes, means: Tensor, bodies: Bodies, points: Mapping[str, Tensor]) -> ControlNodes:
        """Return the field with the groups ``bodies``, whose splines, and those of their nodes, are ``points``."""
        totals = torch.zeros(len(means), len(bodies) + 1, device=means.device)
        totals.scatter_add_(1, bodies.labels[nodes.followed], nodes.weights(means))
        top = totals.topk(2, dim=1)
        is_torn = top.values[:, 1] > LEAST
        binding = torch.where(is_torn, (top.values[:, 1] / top.values[:, 0]).clamp_min(LEAST).log(), ALONE)
        shape, count = points["group_quats"].shape, len(nodes.positions)
        template = self._extended((shape[0], shape[1]), len(means), count)
        now = tensors_of(template.state()) | tensors_of(self.parameters.state()) | {"binding": binding[:, None]}
        moments = self._moments(nodes, bodies, shape[1])
        field = self.with_parameters(template.restored(now | moments | dict(points)))
        field.buffers = {
            "labels": bodies.labels,
            "centers": bodies.centers.float(),
            "bodies": torch.where(is_torn[:, None], top.indices, top.indices[:, :1]),
        }
        field._assign(nodes.positions, means)
        return field

    def _moments(self, nodes: Nodes, bodies: Bodies, num_points: int) -> dict[str, Tensor]:
        """Return second moments of Adam for the groups' splines, as large as their nodes' gradients have been.

        With zeros the first steps would be several times too long. The gradients of N nodes are taken to agree in part:
        their sum is as large as N^(3/4) of them.
        """
        old, groups = tensors_of(self.parameters.state()), len(bodies)
        shape = {"group_shifts": (groups, num_points, 3), "group_quats": (groups, num_points, 4)}
        square = old["exp_avg_sq.means"].mean((1, 2))
        arms = (nodes.positions - with_zero(bodies.centers)[bodies.labels].float()).square().sum(1)
        found = {}
        for name, each in (("group_shifts", square), ("group_quats", 4 * square * arms)):
            total = torch.zeros(groups + 1, device=each.device).index_add_(0, bodies.labels, each)
            total = total * torch.bincount(bodies.labels, minlength=groups + 1).sqrt()
            found[f"exp_avg_sq.{name}"] = total[:-1, None, None].expand(shape[name]).contiguous()
        return found

    def _extended(self, groups: tuple[int, int] | None, moving: int, nodes: int = 0) -> Parameters:
        """Return the parameters of ``nodes`` that stand still, and of groups that bind ``moving`` Gaussians, all zero.

        Args:
            groups: number of rigid groups and of control points of their splines; None: no groups.
        """
        plain = self._untrained(nodes)
        tensors, rates, device = plain.values(), dict(plain.rates), self.setup.center.device
        if groups is not None:
            tensors["group_shifts"] = torch.zeros(*groups, 3, device=device)
            tensors["group_quats"] = torch.zeros(*groups, 4, device=device)
            tensors["binding"] = torch.zeros(moving, 1, device=device)
            rates |= GROUP_RATES | {"group_shifts": rates["means"]}
        roles = {name: Role.PER_MOVING if name == "binding" else Role.SHARED for name in tensors}
        return Parameters(tensors, rates, LR_DECAY, roles)

    @torch.no_grad()
    def _place(self, means: Tensor) -> None:
        """Drop nodes that nothing follows, add some where they are missing, and let ``means`` (M, 3) follow."""
        old = self.buffers["positions"]
        kept = torch.zeros(0, dtype=torch.long, device=means.device)
        if len(old):
            kept = self._nearest(means)[:, 0].unique()
        added = spread_out(means, self.options.nodes - len(kept), old[kept])
        source = torch.cat([kept, torch.zeros(len(added), dtype=torch.long, device=kept.device)])
        is_new = torch.arange(len(source), device=source.device) >= len(kept)
        bodies = self.buffers.get("bodies")
        labels = None if bodies is None else bodies[added, 0]
        started = self._motion_at(means[added], labels)
        values = {name: torch.cat([x.detach()[kept], started[name]]) for name, x in self._splines().items()}
        self.parameters = self.parameters.rearranged(values, source, is_new)
        if labels is not None:
            self.buffers["labels"] = torch.cat([self.buffers["labels"][kept], labels])
        self._assign(torch.cat([old[kept], means[added]]), means)

    def _assign(self, positions: Tensor, means: Tensor) -> None:
        """Let ``means`` (M, 3) follow the nodes at ``positions`` (S, 3), those of their groups if they have any."""
        nodes = nodes_at(positions, means)
        buffers = {"positions": positions, "radii": nodes.radii, "followed": nodes.followed}
        if self.has_groups:
            labels, bodies = self.buffers["labels"], self.buffers["bodies"]
            followed = nodes_of_label(positions, labels, means, bodies[:, 0])
            torn = torch.nonzero(~is_alone(self.parameters["binding"]))[:, 0]
            others = torch.zeros_like(followed)  # the same for all that are of one group: it costs nothing in a file
            others[torn] = nodes_of_label(positions, labels, means[torn], bodies[torn, 1])
            around = nodes_of_label(positions, labels, positions, labels)[:, 1:]
            groups = {"labels": labels, "centers": self.buffers["centers"], "others": others}
            self.buffers = buffers | groups | {"followed": followed, "neighbours": around}
        else:
            self.buffers = buffers | {"neighbours": nodes_at(positions, positions).followed[:, 1:]}

    def _nearest(self, points: Tensor) -> Tensor:
        """Return indices (M, B) of the nodes that ``points`` (M, 3) follow, nearest first."""
        positions, bodies = self.buffers["positions"], self.buffers.get("bodies")
        if bodies is None:
            return nodes_at(positions, points).followed
        return nodes_of_label(positions, self.buffers["labels"], points, bodies[:, 0])

    def _motion_at(self, points: Tensor, labels: Tensor | None = None) -> dict[str, Tensor]:
        """Return the control points (S', P, size), by head, that the present nodes give to ``points`` (S', 3).

        With ``labels`` (S',) those of the groups that the points are in, in the groups' frames.
        """
        splines = {name: x.detach() for name, x in self._splines().items()}
        if not len(self.buffers["positions"]) or not len(points):
            return {name: x.new_zeros(len(points), *x.shape[1:]) for name, x in splines.items()}
        nodes = nodes_at(self.buffers["positions"], points)
        if labels is not None:
            near = nodes_of_label(nodes.positions, self.buffers["labels"], points, labels)
            nodes = replace(nodes, followed=near)
        weights = nodes.weights(points)
        started = {name: torch.einsum("mb,mbpd->mpd", weights, x[nodes.followed]) for name, x in splines.items()}
        if "quats" in splines:
            arms = (points[:, None] - nodes.positions[nodes.followed])[:, :, None].expand(-1, -1, self.num_points, -1)
            swing = turned(splines["quats"][nodes.followed], arms) - arms
            started["means"] = started["means"] + torch.einsum("mb,mbpd->mpd", weights, swing)
        return started

    def _residual(self, local: Offsets) -> Tensor:
        """Return the mean square of what nodes of a group move and turn in its frame, in spacings."""
        grouped = (self.buffers["labels"] < len(self.buffers["centers"])).to(local.means)
        squared = (local.means / self.buffers["radii"][:, None]).square().sum(1)
        if local.quats is not None:
            squared = squared + (2 * local.quats[:, 1:]).square().sum(1)
        return (grouped * squared).sum() / grouped.sum().clamp_min(1)

    def _strain(self, now: Offsets) -> Tensor:
        """Return the mean of |x_j - x_i - R_i (p_j - p_i)|^2 over the squared spacing (Sorkine and Alexa 2007)."""
        positions, neighbours = self.buffers["positions"], self.buffers["neighbours"]
        arms = positions[neighbours] - positions[:, None]
        kept = arms if now.quats is None else turned(now.quats[:, None].expand(-1, arms.shape[1], -1), arms)
        strain = arms + now.means[neighbours] - now.means[:, None] - kept
        return (strain / self.buffers["radii"][:, None, None]).square().sum(-1).mean()
