"""Deformation field of rigid bodies that move along splines, around another field.

Local letters: M moving Gaussians, B bodies, P control points.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, add_prefix, move_fields_to, select_prefix
from dyngs.core.tensor_checks import require_indices, require_positive, require_tensor
from dyngs.deform.field import DeformationField, Offsets, OuterField, select_rows
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.harmonics import dim_harmonics, light_harmonics
from dyngs.ops.nodes import SPAN, spline_motion
from dyngs.ops.quaternions import identity_quat, rotate

INITIAL_SHADE = 0.15, 0.1, 0.0, 0.0
"""Initial fractions of direct and ambient light that a sphere blocks, log size and log softness of
the shadow."""
# Radii over which the edge of a shadow, and its start at the sphere, fall by e.
PENUMBRA, GRAZING = 0.2, 0.3


def light_fraction(
    points: Tensor, labels: Tensor, places: Tensor, radii: Tensor, sun: Tensor, shade: Tensor
) -> Tensor:
    """Return the fraction of light (N,) that reaches ``points`` (N, 3) in the shadow of spheres.

    A sphere blocks direct light behind it, near its axis, and ambient light by its solid angle:
    its squared radius (B,) over the squared distance from ``places`` (B, 3). A point casts no
    shadow on itself: ``labels`` (N,) is the sphere it belongs to, or -1. Light comes from ``sun``
    (3,), of any norm. ``shade`` (4,) is as ``START``. Differentiable in ``sun`` and ``shade``.
    """
    direct, around = shade[:2].clamp(0.0, 0.95)
    size, softness = shade[2:].exp()
    way = torch.nn.functional.normalize(sun, dim=0)
    light = points.new_ones(len(points))
    for ball in range(len(places)):
        to = (places[ball] - points) / radii[ball]
        along = to @ way
        away = (to - along[:, None] * way).norm(dim=1)
        hidden = torch.sigmoid((size - away) / (PENUMBRA * softness)) * torch.sigmoid(
            along / GRAZING
        )
        view = to.square().sum(1).clamp_min(1.0).reciprocal()
        light = light * torch.where(
            labels == ball, 1.0, (1 - direct * hidden) * (1 - around * view)
        )
    return light


LEARNING_RATES = {
    "places": 3e-4,
    "quats": 3e-3,
    "light": 1e-2,
    "albedo": 5e-3,
    "sun": 1e-2,
    "shade": 1e-2,
}
"""Learning rates; that of ``places`` is times the scene extent."""
LR_DECAY = 0.05
GRADIENT_STRIDE = 8  # every so many-th Gaussian gives gradients to the few parameters of shadows


@dataclass(frozen=True)
class BodyRestPose:
    """Bodies in their rest pose, and their Gaussians."""

    centers: Tensor  # (B, 3)
    radii: Tensor  # (B,)
    labels: Tensor  # (M,) body of each Gaussian, -1: none


class BodyField(OuterField):
    """A field that moves the Gaussians of rigid bodies; all others follow the inner field.

    A body moves as x' = R(t) (x - c) + p(t), along uniform cubic B-splines of the position p and
    of the quaternion of R. The colours of its Gaussians change with the light: albedo times the
    light on the outward direction from the centre (``light_harmonics``). All other Gaussians lie
    in its shadow (``light_fraction``). Colour offsets of the inner field apply to bodies, too.
    """

    def __init__(
        self, inner_field: DeformationField, rest: BodyRestPose, learned: Mapping[str, Tensor]
    ) -> None:
        """Build the field from control points ``places`` (B, P, 3) and ``quats`` (B, P, 4).

        ``learned`` may also hold ``albedo`` (M, 3), in units of the degree-0 SH basis, ``light``
        (8, 3), and ``sun`` (3,) and ``shade`` (4,) of ``light_fraction``.
        """
        super().__init__(inner_field)
        self.rest = rest
        like = rest.centers
        blank = {"albedo": like.new_zeros(len(rest.labels), 3), "light": like.new_zeros(8, 3)}
        blank |= {"sun": like.new_tensor([0.0, 0.0, 1.0]), "shade": like.new_tensor(INITIAL_SHADE)}
        rates = LEARNING_RATES | {"places": LEARNING_RATES["places"] * self.setup.extent}
        roles = dict.fromkeys(LEARNING_RATES, Role.SHARED) | {"albedo": Role.PER_MOVING}
        self.parameters = Parameters(blank | dict(learned), rates, LR_DECAY, roles)

    @property
    def num_values(self) -> int:
        return super().num_values + sum(x.numel() for x in vars(self.rest).values())

    def poses(self, time: float) -> tuple[Tensor, Tensor]:
        """Return positions (B, 3) and unnormalised quaternions (B, 4) of bodies at ``time``."""
        motion, quats = spline_motion(
            [self.parameters["places"], self.parameters["quats"], None, None, None], time
        )
        return motion[:, :3], quats

    def modify(self, offsets: Offsets, means: Tensor, time: float, rows: Tensor | None) -> Offsets:
        labels = select_rows(self.rest.labels, rows)
        means = select_rows(means, rows)
        body_rows = torch.nonzero(labels >= 0)[:, 0]
        body = labels[body_rows]
        places, quats = (x.index_select(0, body) for x in self.poses(time))
        quats = torch.nn.functional.normalize(quats, dim=1)
        arms = rotate(quats, means[body_rows] - self.rest.centers[body])
        moved = arms + places - means[body_rows]
        facing = torch.nn.functional.normalize(arms.detach(), dim=1)
        light_change = (light_harmonics(facing) @ self.parameters["light"]) * select_rows(
            self.parameters["albedo"], rows
        )[body_rows]
        quats_out = offsets.quats if offsets.quats is not None else means.new_zeros(len(means), 4)
        scales = offsets.log_scales
        return Offsets(
            offsets.means.index_copy(0, body_rows, moved),
            quats_out.index_copy(0, body_rows, quats - identity_quat(quats)),
            None if scales is None else scales.index_fill(0, body_rows, 0.0),
            offsets.logit_opacities,
            (
                means.new_zeros(len(means), 3) if offsets.colors is None else offsets.colors
            ).index_add(0, body_rows, light_change),
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
            light = light_fraction(means, labels, *balls)
        strided = slice(None, None, GRADIENT_STRIDE)
        light_for_gradient = light_fraction(means[strided], labels[strided], *balls)
        sh = dim_harmonics(gaussians.sh, light, light_for_gradient, GRADIENT_STRIDE)
        return super().apply_shading(gaussians.replace(sh=sh), rows, which, time)

    def zero_gradients_outside_(self, window: tuple[float, float]) -> None:
        super().zero_gradients_outside_(window)
        for points in (self.parameters["places"], self.parameters["quats"]):
            pieces = points.shape[1] - SPAN + 1
            first = math.ceil(window[0] * pieces) + 1
            # by the times at which control points have their largest weight
            last = math.floor(window[1] * pieces) + 1
            if points.grad is not None and window != (0.0, 1.0):
                points.grad[:, :first], points.grad[:, last + 1 :] = 0, 0

    def apply_edit(self, edit: TopologyEdit) -> BodyField:
        field = super().apply_edit(edit)
        field.rest = replace(self.rest, labels=self.rest.labels[edit.source])
        return field

    def state(self) -> State:
        rest = {name: StateTensor(x, Role.SHARED) for name, x in vars(self.rest).items()}
        rest["labels"] = StateTensor(self.rest.labels, Role.PER_MOVING)
        return self.inner_field.state() | add_prefix("bodies", rest | super().state())

    @staticmethod
    def from_state(inner_field: DeformationField, tensors: Mapping[str, Tensor]) -> BodyField:
        """Return the bodies in a state around the restored ``inner_field``; errors as for
        ``with_state``."""
        centers = require_tensor("centers", tensors["centers"], (None, 3))
        radii = require_positive(
            "radii", require_tensor("radii", tensors["radii"], (len(centers),))
        )
        labels = require_tensor(
            "labels", tensors["labels"], (inner_field.setup.num_moving,), torch.long
        )
        require_indices("labels", labels + 1, (len(labels),), len(centers) + 1)
        learned = select_prefix(tensors, "learned")
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
    """Return the body field among ``field`` and its inner fields, or None."""
    while isinstance(field, OuterField) and not isinstance(field, BodyField):
        field = field.inner_field
    return field if isinstance(field, BodyField) else None
