"""The fit of a body to silhouettes and key points: few numbers for the full clip first, then every
frame's pose.

Rasterized silhouettes are differentiable, so that everything is found by Adam. Local letters: F
frames, J joints, B shape parameters, P discs, V views, K key points.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.gaussians.parameters import Parameters
from dyngs.human.avatar.corrections import SharedCorrection, corrected_clip
from dyngs.human.avatar.posing import BodyPose, posed_joints
from dyngs.human.body.body import NUM_BONE_SHAPES
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.fit.silhouettes import ObservedFrame, ShapedSurface, Surface, drawn_silhouettes
from dyngs.human.motion.motion import MotionClip

NUM_TURNED = 22
"""Joints that are turned: those of the body. Fingers, jaw and eyes do not show in silhouettes."""
_GIVEN = 0.05  # expected error of given poses, rad
_LIMIT = 3.0  # standard deviations of usual poses beyond which joints would be dislocated
_LEAST = 8.0  # least spread, degrees: a few clips do not show how far a joint can go
_DEGREES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "hip": ((-11, 1, -6), (23, 14, 7)),
    "knee": ((26, 0, 1), (22, 1, 0)),
    "ankle": ((-1, 27, -12), (13, 8, 6)),
    "spine1": ((7, 0, 0), (7, 2, 3)),
    "spine2": ((5, 0, 0), (7, 6, 10)),
    "spine3": ((-2, 0, 0), (3, 1, 2)),
    "neck": ((-12, 0, 0), (4, 17, 10)),
    "head": ((-1, 0, 0), (11, 5, 4)),
    "collar": ((0, 1, -16), (0, 7, 10)),
    "shoulder": ((16, -13, -49), (37, 20, 28)),
    "elbow": ((-7, -40, 16), (5, 29, 13)),
    "wrist": ((-4, -2, 10), (3, 11, 6)),
}
"""Axis-angle vectors of the left side, and their standard deviations; the right side is the mirror
image."""


@dataclass(frozen=True)
class PosePrior:
    """Expected corrections of the poses of F frames, axis-angle, rad."""

    centre: Tensor  # (F, 22, 3) mean
    spread: Tensor  # (22, 3) standard deviation
    # of these from the centre, beyond which nobody is expected to turn a joint
    limit: float = math.inf


def near_given(clip: MotionClip) -> PosePrior:
    """Return the prior that poses are about those given."""
    return PosePrior(
        torch.zeros_like(clip.poses[:, :NUM_TURNED]),
        torch.full_like(clip.poses[0, :NUM_TURNED], _GIVEN),
    )


def usual(clip: MotionClip) -> PosePrior:
    """Return the prior that corrected poses are usual ones; rotations add as vectors, which holds
    for small ones."""
    spread = usual_spread(NUM_TURNED).to(clip.poses)
    return PosePrior(
        usual_pose(NUM_TURNED).to(clip.poses) - clip.poses[:, :NUM_TURNED], spread, _LIMIT
    )


def usual_pose(joints: int) -> Tensor:
    """Return the mean pose (joints, 3), axis-angle, rad; zero for joints that are not known."""
    return _table(0, joints)


def usual_spread(joints: int) -> Tensor:
    """Return the standard deviations (joints, 3) about it, rad, at least 8 degrees."""
    return _table(1, joints).abs().clamp_min(torch.deg2rad(torch.tensor(_LEAST, device="cpu")))


def _table(which: int, joints: int) -> Tensor:
    found = torch.zeros(joints, 3, device="cpu")
    for row, name in enumerate(JOINT_NAMES[:joints]):
        side, _, rest = name.partition("_")
        degrees = _DEGREES.get(rest if side in ("left", "right") else name)
        if degrees is not None:
            mirrored = (1.0, -1.0, -1.0) if side == "right" else (1.0, 1.0, 1.0)
            found[row] = torch.tensor(
                [x * m for x, m in zip(degrees[which], mirrored, strict=True)], device="cpu"
            )
    return torch.deg2rad(found)


LR = {
    "log_scale": 3e-3,
    "betas": 0.1,
    "turns": 1e-2,
    "poses": 1e-2,
    "trans": 6e-3,
    "padding": 1e-3,
} | {
    "offset": 3e-3,
    "shift": 3e-3,
    "log_focal": 3e-2,
}
"""Learning rates at the first step; those of positions per metre of the person's unit."""
LR_DECAY = 0.1
# of the mean squared shape parameter, of bones as well, whose unit is the spread among adults
BETAS_WEIGHT = 1e-3
TURN, STEP = 0.25, 0.1
"""Rotations, rad, that cost as much as one unit of shape: of all frames, and from one frame to the
next."""
TURN_WEIGHT, POSE_WEIGHT, STEP_WEIGHT = 3e-2, 1e-3, 1e-3
"""Of their mean squares. What silhouettes do not show, such as a limb turned about itself, follows
the noise of Adam's steps where these are much smaller: renders of new poses then lose 1 to 3 dB,
while the silhouettes look as good."""
# of the mean square of what lies beyond the limit of a joint, in standard deviations
LIMIT_WEIGHT = 2e-2
KEYPOINT, KEYPOINT_WEIGHT = 0.02, 0.1
"""Expected error of a key point, as a fraction of the square's side, and the weight of their robust
mean."""
PLACE, PLACE_WEIGHT = 0.03, 0.1
"""Expected error of a joint given in 3D, metres of the person, and the weight of their robust
mean."""
FOCAL, FOCAL_WEIGHT = 0.35, 1e-3
"""Expected error of a guessed focal length, as a logarithm, and the weight of its square."""
PADDING, PADDING_WEIGHT = 0.01, 2e-3
"""Metres between skin and silhouette that cost as much as one unit of shape, and the weight of
their mean square."""
MISTAKEN = 1.0
"""Squared difference of coverages, over the person's area, from which on a silhouette is rather a
mistake. Good masks have 0.05 to 0.2; at 0.3 bodies found in masks of a detector were no better, at
infinity twice as far off."""
FRAMES = 3  # frames drawn in each step
VIEWS = 3  # views of a frame, other ones each time, that are drawn where not all are (``InTurn``)
Observations = Callable[[int], ObservedFrame | None]  # returns what is seen in a row of the clip


