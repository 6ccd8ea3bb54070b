"""The fit of a body template to the silhouettes of a capture: the body drawn as discs, what is
observed in each frame, the optimisation, first poses where none are given, and the choice among
fits on views left out.

Local letters: P discs, F frames, V views, J joints, B shape parameters.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.conventions import ProgressCallback, RasterizeMode, ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import assign_frame_numbers, frame_number
from dyngs.data.capture import Capture, Split, View
from dyngs.data.images.images import area_downscale
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians import Gaussians
from dyngs.gaussians.optimizer import Parameters
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.human.avatar.posing import (
    BodyPose,
    SharedCorrection,
    Skeleton,
    corrected_clip,
    pose_gaussians,
    posed_joints,
    skinning_weights,
    texel_gaussians,
)
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import NUM_BONE_SHAPES, BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.fit.keypoints import Joints3D, Keypoints
from dyngs.human.motion.motion import (
    CapturedMotion,
    MotionClip,
    captured_motion,
    compose_rotations,
)

_OPTIONS = RenderOptions(nonfinite="trust", eps2d=0.1, mode=RasterizeMode.ANTIALIASED)


@dataclass(frozen=True)
class BodyDiscs:
    """Discs on the texels of a template, at rest in some shape, and how they follow shape and
    pose."""

    discs: Gaussians  # P at rest, m
    skeleton: Skeleton  # at rest in the same shape
    normals: Tensor  # (P, 3) outward
    weights: Tensor  # (P, J) skinning weights
    shape_dirs: Tensor  # (P, 3, B) m per unit of the shape parameters
    joint_dirs: Tensor  # (J, 3, B) the same for the joints
    # (9 (J - 1), 3 P) pose blend shapes, m per unit of the rotations minus the identity
    pose_dirs: Tensor | None

    def with_shape(self, betas: Tensor, padding: Tensor) -> BodyDiscs:
        """Return the body of one person, of the mean shape; differentiable.

        ``betas`` (B,) are shape parameters; ``padding`` (P,) m, by how much clothes and hair lie
        outside the skin.
        """
        means = self.discs.means + self.shape_dirs @ betas + padding[:, None] * self.normals
        joints = self.skeleton.joints + self.joint_dirs @ betas
        skeleton = Skeleton(joints, self.skeleton.parents)
        return replace(self, discs=self.discs.replace(means=means), skeleton=skeleton)

    def in_pose(self, pose: BodyPose) -> Gaussians:
        """Return the discs in a pose, in the world; differentiable."""
        offsets = None
        if self.pose_dirs is not None:
            identity = torch.eye(3, dtype=pose.rotations.dtype, device=pose.rotations.device)
            features = pose.rotations[1:] - identity
            offsets = (features.flatten() @ self.pose_dirs).unflatten(0, (-1, 3))
        return pose_gaussians(self.discs, self.weights, self.skeleton, pose, offsets)


def body_discs(body: BodyTemplate, resolution: int) -> BodyDiscs:
    """Return the discs of a template's atlas of ``resolution`` texels a side, in the mean shape."""
    texels = atlas_texels(body, resolution, body.vertices)
    discs, anchors = texel_gaussians(texels, [0.0], 0)
    # Standard deviations in the tangent plane and along the normal, and depth below the skin (0.2),
    # in sides of a texel: silhouettes then have the area of the mesh to 2 % and an IoU with it of
    # 0.95 (48 texels a side) to 0.97 (72). Wider discs cover more, narrower ones leave gaps.
    ratios = anchors.size.new_tensor([0.4, 0.4, 0.075]).log()
    around = body.faces[texels.faces]
    parts = texels.barycentric[..., None]
    shape_dirs = discs.means.new_zeros(len(discs), 3, 0)
    joint_dirs = body.joints.new_zeros(len(body.joints), 3, 0)
    if body.shape_dirs is not None and body.joint_shape_dirs is not None:
        shape_dirs = (parts[..., None] * body.shape_dirs[around]).sum(1)
        joint_dirs = body.joint_shape_dirs
    pose_dirs = None
    if body.pose_dirs is not None:
        pose_dirs = (parts * body.pose_dirs.unflatten(1, (-1, 3))[:, around]).sum(2).flatten(1)
    return BodyDiscs(
        discs=discs.replace(
            means=discs.means - 0.2 * anchors.size[:, None] * texels.normals,
            log_scales=anchors.size.log()[:, None] + ratios,
            logit_opacities=torch.full_like(discs.logit_opacities, 4.0),
        ),
        skeleton=Skeleton(body.joints, body.parents),
        normals=texels.normals,
        weights=skinning_weights(anchors, len(body.joints)),
        shape_dirs=shape_dirs,
        joint_dirs=joint_dirs,
        pose_dirs=pose_dirs,
    )


