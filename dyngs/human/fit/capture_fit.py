"""The fit of a whole capture: reads silhouettes and given poses, fits the body, judges the result
on views left out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.conventions import RasterizeMode, ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import numbered
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
from dyngs.human.motion.motion import CapturedMotion, MotionClip, captured_motion

_WIDTH, _THICKNESS, _INSET = 0.4, 0.075, 0.2
"""Standard deviations of a disc in the tangent plane and along the normal, and its depth below the
skin, in sides of its texel. With these, drawn silhouettes have the area of the mesh to 2 % and an
IoU with it of 0.95 (48 texels a side) to 0.97 (72); wider discs cover more than the body, narrower
ones leave gaps."""
_OPACITY_LOGIT = 4.0
_OPTIONS = RenderOptions(nonfinite="trust", eps2d=0.1, mode=RasterizeMode.ANTIALIASED)


@dataclass(frozen=True)
class Surface:
    """Discs on the texels of a template, and how they follow its shape."""

    discs: Gaussians  # P at rest in the mean shape, m
    normals: Tensor  # (P, 3) outward
    weights: Tensor  # (P, J) skinning weights
    shape_dirs: Tensor  # (P, 3, B) m per unit of the shape parameters
    # (9 (J - 1), 3 P) pose blend shapes, m per unit of the rotations minus the identity; None
    # without
    pose_dirs: Tensor | None
    body: BodyTemplate  # the template

    def __len__(self) -> int:
        return len(self.weights)

    def skeleton(self, betas: Tensor) -> Skeleton:
        """Return the skeleton of shape parameters (B,); differentiable."""
        dirs = self.body.joint_shape_dirs
        joints = self.body.joints if dirs is None else self.body.joints + dirs @ betas
        return Skeleton(joints, self.body.parents)

    def in_shape(self, betas: Tensor, padding: Tensor) -> ShapedSurface:
        """Return the surface of one person at rest; differentiable.

        ``betas`` (B,) are shape parameters; ``padding`` (P,) m, by how much clothes and hair lie
        outside the skin.
        """
        means = self.discs.means + self.shape_dirs @ betas + padding[:, None] * self.normals
        return ShapedSurface(
            self.discs.replace(means=means), self.weights, self.skeleton(betas), self.pose_dirs
        )


@dataclass(frozen=True)
class ShapedSurface:
    """The surface of one person."""

    discs: Gaussians  # P at rest, m
    weights: Tensor  # (P, J) skinning weights
    skeleton: Skeleton
    pose_dirs: Tensor | None = None  # (9 (J - 1), 3 P) as of ``Surface``

    def in_pose(self, pose: BodyPose) -> Gaussians:
        """Return the discs in a pose, in the world; differentiable."""
        offsets = None
        if self.pose_dirs is not None:
            turned = pose.rotations[1:] - torch.eye(
                3, dtype=pose.rotations.dtype, device=pose.rotations.device
            )
            offsets = (turned.flatten() @ self.pose_dirs).unflatten(0, (-1, 3))
        return pose_gaussians(self.discs, self.weights, self.skeleton, pose, offsets)


def surface_of(body: BodyTemplate, resolution: int) -> Surface:
    """Return the surface of a template as the discs of an atlas of ``resolution`` texels a side."""
    texels = atlas_texels(body, resolution, body.vertices)
    discs, anchors = texel_gaussians(texels, [0.0], 0)
    ratios = anchors.size.new_tensor([_WIDTH, _WIDTH, _THICKNESS]).log()
    solid = torch.full_like(discs.logit_opacities, _OPACITY_LOGIT)
    around = body.faces[texels.faces]
    parts = texels.barycentric[..., None]
    pose_dirs = None
    if body.shape_dirs is None:
        shape_dirs = discs.means.new_zeros(len(discs), 3, 0)
    else:
        shape_dirs = (parts[..., None] * body.shape_dirs[around]).sum(1)
    if body.pose_dirs is not None:
        pose_dirs = (parts * body.pose_dirs.unflatten(1, (-1, 3))[:, around]).sum(2).flatten(1)
    return Surface(
        discs=discs.replace(
            means=discs.means - _INSET * anchors.size[:, None] * texels.normals,
            log_scales=anchors.size.log()[:, None] + ratios,
            logit_opacities=solid,
        ),
        normals=texels.normals,
        weights=skinning_weights(anchors, len(body.joints)),
        shape_dirs=shape_dirs,
        pose_dirs=pose_dirs,
        body=body,
    )


def drawn_silhouettes(discs: Gaussians, cameras: Cameras) -> Tensor:
    """Return coverage (V, H, W) in [0, 1] of posed discs in the images of V cameras;
    differentiable."""
    return render(discs, cameras, _OPTIONS, shader=_black).alpha


def _black(discs: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
    """Return the colours (V, P, 1) of discs of which only the coverage counts: one channel, without
    a gradient."""
    return discs.means.new_zeros(len(cameras), len(discs), 1)


_MARGIN = 1.25  # side of the square over the longest side of the person's box


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

    def __len__(self) -> int:
        return len(self.alpha)

    def part(self, turn: int, count: int) -> ObservedFrame:
        """Return ``count`` of the V views, far apart in their order; V turns show each as often.
        All if V <= count."""
        if len(self) <= count:
            return self
        rows = [(turn + i * len(self) // count) % len(self) for i in range(count)]
        picked = {
            name: x[rows]
            for name in ("alpha", "known", "joints")
            if (x := getattr(self, name)) is not None
        }
        cameras = self.cameras
        cameras = Cameras(
            cameras.cam_from_world[rows], cameras.intrinsics[rows], cameras.width, cameras.height
        )
        return replace(self, cameras=cameras, **picked)

    def shrunk(self, factor: int) -> ObservedFrame:
        """Return the squares with sides divided by ``factor``."""
        size = self.cameras.width // factor
        scale = self.cameras.intrinsics.new_tensor([1 / factor, 1 / factor, 1.0])
        cameras = Cameras(
            self.cameras.cam_from_world, scale[:, None] * self.cameras.intrinsics, size, size
        )
        known = (_resized(self.known, size) > 0.999).float()
        return ObservedFrame(
            cameras, _resized(self.alpha, size), known, self.joints, self.positions
        )


def longest_box_side(images: Iterable[Image]) -> int:
    """Return the longest side of the person's box in the images (with alpha), px; 0 if nobody is
    seen."""
    longest = 0
    for image in images:
        box = _box(image)
        longest = longest if box is None else max(longest, box[1] - box[0], box[3] - box[2])
    return longest


def observed_frame(
    images: Sequence[Image], box_side: int, size: int, marked: Mapping[str, Tensor] | None = None
) -> ObservedFrame | None:
    """Return the squares around the person in the images of one frame; None if no image shows
    anybody.

    ``box_side`` is the ``longest_box_side`` of all images, so that all squares have the same scale;
    ``size`` is S; ``marked`` are key points (55, 3) in pixels, by image.
    """
    side = max(round(_MARGIN * box_side), 1)
    squares = [
        square
        for image in images
        if (square := _square(image, side, size, marked or {})) is not None
    ]
    if not squares:
        return None
    poses, intrinsics, alphas, known, joints = (
        torch.cat(parts) for parts in zip(*squares, strict=True)
    )
    return ObservedFrame(
        Cameras(poses, intrinsics, size, size), alphas, known, joints if marked else None
    )


def _square(
    image: Image, side: int, size: int, marked: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None:
    """Return pose (1, 4, 4), intrinsics (1, 3, 3), alpha and known (1, S, S) and joints (1, 55, 3)
    of the square."""
    box = _box(image)
    if box is None or image.alpha is None:
        return None
    top, left = ((box[i] + box[i + 1] - side) // 2 for i in (0, 2))
    weights = torch.ones_like(image.alpha) if image.mask is None else image.mask
    shift = image.cameras.intrinsics.new_tensor(
        [[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]]
    )
    scale = image.cameras.intrinsics.new_tensor([size / side, size / side, 1.0])
    cut = [_resized(_cut(x, top, left, side)[None], size) for x in (image.alpha, weights)]
    intrinsics = scale[:, None] * (image.cameras.intrinsics - shift)
    joints = marked.get(image.name, torch.zeros(len(JOINT_NAMES), 3, device="cpu")).clone()
    joints[:, :2] = (joints[:, :2] - joints.new_tensor([left, top])) / side
    return image.cameras.cam_from_world, intrinsics, cut[0], (cut[1] > 0.999).float(), joints[None]


def _cut(values: Tensor, top: int, left: int, side: int) -> Tensor:
    height, width = values.shape
    square = values.new_zeros(side, side)
    rows = slice(max(top, 0), min(top + side, height))
    columns = slice(max(left, 0), min(left + side, width))
    square[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = values[
        rows, columns
    ]
    return square


def _resized(values: Tensor, size: int) -> Tensor:
    """Return values (V, S', S') averaged over the areas of the pixels of (V, size, size)."""
    return area_downscale(values.permute(1, 2, 0), size, size).permute(2, 0, 1).contiguous()


def _box(image: Image) -> tuple[int, int, int, int] | None:
    """Return first and last + 1 row, first and last + 1 column of the person; None if nobody is
    seen."""
    box = None if image.alpha is None else silhouette_box(image.alpha, 0.5)
    return None if box is None else (box[0].start, box[0].stop, box[1].start, box[1].stop)


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
        error = silhouette_error(drawn_silhouettes(body.in_pose(pose), frame.cameras), frame)
        if frame.joints is not None:
            joints = posed_joints(body.skeleton, pose)
            error = error + KEYPOINT_WEIGHT * keypoint_error(joints, frame.joints, frame.cameras)
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
    return drawn_silhouettes(discs, cameras)


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


NUM_HEADINGS = 8  # directions that a person may face, all of which are tried in every anchor
LIKELY = 3  # of these, nearest to the key points, that are tried where there are some
MOST_ANCHORS = 20  # frames in which headings are tried
CHANGE_WEIGHT = 0.01
"""Error that costs as much as a turn of 45 degrees from one anchor to the next; it grows with the
square."""


def likely_path(errors: Sequence[Sequence[float]], weight: float = CHANGE_WEIGHT) -> list[int]:
    """Return the heading (A,) of each anchor for which errors (A, H) and changes of heading cost
    least in all.

    Source: the algorithm of Viterbi, 1967.
    """
    costs = np.asarray(errors, dtype=np.float64)
    count = costs.shape[1]
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    change = weight * (np.minimum(apart, count - apart) * (8 / count)) ** 2
    total = costs[0]
    came_from = []
    for own in costs[1:]:
        ways = total[:, None] + change
        came_from.append(ways.argmin(0))
        total = ways.min(0) + own
    path = [int(total.argmin())]
    for back in reversed(came_from):
        path.append(int(back[path[-1]]))
    return path[::-1]


def roots_between(anchors: Sequence[int], roots: Tensor, count: int) -> Tensor:
    """Return rotations (count, 3) of the root, axis-angle, rad: those (A, 3) of the anchors, turned
    on between them.

    Before the first anchor and after the last one they stay.
    """
    if len(anchors) == 1:
        return roots.expand(count, 3).clone()
    between = Slerp(np.asarray(anchors, dtype=np.float64), Rotation.from_rotvec(roots.numpy()))
    rows = np.clip(np.arange(count, dtype=np.float64), anchors[0], anchors[-1])
    return torch.from_numpy(between(rows).as_rotvec()).to(roots)


def angle_between(a: Tensor, b: Tensor) -> float:
    """Return the angle, rad, of the rotation from ``a`` (3,) to ``b`` (3,), both axis-angle."""
    return float(
        (Rotation.from_rotvec(a.numpy()).inv() * Rotation.from_rotvec(b.numpy())).magnitude()
    )


STEPS = 40
"""Steps of Adam for each heading of an anchor, and, at each size, for each frame from the pose of
the one before."""
OFF_COURSE = math.radians(30)
"""Rotation of the root away from the path of headings from which a frame is begun on that path
instead."""
# headings of the first frame from which clips without key points are followed without the path, too
WITHOUT_PATH = 2
MOMENTUM = 0.8
"""Fraction of the last rotation that is expected again, so that legs which pass each other are not
exchanged."""
STATURE = 1.70  # height of a person in a usual pose, m, where a single camera leaves it open
PELVIS_FRACTION = 0.53  # height of the pelvis, of that of the person


def first_poses(
    times: Tensor,
    surface: Surface,
    observed: Observations,
    report: ReportProgress = report_nothing,
) -> MotionClip:
    """Return poses of a person in F frames, found in the silhouettes of ``observed`` (per row)
    alone.

    In some frames, the anchors, every heading is tried; a likely path through them says which way
    the person faces. Each frame starts from the pose of the one before, and where that has left the
    path from the path's heading. Without key points clips that never look at the path are compared
    with it. Raises ValueError: nobody in the first frame.
    """
    seen = observed(0)
    if seen is None:
        raise ValueError("nobody is seen in the first frame")
    standing = standing_clip(times, surface, observed)
    up = up_of(seen)
    count = len(times)
    anchors: list[int] = []
    tried: list[list[tuple[Tensor, Tensor, float]]] = []
    rows = evenly_spaced(count, MOST_ANCHORS)
    for number, row in enumerate(rows, 1):
        frame = observed(row)
        if frame is not None:
            anchors.append(row)
            tried.append(_all_headings(standing, row, up, surface, frame))
        report("headings", number, len(rows))
    path = likely_path([[error for _, _, error in own] for own in tried])
    along = torch.stack([own[heading][0][0] for own, heading in zip(tried, path, strict=True)])
    roots = roots_between(anchors, along, count)
    ways: list[tuple[int, Tensor | None]] = [(path[0], roots)]
    if seen.joints is None:  # outlines from two opposite sides are alike: the path may be wrong
        best = sorted(range(NUM_HEADINGS), key=lambda i: tried[0][i][2])
        ways += [(index, None) for index in best[:WITHOUT_PATH]]
    followed = []
    for number, (index, along) in enumerate(ways, 1):
        followed.append(_followed(standing, tried[0][index], along, surface, observed))
        report("first poses", number, len(ways))
    return min(followed, key=lambda found: found[1])[0]


def _followed(
    standing: MotionClip,
    first: tuple[Tensor, Tensor, float],
    roots: Tensor | None,
    surface: Surface,
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
        if roots is not None and angle_between(poses[row, 0], roots[row]) > OFF_COURSE:
            starts = [
                torch.cat([roots[row : row + 1], others[1:]])
                for others in (poses[row], standing.poses[row])
            ]
        found = [_found_from(standing, start, trans[row], row, surface, seen) for start in starts]
        poses[row], trans[row], error = min(found, key=lambda x: x[2])
        errors.append(error)
    return replace(standing, poses=poses, trans=trans), sum(errors) / max(len(errors), 1)


def _all_headings(
    clip: MotionClip, row: int, up: Tensor, surface: Surface, seen: ObservedFrame
) -> list[tuple[Tensor, Tensor, float]]:
    """Return pose, translation and error of a frame as found from each heading; after the first at
    half the size.

    With key points only the ``LIKELY`` headings are tried, and the error of others is infinite.
    """
    starts = [turned(clip, 2 * math.pi * i / NUM_HEADINGS, up) for i in range(NUM_HEADINGS)]
    errors = [_marked_error(start, row, surface, seen) for start in starts]
    likely = sorted(range(NUM_HEADINGS), key=errors.__getitem__)
    found = [(start.poses[row], start.trans[row], math.inf) for start in starts]
    levels = (2, 1) if row == 0 else (2,)
    for index in likely[: NUM_HEADINGS if seen.joints is None else LIKELY]:
        found[index] = _found_from(starts[index], *found[index][:2], row, surface, seen, levels)
    return found


@torch.no_grad()
def _marked_error(clip: MotionClip, row: int, surface: Surface, seen: ObservedFrame) -> float:
    """Return the error of the key points of a frame; 0 without any."""
    if seen.joints is None:
        return 0.0
    blank = new_fit(clip, surface)
    joints = posed_joints(surface.skeleton(blank["betas"]), frame_pose_of(blank, clip, row))
    return float(keypoint_error(joints, seen.joints, seen.cameras))


def standing_clip(times: Tensor, surface: Surface, observed: Observations) -> MotionClip:
    """Return the usual pose, upright, at the place and in the size of the silhouettes of each
    frame.

    Where nobody is seen, the place is that of the frame before.
    """
    joints = surface.body.joints
    up = torch.zeros(3, device="cpu")
    positions = []
    heights = []
    for row in range(len(times)):
        seen = observed(row)
        if seen is None:
            positions.append(positions[-1] if positions else torch.zeros(3, device="cpu"))
            continue
        up = up if up.any() else up_of(seen)
        place, height = place_and_height(seen, up)
        positions.append(place)
        heights += [] if height is None else [height]
    upright = Rotation.align_vectors(up[None].numpy(), np.array([[0.0, 1.0, 0.0]]))[0]
    poses = usual_pose(len(joints)).to(joints).repeat(len(times), 1, 1)
    poses[:, 0] = torch.from_numpy(upright.as_rotvec()).to(poses)
    scale = float(np.median(heights)) / STATURE if heights else 1.0
    trans = torch.stack(positions) - scale * joints[0]  # the root turns about the pelvis
    return MotionClip(times, poses, trans, torch.full((len(times),), scale, device="cpu"))


def up_of(seen: ObservedFrame) -> Tensor:
    """Return the unit vector (3,) that points up in the images, a mean over cameras."""
    up = -seen.cameras.cam_from_world[:, 1, :3].mean(0)
    return up / up.norm()


def place_and_height(seen: ObservedFrame, up: Tensor) -> tuple[Tensor, float | None]:
    """Return the place (3,) of the pelvis in the world and the height of the person, None if one
    camera sees them."""
    rays = [_ray(seen.cameras.select(i), seen.alpha[i]) for i in range(len(seen))]
    rays = [ray for ray in rays if ray is not None]
    if not rays:
        return torch.zeros(3, device="cpu"), None
    starts, directions, angles = (torch.stack(x) for x in zip(*rays, strict=True))
    if len(rays) == 1:
        middle = starts[0] + directions[0] * STATURE / angles[0]
        height = None
    else:
        across = torch.eye(3, device="cpu") - directions[:, :, None] * directions[:, None]
        middle = torch.linalg.lstsq(across.sum(0), (across @ starts[..., None]).sum(0)).solution[
            :, 0
        ]
        height = float((angles * (middle - starts).norm(dim=1)).median())
    return middle + up * (PELVIS_FRACTION - 0.5) * (height or STATURE), height


def turned(clip: MotionClip, angle: float, up: Tensor) -> MotionClip:
    """Return the clip with the person turned by ``angle``, rad, about ``up`` through the pelvis."""
    turn = Rotation.from_rotvec(angle * up.numpy()) * Rotation.from_rotvec(clip.poses[:, 0].numpy())
    poses = clip.poses.clone()
    poses[:, 0] = torch.from_numpy(turn.as_rotvec()).to(poses)
    return replace(clip, poses=poses)


def _ray(camera: Cameras, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
    """Return start and unit direction (3,) of the ray through the middle of a silhouette, and its
    height as an angle.

    The angle is the height over the distance, for a person who stands upright in the image. None if
    nobody is seen.
    """
    box = silhouette_box(alpha, 0.5)
    if box is None:
        return None
    (top, bottom), (left, right) = ((part.start, part.stop) for part in box)
    middle = torch.tensor([(left + right) / 2, (top + bottom) / 2, 1.0], device="cpu")
    intrinsics = camera.intrinsics[0]
    pose = camera.cam_from_world[0]
    local = torch.linalg.solve(intrinsics, middle)
    direction = pose[:3, :3].T @ local
    return (
        camera.centers[0],
        direction / direction.norm(),
        (bottom - top) / (intrinsics[1, 1] * local.norm()),
    )


def _found_from(
    clip: MotionClip,
    pose: Tensor,
    trans: Tensor,
    row: int,
    surface: Surface,
    seen: ObservedFrame,
    levels: tuple[int, ...] = (2, 1),
) -> tuple[Tensor, Tensor, float]:
    """Return pose (J, 3), translation and error of one frame, found from a start; unusual poses add
    to the error.

    ``levels`` are the factors by which what is seen is made smaller, one after the other.
    """
    one = MotionClip(clip.times[row : row + 1], pose[None], trans[None], clip.scale[row : row + 1])
    learned = new_fit(one, surface)
    fitting = Fitting(one, surface, usual(one))
    for level in levels:
        learned = fitting.run(learned, ("poses", "trans"), STEPS, InTurn({0: seen.shrunk(level)}))
    with torch.no_grad():
        error = float(
            mean_error(learned, one, surface, {0: seen}) + prior(learned, fitting.expected)
        )
    own = Rotation.from_rotvec(learned["poses"][0].detach().numpy())
    given = Rotation.from_rotvec(pose[:NUM_TURNED].numpy())
    found = pose.clone()
    found[:NUM_TURNED] = torch.from_numpy((given * own).as_rotvec()).to(found)
    return found, trans + learned["trans"][0].detach(), error


def _extrapolated(poses: Tensor, row: int) -> Tensor:
    """Return the pose (J, 3) expected in frame ``row``: that before it, turned on as it turned
    before.

    What was put on the path of headings was no motion.
    """
    if row < 2 or angle_between(poses[row - 2, 0], poses[row - 1, 0]) > OFF_COURSE:
        return poses[row - 1].clone()
    before, last = (Rotation.from_rotvec(x.numpy()) for x in (poses[row - 2], poses[row - 1]))
    on = Rotation.from_rotvec(MOMENTUM * (before.inv() * last).as_rotvec())
    return torch.from_numpy((last * on).as_rotvec()).to(poses)


IMAGE_SIDE = 512  # longest side of the images that are read, px
RESOLUTION = 48  # texels per side of the atlas whose discs are drawn
MOST_VIEWS = 8  # views of one frame that are looked at
GAIN, GAIN_OF_SHAPE = 0.01, 0.03
"""Gain of IoU for which more is learned, and for which given poses are touched at all.