class InTurn:
    """Observations of a few views of each frame, other ones each time; ``frames`` are all views, by
    row of the clip."""

    def __init__(self, frames: Mapping[int, ObservedFrame | None]) -> None:
        self._frames, self._turns = frames, Counter[int]()

    def __call__(self, row: int) -> ObservedFrame | None:
        frame = self._frames[row]
        self._turns[row] += 1
        return None if frame is None else frame.part(self._turns[row], VIEWS)


def new_fit(clip: MotionClip, surface: Surface) -> Parameters:
    """Return what is learned, all zero.

    ``betas`` (B,) shape; ``log_scale`` (1,) of the factor on the scale; ``turns`` (22, 3)
    axis-angle, rad, applied before the given rotations, in all frames; ``poses`` (F, 22, 3) the
    same per frame; ``shift`` (3,) added to the translations, ``offset`` (3,) m in the frame of the
    pelvis; ``trans`` (F, 3) per frame; ``padding`` (P,) m between skin and silhouette.
    """
    joints = surface.body.joints
    zeros = {
        "log_scale": joints.new_zeros(1),
        "betas": joints.new_zeros(surface.shape_dirs.shape[-1]),
        "turns": joints.new_zeros(NUM_TURNED, 3),
        "poses": joints.new_zeros(len(clip), NUM_TURNED, 3),
        "trans": joints.new_zeros(len(clip), 3),
        "padding": joints.new_zeros(len(surface)),
        "offset": joints.new_zeros(3),
        "shift": joints.new_zeros(3),
    }
    unit = float(clip.scale.mean())
    return Parameters(zeros, LR | {name: LR[name] * unit for name in ("trans", "shift")}, LR_DECAY)


def with_lens(learned: Parameters, distance: float) -> Parameters:
    """Return the same with a focal length to be learned: of one camera that stands at the origin of
    the world.

    Adds ``log_focal`` (1,), the natural logarithm of the factor on the given focal length, and
    ``distance`` (1,), which is never learned: the camera steps back as its focal length grows, so
    that what is at this distance stays as large.
    """
    blank = learned["log_scale"].detach()
    values = {"log_focal": torch.zeros_like(blank), "distance": torch.full_like(blank, distance)}
    rates = {"log_focal": LR["log_focal"], "distance": 0.0}
    return Parameters(learned.values() | values, learned.rates | rates, learned.decay)