def render_silhouettes(discs: Gaussians, cameras: Cameras) -> Tensor:
    """Return coverage (V, H, W) in [0, 1] of posed discs in the images of V cameras;
    differentiable."""

    def black(discs: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
        return discs.means.new_zeros(len(cameras), len(discs), 1)

    return render(discs, cameras, _OPTIONS, shader=black).alpha


@dataclass(frozen=True)
class ObservedFrame:
    """The views of one frame in which the person is seen."""

    cameras: Cameras  # V, of squares of S px
    alpha: Tensor  # (V, S, S) float32 in [0, 1]: coverage by the person
    # (V, S, S) float32, 1 inside the image that the square was cut out of and where its mask
    # counts, else 0
    known: Tensor
    # (V, 55, 3) column and row in the square, as fractions of its side, and confidence of joints
    # that were marked as key points; None without any
    joints: Tensor | None = None
    # (55, 4) positions in the world and confidence of joints that are given in 3D; None without any
    positions: Tensor | None = None

    def part(self, turn: int, count: int) -> ObservedFrame:
        """Return ``count`` of the V views, far apart in their order; V turns show each as often.
        All if V <= count."""
        views = len(self.alpha)
        if views <= count:
            return self
        rows = [(turn + i * views // count) % views for i in range(count)]
        size = self.cameras.width
        return replace(
            self,
            cameras=Cameras(
                self.cameras.cam_from_world[rows], self.cameras.intrinsics[rows], size, size
            ),
            alpha=self.alpha[rows],
            known=self.known[rows],
            joints=None if self.joints is None else self.joints[rows],
        )

    def shrunk(self, factor: int) -> ObservedFrame:
        """Return the squares with sides divided by ``factor``."""
        cameras = self.cameras.scaled(1 / factor)
        alpha, known = (_resized(x, cameras.width) for x in (self.alpha, self.known))
        return replace(self, cameras=cameras, alpha=alpha, known=(known > 0.999).float())


def _resized(values: Tensor, size: int) -> Tensor:
    """Return values (V, S', S') averaged over the areas of the pixels of (V, size, size)."""
    return area_downscale(values.permute(1, 2, 0), size, size).permute(2, 0, 1).contiguous()


def _box(image: Image) -> tuple[slice, slice] | None:
    """Return rows and columns of the person; None if nobody is seen."""
    return None if image.alpha is None else silhouette_box(image.alpha, 0.5)


def longest_box_side(images: Iterable[Image]) -> int:
    """Return the longest side of the person's box in the images (with alpha), px; 0 if nobody is
    seen."""
    longest = 0
    for image in images:
        for part in _box(image) or ():
            longest = max(longest, part.stop - part.start)
    return longest


def crop_frame(
    images: Sequence[Image],
    box_side: int,
    size: int,
    marked: Mapping[str, Tensor] | None = None,
    positions: Tensor | None = None,
) -> ObservedFrame | None:
    """Return the squares around the person in the images of one frame; None if no image shows
    anybody.

    ``box_side`` is the ``longest_box_side`` of all images, so that all squares have the same scale;
    ``size`` is S; ``marked`` are key points (55, 3) as fractions of the width and height, by image.
    """
    side = max(round(1.25 * box_side), 1)
    squares = []
    for image in images:
        box = _box(image)
        if box is None or image.alpha is None:
            continue
        top, left = ((part.start + part.stop - side) // 2 for part in box)
        height, width = image.alpha.shape
        around = (-left, left + side - width, -top, top + side - height)
        weights = torch.ones_like(image.alpha) if image.mask is None else image.mask
        alpha, known = (
            _resized(torch.nn.functional.pad(x, around)[None], size) for x in (image.alpha, weights)
        )
        corner = image.alpha.new_tensor([left, top])
        intrinsics = image.cameras.intrinsics.clone()
        intrinsics[:, :2, 2] -= corner
        intrinsics = intrinsics.new_tensor([size / side, size / side, 1.0])[:, None] * intrinsics
        joints = torch.zeros(len(JOINT_NAMES), 3, device="cpu")
        if marked and image.name in marked:
            joints = marked[image.name].clone()
        joints[:, :2] = (joints[:, :2] * joints.new_tensor([width, height]) - corner) / side
        known = (known > 0.999).float()
        squares.append((image.cameras.cam_from_world, intrinsics, alpha, known, joints[None]))
    if not squares:
        return None
    poses, intrinsics, alpha, known, joints = (torch.cat(x) for x in zip(*squares, strict=True))
    cameras = Cameras(poses, intrinsics, size, size)
    return ObservedFrame(cameras, alpha, known, joints if marked else None, positions)


Observations = Callable[[int], ObservedFrame | None]
"""Returns what is observed in a row of the clip, None where nobody is seen."""


def rotate_views(frames: Mapping[int, ObservedFrame]) -> Observations:
    """Return a function that observes a frame by three of its views, the next three at each call."""
    turns = Counter[int]()

    def look(row: int) -> ObservedFrame | None:
        turns[row] += 1
        return frames[row].part(turns[row], 3) if row in frames else None

    return look


NUM_FITTED_JOINTS = 22
"""Joints that are turned: those of the body. Fingers, jaw and eyes do not show in silhouettes."""
_USUAL = """
hip       -11   1  -6   23 14  7
knee       26   0   1   22  1  0
ankle      -1  27 -12   13  8  6
spine1      7   0   0    7  2  3
spine2      5   0   0    7  6 10
spine3     -2   0   0    3  1  2
neck      -12   0   0    4 17 10
head       -1   0   0   11  5  4
collar      0   1 -16    0  7 10
shoulder   16 -13 -49   37 20 28
elbow      -7 -40  16    5 29 13
wrist      -4  -2  10    3 11  6
"""
"""Usual poses in clips of CMU: mean axis-angle vectors of joints of the left side or in the middle,
and their standard deviations, degrees; the right side is the mirror image."""


def usual_pose_statistics(joints: int) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (joints, 3) of usual poses, axis-angle, rad.

    The mean is zero for joints that are not known. Deviations are at least 8 degrees: a few clips
    do not show how far a joint can go.
    """
    table = {}
    for line in _USUAL.split("\n")[1:-1]:
        name, *numbers = line.split()
        table[name] = torch.tensor([float(x) for x in numbers], device="cpu")
    degrees = torch.zeros(joints, 6, device="cpu")
    for row, name in enumerate(JOINT_NAMES[:joints]):
        own = table.get(name.removeprefix("left_").removeprefix("right_"))
        if own is not None:
            degrees[row] = own
            if name.startswith("right_"):
                degrees[row, 1:3] *= -1
    mean, spread = degrees.split(3, dim=1)
    return torch.deg2rad(mean), torch.deg2rad(spread.clamp_min(8.0))


@dataclass(frozen=True)
class PosePrior:
    """Expected corrections of the poses of F frames, axis-angle, rad."""

    centre: Tensor  # (F, 22, 3) mean
    spread: Tensor  # (22, 3) standard deviation
    # of these from the centre, beyond which nobody is expected to turn a joint
    limit: float


def pose_prior(clip: MotionClip, *, is_given: bool) -> PosePrior:
    """Return the prior that poses are about those given, with an expected error of 0.05 rad, or that
    corrected poses are usual ones; rotations add as vectors, which holds for small ones."""
    poses = clip.poses[:, :NUM_FITTED_JOINTS]
    if is_given:
        return PosePrior(torch.zeros_like(poses), torch.full_like(poses[0], 0.05), math.inf)
    mean, spread = (x.to(poses) for x in usual_pose_statistics(NUM_FITTED_JOINTS))
    return PosePrior(mean - poses, spread, 3.0)


_RATES = {
    "log_scale": 3e-3,
    "betas": 0.1,
    "turns": 1e-2,
    "poses": 1e-2,
    "trans": 6e-3,
    "padding": 1e-3,
    "offset": 3e-3,
    "shift": 3e-3,
}
"""Learning rates at the first step; a tenth at the last."""
LIMIT_WEIGHT = 2e-2
"""Weight of the mean square of what lies beyond the limit of a joint, in standard deviations."""
KEYPOINT_STD = 0.02  # expected error of a key point, as a fraction of the square's side
OUTLIER_ERROR = 1.0
"""Squared difference of coverages, over the person's area, from which on a silhouette is rather a
mistake. Good masks have 0.05 to 0.2; at 0.3 bodies found in masks of a detector were no better, at
infinity twice as far off."""
FRAMES_PER_STEP = 3  # frames drawn in each step


def silhouette_error(drawn: Tensor, seen: ObservedFrame) -> Tensor:
    """Return a mean over the V views of e / (1 + e / ``MISTAKEN``); e is the squared difference
    over what is seen.

    So a mask that shows half the person, or something else, counts little beside those of the other
    views (Geman and McClure 1987).
    """
    wrong = ((drawn - seen.alpha) * seen.known).square().sum((1, 2))
    error = wrong / (seen.alpha * seen.known).sum((1, 2)).clamp_min(1.0)
    return (error / (1 + error / OUTLIER_ERROR)).mean()


def keypoint_error(joints: Tensor, marked: Tensor, cameras: Cameras) -> Tensor:
    """Return the mean robust distance of joints (J, 3) in the world from key points (V, 55, 3), see
    ``ObservedFrame``.

    J is 24, 52 or 55; joints of the same name are compared.
    """
    rows = SMPLX_ROWS[len(joints)]
    marked = marked[:, list(rows)]
    local = (
        joints[: len(rows)] @ cameras.cam_from_world[:, :3, :3].mT
        + cameras.cam_from_world[:, None, :3, 3]
    )
    pixels = local @ cameras.intrinsics.mT
    positions = pixels[..., :2] / pixels[..., 2:].clamp_min(1e-3) / cameras.width
    return _robust_mean(
        (positions - marked[..., :2]).square().sum(-1) / KEYPOINT_STD**2, marked[..., 2]
    )


def joint_position_error(joints: Tensor, given: Tensor, unit: Tensor) -> Tensor:
    """Return the mean robust distance of joints (J, 3) from positions (55, 4), as for key points.

    ``unit`` is the length of a metre of the person in the world; errors of 3 cm are expected.
    """
    rows = SMPLX_ROWS[len(joints)]
    given = given[list(rows)]
    away = (joints[: len(rows)] - given[:, :3]).square().sum(-1) / (0.03 * unit) ** 2
    return _robust_mean(away, given[:, 3])


def _robust_mean(squares: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted mean of sqrt(1 + s) - 1: large errors count linearly."""
    return (weights * ((1 + squares).sqrt() - 1)).sum() / weights.sum().clamp_min(1.0)


@dataclass(frozen=True)
class CandidateFit:
    """One way to fit."""

    name: str  # for people
    learned: Parameters  # of the clip
    iou: float  # mean IoU of drawn and seen silhouettes
    per_frame: tuple[float, ...]  # (F,) the same, per frame; NaN where nobody is seen


@dataclass(frozen=True)
class BodyFit:
    """Given poses of F frames, the template's discs, and the poses that are expected."""

    clip: MotionClip
    body: BodyDiscs
    expected: PosePrior

    def start(self) -> Parameters:
        """Return what is learned, all zero.

        ``betas`` (B,) shape; ``log_scale`` (1,) of the factor on the scale; ``turns`` (22, 3)
        axis-angle, rad, applied before the given rotations, in all frames; ``poses`` (F, 22, 3) the
        same per frame; ``shift`` (3,) added to the translations, ``offset`` (3,) m in the frame of
        the pelvis; ``trans`` (F, 3) per frame; ``padding`` (P,) m between skin and silhouette.
        """
        frames = len(self.clip)
        shapes = {
            "log_scale": (1,),
            "betas": self.body.shape_dirs.shape[-1:],
            "turns": (NUM_FITTED_JOINTS, 3),
            "poses": (frames, NUM_FITTED_JOINTS, 3),
            "trans": (frames, 3),
            "padding": self.body.weights.shape[:1],
            "offset": (3,),
            "shift": (3,),
        }
        zeros = {name: self.body.weights.new_zeros(shape) for name, shape in shapes.items()}
        # Positions are in the unit of the world, rates per metre of the person.
        unit = float(self.clip.scale.mean())
        rates = _RATES | {name: _RATES[name] * unit for name in ("trans", "shift")}
        return Parameters(zeros, rates, 0.1)

    def pose(self, learned: Parameters, row: int) -> BodyPose:
        """Return the fitted pose of frame ``row``."""
        own = learned["turns"] + learned["poses"][row]
        given = self.clip.rotations[row]
        turned = given[:NUM_FITTED_JOINTS] @ axis_angle_to_matrix(own)
        scale = self.clip.scale[row] * learned["log_scale"][0].exp()
        away = learned["shift"] + learned["trans"][row] + scale * (turned[0] @ learned["offset"])
        rotations = torch.cat([turned, given[NUM_FITTED_JOINTS:]])
        return BodyPose(rotations, self.clip.trans[row] + away, scale)

    def shaped(self, learned: Parameters) -> BodyDiscs:
        """Return the body in the fitted shape."""
        return self.body.with_shape(learned["betas"], learned["padding"])

    def silhouettes(self, learned: Parameters, row: int, cameras: Cameras) -> Tensor:
        """Return the silhouettes (V, H, W) of frame ``row`` for V cameras."""
        return render_silhouettes(self.shaped(learned).in_pose(self.pose(learned, row)), cameras)

    def error(self, learned: Parameters, seen: Mapping[int, ObservedFrame]) -> Tensor:
        """Return the mean error of the frames ``seen``, by row: of silhouettes, and of joints where
        they are marked."""
        body = self.shaped(learned)
        errors = []
        for row, frame in seen.items():
            pose = self.pose(learned, row)
            error = silhouette_error(render_silhouettes(body.in_pose(pose), frame.cameras), frame)
            if frame.joints is not None:
                joints = posed_joints(body.skeleton, pose)
                error = error + 0.1 * keypoint_error(joints, frame.joints, frame.cameras)
            if frame.positions is not None:
                joints = posed_joints(body.skeleton, pose)
                error = error + 0.1 * joint_position_error(
                    joints, frame.positions, pose.scale.detach()
                )
            errors.append(error)
        return torch.stack(errors).mean()

    def penalty(self, learned: Parameters) -> Tensor:
        """Return the penalty of shapes, turns and poses that are far from those given, or that
        jump.

        What silhouettes do not show, such as a limb turned about itself, follows the noise of
        Adam's steps where the weights are much smaller: renders of new poses then lose 1 to 3 dB.
        """
        # Of the free template the last directions are those of bones; SMPL has none.
        bones = learned["betas"].square().tensor_split([-NUM_BONE_SHAPES])
        total = learned["betas"].new_zeros(())
        for part in bones:
            total = total + (1e-3 * part.mean() if len(part) else 0.0)
        total = total + 3e-2 * (learned["turns"][1:] / 0.25).square().mean()
        away = (learned["poses"] - self.expected.centre) / self.expected.spread
        total = total + 1e-3 * away[:, 1:].square().mean()
        beyond = (away[:, 1:].abs() - self.expected.limit).clamp_min(0.0)
        total = total + LIMIT_WEIGHT * beyond.square().mean()
        if len(self.clip) > 1:
            total = total + 1e-3 * (learned["poses"].diff(dim=0) / 0.1).square().mean()
        return total + 2e-3 * (learned["padding"] / 0.01).square().mean()

    def run(
        self,
        start: Parameters,
        learned: Sequence[str],
        steps: int,
        observed: Observations,
        report: ProgressCallback = ignore_progress,
        schedule_start: float = 0.0,
    ) -> Parameters:
        """Return the fit ``start`` after ``steps`` of Adam on what is named.

        Frames are taken in a fixed order that covers the clip evenly. Rates begin where they are
        after the fraction ``fallen`` of a run; higher where it is negative.
        """
        # Copies, as updates are in place and ``start`` may be what is taken in the end; without
        # moments.
        copies = {name: x.clone() for name, x in start.values().items()}
        found = Parameters(copies, start.rates, start.decay)
        for name in copies:
            found[name].requires_grad_(name in learned)
        order = spread_order(len(self.clip))
        for step in range(1, steps + 1):
            rows = {
                order[((step - 1) * FRAMES_PER_STEP + i) % len(order)]
                for i in range(FRAMES_PER_STEP)
            }
            seen = {row: frame for row in sorted(rows) if (frame := observed(row)) is not None}
            loss = self.penalty(found)
            if seen:
                loss = loss + self.error(found, seen) * (len(seen) / len(rows))
            if loss.requires_grad:  # else nothing is to be learned
                loss.backward()
            found.step(step, schedule_start + (1 - schedule_start) * step / steps)
            report("fit of the body", step, steps)
        return found

    @torch.no_grad()
    def measured(
        self, name: str, learned: Parameters, judged: Mapping[int, ObservedFrame]
    ) -> CandidateFit:
        """Return a candidate with its IoU in the frames ``judged``, by row."""
        found = [torch.zeros(0, device="cpu")] * len(self.clip)
        for row, frame in judged.items():
            ours = self.silhouettes(learned, row, frame.cameras) > 0.5
            theirs = frame.alpha > 0.5
            known = frame.known > 0
            both = ours & theirs & known
            either = (ours | theirs) & known
            found[row] = both.sum((1, 2)) / either.sum((1, 2)).clamp_min(1)
        per_frame = tuple(float(x.mean()) for x in found)
        return CandidateFit(name, learned, float(torch.cat(found).mean()), per_frame)


def spread_order(count: int) -> list[int]:
    """Return 0 .. count - 1 in an order whose every stretch is spread over the full range."""
    stride = max(1, round(count * 0.618))
    while count > 1 and math.gcd(stride, count) != 1:
        stride += 1
    return [(i * stride) % count for i in range(count)]


def apply_fit(learned: Parameters, clip: MotionClip, *, own_frames: bool) -> MotionClip:
    """Return a clip with what was learned: of the clip that was fitted with the corrections of its
    frames, of another one, whose poses were given by the same means, with what holds for all."""
    values = learned.values()
    missing = (0, 0, 0, clip.poses.shape[1] - NUM_FITTED_JOINTS)
    turns, poses = (torch.nn.functional.pad(values[name], missing) for name in ("turns", "poses"))
    shared = SharedCorrection(turns, float(values["log_scale"][0]))
    frames = (poses, values["trans"]) if own_frames else ()
    turned = corrected_clip(shared, clip, *frames)
    roots = axis_angle_to_matrix(turned.poses[:, 0])
    away = values["shift"] + turned.scale[:, None] * (roots @ values["offset"][:, None])[..., 0]
    return replace(turned, trans=turned.trans + away)


NUM_HEADINGS = 8  # directions that a person may face
STEPS = 40
"""Steps of Adam for each heading of an anchor, and, at each size, for each frame from the pose of
the one before."""
MAX_HEADING_ERROR = math.radians(30)
"""Rotation of the root away from the path of headings from which a frame is begun on that path
instead."""
STATURE = 1.70  # height of a person in a usual pose, m, where a single camera leaves it open
FramePose = tuple[Tensor, Tensor, float]
"""Pose (J, 3), translation (3,) and error of one frame."""


def viterbi_path(costs: np.ndarray, changes: np.ndarray) -> list[int]:
    """Return the states (T,) whose costs (T, S) and changes (T - 1, S, S) cost least in all.

    ``changes`` are from the state of the row to that of the column. Source: the algorithm of
    Viterbi, 1967.
    """
    total = costs[0]
    came_from = []
    for own, change in zip(costs[1:], changes, strict=True):
        ways = total[:, None] + change
        came_from.append(ways.argmin(0))
        total = ways.min(0) + own
    path = [int(total.argmin())]
    for back in reversed(came_from):
        path.append(int(back[path[-1]]))
    return path[::-1]


def likely_headings(errors: Sequence[Sequence[float]], weight: float = 0.01) -> list[int]:
    """Return the heading (A,) of each anchor for which errors (A, H) and changes of heading cost
    least in all.

    ``weight``: error that costs as much as a turn of 45 degrees from one anchor to the next; it
    grows with the square.
    """
    costs = np.asarray(errors, dtype=np.float64)
    anchors, count = costs.shape
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    change = weight * (np.minimum(apart, count - apart) * (8 / count)) ** 2
    return viterbi_path(costs, np.broadcast_to(change, (anchors - 1, count, count)))


def estimate_initial_poses(
    times: Tensor,
    body: BodyDiscs,
    observed: Observations,
    report: ProgressCallback = ignore_progress,
) -> MotionClip:
    """Return poses of a person in F frames, found in the silhouettes of ``observed`` (per row)
    alone.

    In up to 20 frames, the anchors, every heading is tried; a likely path through them says which
    way the person faces. Each frame starts from the pose of the one before, and where that has left
    the path from the path's heading. Without key points clips that never look at the path are
    compared with it. Raises DyngsError: nobody in the first frame.
    """
    seen = observed(0)
    if seen is None:
        raise DyngsError("nobody is seen in the first frame; leave it out (data.frames=1::)")
    up = up_of(seen)
    standing = standing_clip(times, body, up, observed)
    anchors: list[int] = []
    tried: list[list[FramePose]] = []
    rows = evenly_spaced(len(times), 20)
    for number, row in enumerate(rows, 1):
        frame = observed(row)
        if frame is not None:
            anchors.append(row)
            tried.append(_all_headings(standing, row, up, body, frame))
        report("headings", number, len(rows))
    path = likely_headings([[error for _, _, error in own] for own in tried])
    roots = torch.stack([own[heading][0][0] for own, heading in zip(tried, path, strict=True)])
    roots = _roots_between(anchors, roots, len(times))
    ways: list[tuple[int, Tensor | None]] = [(path[0], roots)]
    if seen.joints is None:  # outlines from two opposite sides are alike: the path may be wrong
        best = sorted(range(NUM_HEADINGS), key=lambda i: tried[0][i][2])
        ways += [(index, None) for index in best[:2]]
    followed = []
    for number, (index, along) in enumerate(ways, 1):
        followed.append(_followed(standing, tried[0][index], along, body, observed))
        report("first poses", number, len(ways))
    return min(followed, key=lambda found: found[1])[0]


def standing_clip(times: Tensor, body: BodyDiscs, up: Tensor, observed: Observations) -> MotionClip:
    """Return the usual pose, upright, at the place and in the size of the silhouettes of each
    frame.

    Where nobody is seen, the place is that of the frame before; ``up`` (3,) is a unit vector.
    """
    joints = body.skeleton.joints
    positions = [torch.zeros(3, device="cpu")]
    heights = []
    for row in range(len(times)):
        seen = observed(row)
        place, height = (positions[-1], None) if seen is None else locate_person(seen, up)
        positions.append(place)
        heights += [] if height is None else [height]
    upright = Rotation.align_vectors(up[None].numpy(), np.array([[0.0, 1.0, 0.0]]))[0]
    poses = usual_pose_statistics(len(joints))[0].to(joints).repeat(len(times), 1, 1)
    poses[:, 0] = torch.from_numpy(upright.as_rotvec()).to(poses)
    scale = float(np.median(heights)) / STATURE if heights else 1.0
    trans = torch.stack(positions[1:]) - scale * joints[0]  # the root turns about the pelvis
    return MotionClip(times, poses, trans, torch.full((len(times),), scale, device="cpu"))


def up_of(seen: ObservedFrame) -> Tensor:
    """Return the unit vector (3,) that points up in the images, a mean over cameras."""
    up = -seen.cameras.cam_from_world[:, 1, :3].mean(0)
    return up / up.norm()


def locate_person(seen: ObservedFrame, up: Tensor) -> tuple[Tensor, float | None]:
    """Return the place (3,) of the pelvis in the world and the height of the person, None if one
    camera sees them.

    The rays through the middles of the silhouettes meet there.
    """
    boxes = [silhouette_box(alpha, 0.5) or silhouette_box(alpha) for alpha in seen.alpha]
    edges = [(r.start, r.stop, c.start, c.stop) for r, c in filter(None, boxes)]
    top, bottom, left, right = torch.tensor(edges, dtype=torch.float32, device="cpu").T
    middles = torch.stack([(left + right) / 2, (top + bottom) / 2, torch.ones_like(top)], dim=1)
    intrinsics = seen.cameras.intrinsics
    local = torch.linalg.solve(intrinsics, middles)
    # height over distance, of a person who stands upright in the image
    angles = (bottom - top) / (intrinsics[:, 1, 1] * local.norm(dim=1))
    directions = (seen.cameras.cam_from_world[:, :3, :3].mT @ local[..., None])[..., 0]
    directions = torch.nn.functional.normalize(directions, dim=1)
    starts = seen.cameras.centers
    if len(starts) == 1:
        middle = starts[0] + directions[0] * STATURE / angles[0]
        height = None
    else:
        across = torch.eye(3, device="cpu") - directions[:, :, None] * directions[:, None]
        right_side = (across @ starts[..., None]).sum(0)
        middle = torch.linalg.lstsq(across.sum(0), right_side).solution[:, 0]
        height = float((angles * (middle - starts).norm(dim=1)).median())
    # The pelvis is at 0.53 of the height of a person.
    return middle + up * (0.53 - 0.5) * (height or STATURE), height


def _all_headings(
    standing: MotionClip, row: int, up: Tensor, body: BodyDiscs, seen: ObservedFrame
) -> list[FramePose]:
    """Return pose, translation and error of a frame as found from each heading; after the first at
    half the size.

    With key points only the three nearest headings are tried, and the error of others is infinite.
    """
    angles = torch.arange(NUM_HEADINGS, device="cpu").double() * (2 * math.pi / NUM_HEADINGS)
    starts = standing.poses[row].repeat(NUM_HEADINGS, 1, 1)
    starts[:, 0] = compose_rotations(angles[:, None] * up, starts[:, 0])
    trans = standing.trans[row]
    found = [(start, trans, math.inf) for start in starts]
    likely = list(range(NUM_HEADINGS))
    if seen.joints is not None:
        errors = []
        for start in starts:
            pose = BodyPose(axis_angle_to_matrix(start), trans, standing.scale[row])
            joints = posed_joints(body.skeleton, pose)
            errors.append(float(keypoint_error(joints, seen.joints, seen.cameras)))
        likely = sorted(likely, key=errors.__getitem__)[:3]
    levels = (2, 1) if row == 0 else (2,)
    for index in likely:
        found[index] = _fitted_frame(standing, row, starts[index], trans, body, seen, levels)
    return found


def _fitted_frame(
    clip: MotionClip,
    row: int,
    pose: Tensor,
    trans: Tensor,
    body: BodyDiscs,
    seen: ObservedFrame,
    levels: Sequence[int] = (2, 1),
) -> FramePose:
    """Return pose (J, 3), translation and error of one frame, found from a start; unusual poses add
    to the error.

    ``levels`` are the factors by which what is seen is made smaller, one after the other.
    """
    one = MotionClip(clip.times[row : row + 1], pose[None], trans[None], clip.scale[row : row + 1])
    fitting = BodyFit(one, body, pose_prior(one, is_given=False))
    learned = fitting.start()
    for level in levels:
        look = rotate_views({0: seen.shrunk(level)})
        learned = fitting.run(learned, ("poses", "trans"), STEPS, look)
    with torch.no_grad():
        error = float(fitting.error(learned, {0: seen}) + fitting.penalty(learned))
    found = pose.clone()
    found[:NUM_FITTED_JOINTS] = compose_rotations(
        pose[:NUM_FITTED_JOINTS], learned["poses"][0].detach()
    )
    return found, trans + learned["trans"][0].detach(), error


def _roots_between(anchors: Sequence[int], roots: Tensor, count: int) -> Tensor:
    """Return rotations (count, 3) of the root, axis-angle, rad: those (A, 3) of the anchors, turned
    on between them.

    Before the first anchor and after the last one they stay.
    """
    if len(anchors) == 1:
        return roots.expand(count, 3)
    between = Slerp(anchors, Rotation.from_rotvec(roots.numpy()))
    rows = np.clip(np.arange(count), anchors[0], anchors[-1])
    return torch.from_numpy(between(rows).as_rotvec()).to(roots)


def _followed(
    standing: MotionClip,
    first: FramePose,
    roots: Tensor | None,
    body: BodyDiscs,
    observed: Observations,
) -> tuple[MotionClip, float]:
    """Return the clip with the poses after the first frame found one by one, and the mean error of
    what is seen.

    ``roots`` (F, 3) is a path of headings to stay near; None: there is none.
    """
    poses = standing.poses.clone()
    trans = standing.trans.clone()
    poses[0], trans[0], _ = first
    errors = []
    for row in range(1, len(poses)):
        seen = observed(row)
        poses[row] = _extrapolated(poses, row)
        trans[row] = trans[row - 1] + standing.trans[row] - standing.trans[row - 1]
        if seen is None:
            continue
        starts = [poses[row]]
        if roots is not None and _angle_between(poses[row, 0], roots[row]) > MAX_HEADING_ERROR:
            others = torch.stack([poses[row], standing.poses[row]])
            others[:, 0] = roots[row]
            starts = list(others)
        found = [_fitted_frame(standing, row, x, trans[row], body, seen) for x in starts]
        poses[row], trans[row], error = min(found, key=lambda x: x[2])
        errors.append(error)
    return replace(standing, poses=poses, trans=trans), sum(errors) / max(len(errors), 1)


def _extrapolated(poses: Tensor, row: int) -> Tensor:
    """Return the pose (J, 3) expected in frame ``row``: that before it, turned on as it turned
    before.

    Four fifths of the last rotation are expected again, so that legs which pass each other are not
    exchanged. What was put on the path of headings was no motion.
    """
    if row < 2 or _angle_between(poses[row - 2, 0], poses[row - 1, 0]) > MAX_HEADING_ERROR:
        return poses[row - 1].clone()
    before, last = poses[row - 2 : row].double()
    return compose_rotations(last, 0.8 * compose_rotations(-before, last)).to(poses)


def _angle_between(a: Tensor, b: Tensor) -> float:
    """Return the angle, rad, of the rotation from ``a`` (3,) to ``b`` (3,), both axis-angle."""
    return float(compose_rotations(-a.double(), b.double()).norm())


RESOLUTION = 48  # texels per side of the atlas whose discs are drawn
MIN_GAIN, MIN_SHAPE_GAIN = 0.01, 0.03
"""Gain of IoU for which more is learned, and for which given poses are touched at all.

Below the first, renders of new poses were worse by 0.1 to 0.3 dB on two people. A body of another
shape explains thick clothes, too: with exact poses it gained 0.02, and lost 2.7 dB in new poses.
"""
SHARED_PARAMETERS = (
    "log_scale",
    "betas",
    "padding",
    "offset",
    "shift",
)  # what is the same in all frames


@dataclass(frozen=True)
class FitEffort:
    """How much a fit may cost."""

    side: int = 128  # of the squares around the person that are looked at, px
    steps: int = 120  # least number of steps of Adam of a stage
    draws_per_frame: int = 18  # how often a frame is drawn where its pose is learned

    def steps_for(self, clip: MotionClip) -> int:
        """Return the number of steps that draws every frame often enough."""
        return max(self.steps, -(-self.draws_per_frame * len(clip) // FRAMES_PER_STEP))


@dataclass(frozen=True)
class CaptureFit:
    """A fit of a capture's clip of training."""

    motion: CapturedMotion  # the given clip, F frames
    chosen: CandidateFit  # the candidate that was taken
    tried: tuple[CandidateFit, ...]  # all candidates; the first one has the poses as given
    # views left out of the fit, on which the candidates were measured; 0: measured on those fitted
    # to
    num_held_out: int

    @property
    def betas(self) -> Tensor:
        """Shape parameters (B,) of the template."""
        return self.chosen.learned.values()["betas"]

    @property
    def clip(self) -> MotionClip:
        """The clip that was fitted, with its corrections."""
        return apply_fit(self.chosen.learned, self.motion.clip, own_frames=True)


def fit_capture(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    report: ProgressCallback,
    keypoints: Keypoints | None = None,
    effort: FitEffort = FitEffort(),
    *,
    joints: Joints3D | None = None,
    one_camera: bool = False,
    shape_known: bool = False,
) -> CaptureFit:
    """Return the fit of ``body`` to the silhouettes of a capture's training views.

    With given poses: first the shape; then rotations that are the same in all frames, and then
    those of every frame, each where it explains views clearly better that were left out. Without:
    poses are found first (``first_poses``).

    Args:
        keypoints: of the images, by view.
        joints: in 3D, of frames of the capture.
        one_camera: the size stays as it is, as one camera does not tell a small person from a
            distant one.
        shape_known: the body has the shape of the person already.

    Raises DyngsError: no silhouettes, or nobody in them.
    """
    if not capture.has_alpha:
        raise DyngsError(
            f"{capture.root}: the images have no silhouettes; add masks of the person (`dyngs docs people`)"
        )
    capture = capture.replace(splits=assign_frame_numbers(capture.splits))
    views = capture.splits["train"]
    if capture.body is None:
        motion = _unposed(views, body.joints)
    else:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
    seen = crop_views(capture, motion, options, effort, keypoints or {}, joints or {})
    discs = body_discs(body, RESOLUTION)
    shape = list(SHARED_PARAMETERS)
    if one_camera:
        shape.remove("log_scale")
    if shape_known:
        shape.remove("betas")
    if capture.body is not None:
        fitting = BodyFit(motion.clip, discs, pose_prior(motion.clip, is_given=True))
        tried = _from_given(fitting, seen, shape, report, effort)
        first_gain = MIN_GAIN if shape_known else MIN_SHAPE_GAIN
    else:
        clip = estimate_initial_poses(motion.clip.times, discs, seen.used.get, report)
        motion = CapturedMotion(clip, motion.frames)
        fitting = BodyFit(clip, discs, pose_prior(clip, is_given=False))
        tried = _from_silhouettes(fitting, seen, shape, report, effort)
        first_gain = 0.0
    return CaptureFit(motion, _simplest_of_the_best(tried, first_gain), tried, seen.num_held_out)


def _simplest_of_the_best(tried: Sequence[CandidateFit], first_gain: float) -> CandidateFit:
    """Return the candidate after which none is clearly better: ``tried`` is ordered from simple to
    complex.

    ``first_gain`` is the gain of IoU for which the first one is left: given poses are touched for
    much only.
    """
    best = tried[0]
    for candidate in tried[1:]:
        gain = first_gain if best is tried[0] else MIN_GAIN
        best = candidate if candidate.iou > best.iou + gain else best
    return best


def _from_given(
    fitting: BodyFit,
    seen: FitViews,
    shape: Sequence[str],
    report: ProgressCallback,
    effort: FitEffort,
) -> tuple[CandidateFit, ...]:
    """Return candidates from given poses, from simple to complex."""
    start = fitting.start()
    halves = rotate_views(seen.halves())
    # Clothes and hair are no sign of wrong poses.
    dressed = fitting.run(start, ("padding",), effort.steps, halves, report)
    tried = [fitting.measured("the poses as given", dressed, seen.judged)]
    found = start
    for look in (halves, seen.used.get):
        found = fitting.run(found, shape, effort.steps, look, report)
    tried.append(fitting.measured("one shape", found, seen.judged))
    every_frame = (*shape, "turns", "poses", "trans")
    for name, learned, steps in (
        ("turns that are the same in all frames as well", (*shape, "turns"), effort.steps),
        ("turns of every frame as well", every_frame, effort.steps_for(fitting.clip)),
    ):
        # The last quarter of the steps, at low rates, shows whether all of them are worth it.
        found = fitting.run(
            tried[-1].learned, learned, -(-steps // 4), seen.used.get, report, schedule_start=0.75
        )
        candidate = fitting.measured(name, found, seen.judged)
        if candidate.iou > max(x.iou for x in tried) + 0.75 * MIN_GAIN:
            found = fitting.run(found, learned, steps, seen.used.get, report)
            candidate = fitting.measured(name, found, seen.judged)
        tried.append(candidate)
    return tuple(tried)


def _from_silhouettes(
    fitting: BodyFit,
    seen: FitViews,
    shape: Sequence[str],
    report: ProgressCallback,
    effort: FitEffort,
) -> tuple[CandidateFit, ...]:
    """Return candidates from poses that were found frame by frame.

    These are off by more than given ones: they get three times the steps, at rates of twice as much
    at first.
    """
    found = fitting.start()
    first = fitting.measured("poses found frame by frame", found, seen.judged)
    learned = (*shape, "poses", "trans")
    steps = 3 * effort.steps_for(fitting.clip)
    for look in (seen.halves().get, seen.used.get):
        found = fitting.run(found, learned, steps, look, report, schedule_start=-0.3)
    return first, fitting.measured("one shape, and poses of every frame", found, seen.judged)


@dataclass(frozen=True)
class FitViews:
    """Observed frames by row of the clip: those to fit to, and those to judge by."""

    used: dict[int, ObservedFrame]
    judged: dict[int, ObservedFrame]
    num_held_out: int  # number of views to judge by; 0: they are those to fit to

    def halves(self) -> dict[int, ObservedFrame]:
        """Return the frames to fit to at half the size."""
        return {row: frame.shrunk(2) for row, frame in self.used.items()}


def split_views(
    views: Sequence[View], motion: CapturedMotion
) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
    """Return, per row of the clip, the indices of at most eight views to fit to, and of those left
    out to judge by.

    One view of each frame is left out, another one in each frame, where a frame has at least five.
    """
    by_row: dict[int, list[int]] = {row: [] for row in range(len(motion.clip))}
    for i, view in enumerate(views):
        by_row[motion.rows[frame_number(view)]].append(i)
    used = {}
    left_out = {}
    for row, own in by_row.items():
        left_out[row] = [own[row % len(own)]] if len(own) >= 5 else []
        rest = [i for i in own if i not in left_out[row]]
        step = max(1, -(-len(rest) // 8))
        used[row] = rest[row % step :: step]
    return used, left_out


def _unposed(views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """Return a clip of the views' frames that says nothing about poses, for a body with ``joints``
    (J, 3)."""
    times = {frame_number(view): view.time for view in views}
    frames = tuple(sorted(times))
    even = np.linspace(0, 1, len(frames)).tolist()
    moments = [
        start if times[frame] is None else times[frame]
        for frame, start in zip(frames, even, strict=True)
    ]
    zeros = joints.new_zeros(len(frames), len(joints), 3)
    moments = torch.tensor(moments, dtype=torch.float64, device="cpu")
    return CapturedMotion(
        MotionClip(moments, zeros, zeros[:, 0], torch.ones_like(zeros[:, 0, 0])), frames
    )


def crop_views(
    capture: Capture,
    motion: CapturedMotion,
    options: DataConfig,
    effort: FitEffort,
    keypoints: Keypoints,
    joints: Joints3D,
) -> FitViews:
    """Return the squares around the person in all frames of ``motion``.

    Raises DyngsError: nobody is seen, or the masks are those of the background.
    """
    views = capture.splits["train"]
    images = ImageLoader(views, options.model_copy(update={"longest_side": 512, "downscale": 1}))
    used, left_out = split_views(views, motion)
    shown = [i for rows in (used, left_out) for own in rows.values() for i in own]
    # People who are cut off on three sides cover less.
    if float(np.mean([_border_covered(images[i]) for i in shown])) > 0.6:
        raise DyngsError(
            f"{capture.root}: the silhouettes cover the borders of the images; white is the person: are the masks "
            "inverted? (`dyngs docs people`)"
        )
    side = longest_box_side(images[i] for i in shown)
    if side < 8:
        raise DyngsError(
            f"{capture.root}: nobody is seen in the silhouettes; check the masks (`dyngs docs people`)"
        )
    size = min(effort.side, 2 * (side // 2))
    marked = {
        view.name: keypoints[view.name] / torch.tensor([view.width, view.height, 1], device="cpu")
        for view in views
        if view.name in keypoints
    }
    positions = {row: joints[frame] for frame, row in motion.rows.items() if frame in joints}

    def observed(rows: dict[int, list[int]]) -> dict[int, ObservedFrame]:
        frames = {
            row: crop_frame([images[i] for i in own], side, size, marked, positions.get(row))
            for row, own in rows.items()
        }
        return {row: frame for row, frame in frames.items() if frame is not None}

    num_held_out = sum(map(len, left_out.values()))
    frames = observed(used)
    return FitViews(frames, observed(left_out) if num_held_out else frames, num_held_out)


def _border_covered(image: Image) -> float:
    """Return the fraction of the image's outermost pixels that the silhouette covers."""
    if image.alpha is None:
        return 0.0
    border = torch.ones_like(image.alpha, dtype=torch.bool)
    border[1:-1, 1:-1] = False
    return float((image.alpha[border] > 0.5).float().mean())


@dataclass(frozen=True)
class PlacedClip:
    """Another clip of a fitted person."""

    motion: CapturedMotion  # its poses as given, with what holds for all frames; a row per frame
    iou: float  # at the place of the fit
    iou_moved: float | None  # moved to its own silhouettes; None where that was not taken

    def summary(self) -> str:
        """Return a line for people."""
        if self.iou_moved is None:
            return f"new poses: at the place of the fit; overlap of silhouettes {self.iou:.3f}"
        return (
            f"new poses: moved to their silhouettes; overlap {self.iou:.3f} -> {self.iou_moved:.3f}"
        )


def place_new_poses(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    found: CaptureFit,
    report: ProgressCallback,
    effort: FitEffort = FitEffort(),
) -> PlacedClip | None:
    """Return the clip of ``pose`` moved to its silhouettes, if it looks better there; None without
    such a clip.

    All views of ``capture`` have frame numbers; ``found`` is the fit of those of training.
    """
    views = capture.splits.get("pose", ())
    if not views or capture.body is None:
        return None
    motion = captured_motion(capture.root, capture.body["pose"], views, body.joints)
    seen = crop_views(capture.replace(splits={"train": views}), motion, options, effort, {}, {})
    fitting = BodyFit(
        motion.clip, body_discs(body, RESOLUTION), pose_prior(motion.clip, is_given=True)
    )
    start = fitting.start()
    with torch.no_grad():
        for name in (*SHARED_PARAMETERS, "turns"):
            start[name].copy_(found.chosen.learned[name])
    # Three numbers are learned: few steps are enough.
    moved = fitting.run(start, ("shift",), min(effort.steps, 40), seen.used.get, report)
    before, after = (fitting.measured("", x, seen.judged) for x in (start, moved))
    is_better = after.iou > before.iou + 0.001
    clip = apply_fit(
        moved if is_better else start, motion.clip_of_frames(motion.frames), own_frames=False
    )
    return PlacedClip(replace(motion, clip=clip), before.iou, after.iou if is_better else None)


def collect_fitted_clips(
    capture: Capture, body: BodyTemplate, found: CaptureFit, new_poses: PlacedClip | None
) -> dict[Split, CapturedMotion]:
    """Return the clip of training, with the frames of val and test, and that of ``pose``, if the
    capture has one.

    Frames that were not fitted have what holds for all frames applied to their given poses; without
    given poses they lie between their neighbours. All views of ``capture`` have frame numbers.
    """
    views = [view for split in ("train", "val", "test") for view in capture.splits.get(split, ())]
    times = {frame_number(view): view.time for view in views}
    frames = tuple(sorted(times))
    fitted = replace(found.motion, clip=found.clip)
    if capture.body is not None:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
        clip = apply_fit(found.chosen.learned, motion.clip_of_frames(frames), own_frames=False)
    else:
        clip = MotionClip.joined([fitted.clip.at(times[frame]) for frame in frames])
    rows = [row for row, frame in enumerate(frames) if frame in fitted.rows]
    clip = clip.replace_rows(rows, fitted.clip_of_frames([frames[row] for row in rows]))
    clips: dict[Split, CapturedMotion] = {"train": CapturedMotion(clip, frames)}
    if new_poses is not None:
        clips["pose"] = new_poses.motion
    return clips
