"""4D Gaussians: a mean and a covariance over space and time (Yang et al. 2024).

At a time, each is a 3D Gaussian: its mean moves linearly, its covariance is that of space given
the time, and its opacity is weighted by the marginal density of the time. The colour is spherical
harmonics times a cosine series in time. Slicing is one operation of the kernels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.state import Role
from dyngs.deform import predictor
from dyngs.deform.field import (
    DeformationField,
    DeformedGaussians,
    FieldSetup,
    MovingRows,
    OpacityWindow,
    select_rows,
)
from dyngs.deform.free import FreeInitialization
from dyngs.deform.keys import Gaussians4DField
from dyngs.gaussians import Gaussians
from dyngs.gaussians.densify import SPLIT_SHRINK
from dyngs.gaussians.optimizer import Parameters
from dyngs.ops.adam import Count
from dyngs.ops.quaternions import identity_quat, quat_product, unit_quats
from dyngs.ops.slicing import (
    FADED_LOGIT,
    condition_gaussians,
    harmonics_in_time,
    slice_gaussians,
)

LR_QUATS = 1e-3  # learning rate of the right quaternions, that of 3DGS for rotations
LR_SH = 0.0025 / 20  # learning rate of SH coefficients over time, that of 3DGS above degree 0
LR_DECAY = 0.1  # ratio of the last to the first learning rate
MIN_SPAN = 0.25  # smallest standard deviation along time, in time steps
MIN_WEIGHT = 0.05  # Gaussians are not rendered where their opacity is below this fraction


@dataclass(frozen=True)
class LinearGaussians:
    """M 4D Gaussians as 3D Gaussians that move along lines and fade."""

    gaussians: Gaussians  # at their mean times; the covariances are constant
    velocities: Tensor  # (M, 3) world units per clip
    times: Tensor  # (M,) mean times, in clips
    log_stds: Tensor  # (M,) logarithms of the standard deviations of the opacity over time


class Gaussians4D(DeformationField):
    """M Gaussians over space and time; the canonical Gaussians hold what they share with 3D ones.

    A 4D vector is a quaternion t + x i + y j + z k, rotated by q_l v q_r. q_l is the rotation of
    the canonical Gaussian. With q_r = conj(q_l) the rotation is one of space.
    """

    has_lifetime = can_fade = True
    can_freeze = False

    def __init__(
        self, options: Gaussians4DField, setup: FieldSetup, generator: torch.Generator
    ) -> None:
        self.options, self.setup = options, setup
        self.gap = 1 / max(setup.num_times - 1, 1)
        count = setup.num_moving
        quats = identity_quat(torch.zeros(1, device="cpu")).expand(count, 4)
        centers = torch.full((count,), 0.5, device="cpu")
        width = options.predictor_width
        self.depends_on_view = width > 0
        self._network = predictor.start_values(width, generator) if width else {}
        spans = torch.ones(count, device="cpu")
        self.parameters = self._untrained(centers, spans, quats)

    def with_initialization(
        self, start: FreeInitialization, gaussians: Gaussians
    ) -> tuple[Gaussians4D, Gaussians]:
        """Return an untrained field with the times, spans and velocities of ``start``.

        ``gaussians`` (M): the canonical Gaussians; isotropic where they have a velocity. Returns
        them with the rotations and scales that give these velocities, too.
        """
        gaussians = gaussians.to(device="cpu")
        spans = start.spans.clamp_min(MIN_SPAN * self.gap)
        tilted, spans, right_quats = tilt_in_time(gaussians, spans, start.velocities)
        parameters = self._untrained(start.centers, spans, right_quats)
        return self.with_parameters(parameters), tilted

    def step(self, step: int, progress: float) -> Count:
        for name in self._network:
            weights = self.parameters[name]
            if weights.grad is not None:
                weights.grad.add_(weights.detach(), alpha=predictor.WEIGHT_DECAY)
        return super().step(step, progress)

    def deform(
        self,
        gaussians: Gaussians,
        moving: MovingRows,
        time: float,
        *,
        in_training: bool = False,
        eye: Tensor | None = None,
    ) -> DeformedGaussians:
        own = gaussians if moving.rows is None else gaussians.picked(moving.rows)
        now = own.means.new_full((1, 1), time)
        means, times, log_scales, log_spans, quats, right_quats = self._shapes(
            own, moving.visible, now, eye
        )
        sliced = slice_gaussians(
            means,
            times[:, 0],
            quats,
            right_quats,
            log_scales,
            log_spans[:, 0],
            own.logit_opacities,
            time,
            MIN_WEIGHT,
        )
        sh = self._colours(own.sh, time - times, sliced[3], moving.visible)
        drawn = Gaussians(*sliced, sh)
        if moving.rows is None:
            return DeformedGaussians(drawn)
        tensors = gaussians.tensors()
        for name, values in drawn.tensors().items():
            tensors[name] = tensors[name].index_copy(0, moving.rows, values)
        return DeformedGaussians(Gaussians(**tensors))

    def _shapes(
        self, gaussians: Gaussians, visible: Tensor | None, now: Tensor, eye: Tensor | None
    ) -> Sequence[Tensor]:
        """Return means, their times, log scales, log spans, and left and right rotations.

        The predictor multiplies means about the centre of the motion and the middle of the clip. It
        multiplies a scale by exp(c) instead of 1 + c, which stays positive.

        Args:
            gaussians: A canonical Gaussians.
            visible: their indices (A,) among the moving ones; None: all.
            now: (1, 1), or (A, 1) with a time for each Gaussian.
            eye: (3,) camera centre; None: no camera.
        """
        times, log_spans, right_quats = (
            select_rows(self.parameters[name], visible)
            for name in ("times", "log_spans", "right_quats")
        )
        means = gaussians.means
        quats = gaussians.quats
        shapes = means, times, gaussians.log_scales, log_spans, quats, right_quats
        if not self.depends_on_view:
            return shapes
        directions = None
        if eye is not None:
            away = means.detach() - eye.detach().to(means)
            directions = torch.nn.functional.normalize(away, dim=1)
        inside = self.setup.normalize(means.detach())
        changes = predictor.predict_changes(
            self.parameters, inside, times.detach(), directions, now
        )
        factors = means - self.setup.center, times - 0.5, 1, 1, quats, right_quats
        parts = zip(shapes, factors, changes.split([3, 1, 3, 1, 4, 4], dim=1), strict=True)
        return [x + factor * change for x, factor, change in parts]

    @torch.no_grad()
    def linear(self, gaussians: Gaussians) -> LinearGaussians:
        """Return the motion and the conditional covariances of the canonical ``gaussians`` (M).

        With a predictor, each as it is at its mean time, without a camera.
        """
        means, times, log_scales, log_spans, quats, right_quats = self._shapes(
            gaussians, None, self.parameters["times"], None
        )
        quats, log_scales, velocities, log_stds = condition_gaussians(
            quats, right_quats, log_scales, log_spans[:, 0]
        )
        conditioned = gaussians.replace(means=means, quats=quats, log_scales=log_scales)
        return LinearGaussians(conditioned, velocities, times[:, 0], log_stds)

    @torch.no_grad()
    def lifetimes(self, gaussians: Gaussians) -> Tensor | None:
        if self.depends_on_view:  # which may lengthen them
            return None
        motion = self.linear(gaussians)
        # A little longer, because slicing rounds otherwise.
        reach = (1 + 1e-4) * math.sqrt(-2 * math.log(MIN_WEIGHT)) * motion.log_stds.double().exp()
        return motion.times.double()[:, None] + torch.stack([-reach, reach], dim=1)

    @torch.no_grad()
    def opacity_window(self, gaussians: Gaussians, time: float) -> OpacityWindow:
        motion = self.linear(gaussians)
        log_stds = motion.log_stds.double()
        elapsed = time - motion.times.double()
        # limits keep all factors finite; the density is 0 at 40 standard deviations
        squares = (elapsed * (-log_stds).exp()).square().clamp_max(1600)
        curvature = (squares - 1) * (-0.5 * squares - 2 * log_stds.clamp_min(-300)).exp()
        return OpacityWindow(curvature, self.parameters["log_spans"][:, 0].double())

    def _colours(
        self, sh: Tensor, elapsed: Tensor, logits: Tensor, visible: Tensor | None
    ) -> Tensor:
        """Return SH coefficients (A, K, 3), ``elapsed`` (A, 1) clips after the mean times."""
        if "sh_time" not in self.parameters:
            return sh
        is_seen = logits.detach() > FADED_LOGIT
        return harmonics_in_time(sh, self.parameters["sh_time"], visible, elapsed[:, 0], is_seen)

    @torch.no_grad()
    def storage_quats(self, quats: Tensor) -> tuple[Tensor, Tensor]:
        """Return equivalent left and right rotations (M, 4) with the largest part of q_l first.

        Storage turns other Gaussians by halves, which changes q_l v q_r. But q_l u v conj(u) q_r is
        the same Gaussian for each unit u of the quaternions.
        """
        left = unit_quats(quats)
        right = unit_quats(self.parameters["right_quats"])
        units = torch.eye(4, device=quats.device)[left.abs().argmax(1)]
        forms = quat_product(left, units), quat_product(units, right)
        left, right = (torch.where(x[:, :1] < 0, -x, x) for x in forms)
        return left, right

    @property
    def num_waves(self) -> int:
        """Number of cosines in time of each spherical harmonic."""
        return self.options.frequencies if "sh_time" in self.parameters else 0

    @property
    def time_gradient(self) -> Tensor:
        """Gradient (M,) of the loss by the mean times, since the last update."""
        times = self.parameters["times"]
        return (torch.zeros_like(times) if times.grad is None else times.grad)[:, 0]

    def split(
        self, gaussians: Gaussians, rows: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Sample halves of the moving Gaussians ``rows`` (R,) from their 4D densities.

        ``gaussians`` (R): the same Gaussians. Returns means (R, 3) and the new times and spans.
        """
        log_spans = self.parameters["log_spans"].detach()[rows]
        scales = torch.cat([log_spans, gaussians.log_scales], dim=1).exp()
        noise = torch.randn((len(rows), 4), generator=generator, device="cpu").to(scales.device)
        left = unit_quats(gaussians.quats)
        right = unit_quats(self.parameters["right_quats"].detach()[rows])
        shift = quat_product(quat_product(left, noise * scales), right)
        times = self.parameters["times"].detach()[rows] + shift[:, :1]
        return gaussians.means + shift[:, 1:], {
            "times": times,
            "log_spans": log_spans - math.log(SPLIT_SHRINK),
        }

    def _untrained(self, centers: Tensor, spans: Tensor, right_quats: Tensor) -> Parameters:
        tensors = {
            "times": centers[:, None],
            "log_spans": spans.log()[:, None],
            "right_quats": right_quats,
        }
        terms = self.options.frequencies * self.setup.num_sh_terms
        if terms:
            tensors["sh_time"] = torch.zeros(len(centers), terms, 3, device="cpu")
        rates = {
            "times": self.options.lr_times * self.gap,
            "log_spans": self.options.lr_spans,
            "right_quats": LR_QUATS,
            "sh_time": LR_SH,
        }
        roles = dict.fromkeys(tensors, Role.PER_MOVING) | dict.fromkeys(self._network, Role.SHARED)
        decays = dict.fromkeys(tensors, LR_DECAY) | dict.fromkeys(self._network, predictor.LR_DECAY)
        rates |= dict.fromkeys(self._network, predictor.LR)
        return Parameters(tensors | self._network, rates, decays, roles)