def refined(cameras: Cameras, learned: Parameters) -> Cameras:
    """Return the cameras with the focal length that was learned; as they are where none is."""
    if "log_focal" not in learned:
        return cameras
    factor = learned["log_focal"].exp()
    focal = torch.zeros_like(cameras.intrinsics[0])
    focal[0, 0] = focal[1, 1] = 1.0
    intrinsics = cameras.intrinsics + (factor - 1) * focal * cameras.intrinsics
    along = torch.zeros_like(cameras.cam_from_world[0])
    along[2, 3] = 1.0
    poses = cameras.cam_from_world + (factor - 1) * learned["distance"] * along
    return Cameras(poses, intrinsics, cameras.width, cameras.height)


def frame_pose_of(learned: Parameters, clip: MotionClip, row: int) -> BodyPose:
    """Return the fitted pose of frame ``row``."""
    own = learned["turns"] + learned["poses"][row]
    given = clip.rotations[row]
    turned = given[: len(own)] @ axis_angle_to_matrix(own)
    scale = clip.scale[row] * learned["log_scale"][0].exp()
    away = learned["shift"] + learned["trans"][row] + scale * (turned[0] @ learned["offset"])
    return BodyPose(torch.cat([turned, given[len(own) :]]), clip.trans[row] + away, scale)


def silhouette_error(drawn: Tensor, seen: ObservedFrame) -> Tensor:
    """Return a mean over the V views of e / (1 + e / ``MISTAKEN``); e is the squared difference
    over what is seen.

    So a mask that shows half the person, or something else, counts little beside those of the other
    views (Geman and McClure 1987).
    """
    wrong = ((drawn - seen.alpha) * seen.known).square().sum((1, 2))
    error = wrong / (seen.alpha * seen.known).sum((1, 2)).clamp_min(1.0)
    return (error / (1 + error / MISTAKEN)).mean()


def keypoint_error(joints: Tensor, marked: Tensor, cameras: Cameras) -> Tensor:
    """Return the mean robust distance of joints (J, 3) in the world from key points (V, 55, 3), see
    ``ObservedFrame``.

    J is 24, 52 or 55; joints of the same name are compared.
    sqrt(1 + (d / ``KEYPOINT``)^2) - 1, weighted by the confidences: large errors count linearly.
    """
    rows = SMPLX_ROWS[len(joints)]
    marked = marked[:, list(rows)]
    local = (
        joints[: len(rows)] @ cameras.cam_from_world[:, :3, :3].mT
        + cameras.cam_from_world[:, None, :3, 3]
    )
    pixels = local @ cameras.intrinsics.mT
    positions = pixels[..., :2] / pixels[..., 2:].clamp_min(1e-3) / cameras.width
    away = (positions - marked[..., :2]).square().sum(-1) / KEYPOINT**2
    weights = marked[..., 2]
    return (weights * ((1 + away).sqrt() - 1)).sum() / weights.sum().clamp_min(1.0)


def place_error(joints: Tensor, given: Tensor, unit: Tensor) -> Tensor:
    """Return the mean robust distance of joints (J, 3) from positions (55, 4), as for key points.

    ``unit`` is the length of a metre of the person in the world.
    """
    rows = SMPLX_ROWS[len(joints)]
    given = given[list(rows)]
    away = (joints[: len(rows)] - given[:, :3]).square().sum(-1) / (PLACE * unit) ** 2
    weights = given[:, 3]
    return (weights * ((1 + away).sqrt() - 1)).sum() / weights.sum().clamp_min(1.0)


def prior(learned: Parameters, expected: PosePrior) -> Tensor:
    """Return the penalty of shapes, turns and poses that are far from those given, or that jump."""
    total = learned["betas"].new_zeros(())
    # Of the free template the last directions are those of bones; SMPL has none.
    for part in learned["betas"].square().tensor_split([-NUM_BONE_SHAPES]):
        total = total + (BETAS_WEIGHT * part.mean() if len(part) else 0.0)
    total = total + TURN_WEIGHT * (learned["turns"][1:] / TURN).square().mean()
    away = (learned["poses"] - expected.centre) / expected.spread
    total = total + POSE_WEIGHT * away[:, 1:].square().mean()
    total = (
        total + LIMIT_WEIGHT * (away[:, 1:].abs() - expected.limit).clamp_min(0.0).square().mean()
    )
    if len(learned["poses"]) > 1:
        jumps = learned["poses"][1:] - learned["poses"][:-1]
        total = total + STEP_WEIGHT * (jumps / STEP).square().mean()
    if "log_focal" in learned:
        total = total + FOCAL_WEIGHT * (learned["log_focal"] / FOCAL).square().mean()
    return total + PADDING_WEIGHT * (learned["padding"] / PADDING).square().mean()


