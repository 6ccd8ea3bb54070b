"""Rigid bodies that move along splines, within another field: the smallest motion that explains
what turns.

Local letters: M moving Gaussians, B bodies, P control points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, move_fields_to, part_of, add_prefix
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.deform.field import DeformationField, Offsets, OuterField, select_rows
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.harmonics import dim_harmonics, light_harmonics
from dyngs.ops.nodes import SPAN, spline_motion
from dyngs.ops.quaternions import identity_quat, rotate

START = 0.15, 0.1, 0.0, 0.0
"""Parts of direct light and of that from all around that a ball takes; logarithms of the shadow's
size and softness."""
# Radii in which the edge of a shadow, and its beginning at the ball, fall by e
PENUMBRA, GRAZING = 0.2, 0.3


def light_fraction(
    points: Tensor, labels: Tensor, places: Tensor, radii: Tensor, sun: Tensor, shade: Tensor
) -> Tensor:
    """Return the (N,) parts of the light that reach ``points`` (N, 3) around balls; differentiable
    in the last two.

    A ball hides direct light from what lies behind it, near its axis, and of that from all around
    as much as it fills of the view: the square of its radius (B,) over the distance from its place
    (B, 3). The ball of ``labels`` (N,) that a point is a part of, -1 for none, throws no shadow on
    it. Direct light comes from ``sun`` (3,), of any length; ``shade`` (4,) is as ``START``.
    """
    direct, around = shade[:2].clamp(0.0, 0.95)
    size, softness = shade[2:].exp()
    way = torch.nn.functional.normalize(sun, dim=0)
    left = points.new_ones(len(points))
    for ball in range(len(places)):
        to = (places[ball] - points) / radii[ball]
        along = to @ way
        away = (to - along[:, None] * way).norm(dim=1)
        hidden = torch.sigmoid((size - away) / (PENUMBRA * softness)) * torch.sigmoid(
            along / GRAZING
        )
        view = to.square().sum(1).clamp_min(1.0).reciprocal()
        left = left * torch.where(labels == ball, 1.0, (1 - direct * hidden) * (1 - around * view))
    return left


RATES = {"places": 3e-4, "quats": 3e-3, "light": 1e-2, "albedo": 5e-3, "sun": 1e-2, "shade": 1e-2}
"""Learning rates; that of places times the scene extent."""
LR_DECAY = 0.05
TEACHES = 8  # Every so many-th Gaussian says what the few numbers of shadows should be


@dataclass(frozen=True)
class BodyRestPose:
    """Where bodies lie when they are at rest, and which Gaussians are theirs."""

    centers: Tensor  # (B, 3)
    radii: Tensor  # (B,)
    labels: Tensor  # (M,) body of each Gaussian, -1 for none


class BodyField(OuterField):
    """The offsets of ``others``, but for the Gaussians of bodies: these move rigidly, and take
    colours alone from it.

    A body turns about its own centre, x' = R(t) (x - c) + p(t), along uniform cubic B-splines of
    the place p and of the quaternion of R; the Gaussians turn with it, into the light and out of
    it: their colours change by their albedo times the light on what faces the way that they lie
    from the centre (``light_harmonics``). All else is in their shadow (``light_left``).
    """

    def __init__(
        self, inner_field: DeformationField, rest: BodyRestPose, learned: Mapping[str, Tensor]
    ) -> None:
        """Take the control points ``places`` (B, P, 3) and ``quats`` (B, P, 4) of the bodies'
        splines, and others.

        These may be missing: ``albedo`` (M, 3), in units of the harmonic of degree 0; ``light`` (8,
        3); ``sun`` (3,) and ``shade`` (4,), see ``light_left``.
        """
        super().__init__(inner_field)
        self.rest = rest
        like = rest.centers
        blank = {"albedo": like.new_zeros(len(rest.labels), 3), "light": like.new_zeros(8, 3)}
        blank |= {"sun": like.new_tensor([0.0, 0.0, 1.0]), "shade": like.new_tensor(START)}
        rates = RATES | {"places": RATES["places"] * self.setup.extent}
        roles = dict.fromkeys(RATES, Role.SHARED) | {"albedo": Role.PER_MOVING}
        self.parameters = Parameters(blank | dict(learned), rates, LR_DECAY, roles)

    @property
    def num_values(self) -> int:
        return super().num_values + sum(x.numel() for x in vars(self.rest).values())

    def poses(self, time: float) -> tuple[Tensor, Tensor]:
        """Return (B, 3) places of the bodies' centres and (B, 4) quaternions, of any length."""
        motion, quats = spline_motion(
            [self.parameters["places"], self.parameters["quats"], None, None, None], time
        )
        return motion[:, :3], quats

    def changed(self, found: Offsets, means: Tensor, time: float, rows: Tensor | None) -> Offsets:
        labels = select_rows(self.rest.labels, rows)
        means = select_rows(means, rows)
        own = torch.nonzero(labels >= 0)[:, 0]
        body = labels[own]
        places, quats = (x.index_select(0, body) for x in self.poses(time))
        quats = torch.nn.functional.normalize(quats, dim=1)
        arms = rotate(quats, means[own] - self.rest.centers[body])
        moved = arms + places - means[own]
        facing = torch.nn.functional.normalize(arms.detach(), dim=1)
        lit = (light_harmonics(facing) @ self.parameters["light"]) * select_rows(
            self.parameters["albedo"], rows
        )[own]
        turned = found.quats if found.quats is not None else means.new_zeros(len(means), 4)
        scales = found.log_scales
        return Offsets(
            found.means.index_copy(0, own, moved),
            turned.index_copy(0, own, quats - identity_quat(quats)),
            None if scales is None else scales.index_fill(0, own, 0.0),
            found.logit_opacities,
            (means.new_zeros(len(means), 3) if found.colors is None else found.colors).index_add(
                0, own, lit
            ),
        )

    def apply_shading(
        self, gaussians: Gaussians, rows: Tensor | None, which: Tensor | None, time: float
    ) -> Gaussians:
        labels = select_rows(self.rest.labels, which)
        if rows is not None:
            labels = labels.new_full((len(gaussians),), -1).index_copy(0, rows, labels)
        means = gaussians.means.detach()
        places = self.poses(time)[0].detach()
        balls = places, self.rest.radii, self.parameters["sun"], self.parameters["shade"]
        with torch.no_grad():
            left = light_fraction(means, labels, *balls)
        few = light_fraction(means[::TEACHES], labels[::TEACHES], *balls)
        return super().apply_shading(
            gaussians.replace(sh=dim_harmonics(gaussians.sh, left, few, TEACHES)), rows, which, time
        )

    def zero_gradients_outside_(self, window: tuple[float, float]) -> None:
        super().zero_gradients_outside_(window)
        for points in (self.parameters["places"], self.parameters["quats"]):
            pieces = points.shape[1] - SPAN + 1
            first = math.ceil(window[0] * pieces) + 1
            last = math.floor(window[1] * pieces) + 1  # by where they peak
            if points.grad is not None and window != (0.0, 1.0):
                points.grad[:, :first], points.grad[:, last + 1 :] = 0, 0

    def apply_edit(self, edit: TopologyEdit) -> BodyField:
        field = super().apply_edit(edit)
        field.rest = replace(self.rest, labels=self.rest.labels[edit.source])
        return field.with_parameters(self.parameters.apply_edit(Role.PER_MOVING, edit))

    def state(self) -> State:
        rest = {name: StateTensor(x, Role.SHARED) for name, x in vars(self.rest).items()}
        rest["labels"] = StateTensor(self.rest.labels, Role.PER_MOVING)
        return self.inner_field.state() | add_prefix("bodies", rest | super().state())

    @staticmethod
    def from_state(inner_field: DeformationField, tensors: Mapping[str, Tensor]) -> BodyField:
        """Return the field of a state within the restored ``others``; raises as ``restored``."""
        centers = require_tensor("centers", tensors["centers"], (None, 3))
        radii = require_positive(
            "radii", require_tensor("radii", tensors["radii"], (len(centers),))
        )
        labels = require_tensor(
            "labels", tensors["labels"], (inner_field.setup.num_moving,), torch.long
        )
        require_indices("labels", labels + 1, (len(labels),), len(centers) + 1)
        learned = part_of(tensors, "learned")
        points = learned["places"].shape[1] if learned["places"].ndim == 3 else 0
        if points < SPAN:
            raise ValueError(f"'places' has {points} control points, and must have at least {SPAN}")
        like = {
            name: centers.new_zeros(len(centers), points, size)
            for name, size in (("places", 3), ("quats", 4))
        }
        field = BodyField(inner_field, BodyRestPose(centers, radii, labels), like)
        field.parameters = field.parameters.with_state(learned)
        return field

    def to(self, device: torch.device | str) -> BodyField:
        field = super().to(device)
        field.rest = move_fields_to(self.rest, device)
        return field


def find_body_field(field: DeformationField | None) -> BodyField | None:
    """Return the field of bodies among ``field`` and those within it; None where there is none."""
    while isinstance(field, OuterField) and not isinstance(field, BodyField):
        field = field.inner_field
    return field if isinstance(field, BodyField) else None