Below the first, renders of new poses were worse by 0.1 to 0.3 dB on two people. A body of another
shape explains thick clothes, too: with exact poses it gained 0.02, and lost 2.7 dB in new poses.
"""
# most steps of Adam in which a clip is moved to its silhouettes: three numbers are learned
PLACING = 40
TRIAL, PROMISING = 4, 0.75
"""What is tried next is learned in the last of so many parts of its steps at first, when rates are
low, and in all of them where that gains this fraction of ``GAIN``. Where a limb is off, it gains
several times that."""
LONGER, HIGHER = 3, 0.3
"""Poses that were found frame by frame are off by more than given ones: they get so many times the
steps, at rates of 10 to this power times as much at first. Found in 20 frames of four people."""
MOST_OF_THE_BORDER = 0.6
"""Mean fraction of the outermost pixels of images beyond which a silhouette is that of the
background: people who are cut off on three sides cover less."""
SHAPE = ("log_scale", "betas", "padding", "offset", "shift")  # what is the same in all frames


@dataclass(frozen=True)
class FitEffort:
    """How much a fit may cost."""

    side: int = 128  # of the squares around the person that are looked at, px
    steps: int = 120  # least number of steps of Adam of a stage
    visits: int = 18  # how often a frame is drawn where its pose is learned

    def steps_for(self, clip: MotionClip) -> int:
        """Return the number of steps that draws every frame often enough."""
        return max(self.steps, -(-self.visits * len(clip) // FRAMES))


@dataclass(frozen=True)
class TriedFit:
    """One way to fit."""

    name: str  # for people
    learned: Parameters  # of the clip
    iou: float  # mean IoU of drawn and seen silhouettes
    per_frame: tuple[float, ...]  # (F,) the same, per frame


@dataclass(frozen=True)
class CaptureFit:
    """A fit of a capture's clip of training."""

    fit: BodyFit  # of the clip
    motion: CapturedMotion  # the given clip, F frames
    chosen: TriedFit  # the candidate that was taken
    tried: tuple[TriedFit, ...]  # all candidates; the first one has the poses as given
    # views left out of the fit, on which the candidates were measured; 0: measured on those fitted
    # to
    held_out: int