@dataclass(frozen=True)
class Fitting:
    """Given poses of F frames, the template's surface, and the poses that are expected."""

    clip: MotionClip
    surface: Surface
    expected: PosePrior

    def run(
        self,
        start: Parameters,
        learned: Sequence[str],
        steps: int,
        observed: Observations,
        tick: Callable[[], None] = lambda: None,
        fallen: float = 0.0,
    ) -> Parameters:
        """Return the fit ``start`` after ``steps`` of Adam on what is named; ``tick`` is called
        after each.

        Frames are taken in a fixed order that covers the clip evenly. Rates begin where they are
        after the fraction ``fallen`` of a run; higher where it is negative.
        """
        # Copies, as updates are in place and ``start`` may be what is taken in the end; without
        # moments.
        found = Parameters(
            {name: x.clone() for name, x in start.values().items()}, start.rates, start.decay
        )
        for name in found.values():
            found[name].requires_grad_(name in learned)
        order = spread_order(len(self.clip))
        for step in range(1, steps + 1):
            rows = {order[((step - 1) * FRAMES + i) % len(order)] for i in range(FRAMES)}
            seen = {row: frame for row in sorted(rows) if (frame := observed(row)) is not None}
            loss = prior(found, self.expected)
            if seen:
                loss = loss + mean_error(found, self.clip, self.surface, seen) * (
                    len(seen) / len(rows)
                )
            if loss.requires_grad:  # else nothing is to be learned
                loss.backward()
            found.step(step, fallen + (1 - fallen) * step / steps)
            tick()
        return found


def mean_error(
    learned: Parameters, clip: MotionClip, surface: Surface, seen: Mapping[int, ObservedFrame]
) -> Tensor:
    """Return the error of the frames ``seen``, by row: of silhouettes, and of joints where they are
    marked."""
    body = shaped(learned, surface)
    errors = []
    for row, frame in seen.items():
        pose = frame_pose_of(learned, clip, row)
        cameras = refined(frame.cameras, learned)
        error = silhouette_error(drawn_silhouettes(body.in_pose(pose), cameras), frame)
        if frame.joints is not None:
            joints = posed_joints(body.skeleton, pose)
            error = error + KEYPOINT_WEIGHT * keypoint_error(joints, frame.joints, cameras)
        if frame.positions is not None:
            joints = posed_joints(body.skeleton, pose)
            error = error + PLACE_WEIGHT * place_error(joints, frame.positions, pose.scale.detach())
        errors.append(error)
    return torch.stack(errors).mean()


def shaped(learned: Parameters, surface: Surface) -> ShapedSurface:
    """Return the surface in the fitted shape."""
    return surface.in_shape(learned["betas"], learned["padding"])


def drawn_frame(
    learned: Parameters, clip: MotionClip, surface: Surface, row: int, cameras: Cameras
) -> Tensor:
    """Return the silhouettes (V, H, W) of frame ``row`` for V cameras."""
    discs = shaped(learned, surface).in_pose(frame_pose_of(learned, clip, row))
    return drawn_silhouettes(discs, refined(cameras, learned))


def spread_order(count: int) -> list[int]:
    """Return 0 .. count - 1 in an order whose every stretch is spread over the full range."""
    stride = max(1, round(count * 0.618))
    while count > 1 and math.gcd(stride, count) != 1:
        stride += 1
    return [(i * stride) % count for i in range(count)]


