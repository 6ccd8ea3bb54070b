"""Silhouettes of a body in any shape and pose, as the rasterizer draws discs on its surface, and
those of images.

Local letters: P discs, B shape parameters, V views of one frame, S side of a square in pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import RasterizeMode
from dyngs.data.images.images import area_downscale
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.human.avatar.anchors import skinning_weights, texel_gaussians
from dyngs.human.avatar.posing import BodyPose, Skeleton, pose_gaussians
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES

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