def tilt_in_time(
    gaussians: Gaussians, spans: Tensor, velocities: Tensor
) -> tuple[Gaussians, Tensor, Tensor]:
    """Give Gaussians (M) ``velocities`` (M, 3), world units per clip, by a rotation in space-time.

    Isotropic Gaussians of size s that last ``spans`` (M,) have the covariance [[s^2 + v^2 d^2,
    v d^2], [v d^2, d^2]] along the velocity and time. Its axes are turned by an angle: e^{u a / 2}
    from both sides, with the direction u of the velocity. Returns the Gaussians, the scales along
    the fourth axis (M,), and the right quaternions (M, 4). Gaussians without velocity stay.
    """
    speed = velocities.norm(dim=1)
    direction = velocities / speed.clamp_min(torch.finfo(speed.dtype).tiny)[:, None]
    size = gaussians.log_scales[:, 0].exp()
    in_space = size.square() + (speed * spans).square()
    in_time = spans.square()
    mixed = speed * in_time
    gap = torch.hypot(in_time - in_space, 2 * mixed)
    longer = (0.5 * (in_space + in_time + gap)).sqrt()
    shorter = size * spans / longer
    half_angle = 0.25 * torch.atan2(2 * mixed, in_time - in_space)
    turn = torch.cat([half_angle.cos()[:, None], half_angle.sin()[:, None] * direction], dim=1)
    # the rotation that turns the first axis into the direction
    zero = torch.zeros_like(speed)
    aligned = torch.stack([1 + direction[:, 0], zero, -direction[:, 2], direction[:, 1]], dim=1)
    opposite = aligned.new_tensor([0.0, 0.0, 1.0, 0.0])
    aligned = unit_quats(torch.where((aligned.norm(dim=1) > 1e-3)[:, None], aligned, opposite))
    moves = (speed > 0)[:, None]
    conjugate = aligned.new_tensor([1.0, -1.0, -1.0, -1.0])
    quats = torch.where(moves, quat_product(turn, aligned), gaussians.quats)
    right = torch.where(moves, quat_product(aligned * conjugate, turn), gaussians.quats * conjugate)
    along = torch.where(speed > 0, shorter.log(), gaussians.log_scales[:, 0])
    log_scales = torch.cat([along[:, None], gaussians.log_scales[:, 1:]], dim=1)
    tilted = gaussians.replace(quats=quats, log_scales=log_scales)
    return tilted, torch.where(speed > 0, longer, spans), right
