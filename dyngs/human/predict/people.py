"""Captured people with bodies and images, as inputs of prediction networks.

Symbols: V images of H x W pixels, J key points, M vertices, T triangles, N points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import torch
from scipy.ndimage import maximum_filter
from scipy.spatial import KDTree
from torch import Tensor, get_num_threads
from torch.nn.functional import grid_sample, pad

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import move_fields_to
from dyngs.data.capture import Capture, View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.human.avatar.posing import BodyPose, frame_pose
from dyngs.human.body.body import BodyTemplate, skin
from dyngs.human.body.body_reader import rest_shape
from dyngs.human.body.mesh import vertex_normals
from dyngs.human.motion.motion import CapturedMotion, captured_motion
from dyngs.ops.device import CPU
from dyngs.ops.patches import visible_patches

NUM_KEY_POINTS = 22
"""Body joints that SMPL, SMPL-H and SMPL-X have in common."""
MULTIPLE = 8  # image sides are padded to multiples of this, px
MARGIN = 8  # background around a person, px


DILATION, EROSION = 0.06, 0.04  # distances of the boundary meshes from the body, m
_NEAREST = 0.05  # near plane of depth maps, m
_CELL = 0.02  # of the grid of heights, m


@dataclass(frozen=True)
class PosedBody:
    """Posed body, m; a dilated and an eroded copy bound the clothed surface."""

    key_points: Tensor  # (J, 3)
    vertices: Tensor  # (M, 3)
    faces: Tensor  # (T, 3) int64

    @cached_property
    def _normals(self) -> Tensor:
        return mesh_normals(self.vertices, self.faces)

    @cached_property
    def _heights(self) -> tuple[Tensor, Tensor, Tensor]:
        """Heights (1, 1, x, y, z) at the centres of a grid of cells, its least corner (3,) and its
        size (3,)."""
        vertices = self.vertices.double().cpu().numpy()
        reach = DILATION + _CELL
        low = vertices.min(axis=0) - reach
        size = np.ceil((vertices.max(axis=0) + reach - low) / _CELL).astype(int)
        occupied = np.zeros(size, dtype=bool)
        occupied[tuple(((vertices - low) / _CELL).astype(int).T)] = True
        # Most cells are far from the body; leaving them out takes a third of the time.
        cells = np.argwhere(maximum_filter(occupied, 2 * round(reach / _CELL) + 1))
        centres = low + _CELL * (cells + 0.5)
        search = KDTree(vertices).query
        distance, nearest = search(centres, distance_upper_bound=reach, workers=get_num_threads())
        nearest = np.minimum(nearest, len(vertices) - 1)  # of cells out of reach
        outward = (centres - vertices[nearest]) * self._normals.double().cpu().numpy()[nearest]
        signed = np.copysign(distance, outward.sum(-1))
        heights = np.full(size, reach)
        heights[tuple(cells.T)] = np.where(distance < reach, signed, reach)
        grid, low, size = (
            torch.from_numpy(x).to(self.vertices) for x in (heights, low, _CELL * size)
        )
        return grid[None, None], low, size

    def height(self, points: Tensor) -> Tensor:
        """Return the signed distance (N,) of points (N, 3) to the nearest vertex, m; negative
        inside.

        Interpolated in a grid of 2 cm cells, and at most 8 cm.
        """
        heights, low, size = self._heights
        at = (2 * (points - low) / size - 1).flip(-1)  # the last axis of the grid comes first
        at = at[None, None, None]
        return grid_sample(heights, at, padding_mode="border", align_corners=False).flatten()

    def depth(self, camera: Cameras) -> Tensor:
        """Return the depth map (H, W) of the body, m; infinite in the background."""
        return depths(self.vertices, self.faces, camera)

    def interval(self, camera: Cameras) -> Tensor:
        """Return where the rays of a camera may hit the clothed surface, as depth maps (3, H, W),
        m.

        The first depth is the entry into the dilated mesh; the last is the eroded mesh or the exit
        of the dilated mesh; the third is the body. Infinite where rays miss.
        """
        outer = self.vertices + DILATION * self._normals
        inner = self.vertices - EROSION * self._normals
        entry = depths(outer, self.faces, camera)
        exit_depth = depths(outer, self.faces, camera, last=True)
        # Parts thinner than the erosion turn inside out, so that faces of the eroded mesh may lie
        # in front of the body; depths before the body are therefore raised.
        eroded = depths(inner, self.faces, camera, front_faces=True)
        body_depth = self.depth(camera)
        end = torch.minimum(torch.maximum(eroded, body_depth + EROSION / 2), exit_depth)
        return torch.stack([entry, torch.maximum(end, entry), body_depth])


@dataclass(frozen=True)
class Sources:
    """Input images of a prediction, cropped to the person and padded to one size; V of them."""

    rgba: Tensor  # (V, 4, H, W), premultiplied alpha
    cam_from_world: Tensor  # (V, 4, 4), m
    intrinsics: Tensor  # (V, 3, 3), px

    @property
    def cameras(self) -> Cameras:
        """The V cameras, in metres."""
        return Cameras(self.cam_from_world, self.intrinsics, *self.rgba.shape[:1:-1])


@dataclass(frozen=True)
class Person:
    """Person of one capture: body, motion and images."""

    name: str
    body: BodyTemplate  # in the person's shape, without a shape space
    motion: CapturedMotion
    images: ImageLoader
    _bodies: dict[Any, tuple[PosedBody, float]] = field(default_factory=dict)

    @property
    def views(self) -> tuple[View, ...]:
        return self.images.views

    def pose_in(self, view: View | Image) -> BodyPose:
        row = self.motion.rows[-1 if view.frame is None else view.frame]
        return frame_pose(self.motion.clip, row)

    def body_in(self, view: View, device: torch.device = CPU) -> tuple[PosedBody, float]:
        """Return the body in the pose of ``view``, and the world units per metre; cached."""
        key = view.frame, device
        if key not in self._bodies:
            pose = self.pose_in(view)
            body = self.body
            vertices, joints = skin(body, body.vertices, body.joints, pose.rotations)
            shift = pose.trans / pose.scale
            posed = PosedBody(joints[:NUM_KEY_POINTS] + shift, vertices + shift, body.faces)
            self._bodies[key] = move_fields_to(posed, device), float(pose.scale)
        return self._bodies[key]


def captured_person(capture: Capture, template: BodyTemplate, images: ImageLoader) -> Person:
    """Return the person of a capture with its ``images``.

    Raises DyngsError: no body parameters, no silhouettes, or a view without body parameters.
    """
    if capture.body is None or not capture.has_alpha:
        missing = "silhouettes" if capture.body is not None else "body parameters"
        raise DyngsError(
            f"{capture.root}: no {missing}, which predictions need; see `dyngs docs people`"
        )
    body_frames = capture.body["train"]
    vertices, joints = rest_shape(template, body_frames)
    body = replace(
        template,
        vertices=vertices,
        joints=joints,
        shape_dirs=None,
        joint_shape_dirs=None,
    )
    motion = captured_motion(capture.root, body_frames, capture.splits["train"], joints)
    return Person(capture.root.name, body, motion, images)


def read_captured_person(data: DataConfig, template: BodyTemplate) -> Person:
    """Read the person of a capture with depth maps; see ``captured_person``."""
    capture = read_capture(data)
    return captured_person(
        capture, template, ImageLoader(capture.splits["train"], data, with_maps=True)
    )


def cameras_in_metres(cameras: Cameras, scale: float) -> Cameras:
    """Convert cameras of a world with ``scale`` units per metre to metres."""
    pose = cameras.cam_from_world.clone()
    pose[:, :3, 3] /= scale
    return replace(cameras, cam_from_world=pose)


def crop_source_images(images: Sequence[Image], scale: float) -> Sources:
    """Crop images to the person, in a world with ``scale`` units per metre, and pad them to one
    size."""
    crops = [crop_to_person(image, MARGIN) for image in images]
    cameras = [cameras_in_metres(crop.cameras, scale) for crop in crops]
    width = _padded(max(camera.width for camera in cameras))
    height = _padded(max(camera.height for camera in cameras))
    rgba = [
        pad(image_planes(crop), (0, width - camera.width, 0, height - camera.height))
        for crop, camera in zip(crops, cameras, strict=True)
    ]
    return Sources(
        torch.stack(rgba),
        torch.cat([x.cam_from_world for x in cameras]),
        torch.cat([x.intrinsics for x in cameras]),
    )


def _padded(side: int) -> int:
    return -(-side // MULTIPLE) * MULTIPLE


def crop_to_person(image: Image, margin: int) -> Image:
    """Crop an image to its visible part plus ``margin`` px, with its camera."""
    visible = (image_planes(image)[3] > 0).nonzero()
    if not len(visible):
        return image
    top, left = (visible.amin(0) - margin).clamp_min(0).tolist()
    bottom, right = (visible.amax(0) + 1 + margin).tolist()
    return crop_image(image, top, left, bottom - top, right - left)


def crop_image(image: Image, top: int, left: int, height: int, width: int) -> Image:
    """Crop an image at a row and column, with its camera and maps; smaller where the image ends."""
    tensors: Any = {
        name: x[top : top + height, left : left + width].contiguous()
        for name, x in image.tensors().items()
    }
    camera = image.cameras
    intrinsics = camera.intrinsics.clone()
    intrinsics[:, :2, 2] -= intrinsics.new_tensor([left, top])
    height, width = tensors["rgb_premultiplied"].shape[:2]
    cameras = Cameras(camera.cam_from_world, intrinsics, width, height)
    return replace(image, cameras=cameras, **tensors)


def crop_window(image: Image, left: int, top: int, side: int) -> Image:
    """Crop a square of ``side`` px at a column and row, with camera and depth.

    The square is shifted to lie inside the image, and smaller only if the image is.
    """
    left = max(min(left, image.cameras.width - side), 0)
    top = max(min(top, image.cameras.height - side), 0)
    return crop_image(image, top, left, side, side)


def image_planes(image: Image) -> Tensor:
    """Return premultiplied colours and alpha (4, H, W); alpha is 1 in images without it."""
    alpha = image.alpha
    if alpha is None:
        alpha = torch.ones_like(image.rgb_premultiplied[..., 0])
    return torch.cat([image.rgb_premultiplied, alpha[..., None]], dim=-1).permute(2, 0, 1)


def sample_maps(
    maps: Tensor, grid: Tensor, mode: str = "bilinear", outside: str = "zeros"
) -> Tensor:
    """Sample maps (V, D, h, w) at positions (V, M, 2) in [-1, 1]; return (V, M, D).

    ``outside`` is the padding mode of ``grid_sample``.
    """
    return grid_sample(maps, grid[:, None], mode, outside, align_corners=False)[:, :, 0].mT


def mesh_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return unit vertex normals (M, 3), computed in float64."""
    normals = vertex_normals(vertices.double().cpu().numpy(), faces.cpu().numpy())
    return torch.from_numpy(normals).to(vertices)