@dataclass(frozen=True)
class FitViews:
    """What is looked at, by row of the clip: frames to fit to, and frames to judge by."""

    used: dict[int, ObservedFrame | None]
    judged: dict[int, ObservedFrame | None]
    held_out: int

    def with_positions(self, positions: Mapping[int, Tensor]) -> FitViews:
        """Return the same with joints given in 3D, by row."""
        used = {
            row: None if frame is None else replace(frame, positions=positions.get(row))
            for row, frame in self.used.items()
        }
        return replace(self, used=used, judged=used if self.judged is self.used else self.judged)

    @cached_property
    def halves(self) -> dict[int, ObservedFrame | None]:
        """The frames to fit to at half the size."""
        return {row: None if frame is None else frame.shrunk(2) for row, frame in self.used.items()}


def fit_capture(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    report: ReportProgress,
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
            f"{capture.root}: the images have no silhouettes; add masks of the person (docs/human.md)"
        )
    capture = capture.replace(splits=numbered(capture.splits))
    views = capture.splits["train"]
    given = capture.body is not None
    motion = (
        _unposed(views, body.joints)
        if capture.body is None
        else captured_motion(capture.root, capture.body["train"], views, body.joints)
    )
    seen = look_at(capture, motion, options, effort, keypoints or {})
    surface = surface_of(body, RESOLUTION)
    shape = [
        name
        for name in SHAPE
        if not (name == "log_scale" and one_camera) and not (name == "betas" and shape_known)
    ]
    if joints is not None:
        seen = seen.with_positions(
            {row: joints[frame] for frame, row in motion.rows.items() if frame in joints}
        )
    if given:
        fitting = Fitting(motion.clip, surface, near_given(motion.clip))
        tried = _from_given(fitting, seen, shape, report, effort)
    else:
        clip = first_poses(motion.clip.times, surface, seen.used.__getitem__, report)
        motion = CapturedMotion(clip, motion.frames)
        fitting = Fitting(clip, surface, usual(clip))
        tried = _from_silhouettes(fitting, seen, shape, report, effort)
    first_gain = 0.0 if not given else GAIN if shape_known else GAIN_OF_SHAPE
    chosen = simplest_of_the_best(tried, first_gain)
    fit = body_fit(chosen.learned, len(body.joints))
    return CaptureFit(fit, motion, chosen, tried, seen.held_out)


