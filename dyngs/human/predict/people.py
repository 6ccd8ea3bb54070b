"""Captured people with their bodies and images, as networks see them: those that predict fields in
metres of the body.

Local letters: V images of H x W pixels, J key points, M vertices, T triangles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.human.avatar.posing import BodyPose, frame_pose
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import rest_shape
from dyngs.human.body.mesh import rasterize, vertex_normals
from dyngs.human.body.skinning import apply_transforms, blend_transforms, joint_transforms
from dyngs.human.motion.motion import CapturedMotion, captured_motion
from dyngs.human.predict.gps.rectification import crop_image, crop_to_person

NUM_KEY_POINTS = 22
"""Joints that are key points: those of the body, which SMPL, SMPL-H and SMPL-X have in common."""
MULTIPLE = 8  # Sides of images are padded to multiples of so many pixels
MARGIN = 8  # px of background around a person


@dataclass(frozen=True)
class PosedBody:
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
    body: BodyTemplate  # the template in the person's shape, without a shape space
    motion: CapturedMotion
    images: ImageLoader
    _bodies: dict[int | None, tuple[PosedBody, float]] = field(default_factory=dict)

    @property
    def views(self) -> tuple[View, ...]:
        return self.images.views

    def pose_in(self, view: View) -> BodyPose:
        row = self.motion.rows[-1 if view.frame is None else view.frame]
        return frame_pose(self.motion.clip, row)

    def posed(self, vertices: Tensor, pose: BodyPose) -> tuple[Tensor, Tensor]:
        """Return ``vertices`` (M, 3) at rest, and the joints (J, 3), in a pose before scale and
        translation."""
        body = self.body
        if body.pose_dirs is not None:
            features = (pose.rotations[1:] - torch.eye(3, device=vertices.device)).flatten()
            vertices = vertices + (features @ body.pose_dirs).unflatten(0, (-1, 3))
        moves = joint_transforms(body.joints, body.parents, pose.rotations)
        posed = apply_transforms(blend_transforms(body.weights, moves), vertices)
        return posed, apply_transforms(moves, body.joints)

    def body_in(self, view: View) -> tuple[PosedBody, float]:
        """Return the body in the pose of ``view``, and how many world units are a metre; kept."""
        if view.frame not in self._bodies:
            pose = self.pose_in(view)
            vertices, joints = self.posed(self.body.vertices, pose)
            shift = pose.trans / pose.scale
            body = PosedBody(joints[:NUM_KEY_POINTS] + shift, vertices + shift, self.body.faces)
            self._bodies[view.frame] = body, float(pose.scale)
        return self._bodies[view.frame]


def captured_person(capture: Capture, template: BodyTemplate, images: ImageLoader) -> Person:
    """Return the person of a capture with its ``images``.

    Raises DyngsError: no body parameters, no silhouettes, or a view without parameters.
    """
    if capture.body is None or not capture.has_alpha:
        missing = "silhouettes" if capture.body is not None else "body parameters"
        raise DyngsError(
            f"{capture.root}: has no {missing}, which a prediction needs; see `dyngs docs people`"
        )
    given = capture.body["train"]
    vertices, joints = rest_shape(template, given)
    body = replace(
        template,
        vertices=vertices,
        joints=joints,
        shape_dirs=None,
        joint_shape_dirs=None,
    )
    motion = captured_motion(capture.root, given, capture.splits["train"], joints)
    return Person(capture.root.name, body, motion, images)


def read_captured_person(data: DataConfig, template: BodyTemplate) -> Person:
    """Return the person of a capture with depth maps; see ``person_in``."""
    capture = read_capture(data)
    return captured_person(
        capture, template, ImageLoader(capture.splits["train"], data, with_maps=True)
    )


def metric(cameras: Cameras, scale: float) -> Cameras:
    """Return cameras of a world of which ``scale`` units are a metre in metres: they see the
    same."""
    pose = cameras.cam_from_world.clone()
    pose[:, :3, 3] /= scale
    return replace(cameras, cam_from_world=pose)


def crop_source_images(images: Sequence[Image], scale: float) -> Sources:
    """Return images of a world of which ``scale`` units are a metre."""
    parts = [crop_to_person(image, MARGIN) for image in images]
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
    return crop_image(image, top, left, height, width)


DILATION, EROSION = 0.06, 0.04  # How far the copies are from the mesh, m
_NEAREST = 0.05  # Least depth of what is drawn, m


class BodyBoundaries:
    """The meshes of a body, and of a dilated and an eroded copy."""

    def __init__(self, body: PosedBody) -> None:
        self._faces = body.faces.cpu().numpy()
        self._body = body.vertices.cpu().numpy().astype(np.float64)
        self._normals = vertex_normals(self._body, self._faces)
        self._tree = KDTree(self._body)

    def height(self, points: Tensor) -> Tensor:
        """Return how far points (N, 3) are from the nearest vertex of the body, m; negative
        inside."""
        places = points.detach().cpu().double().numpy()
        distance, nearest = (np.asarray(x) for x in self._tree.query(places))
        inside = ((places - self._body[nearest]) * self._normals[nearest]).sum(1) < 0
        return torch.from_numpy(np.where(inside, -distance, distance)).to(points)

    def depth(self, camera: Cameras) -> Tensor:
        """Return depths (H, W) of the body, m, infinite beside it."""
        return depths(self._body, self._faces, camera)

    def interval(self, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
        """Return where the rays of one camera may meet the person, as depths (H, W) in m; infinite
        where they do not.

        Where they come in; where they are surely inside, or come out; where they meet the body.
        """
        outer = self._body + DILATION * self._normals
        inner = self._body - EROSION * self._normals
        begin = depths(outer, self._faces, camera)
        out = depths(outer, self._faces, camera, last=True)
        # what is thinner than the copy is eroded is turned inside out: its back faces lie before
        # its front, and where there are cavities (mouth, eyes) and between fingers even front faces
        # do; nobody is inside before the body
        surely = depths(inner, self._faces, camera, front_faces=True)
        met = self.depth(camera)
        inside = torch.minimum(torch.maximum(surely, met + EROSION / 2), out)
        end = torch.where(met.isfinite(), inside, out)
        return begin, torch.maximum(end, begin), met


def depths(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Cameras,
    *,
    last: bool = False,
    front_faces: bool = False,
) -> Tensor:
    """Return depths (H, W) at pixel centres where rays meet a mesh first, m, or ``last``; infinite
    beside it.

    ``vertices`` (M, 3), ``faces`` (T, 3) anticlockwise from outside. ``front_faces``: of those
    alone.
    """
    pose, k = (x[0].double().cpu().numpy() for x in (camera.cam_from_world, camera.intrinsics))
    local = vertices @ pose[:3, :3].T + pose[:3, 3]
    inverse = 1 / np.maximum(local[:, 2], _NEAREST)
    pixels = (local @ k.T)[:, :2] * inverse[:, None] - 0.5
    most = 1.01 / _NEAREST
    corners = np.concatenate([pixels, (most - inverse if last else inverse)[:, None]], axis=1)
    corners = corners[faces]
    hidden = (local[faces, 2] <= _NEAREST).any(axis=1)
    if front_faces:
        (x0, x1, x2), (y0, y1, y2) = corners[..., 0].T, corners[..., 1].T
        hidden |= (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0) >= 0  # rows go down
    corners = corners[~hidden]
    found = rasterize(corners, camera.width, camera.height)
    # linear in the image
    nearness = 1 / (found.barycentric / corners[found.faces, :, 2]).sum(axis=1)
    image = np.full(camera.height * camera.width, np.inf)
    image[found.index] = 1 / (most - nearness if last else nearness)
    shape = camera.height, camera.width
    return torch.from_numpy(image.reshape(shape)).to(camera.intrinsics)
