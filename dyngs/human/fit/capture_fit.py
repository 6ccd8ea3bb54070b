"""Fit of a body template to silhouettes: rendering, optimisation, initial poses, and model
selection.

The body is rendered as disc-shaped Gaussians. Candidate fits are compared on held-out views.
Symbols: P discs, F frames, V views, J joints, B shape parameters, S pixels per side of a crop.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.conventions import ProgressCallback, RasterizeMode, ignore_progress
from dyngs.core.errors import DyngsError, quote_path
from dyngs.data.body_frames import assign_frame_numbers, frame_number
from dyngs.data.capture import Capture, Split, View
from dyngs.data.images.images import area_downscale
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image, ImageLoader
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
from dyngs.human.fit.skeleton_fit import (
    SkeletonModel,
    SkeletonTargets,
    fit_skeleton,
)
from dyngs.human.motion.motion import (
    CapturedMotion,
    MotionClip,
    captured_motion,
)

_OPTIONS = RenderOptions(nonfinite="trust", eps2d=0.1, mode=RasterizeMode.ANTIALIASED)


@dataclass(frozen=True)
class BodyDiscs:
    """Disc-shaped Gaussians on the texels of a template, with their blend shapes and skinning
    weights."""

    discs: Gaussians  # P in the rest pose, m
    skeleton: Skeleton  # in the rest pose, same shape
    normals: Tensor  # (P, 3) outward
    weights: Tensor  # (P, J) skinning weights
    shape_dirs: Tensor  # (P, 3, B) m per unit of the shape parameters
    joint_dirs: Tensor  # (J, 3, B) the same for joints
    # (9 (J - 1), 3 P) pose blend shapes, m per unit of the rotations minus the identity
    pose_dirs: Tensor | None

    def with_shape(self, betas: Tensor, padding: Tensor) -> BodyDiscs:
        """Apply shape parameters ``betas`` (B,) to the mean shape; differentiable.

        ``padding`` (P,) m moves discs outwards, for clothes and hair.
        """
        means = self.discs.means + self.shape_dirs @ betas + padding[:, None] * self.normals
        joints = self.skeleton.joints + self.joint_dirs @ betas
        skeleton = Skeleton(joints, self.skeleton.parents)
        return replace(self, discs=self.discs.replace(means=means), skeleton=skeleton)

    def in_pose(self, pose: BodyPose) -> Gaussians:
        """Return the posed discs in world coordinates; differentiable."""
        offsets = None
        if self.pose_dirs is not None:
            identity = torch.eye(3, dtype=pose.rotations.dtype, device=pose.rotations.device)
            features = pose.rotations[1:] - identity
            offsets = (features.flatten() @ self.pose_dirs).unflatten(0, (-1, 3))
        return pose_gaussians(self.discs, self.weights, self.skeleton, pose, offsets)


def body_discs(body: BodyTemplate, resolution: int) -> BodyDiscs:
    """Create discs on the texels of a mean-shape template, ``resolution`` texels per side."""
    texels = atlas_texels(body, resolution, body.vertices)
    discs, anchors = texel_gaussians(texels, [0.0], 0)
    # Standard deviations and depth below the skin (0.2), in texel sides, at which silhouettes have
    # the area of the mesh to 2 %. Wider discs cover more, narrower ones leave gaps.
    ratios = anchors.size.new_tensor([0.4, 0.4, 0.075]).log()
    corner_indices = body.faces[texels.faces]
    barycentric = texels.barycentric[..., None]
    shape_dirs = discs.means.new_zeros(len(discs), 3, 0)
    joint_dirs = body.joints.new_zeros(len(body.joints), 3, 0)
    if body.shape_dirs is not None and body.joint_shape_dirs is not None:
        shape_dirs = (barycentric[..., None] * body.shape_dirs[corner_indices]).sum(1)
        joint_dirs = body.joint_shape_dirs
    pose_dirs = None
    if body.pose_dirs is not None:
        pose_dirs = (
            (barycentric * body.pose_dirs.unflatten(1, (-1, 3))[:, corner_indices])
            .sum(2)
            .flatten(1)
        )
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
    """Render the coverage (V, H, W) in [0, 1] of posed discs for V cameras; differentiable."""

    def no_colour(discs: Gaussians, cameras: Cameras, radii: Tensor) -> Tensor:
        return discs.means.new_zeros(len(cameras), len(discs), 1)

    return render(discs, cameras, _OPTIONS, shader=no_colour).alpha


@dataclass(frozen=True)
class ObservedFrame:
    """Silhouettes of the person in the views of one frame, cropped to squares."""

    cameras: Cameras  # V, of S x S crops
    alpha: Tensor  # (V, S, S) float32 in [0, 1]: coverage by the person
    known: Tensor  # (V, S, S) float32, 1 inside the original image and its valid mask, else 0
    # (V, 55, 3) column and row, as fractions of S, and confidence of 2D key points
    joints: Tensor | None = None
    positions: Tensor | None = None  # (55, 4) world positions and confidence of 3D joints
    # (55, 4) joints relative to the hips, m, in world axes, and confidence; only directions count
    relative: Tensor | None = None

    @property
    def has_joints(self) -> bool:
        """Whether there are key points or joints besides the silhouettes."""
        return not (self.joints is None and self.positions is None and self.relative is None)

    def select_views(self, turn: int, count: int) -> ObservedFrame:
        """Return ``count`` evenly spaced views; V consecutive turns use each view equally often."""
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

    def downscale(self, factor: int) -> ObservedFrame:
        """Return the crops with sides divided by ``factor``."""
        cameras = self.cameras.scaled(1 / factor)
        alpha, known = (_resized(x, cameras.width) for x in (self.alpha, self.known))
        return replace(self, cameras=cameras, alpha=alpha, known=(known > 0.999).float())


def _resized(values: Tensor, size: int) -> Tensor:
    """Average square values (V, S', S') over pixel areas to (V, size, size)."""
    return area_downscale(values.permute(1, 2, 0), size, size).permute(2, 0, 1).contiguous()


def _box(image: Image) -> tuple[slice, slice] | None:
    """Return rows and columns of the person; None if the mask is empty."""
    return None if image.alpha is None else silhouette_box(image.alpha, 0.5)


def longest_box_side(images: Iterable[Image]) -> int:
    """Return the longest side of the person's bounding box over all images, px; 0 if all masks are
    empty."""
    longest = 0
    for image in images:
        for part in _box(image) or ():
            longest = max(longest, part.stop - part.start)
    return longest


def crop_frame(
    images: Sequence[Image],
    box_side: int,
    size: int,
    keypoints: Mapping[str, Tensor] | None = None,
    positions: Tensor | None = None,
) -> ObservedFrame | None:
    """Crop the images of one frame to squares around the person; None if all masks are empty.

    Args:
        images: of one frame.
        box_side: ``longest_box_side`` of all frames, so that all crops have the same scale.
        size: S, px.
        keypoints: (55, 3) by image name; columns and rows are fractions of width and height.
        positions: (55, 4) 3D joints.
    """
    side = max(round(1.25 * box_side), 1)
    crops = []
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
        if keypoints and image.name in keypoints:
            joints = keypoints[image.name].clone()
        joints[:, :2] = (joints[:, :2] * joints.new_tensor([width, height]) - corner) / side
        known = (known > 0.999).float()
        crops.append((image.cameras.cam_from_world, intrinsics, alpha, known, joints[None]))
    if not crops:
        return None
    poses, intrinsics, alpha, known, joints = (torch.cat(x) for x in zip(*crops, strict=True))
    cameras = Cameras(poses, intrinsics, size, size)
    return ObservedFrame(cameras, alpha, known, joints if keypoints else None, positions)


Observations = Callable[[int], ObservedFrame | None]
"""Returns the observed frame of a clip row; None if its masks are empty."""


def rotate_views(frames: Mapping[int, ObservedFrame]) -> Observations:
    """Return an ``Observations`` that uses three views per frame, the next three at each call."""
    turns = Counter[int]()

    def next_views(row: int) -> ObservedFrame | None:
        turns[row] += 1
        return frames[row].select_views(turns[row], 3) if row in frames else None

    return next_views


NUM_FITTED_JOINTS = 22
"""Joints whose rotations are fitted: those of the body, without fingers, jaw and eyes."""
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
"""Pose statistics of CMU motion capture: mean axis-angle vectors and standard deviations, degrees,
for joints of the left side and the middle; the right side is mirrored."""


def usual_pose_statistics(joints: int) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation (joints, 3) of usual poses, axis-angle, rad.

    The mean is zero for joints without statistics. Standard deviations are at least 8 degrees,
    because few clips do not show the range of a joint.
    """
    table = {}
    for line in _USUAL.split("\n")[1:-1]:
        name, *numbers = line.split()
        table[name] = torch.tensor([float(x) for x in numbers], device="cpu")
    degrees = torch.zeros(joints, 6, device="cpu")
    for row, name in enumerate(JOINT_NAMES[:joints]):
        values = table.get(name.removeprefix("left_").removeprefix("right_"))
        if values is not None:
            degrees[row] = values
            if name.startswith("right_"):
                degrees[row, 1:3] *= -1
    mean, spread = degrees.split(3, dim=1)
    return torch.deg2rad(mean), torch.deg2rad(spread.clamp_min(8.0))