@torch.no_grad()
def depths(
    vertices: Tensor,
    faces: Tensor,
    camera: Cameras,
    *,
    last: bool = False,
    front_faces: bool = False,
) -> Tensor:
    """Return the depth map (H, W) of a mesh at pixel centres, m; infinite in the background.

    Args:
        vertices: (M, 3).
        faces: (T, 3), counter-clockwise from outside.
        camera: a single camera.
        last: return the last intersection instead of the first.
        front_faces: ignore back faces.
    """
    pose = camera.cam_from_world[0].to(vertices)
    local = vertices @ pose[:3, :3].T + pose[:3, 3]
    corners = local[faces]
    shown = (corners[..., 2] > _NEAREST).all(1)
    farthest = 1 / _NEAREST + 1
    if last:  # a projective map that keeps pixels and planes and reverses the order of depths
        corners = corners / (farthest * corners[..., 2:] - 1)
    if front_faces:
        a, b, c = corners.unbind(1)
        shown &= (a * torch.linalg.cross(b, c)).sum(-1) < 0
    corners = corners[shown]
    pairs = combinations_with_replacement(corners.unbind(1), 2)
    patches = torch.stack([(one + other) / 2 for one, other in pairs], 1)
    own = replace(camera, cam_from_world=torch.eye(4, device=pose.device)[None])
    ids, uv = visible_patches(patches, own, 1e-3, segments=1)
    meets = ids[0] >= 0
    weights = torch.cat([uv, 1 - uv.sum(-1, keepdim=True)], -1)[0, meets]
    depth = (corners[ids[0, meets].long(), :, 2] * weights).sum(-1)
    if last:
        depth = depth / (farthest * depth - 1)
    image = uv.new_full(meets.shape, torch.inf)
    image[meets] = depth
    return image
