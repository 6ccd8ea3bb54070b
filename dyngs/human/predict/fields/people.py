"""Captured people with their bodies and images, as networks that predict fields see them: in metres
of the body.

Local letters: V images of H x W pixels, J key points, M vertices, T triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.human.avatar.posing import BodyPose, frame_pose
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import rest_shape
from dyngs.human.body.skinning import apply_transforms, blend_transforms, joint_transforms
from dyngs.human.motion.motion import CapturedMotion, captured_motion
from dyngs.human.predict.gps.pairs import around
from dyngs.human.predict.gps.rectification import cropped

KEY_POINTS = 22
"""Joints that are key points: those of the body, which SMPL, SMPL-H and SMPL-X have in common."""
MULTIPLE = 8  # Sides of images are padded to multiples of so many pixels
MARGIN = 8  # px of background around a person
MISFIT = 0.25  # Of the size of a silhouette, how far its box may be from that of the body


@dataclass(frozen=True)
class Body:
    """A posed body in a world of metres."""

    key_points: Tensor  # (J, 3)
    vertices: Tensor  # (M, 3)
    faces: Tensor  # (T, 3) int64


@dataclass(frozen=True)
class Sources:
    """The images that a person is predicted from, cut around the silhouettes and padded to one
    size."""

    rgba: Tensor  # (V, 4, H, W), colours times alpha
    cam_from_world: Tensor  # (V, 4, 4), m
    intrinsics: Tensor  # (V, 3, 3), px

    def __len__(self) -> int:
        return len(self.rgba)

    @property
    def centers(self) -> Tensor:
        """(V, 3) camera centres, m."""
        rotation = self.cam_from_world[:, :3, :3]
        translation = self.cam_from_world[:, :3, 3]
        return -(rotation * translation[..., None]).sum(1)

    def camera(self, index: int) -> Cameras:
        height, width = self.rgba.shape[2:]
        return Cameras(
            self.cam_from_world[index][None], self.intrinsics[index][None], width, height
        )


@dataclass(frozen=True)
class Person:
    """One capture of a person."""

    name: str
    template: BodyTemplate  # in the person's shape
    motion: CapturedMotion
    images: ImageLoader
    _bodies: dict[int | None, tuple[Body, float]] = field(default_factory=dict)

    @property
    def views(self) -> tuple[View, ...]:
        return self.images.views

    def pose_in(self, view: View) -> BodyPose:
        return frame_pose(
            self.motion.clip, self.motion.rows[-1 if view.frame is None else view.frame]
        )

    def body_in(self, view: View) -> tuple[Body, float]:
        """Return the body in the pose of ``view``, and how many world units are a metre; kept."""
        if view.frame not in self._bodies:
            self._bodies[view.frame] = self._posed(view)
        return self._bodies[view.frame]

    def _posed(self, view: View) -> tuple[Body, float]:
        pose = self.pose_in(view)
        body = self.template
        vertices = body.vertices
        if body.pose_dirs is not None:
            features = (pose.rotations[1:] - torch.eye(3, device=vertices.device)).flatten()
            vertices = vertices + (features @ body.pose_dirs).unflatten(0, (-1, 3))
        moves = joint_transforms(body.joints, body.parents, pose.rotations)
        shift = pose.trans / pose.scale
        joints = apply_transforms(moves, body.joints)[:KEY_POINTS] + shift
        posed = apply_transforms(blend_transforms(body.weights, moves), vertices) + shift
        return Body(joints, posed, body.faces), float(pose.scale)


def person_of(data: DataConfig, template: BodyTemplate) -> Person:
    """Return the person of a capture.

    Raises DyngsError: no body parameters, no silhouettes, or a view without parameters.
    """
    capture = read_capture(data)
    if capture.body is None:
        raise DyngsError(
            f"{data.root}: has no body parameters, which say where the key points are; `dyngs data fit` finds them"
        )
    if not capture.has_alpha:
        raise DyngsError(
            f"{data.root}: the images have no silhouettes; give them alpha, see docs/human.md"
        )
    given = capture.body["train"]
    views = capture.splits["train"]
    vertices, joints = rest_shape(template, given)
    motion = captured_motion(capture.root, given, views, joints)
    return Person(
        name=capture.root.name,
        template=replace(template, vertices=vertices, joints=joints, **_NO_SHAPES),
        motion=motion,
        images=ImageLoader(views, data, with_maps=True),
    )


_NO_SHAPES = {
    "shape_dirs": None,
    "joint_shape_dirs": None,
    "expression_dirs": None,
    "joint_expression_dirs": None,
}


def metric(cameras: Cameras, scale: float) -> Cameras:
    """Return cameras of a world of which ``scale`` units are a metre in metres: they see the
    same."""
    pose = cameras.cam_from_world.clone()
    pose[:, :3, 3] /= scale
    return replace(cameras, cam_from_world=pose)


def sources_of(images: Sequence[Image], scale: float) -> Sources:
    """Return images of a world of which ``scale`` units are a metre."""
    parts = [cropped(image, MARGIN) for image in images]
    height, width = (
        -(-max(getattr(part.cameras, side) for part in parts) // MULTIPLE) * MULTIPLE
        for side in ("height", "width")
    )
    rgba = torch.zeros((len(parts), 4, height, width), device=parts[0].rgb_premultiplied.device)
    for own, part in zip(rgba, parts, strict=True):
        assert part.alpha is not None
        rows, columns = part.alpha.shape
        own[:3, :rows, :columns] = part.rgb_premultiplied.permute(2, 0, 1)
        own[3, :rows, :columns] = part.alpha
    cameras = [metric(part.cameras, scale) for part in parts]
    poses, intrinsics = (
        torch.cat([getattr(x, name) for x in cameras]).to(rgba)
        for name in ("cam_from_world", "intrinsics")
    )
    return Sources(rgba, poses, intrinsics)


def require_shown(name: str, image: Image, body: Body, scale: float) -> None:
    """Raise DyngsError, for the capture ``name``, unless an image shows a person where the body is
    (world units in m).

    The box of its silhouette must be that of the body, to ``MISFIT`` of its longer side: clothes
    and hair stand out less, and cameras that are wrong rarely do.
    """
    assert image.alpha is not None
    rows, columns = ((image.alpha > 0.5).any(side).nonzero()[:, 0] for side in (1, 0))
    if not len(rows):
        raise DyngsError(
            f"{name}: {image.name} shows no silhouette of a person; give its mask, or other views"
        )
    camera = metric(image.cameras.to(dtype=torch.float32), scale)
    local = body.vertices @ camera.cam_from_world[0, :3, :3].T + camera.cam_from_world[0, :3, 3]
    if bool((local[:, 2] <= 0).any()):
        raise DyngsError(
            f"{name}: the body lies behind the camera of {image.name}; its calibration or the body is wrong"
        )
    pixels = (local @ camera.intrinsics[0].T)[:, :2] / local[:, 2:]
    size = pixels.new_tensor([camera.width, camera.height])
    shown = torch.stack([torch.stack([x[0], x[-1] + 1]) for x in (columns, rows)], 1).to(pixels)
    apart = (shown - torch.stack([pixels.amin(0), pixels.amax(0)]).clamp_min(0).minimum(size)).abs()
    if float(apart.max()) > MISFIT * float((shown[1] - shown[0]).max()):
        raise DyngsError(
            f"{name}: {image.name} shows the person {float(apart.max()):.0f} px from where the body is by its camera; "
            "the calibration or the body is wrong"
        )


def window(image: Image, left: int, top: int, side: int) -> Image:
    """Return the square of ``side`` px of an image, with its camera and depth, that begins at a
    column and row.

    It is moved into the image, and is smaller only where the image is.
    """
    camera = image.cameras
    width = min(side, camera.width)
    height = min(side, camera.height)
    left = min(max(left, 0), camera.width - width)
    top = min(max(top, 0), camera.height - height)
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, 0, 2] -= left
    intrinsics[:, 1, 2] -= top

    def part(x: Tensor | None) -> Tensor | None:
        return None if x is None else x[top : top + height, left : left + width].contiguous()

    rgb = image.rgb_premultiplied[top : top + height, left : left + width].contiguous()
    return replace(
        image,
        cameras=Cameras(camera.cam_from_world, intrinsics, width, height),
        rgb_premultiplied=rgb,
        **{
            name: part(getattr(image, name))
            for name in ("alpha", "mask", "depth", "moves", "labels", "flow")
        },
    )


def moments(views: Sequence[View]) -> dict[tuple[int | None, float | None], list[int]]:
    """Return the views of each moment, in their order around the person."""
    found: dict[tuple[int | None, float | None], list[int]] = {}
    for i, view in enumerate(views):
        found.setdefault((view.frame, view.time), []).append(i)
    return {moment: around(views, own) for moment, own in found.items()}


def spread(ring: Sequence[int], count: int, first: int = 0) -> list[int]:
    """Return ``count`` of the views of a ring, evenly around it from the one at ``first`` on."""
    return [ring[(first + round(i * len(ring) / count)) % len(ring)] for i in range(count)]