@dataclass(frozen=True)
class PosePrior:
    """Prior of pose corrections over F frames, axis-angle, rad."""

    mean: Tensor  # (F, 22, 3)
    std: Tensor  # (22, 3)
    limit: float  # joint limit, in standard deviations


def pose_prior(clip: MotionClip, *, is_given: bool) -> PosePrior:
    """Return the prior: given poses with an error of 0.05 rad, or else usual poses.

    Rotations are added as vectors, which holds for small ones.
    """
    poses = clip.poses[:, :NUM_FITTED_JOINTS]
    if is_given:
        return PosePrior(torch.zeros_like(poses), torch.full_like(poses[0], 0.05), math.inf)
    mean, std = (x.to(poses) for x in usual_pose_statistics(NUM_FITTED_JOINTS))
    return PosePrior(mean - poses, std, 3.0)


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
"""Initial learning rates; they fall to a tenth."""
LIMIT_WEIGHT = 2e-2
"""Weight of the mean squared excess over joint limits, in standard deviations."""
JOINT_WEIGHT = 0.1  # of errors of key points and joints, relative to the silhouette error
OUTLIER_ERROR = 1.0
"""Relative squared silhouette error at which a mask counts as an outlier; good masks have 0.05 to
0.2."""
FRAMES_PER_STEP = 3