def simplest_of_the_best(tried: Sequence[TriedFit], first_gain: float = GAIN_OF_SHAPE) -> TriedFit:
    """Return the candidate after which none is clearly better: ``tried`` is ordered from simple to
    complex.

    ``first_gain`` is the gain of IoU for which the first one is left: given poses are touched for
    much only.
    """
    best = tried[0]
    for candidate in tried[1:]:
        wanted = first_gain if best is tried[0] else GAIN
        best = candidate if candidate.iou > best.iou + wanted else best
    return best


def split_views(
    views: Sequence[View], motion: CapturedMotion
) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
    """Return, per row of the clip, the indices of the views to fit to, and of those left out to
    judge by.

    One view of each frame is left out, another one in each frame, where a frame has at least five.
    """
    rows = motion.rows
    by_row: dict[int, list[int]] = {row: [] for row in range(len(motion.clip))}
    for i, view in enumerate(views):
        by_row[rows[-1 if view.frame is None else view.frame]].append(i)
    used: dict[int, list[int]] = {}
    left_out: dict[int, list[int]] = {}
    for row, own in by_row.items():
        apart = own[row % len(own)] if len(own) >= 5 else -1
        rest = [i for i in own if i != apart]
        step = max(1, -(-len(rest) // MOST_VIEWS))
        used[row] = rest[row % step :: step]
        left_out[row] = [apart] if apart >= 0 else []
    return used, left_out


def _unposed(views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """Return a clip of the views' frames that says nothing about poses, for a body with ``joints``
    (J, 3)."""
    times = {-1 if view.frame is None else view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    last = max(len(frames) - 1, 1)
    moments = [
        row / last if times[frame] is None else times[frame] for row, frame in enumerate(frames)
    ]
    zeros = joints.new_zeros(len(frames), len(joints), 3)
    clip = MotionClip(
        torch.tensor(moments, dtype=torch.float64, device="cpu"),
        zeros,
        zeros[:, 0],
        torch.ones_like(zeros[:, 0, 0]),
    )
    return CapturedMotion(clip, frames)


def look_at(
    capture: Capture,
    motion: CapturedMotion,
    options: DataConfig,
    effort: FitEffort,
    keypoints: Keypoints,
) -> FitViews:
    """Return the squares around the person in all frames. Raises DyngsError: nobody is seen."""
    views = capture.splits["train"]
    images = ImageLoader(
        views, options.model_copy(update={"longest_side": IMAGE_SIDE, "downscale": 1})
    )
    used, left_out = split_views(views, motion)
    shown = [i for rows in (used, left_out) for own in rows.values() for i in own]
    if float(np.mean([_border_covered(images[i]) for i in shown])) > MOST_OF_THE_BORDER:
        raise DyngsError(
            f"{capture.root}: the silhouettes cover the borders of the images; white is the person: are the masks "
            "inverted? (docs/human.md)"
        )
    side = longest_box_side(images[i] for i in shown)
    if side < 8:
        raise DyngsError(
            f"{capture.root}: nobody is seen in the silhouettes; check the masks (docs/human.md)"
        )
    size = min(effort.side, 2 * (side // 2))
    marked = _marked(views, images, shown, keypoints)

    def frames(rows: dict[int, list[int]]) -> dict[int, ObservedFrame | None]:
        return {
            row: observed_frame([images[i] for i in own], side, size, marked)
            for row, own in rows.items()
        }

    held_out = sum(map(len, left_out.values()))
    seen = frames(used)
    return FitViews(seen, frames(left_out) if held_out else seen, held_out)


def _border_covered(image: Image) -> float:
    """Return the fraction of the image's outermost pixels that the silhouette covers."""
    if image.alpha is None:
        return 0.0
    inside = image.alpha > 0.5
    return float(
        torch.cat([inside[0], inside[-1], inside[1:-1, 0], inside[1:-1, -1]]).float().mean()
    )


def _marked(
    views: Sequence[View], images: ImageLoader, shown: Sequence[int], points: Keypoints
) -> Keypoints:
    """Return the key points (55, 3) in the pixels of the images, of those of the stored images."""
    found: Keypoints = {}
    for i in shown if points else ():
        view = views[i]
        if view.name in points:
            camera = images[i].cameras
            scale = points[view.name].new_tensor(
                [camera.width / view.width, camera.height / view.height, 1.0]
            )
            found[view.name] = points[view.name] * scale
    return found


def _from_given(
    fitting: Fitting,
    seen: FitViews,
    shared: Sequence[str],
    report: ReportProgress,
    effort: FitEffort,
) -> tuple[TriedFit, ...]:
    start = new_fit(fitting.clip, fitting.surface)
    tick = ticker("shape", report, 3 * effort.steps)
    half = InTurn(seen.halves)
    full = seen.used.__getitem__
    # Clothes and hair are no sign of wrong poses.
    dressed = fitting.run(start, ("padding",), effort.steps, half, tick)
    tried = [measured("the poses as given", dressed, fitting, seen)]
    shape = start
    for look in (half, full):
        shape = fitting.run(shape, shared, effort.steps, look, tick)
    tried.append(measured("one shape", shape, fitting, seen))
    more = (
        ("turns that are the same in all frames as well", (*shared, "turns"), effort.steps),
        (
            "turns of every frame as well",
            (*shared, "turns", "poses", "trans"),
            effort.steps_for(fitting.clip),
        ),
    )
    for name, learned, steps in more:
        few = -(-steps // TRIAL)
        tick = ticker("poses", report, few)
        found = fitting.run(tried[-1].learned, learned, few, full, tick, fallen=1 - 1 / TRIAL)
        candidate = measured(name, found, fitting, seen)
        if candidate.iou > max(x.iou for x in tried) + PROMISING * GAIN:
            found = fitting.run(found, learned, steps, full, ticker("poses", report, steps))
            candidate = max(candidate, measured(name, found, fitting, seen), key=lambda x: x.iou)
        tried.append(candidate)
    return tuple(tried)


def _from_silhouettes(
    fitting: Fitting,
    seen: FitViews,
    shape: Sequence[str],
    report: ReportProgress,
    effort: FitEffort,
) -> tuple[TriedFit, ...]:
    start = new_fit(fitting.clip, fitting.surface)
    steps = LONGER * effort.steps_for(fitting.clip)
    tick = ticker("shape", report, 2 * steps)
    found = start
    first = measured("poses found frame by frame", start, fitting, seen)
    for look in (seen.halves.__getitem__, seen.used.__getitem__):
        found = fitting.run(found, (*shape, "poses", "trans"), steps, look, tick, fallen=-HIGHER)
    return first, measured("one shape, and poses of every frame", found, fitting, seen)


def ticker(name: str, report: ReportProgress, total: int) -> Callable[[], None]:
    """Return a function that reports one more step of ``total``."""
    done = 0

    def tick() -> None:
        nonlocal done
        done += 1
        report(name, done, total)

    return tick


@torch.no_grad()
def measured(name: str, learned: Parameters, fitting: Fitting, seen: FitViews) -> TriedFit:
    """Return the candidate with its IoU in the frames that judge."""
    found = []
    for row, frame in seen.judged.items():
        found.append(torch.zeros(0, device="cpu"))
        if frame is not None:
            drawn = drawn_frame(learned, fitting.clip, fitting.surface, row, frame.cameras)
            ours = drawn > 0.5
            theirs = frame.alpha > 0.5
            known = frame.known > 0
            both = ours & theirs & known
            either = (ours | theirs) & known
            found[-1] = both.sum((1, 2)) / either.sum((1, 2)).clamp_min(1)
    per_frame = tuple(float(x.mean()) if len(x) else float("nan") for x in found)
    return TriedFit(name, learned, float(torch.cat(found).mean()), per_frame)


_CLEARLY = 0.001  # gain of IoU for which the clip is moved


@dataclass(frozen=True)
class NewClip:
    """Another clip of a fitted person."""

    motion: CapturedMotion  # its poses as given
    # (3,) to add to its translations, in the unit of the world, in place of that of the fit
    shift: Tensor
    iou: float  # with the shift of the fit
    iou_moved: float | None  # with that of the clip itself; None where that was not taken

    def summary(self) -> str:
        """Return a line for people."""
        if self.iou_moved is None:
            return f"new poses: at the place of the fit; overlap of silhouettes {self.iou:.3f}"
        return (
            f"new poses: moved to their silhouettes; overlap {self.iou:.3f} -> {self.iou_moved:.3f}"
        )


def placed_clip(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    found: CaptureFit,
    report: ReportProgress,
    effort: FitEffort = FitEffort(),
) -> NewClip | None:
    """Return the clip of ``pose`` moved to its silhouettes, if it looks better there; None without
    such a clip.

    All views of ``capture`` have frame numbers; ``found`` is the fit of those of training.
    """
    views = capture.splits.get("pose", ())
    if not views or capture.body is None:
        return None
    motion = captured_motion(capture.root, capture.body["pose"], views, body.joints)
    surface = surface_of(body, RESOLUTION)
    seen = look_at(capture.replace(splits={"train": views}), motion, options, effort, {})
    start = new_fit(motion.clip, surface)
    with torch.no_grad():
        for name, value in found.chosen.learned.values().items():
            if name not in ("poses", "trans"):
                start[name].copy_(value)
    name = "place of new poses"
    steps = min(effort.steps, PLACING)
    tick = ticker(name, report, steps)
    fitting = Fitting(motion.clip, surface, near_given(motion.clip))
    moved = fitting.run(start, ("shift",), steps, seen.used.__getitem__, tick)
    before, after = (measured(name, x, fitting, seen) for x in (start, moved))
    better = after.iou > before.iou + _CLEARLY
    shift = (moved if better else start)["shift"].detach()
    return NewClip(motion, shift, before.iou, after.iou if better else None)


def fitted_clips(
    capture: Capture, body: BodyTemplate, found: CaptureFit, new_poses: NewClip | None
) -> dict[Split, CapturedMotion]:
    """Return the clip of training, with the frames of val and test, and that of ``pose``, if the
    capture has one.

    Frames that were not fitted have what holds for all frames applied to their given poses; without
    given poses they lie between their neighbours. All views of ``capture`` have frame numbers;
    ``new_poses`` is the clip of ``pose``.
    """
    clips: dict[Split, CapturedMotion] = {"train": _of_training(capture, body, found)}
    if new_poses is not None:
        fit = replace(found.fit, shift=new_poses.shift)
        clips["pose"] = CapturedMotion(
            fit.applied(_expanded(new_poses.motion)), new_poses.motion.frames
        )
    return clips


def _of_training(capture: Capture, body: BodyTemplate, found: CaptureFit) -> CapturedMotion:
    fitted = replace(found.motion, clip=found.fit.fitted(found.motion.clip))
    known = _expanded(fitted)
    rows = fitted.rows
    views = [view for split in ("train", "val", "test") for view in capture.splits.get(split, ())]
    times = {-1 if view.frame is None else view.frame: view.time for view in views}
    frames = tuple(sorted(times))
    if capture.body is not None:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
        others = found.fit.applied(motion.clip)
        at = motion.rows
        parts = [
            known.select(_row(rows[f])) if f in rows else others.select(_row(at[f])) for f in frames
        ]
    else:
        parts = [
            known.select(_row(rows[f])) if f in rows else fitted.clip.at(times[f]) for f in frames
        ]
    tensors = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("times", "poses", "trans", "scale")
    }
    return CapturedMotion(MotionClip(**tensors), frames)


def _expanded(motion: CapturedMotion) -> MotionClip:
    """Return a clip with a row for every frame, also of who never moves."""
    rows = motion.rows
    return motion.clip.select(torch.tensor([rows[frame] for frame in motion.frames], device="cpu"))


def _row(row: int) -> torch.Tensor:
    return torch.tensor([row], device="cpu")