@dataclass(frozen=True)
class BodyFit:
    """A body fitted to a clip of F frames, as a correction of the poses that were given."""

    betas: Tensor  # (B,) shape parameters of the template
    shared: SharedCorrection  # turns of the joints and factor on the size, the same in all frames
    # (3,) m, correction of the translation in the frame of the pelvis, the same in all frames
    offset: Tensor
    shift: Tensor  # (3,) the same in the frame of the world, in its unit
    poses: Tensor  # (F, J, 3) axis-angle, rad, added to the turns per frame
    trans: Tensor  # (F, 3) added to the given translations

    def fitted(self, clip: MotionClip) -> MotionClip:
        """Return the clip that was fitted, with its corrections."""
        return self._moved(corrected_clip(self.shared, clip, self.poses, self.trans))

    def applied(self, clip: MotionClip) -> MotionClip:
        """Return another clip whose poses were given by the same means, with what holds for all
        frames."""
        return self._moved(corrected_clip(self.shared, clip))

    def _moved(self, turned: MotionClip) -> MotionClip:
        roots = axis_angle_to_matrix(turned.poses[:, 0])
        away = self.shift + turned.scale[:, None] * (roots @ self.offset[:, None])[..., 0]
        return replace(turned, trans=turned.trans + away)


def body_fit(learned: Parameters, joints: int) -> BodyFit:
    """Return what was learned (``new_fit``) as a fit of a body of so many joints."""
    values = learned.values()

    def padded(turns: Tensor) -> Tensor:
        blank = turns.new_zeros(*turns.shape[:-2], joints - turns.shape[-2], 3)
        return torch.cat([turns, blank], dim=-2)

    shared = SharedCorrection(padded(values["turns"]), float(values["log_scale"][0]))
    positions = (values["offset"], values["shift"])
    return BodyFit(values["betas"], shared, *positions, padded(values["poses"]), values["trans"])


EVERY = 4  # each so many-th frame is left out: of those only poses are fitted
# fraction by which the error on frames left out must fall for a refined focal length to be taken
GAIN = 0.01


@dataclass(frozen=True)
class LensFit:
    """A focal length that was tried."""

    factor: float  # on the guessed focal length
    # from the camera at which the size in the images is kept, in units of the world
    distance: float
    # on the frames left out, with the focal length as guessed and as refined
    error: tuple[float, float]
    taken: bool  # the refined one is better

    def summary(self) -> str:
        """Return a line for people."""
        guessed, refined = self.error
        return (
            f"focal length: {self.factor:.2f} times the guess, error on frames left out {guessed:.4f} -> {refined:.4f}"
            + (", taken" if self.taken else ": the guess stays, as the images do not tell")
        )


def fit_lens(
    fitting: Fitting,
    start: Parameters,
    shape: Sequence[str],
    observed: Observations,
    steps: int,
    tick: Callable[[], None] = lambda: None,
) -> tuple[Parameters, LensFit]:
    """Return the fit of shape, poses and focal length to the frames of one camera at the origin;
    ``start`` if it stays.

    Both lenses are fitted to three of four frames; then poses of the other frames: where these
    agree better, the refined one is taken. ``start`` was found with the guessed focal length;
    ``shape`` names what is the same in all frames.
    """
    rows = list(range(len(fitting.clip)))
    apart = rows[EVERY // 2 :: EVERY] or rows
    rest = [row for row in rows if row not in apart] or rows
    own = ("poses", "trans")

    def run(start: Parameters, learned: Sequence[str], seen: Sequence[int]) -> Parameters:
        return fitting.run(
            start, learned, steps, lambda row: observed(row) if row in seen else None, tick
        )

    distance = float(-fitting.clip.trans[:, 2].mean())
    guessed = run(start, (*shape, *own), rest)
    refined = run(with_lens(start, distance), (*shape, *own, "log_focal"), rest)
    both = [run(found, own, apart) for found in (guessed, refined)]
    errors = (
        _mean_error(fitting, both[0], observed, apart),
        _mean_error(fitting, both[1], observed, apart),
    )
    taken = errors[1] < (1 - GAIN) * errors[0]
    found = run(both[1], (*shape, *own, "log_focal"), rows) if taken else start
    last = found if taken else refined
    return found, LensFit(float(last["log_focal"].detach().exp()), distance, errors, taken)


@torch.no_grad()
def _mean_error(
    fitting: Fitting, learned: Parameters, observed: Observations, rows: Sequence[int]
) -> float:
    seen = {row: frame for row in rows if (frame := observed(row)) is not None}
    return float(mean_error(learned, fitting.clip, fitting.surface, seen)) if seen else 0.0