def silhouette_error(rendered: Tensor, observed: ObservedFrame) -> Tensor:
    """Return the mean over V views of e / (1 + e / ``OUTLIER_ERROR``), e the relative squared
    error.

    The robust form limits the influence of wrong masks (Geman and McClure 1987).
    """
    squared = ((rendered - observed.alpha) * observed.known).square().sum((1, 2))
    error = squared / (observed.alpha * observed.known).sum((1, 2)).clamp_min(1.0)
    return (error / (1 + error / OUTLIER_ERROR)).mean()


def skeleton_targets(
    frames: Mapping[int, ObservedFrame], num_frames: int, joints: int
) -> SkeletonTargets:
    """Return the key points and joints of observed frames, by row, for a body with ``joints``
    joints."""
    rows = list(SMPLX_ROWS[joints])
    indices: list[int] = []
    projections = []
    keypoints = []
    positions = torch.zeros(num_frames, len(rows), 4, device="cpu")
    relative = torch.zeros(num_frames, len(rows), 4, device="cpu")
    for row, frame in frames.items():
        intrinsics = frame.cameras.intrinsics.clone()
        intrinsics[:, :2] /= frame.cameras.width
        projections.append(intrinsics @ frame.cameras.cam_from_world[:, :3])
        seen = frame.joints
        if seen is None:
            seen = torch.zeros(len(intrinsics), len(JOINT_NAMES), 3, device="cpu")
        keypoints.append(seen[:, rows])
        indices += [row] * len(seen)
        if frame.positions is not None:
            positions[row] = frame.positions[rows]
        if frame.relative is not None:
            relative[row] = frame.relative[rows]
    return SkeletonTargets(
        torch.tensor(indices, device="cpu"),
        torch.cat(projections),
        torch.cat(keypoints),
        positions,
        relative,
    )


@dataclass(frozen=True)
class CandidateFit:
    """Result of one fitting variant."""

    name: str  # for messages
    learned: Parameters
    iou: float  # mean silhouette IoU
    per_frame: tuple[float, ...]  # (F,) IoU per frame; NaN where the masks are empty


@dataclass(frozen=True)
class BodyFit:
    """Optimisation problem: initial poses of F frames, the discs of the template, and a pose
    prior."""

    clip: MotionClip
    body: BodyDiscs
    prior: PosePrior

    def initial_parameters(self) -> Parameters:
        """Return the zero-initialised parameters of the fit.

        Returns:
            ``betas`` (B,) shape; ``log_scale`` (1,); ``turns`` (22, 3) axis-angle, rad, applied
            before the initial rotations in all frames; ``poses`` (F, 22, 3) the same per frame;
            ``shift`` (3,) added to all translations; ``offset`` (3,) m, in the frame of the
            pelvis; ``trans`` (F, 3) per frame; ``padding`` (P,) m between skin and silhouette.
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
        # Learning rates are per metre of the person, positions in world units.
        unit = float(self.clip.scale.mean())
        rates = _RATES | {name: _RATES[name] * unit for name in ("trans", "shift")}
        return Parameters(zeros, rates, 0.1)

    def pose(self, learned: Parameters, row: int) -> BodyPose:
        """Return the fitted pose of clip row ``row``."""
        correction = learned["turns"] + learned["poses"][row]
        initial = self.clip.rotations[row]
        rotated = initial[:NUM_FITTED_JOINTS] @ axis_angle_to_matrix(correction)
        scale = self.clip.scale[row] * learned["log_scale"][0].exp()
        translation = (
            learned["shift"] + learned["trans"][row] + scale * (rotated[0] @ learned["offset"])
        )
        rotations = torch.cat([rotated, initial[NUM_FITTED_JOINTS:]])
        return BodyPose(rotations, self.clip.trans[row] + translation, scale)

    def shaped(self, learned: Parameters) -> BodyDiscs:
        """Return the body in the fitted shape."""
        return self.body.with_shape(learned["betas"], learned["padding"])

    def silhouettes(self, learned: Parameters, row: int, cameras: Cameras) -> Tensor:
        """Render the silhouettes (V, H, W) of clip row ``row`` for V cameras."""
        return render_silhouettes(self.shaped(learned).in_pose(self.pose(learned, row)), cameras)

    def error(self, learned: Parameters, frames: Mapping[int, ObservedFrame]) -> Tensor:
        """Return the mean error of observed frames, by row: silhouettes, and 2D and 3D joints if
        given."""
        body = self.shaped(learned)
        errors = []
        for row, frame in frames.items():
            pose = self.pose(learned, row)
            error = silhouette_error(render_silhouettes(body.in_pose(pose), frame.cameras), frame)
            if frame.has_joints:
                joints = posed_joints(body.skeleton, pose)
                targets = skeleton_targets({0: frame}, 1, len(joints))
                joint_errors = targets.error(joints[None], float(pose.scale))
                error = error + JOINT_WEIGHT * joint_errors.squeeze()
            errors.append(error)
        return torch.stack(errors).mean()

    def penalty(self, learned: Parameters) -> Tensor:
        """Return the penalty of unlikely shapes and poses, and of fast pose changes.

        Silhouettes do not constrain all joints, such as a limb rotated about its axis. With much
        lower weights these follow the noise of Adam.
        """
        # The last directions of the free template are those of bones; SMPL has none.
        bones = learned["betas"].square().tensor_split([-NUM_BONE_SHAPES])
        total = learned["betas"].new_zeros(())
        for part in bones:
            total = total + (1e-3 * part.mean() if len(part) else 0.0)
        total = total + 3e-2 * (learned["turns"][1:] / 0.25).square().mean()
        deviations = (learned["poses"] - self.prior.mean) / self.prior.std
        total = total + 1e-3 * deviations[:, 1:].square().mean()
        excess = (deviations[:, 1:].abs() - self.prior.limit).clamp_min(0.0)
        total = total + LIMIT_WEIGHT * excess.square().mean()
        if len(self.clip) > 1:
            total = total + 1e-3 * (learned["poses"].diff(dim=0) / 0.1).square().mean()
        return total + 2e-3 * (learned["padding"] / 0.01).square().mean()

    def optimize(
        self,
        start: Parameters,
        learned: Sequence[str],
        steps: int,
        observed: Observations,
        on_progress: ProgressCallback = ignore_progress,
        schedule_start: float = 0.0,
        stage: str = "all parameters",
    ) -> Parameters:
        """Return ``start`` after ``steps`` of Adam on the parameters named in ``learned``.

        Frames are visited in a fixed order that covers the clip evenly. Learning rates start at
        fraction ``schedule_start`` of their schedule; a negative value gives higher rates.
        """
        # Updates are in place, and ``start`` may be chosen in the end: optimise a copy.
        copies = {name: x.clone() for name, x in start.values().items()}
        parameters = Parameters(copies, start.rates, start.decay)
        for name in copies:
            parameters[name].requires_grad_(name in learned)
        order = spread_order(len(self.clip))
        for step in range(1, steps + 1):
            rows = {
                order[((step - 1) * FRAMES_PER_STEP + i) % len(order)]
                for i in range(FRAMES_PER_STEP)
            }
            frames = {row: frame for row in sorted(rows) if (frame := observed(row)) is not None}
            loss = self.penalty(parameters)
            if frames:
                loss = loss + self.error(parameters, frames) * (len(frames) / len(rows))
            if loss.requires_grad:
                loss.backward()
            parameters.step(step, schedule_start + (1 - schedule_start) * step / steps)
            on_progress(f"body fit, {stage}", step, steps)
        return parameters

    @torch.no_grad()
    def evaluate(
        self, name: str, learned: Parameters, frames: Mapping[int, ObservedFrame]
    ) -> CandidateFit:
        """Return a candidate with its silhouette IoU in the given frames, by row."""
        ious = [torch.zeros(0, device="cpu")] * len(self.clip)
        for row, frame in frames.items():
            rendered = self.silhouettes(learned, row, frame.cameras) > 0.5
            observed = frame.alpha > 0.5
            known = frame.known > 0
            intersection = rendered & observed & known
            union = (rendered | observed) & known
            ious[row] = intersection.sum((1, 2)) / union.sum((1, 2)).clamp_min(1)
        per_frame = tuple(float(x.mean()) for x in ious)
        return CandidateFit(name, learned, float(torch.cat(ious).mean()), per_frame)


def spread_order(count: int) -> list[int]:
    """Return a permutation of 0 .. count - 1 whose every section is spread over the full range."""
    stride = max(1, round(count * 0.618))
    while count > 1 and math.gcd(stride, count) != 1:
        stride += 1
    return [(i * stride) % count for i in range(count)]


def apply_fit(learned: Parameters, clip: MotionClip, *, own_frames: bool) -> MotionClip:
    """Return a clip with fitted corrections: per-frame ones for the fitted clip (``own_frames``),
    only shared ones for another clip."""
    values = learned.values()
    padding = (0, 0, 0, clip.poses.shape[1] - NUM_FITTED_JOINTS)
    turns, poses = (torch.nn.functional.pad(values[name], padding) for name in ("turns", "poses"))
    shared = SharedCorrection(turns, float(values["log_scale"][0]))
    frames = (poses, values["trans"]) if own_frames else ()
    clip_with_rotations = corrected_clip(shared, clip, *frames)
    roots = axis_angle_to_matrix(clip_with_rotations.poses[:, 0])
    translation = (
        values["shift"]
        + clip_with_rotations.scale[:, None] * (roots @ values["offset"][:, None])[..., 0]
    )
    return replace(clip_with_rotations, trans=clip_with_rotations.trans + translation)


STATURE = 1.70  # assumed height of the person, m, for a single camera


def poses_from_key_points(
    times: Tensor,
    body: BodyDiscs,
    frames: Mapping[int, ObservedFrame],
    on_progress: ProgressCallback,
) -> tuple[MotionClip, Tensor]:
    """Estimate poses and shape parameters (B,) from the key points and joints of all frames."""
    first = frames[min(frames)]
    up = mean_up_direction(first)
    standing = standing_clip(times, body, up, frames.get)
    targets = skeleton_targets(frames, len(times), len(body.skeleton.joints))
    mean, std = usual_pose_statistics(NUM_FITTED_JOINTS)
    model = SkeletonModel(body.skeleton.joints, body.joint_dirs, body.skeleton.parents, mean, std)
    return fit_skeleton(standing, up, model, targets, on_progress)


def standing_clip(times: Tensor, body: BodyDiscs, up: Tensor, observed: Observations) -> MotionClip:
    """Return the usual pose, upright, at the position and in the size of the silhouettes of each
    frame.

    Frames with empty masks keep the previous position; ``up`` (3,) is a unit vector.
    """
    joints = body.skeleton.joints
    positions = [torch.zeros(3, device="cpu")]
    heights = []
    for row in range(len(times)):
        frame = observed(row)
        position, height = (positions[-1], None) if frame is None else locate_person(frame, up)
        positions.append(position)
        heights += [] if height is None else [height]
    upright = Rotation.align_vectors(up[None].numpy(), np.array([[0.0, 1.0, 0.0]]))[0]
    poses = usual_pose_statistics(len(joints))[0].to(joints).repeat(len(times), 1, 1)
    poses[:, 0] = torch.from_numpy(upright.as_rotvec()).to(poses)
    scale = float(np.median(heights)) / STATURE if heights else 1.0
    trans = torch.stack(positions[1:]) - scale * joints[0]  # the root rotates about the pelvis
    return MotionClip(times, poses, trans, torch.full((len(times),), scale, device="cpu"))


def mean_up_direction(frame: ObservedFrame) -> Tensor:
    """Return the mean up direction (3,) of the cameras, a unit vector."""
    up = -frame.cameras.cam_from_world[:, 1, :3].mean(0)
    return up / up.norm()


def locate_person(frame: ObservedFrame, up: Tensor) -> tuple[Tensor, float | None]:
    """Return the pelvis (3,) in world coordinates and the height of the person (None for one
    camera).

    The position is where the rays through the centres of the silhouettes meet.
    """
    boxes = [silhouette_box(alpha, 0.5) or silhouette_box(alpha) for alpha in frame.alpha]
    edges = [(r.start, r.stop, c.start, c.stop) for r, c in filter(None, boxes)]
    top, bottom, left, right = torch.tensor(edges, dtype=torch.float32, device="cpu").T
    middles = torch.stack([(left + right) / 2, (top + bottom) / 2, torch.ones_like(top)], dim=1)
    intrinsics = frame.cameras.intrinsics
    local = torch.linalg.solve(intrinsics, middles)
    # Height over distance of an upright person.
    angles = (bottom - top) / (intrinsics[:, 1, 1] * local.norm(dim=1))
    directions = (frame.cameras.cam_from_world[:, :3, :3].mT @ local[..., None])[..., 0]
    directions = torch.nn.functional.normalize(directions, dim=1)
    starts = frame.cameras.centers
    if len(starts) == 1:
        middle = starts[0] + directions[0] * STATURE / angles[0]
        height = None
    else:
        projections = torch.eye(3, device="cpu") - directions[:, :, None] * directions[:, None]
        right_side = (projections @ starts[..., None]).sum(0)
        middle = torch.linalg.lstsq(projections.sum(0), right_side).solution[:, 0]
        height = float((angles * (middle - starts).norm(dim=1)).median())
    # The pelvis is at 0.53 of the body height.
    return middle + up * (0.53 - 0.5) * (height or STATURE), height


RESOLUTION = 48  # texels per side of the discs
MIN_GAIN, MIN_SHAPE_GAIN = 0.01, 0.03
"""Least IoU gain for which a more complex fit is chosen, and for which given poses are changed.

The second is larger because a wrong shape can explain loose clothes and then gives worse new poses.
"""
SHARED_PARAMETERS = ("log_scale", "betas", "padding", "offset", "shift")  # same in all frames


@dataclass(frozen=True)
class FitEffort:
    """Computational cost of a fit."""

    side: int = 128  # of the crops around the person, px
    steps: int = 120  # minimum Adam steps per stage
    draws_per_frame: int = 18  # how often each frame is used when per-frame poses are fitted

    def steps_for(self, clip: MotionClip) -> int:
        """Return the number of steps that uses every frame often enough."""
        return max(self.steps, -(-self.draws_per_frame * len(clip) // FRAMES_PER_STEP))


@dataclass(frozen=True)
class CaptureFit:
    """Body fit of the training clip of a capture."""

    motion: CapturedMotion  # initial poses of F frames
    chosen: CandidateFit
    candidates: tuple[CandidateFit, ...]  # from simple to complex
    num_held_out: int  # views for the IoU of candidates; 0: measured on the fitted views

    @property
    def betas(self) -> Tensor:
        """Shape parameters (B,)."""
        return self.chosen.learned.values()["betas"]

    @property
    def clip(self) -> MotionClip:
        """The fitted clip."""
        return apply_fit(self.chosen.learned, self.motion.clip, own_frames=True)


def fit_capture(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    on_progress: ProgressCallback,
    keypoints: Keypoints | None = None,
    effort: FitEffort = FitEffort(),
    *,
    joints: Joints3D | None = None,
    relative_joints: Joints3D | None = None,
    one_camera: bool = False,
    shape_known: bool = False,
) -> CaptureFit:
    """Fit ``body`` to the silhouettes of a capture's training views.

    With given poses: first the shape, then rotations shared by all frames, then rotations per
    frame; each stage is kept only if it improves held-out views clearly. Without poses: these are
    estimated first from key points or joints (``poses_from_key_points``).

    Args:
        capture: with silhouettes.
        options: of reading images.
        body: template to fit.
        on_progress: progress callback.
        keypoints: 2D key points, by view.
        effort: computational cost.
        joints: 3D joints, by frame.
        relative_joints: 3D joints relative to the hips, m, by frame.
        one_camera: keep the size, which a single camera does not determine.
        shape_known: keep the shape of ``body``.

    Raises:
        DyngsError: no silhouettes, empty masks, or neither poses nor key points.
    """
    if capture.body is None and not keypoints and not joints:
        raise DyngsError(
            f"{capture.root}: has neither body parameters nor key points of the person; run `dyngs "
            f"data people {quote_path(capture.root)} OUT`, or give key points of another program "
            "(--keypoints, `dyngs docs people`)"
        )
    if not capture.has_alpha:
        raise DyngsError(
            f"{capture.root}: the images have no silhouettes; add masks of the person ("
            "`dyngs docs people`)"
        )
    capture = capture.replace(splits=assign_frame_numbers(capture.splits))
    views = capture.splits["train"]
    if capture.body is None:
        motion = _clip_without_poses(views, body.joints)
    else:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
    fit_views = crop_views(
        capture,
        motion,
        options,
        effort,
        keypoints or {},
        joints or {},
        relative_joints or {},
    )
    discs = body_discs(body, RESOLUTION)
    shape = list(SHARED_PARAMETERS)
    if one_camera:
        shape.remove("log_scale")
    if shape_known:
        shape.remove("betas")
    if capture.body is not None:
        body_fit = BodyFit(motion.clip, discs, pose_prior(motion.clip, is_given=True))
        candidates = _from_given(body_fit, fit_views, shape, on_progress, effort)
        first_gain = MIN_GAIN if shape_known else MIN_SHAPE_GAIN
    else:
        times = motion.clip.times
        clip, betas = poses_from_key_points(times, discs, fit_views.used, on_progress)
        motion = CapturedMotion(clip, motion.frames)
        body_fit = BodyFit(clip, discs, pose_prior(clip, is_given=False))
        start = None if shape_known else betas
        candidates = _from_silhouettes(body_fit, fit_views, shape, start, on_progress, effort)
        first_gain = 0.0
    return CaptureFit(
        motion, _choose_simplest(candidates, first_gain), candidates, fit_views.num_held_out
    )


def _choose_simplest(candidates: Sequence[CandidateFit], first_gain: float) -> CandidateFit:
    """Return the first candidate that no later one clearly improves on; they go from simple to
    complex.

    ``first_gain`` is the IoU gain needed to leave the first candidate.
    """
    best = candidates[0]
    for candidate in candidates[1:]:
        gain = first_gain if best is candidates[0] else MIN_GAIN
        best = candidate if candidate.iou > best.iou + gain else best
    return best


def _from_given(
    body_fit: BodyFit,
    fit_views: FitViews,
    shape: Sequence[str],
    on_progress: ProgressCallback,
    effort: FitEffort,
) -> tuple[CandidateFit, ...]:
    """Return candidate fits that start from given poses, from simple to complex."""
    start = body_fit.initial_parameters()
    halves = rotate_views(fit_views.halves())
    # Padding for clothes and hair, which silhouettes include, is fitted in any case.
    dressed = body_fit.optimize(
        start, ("padding",), effort.steps, halves, on_progress, stage="clothes"
    )
    candidates = [body_fit.evaluate("given poses", dressed, fit_views.evaluated)]
    parameters = start
    for stage, views in (("shape, small images", halves), ("shape", fit_views.used.get)):
        parameters = body_fit.optimize(
            parameters, shape, effort.steps, views, on_progress, stage=stage
        )
    candidates.append(body_fit.evaluate("shape", parameters, fit_views.evaluated))
    every_frame = (*shape, "turns", "poses", "trans")
    for name, learned, steps in (
        ("shape and shared rotations", (*shape, "turns"), effort.steps),
        ("shape and per-frame rotations", every_frame, effort.steps_for(body_fit.clip)),
    ):
        # A trial with the last quarter of the schedule decides whether to run all of it.
        parameters = body_fit.optimize(
            candidates[-1].learned,
            learned,
            -(-steps // 4),
            fit_views.used.get,
            on_progress,
            schedule_start=0.75,
            stage=f"{name}, trial",
        )
        candidate = body_fit.evaluate(name, parameters, fit_views.evaluated)
        if candidate.iou > max(x.iou for x in candidates) + 0.75 * MIN_GAIN:
            parameters = body_fit.optimize(
                parameters, learned, steps, fit_views.used.get, on_progress, stage=name
            )
            candidate = body_fit.evaluate(name, parameters, fit_views.evaluated)
        candidates.append(candidate)
    return tuple(candidates)


def _from_silhouettes(
    body_fit: BodyFit,
    fit_views: FitViews,
    shape: Sequence[str],
    betas: Tensor | None,
    on_progress: ProgressCallback,
    effort: FitEffort,
) -> tuple[CandidateFit, ...]:
    """Return candidate fits that start from estimated poses, and shape parameters (B,) if known.

    These are less accurate than given ones: they get three times the steps and higher initial
    rates.
    """
    parameters = body_fit.initial_parameters()
    if betas is not None:
        parameters["betas"].data.copy_(betas)
    first = body_fit.evaluate("frame-by-frame poses", parameters, fit_views.evaluated)
    learned = (*shape, "poses", "trans")
    steps = 3 * effort.steps_for(body_fit.clip)
    for stage, views in (
        ("shape and poses, small images", fit_views.halves().get),
        ("shape and poses", fit_views.used.get),
    ):
        parameters = body_fit.optimize(
            parameters, learned, steps, views, on_progress, schedule_start=-0.3, stage=stage
        )
    return first, body_fit.evaluate("shape and per-frame poses", parameters, fit_views.evaluated)


@dataclass(frozen=True)
class FitViews:
    """Observed frames by clip row: to fit to, and to evaluate on."""

    used: dict[int, ObservedFrame]
    evaluated: dict[int, ObservedFrame]
    num_held_out: int  # views in ``evaluated``; 0: the same as in ``used``

    def halves(self) -> dict[int, ObservedFrame]:
        """Return the frames to fit to at half the resolution."""
        return {row: frame.downscale(2) for row, frame in self.used.items()}


def split_views(
    views: Sequence[View], motion: CapturedMotion
) -> tuple[dict[int, list[int]], dict[int, list[int]]]:
    """Return, per clip row, at most eight view indices to fit to, and those held out for
    evaluation.

    Of frames with five or more views one is held out, in turn.
    """
    by_row: dict[int, list[int]] = {row: [] for row in range(len(motion.clip))}
    for i, view in enumerate(views):
        by_row[motion.rows[frame_number(view)]].append(i)
    used = {}
    held_out = {}
    for row, indices in by_row.items():
        held_out[row] = [indices[row % len(indices)]] if len(indices) >= 5 else []
        remaining = [i for i in indices if i not in held_out[row]]
        step = max(1, -(-len(remaining) // 8))
        used[row] = remaining[row % step :: step]
    return used, held_out


def _clip_without_poses(views: Sequence[View], joints: Tensor) -> CapturedMotion:
    """Return a clip of the views' frames with all poses zero, for a body with ``joints`` (J, 3)."""
    times = {frame_number(view): view.time for view in views}
    frames = tuple(sorted(times))
    spread_times = np.linspace(0, 1, len(frames)).tolist()
    clip_times = [
        start if times[frame] is None else times[frame]
        for frame, start in zip(frames, spread_times, strict=True)
    ]
    zeros = joints.new_zeros(len(frames), len(joints), 3)
    clip_times = torch.tensor(clip_times, dtype=torch.float64, device="cpu")
    return CapturedMotion(
        MotionClip(clip_times, zeros, zeros[:, 0], torch.ones_like(zeros[:, 0, 0])), frames
    )


def crop_views(
    capture: Capture,
    motion: CapturedMotion,
    options: DataConfig,
    effort: FitEffort,
    keypoints: Keypoints,
    joints: Joints3D,
    relative_joints: Joints3D,
) -> FitViews:
    """Crop all frames of ``motion`` to squares around the person.

    Raises DyngsError: the masks are empty or inverted.
    """
    views = capture.splits["train"]
    images = ImageLoader(views, options.model_copy(update={"longest_side": 512, "downscale": 1}))
    used, held_out = split_views(views, motion)
    indices = [i for rows in (used, held_out) for row_views in rows.values() for i in row_views]
    # Even a person cut off on three sides covers less of the image border.
    if float(np.mean([_border_covered(images[i]) for i in indices])) > 0.6:
        raise DyngsError(
            f"{capture.root}: the masks cover the image borders and seem to be inverted; the "
            "person must be white (`dyngs docs people`)"
        )
    side = longest_box_side(images[i] for i in indices)
    if side < 8:
        raise DyngsError(
            f"{capture.root}: the silhouettes are empty; check the masks (`dyngs docs people`)"
        )
    size = min(effort.side, 2 * (side // 2))
    relative_keypoints = {
        view.name: keypoints[view.name] / torch.tensor([view.width, view.height, 1], device="cpu")
        for view in views
        if view.name in keypoints
    }
    positions, relative = (
        {row: given[frame] for frame, row in motion.rows.items() if frame in given}
        for given in (joints, relative_joints)
    )

    def observed(rows: dict[int, list[int]]) -> dict[int, ObservedFrame]:
        frames = {
            row: crop_frame(
                [images[i] for i in row_views], side, size, relative_keypoints, positions.get(row)
            )
            for row, row_views in rows.items()
        }
        return {
            row: replace(frame, relative=relative.get(row))
            for row, frame in frames.items()
            if frame is not None
        }

    num_held_out = sum(map(len, held_out.values()))
    frames = observed(used)
    return FitViews(frames, observed(held_out) if num_held_out else frames, num_held_out)


def _border_covered(image: Image) -> float:
    """Return the fraction of the outermost pixels that the silhouette covers."""
    if image.alpha is None:
        return 0.0
    border = torch.ones_like(image.alpha, dtype=torch.bool)
    border[1:-1, 1:-1] = False
    return float((image.alpha[border] > 0.5).float().mean())


@dataclass(frozen=True)
class PlacedClip:
    """Poses of the split ``pose``, placed by the fit."""

    motion: CapturedMotion  # given poses with shared corrections, one row per frame
    iou: float  # with the translation of the fit
    iou_moved: float | None  # after fitting the translation to its own silhouettes; None: not used

    def summary(self) -> str:
        """Return a one-line summary."""
        if self.iou_moved is None:
            return f"new poses: silhouette IoU {self.iou:.3f}"
        return (
            f"new poses: translation fitted; silhouette IoU {self.iou:.3f} -> {self.iou_moved:.3f}"
        )


def place_new_poses(
    capture: Capture,
    options: DataConfig,
    body: BodyTemplate,
    fit: CaptureFit,
    on_progress: ProgressCallback,
    effort: FitEffort = FitEffort(),
) -> PlacedClip | None:
    """Fit the translation of the split ``pose`` to its silhouettes if that improves them.

    Returns None without such a split. All views need frame numbers; ``fit`` is that of the
    training clip.
    """
    views = capture.splits.get("pose", ())
    if not views or capture.body is None:
        return None
    motion = captured_motion(capture.root, capture.body["pose"], views, body.joints)
    fit_views = crop_views(
        capture.replace(splits={"train": views}), motion, options, effort, {}, {}, {}
    )
    body_fit = BodyFit(
        motion.clip, body_discs(body, RESOLUTION), pose_prior(motion.clip, is_given=True)
    )
    start = body_fit.initial_parameters()
    with torch.no_grad():
        for name in (*SHARED_PARAMETERS, "turns"):
            start[name].copy_(fit.chosen.learned[name])
    # Three parameters need few steps.
    moved = body_fit.optimize(
        start, ("shift",), min(effort.steps, 40), fit_views.used.get, on_progress, stage="new poses"
    )
    before, after = (body_fit.evaluate("", x, fit_views.evaluated) for x in (start, moved))
    is_better = after.iou > before.iou + 0.001
    clip = apply_fit(
        moved if is_better else start, motion.clip_of_frames(motion.frames), own_frames=False
    )
    return PlacedClip(replace(motion, clip=clip), before.iou, after.iou if is_better else None)


def collect_fitted_clips(
    capture: Capture, body: BodyTemplate, fit: CaptureFit, new_poses: PlacedClip | None
) -> dict[Split, CapturedMotion]:
    """Return the fitted clips by split: ``train`` (with the frames of val and test) and ``pose``,
    if present.

    Frames outside the fit get shared corrections on given poses, or interpolated poses without
    any. All views need frame numbers.
    """
    views = [view for split in ("train", "val", "test") for view in capture.splits.get(split, ())]
    times = {frame_number(view): view.time for view in views}
    frames = tuple(sorted(times))
    fitted = replace(fit.motion, clip=fit.clip)
    if capture.body is not None:
        motion = captured_motion(capture.root, capture.body["train"], views, body.joints)
        clip = apply_fit(fit.chosen.learned, motion.clip_of_frames(frames), own_frames=False)
    else:
        clip = MotionClip.joined([fitted.clip.at(times[frame]) for frame in frames])
    rows = [row for row, frame in enumerate(frames) if frame in fitted.rows]
    clip = clip.replace_rows(rows, fitted.clip_of_frames([frames[row] for row in rows]))
    clips: dict[Split, CapturedMotion] = {"train": CapturedMotion(clip, frames)}
    if new_poses is not None:
        clips["pose"] = new_poses.motion
    return clips
