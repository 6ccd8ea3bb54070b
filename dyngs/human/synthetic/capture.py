"""A synthetic capture of a person: the dressed template in motion, from many cameras, with exact body parameters.

Pictures are rasterized with a depth buffer in numpy, independently of the rasterizer of Gaussians, as ground truth.

Local letters: J joints, M vertices, T triangles, U vertices of the atlas, F frames, H fragments, S texels per side.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.data.synthetic.captures import require_new_folder
from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X
from dyngs.errors import DyngsError
from dyngs.files.write import write_image, write_text
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.clothes import (
    dress_body,
    paint_texture,
    random_outfit,
    texel_coordinates,
    texture_coordinates,
)
from dyngs.human.template.body import BodyTemplate, apply_shape, posed_vertices
from dyngs.human.template.joints import JOINT_NAMES
from dyngs.human.template.load import default_template
from dyngs.human.template.mesh import Fragments, interpolate, normalized, rasterize, vertex_normals

_FPS = 12.0
_RADIUS = 3.5
"""Radius of the ring of cameras, m."""
_TARGET = np.array([0.0, 0.95, 0.0])
"""The point that all cameras look at, m."""
_TO_LIGHT = np.array([0.35, 0.75, 0.56])
_AMBIENT, _DIFFUSE = 0.6, 0.45


@dataclass(frozen=True)
class HumanOptions:
    """Options of a synthetic capture of a person.

    Attributes:
        size: width and height in pixels.
        num_frames: frames of the walk, for the splits train and test.
        num_new: frames of another motion, the split ``pose``; 0: no such split.
        num_cameras: training cameras, on a ring around the person.
        num_test: test cameras, each midway between two training cameras; 0: neither test nor ``pose``.
        seed: of the outfit, see ``dyngs.human.synthetic.clothes.random_outfit``; the same seed gives the same bytes.
        samples: per side of a pixel.
        body_seed: of the person's body shape; None: the template's own.
    """

    size: int = 128
    num_frames: int = 12
    num_new: int = 6
    num_cameras: int = 8
    num_test: int = 2
    seed: int = 0
    samples: int = 2
    body_seed: int | None = None


@dataclass(frozen=True)
class PosedMesh:
    """A textured mesh in the world; float64, m.

    Attributes:
        vertices: (M, 3) in the world.
        faces: (T, 3) int64, counter-clockwise from outside.
        uv: (U, 2) in [0, 1]; row of the texture = (1 - v) * S.
        uv_faces: (T, 3) int64 into ``uv``.
        texture: (S, S, 3) sRGB values in [0, 1].
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    uv_faces: np.ndarray
    texture: np.ndarray


def write_human_capture(out: Path, options: HumanOptions = HumanOptions()) -> Path:
    """Write pictures of a walking person in the layout that ``dyngs.data.readers.body_json`` reads; returns ``out``.

    Files: ``images/SPLIT/fFFF_cCC.png`` (RGBA, straight alpha, sRGB), ``transforms_SPLIT.json`` (OpenGL poses, m,
    y up, floor at y = 0), and the exact parameters of the default template, ``body_train.npz`` and ``body_pose.npz``.
    Clothes are offset from the template's surface; the person's size is the ``scale`` of the parameters. The split test
    shows the frames of train from other cameras, ``pose`` another motion from these other cameras.

    Raises:
        DyngsError: options out of range, or ``out`` is not empty or cannot be written.
    """
    if min(options.size, options.num_frames, options.num_cameras, options.samples) < 1:
        raise DyngsError("a synthetic person needs size, num_frames, num_cameras and samples of at least 1")
    if min(options.num_new, options.num_test, options.seed) < 0:
        raise DyngsError("a synthetic person needs num_new, num_test and seed of at least 0")
    require_new_folder(out)
    body, betas = _person(options.body_seed)
    outfit = random_outfit(options.seed)
    clothed, texture = dress_body(body, outfit), paint_texture(body, outfit)
    train = dict(enumerate(_ring(options.num_cameras)))
    test = {len(train) + i: pose for i, pose in enumerate(_ring_between(options.num_test, options.num_cameras))}
    clips = {"train": walk(body, options.num_frames)}
    if options.num_new and test:
        clips["pose"] = squat(body, options.num_new)
    for name, clip in clips.items():
        motion = replace(clip, trans=outfit.size * clip.trans, scale=outfit.size * clip.scale, betas=betas)
        meshes = list(_posed_meshes(clothed, motion, texture))
        splits = {"train": train, "test": test} if name == "train" else {"pose": test}
        for split, cameras in splits.items():
            _write_split(out, split, meshes, cameras, options)
        write_amass(motion, out / f"body_{name}.npz", shape_space="smpl" if options.body_seed is None else "anny")
    return out


def _person(seed: int | None) -> tuple[BodyTemplate, Tensor]:
    """Return the template in a random shape, and its shape parameters (B,)."""
    body = default_template()
    if seed is None:
        return body, torch.zeros(10, device="cpu")
    betas = torch.randn(body.num_shapes, generator=torch.Generator().manual_seed(seed), device="cpu")
    vertices, joints = apply_shape(body, betas)
    return replace(body, vertices=vertices, joints=joints), betas


def walk(body: BodyTemplate, num_frames: int) -> Motion:
    """Return three swings of legs and arms in place while the body turns by 50 degrees; soles at y = 0."""
    time = np.linspace(0.0, 1.0, num_frames)
    swing, lift = np.sin(3 * np.pi * time), 0.3 - 0.3 * np.cos(3 * np.pi * time)
    rotations = {
        "pelvis": _axis_angle(y=np.radians(50.0) * (time - 0.5)),
        "spine2": _axis_angle(y=0.2 * swing),
        "head": _axis_angle(y=0.5 * np.sin(2 * np.pi * time)),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        rotations |= {
            f"{side}_hip": _axis_angle(x=-0.5 * sign * swing),
            f"{side}_knee": _axis_angle(x=0.2 + 0.6 * np.maximum(-sign * swing, 0.0) + 0.3 * lift),
            f"{side}_shoulder": _axis_angle(x=0.6 * sign * swing, z=-sign * 1.15),
            f"{side}_elbow": _axis_angle(y=-sign * (0.3 + lift)),
        }
    return _grounded_motion(body, rotations, num_frames)


def squat(body: BodyTemplate, num_frames: int) -> Motion:
    """Return a motion from standing into a squat while the arms rise sideways; soles at y = 0."""
    depth = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, num_frames))
    rotations = {"spine1": _axis_angle(x=0.35 * depth), "head": _axis_angle(x=-0.3 * depth, z=0.2 * depth)}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        rotations |= {
            f"{side}_hip": _axis_angle(x=-1.3 * depth, z=0.15 * sign * depth),
            f"{side}_knee": _axis_angle(x=1.9 * depth),
            f"{side}_ankle": _axis_angle(x=-0.6 * depth),
            f"{side}_shoulder": _axis_angle(z=sign * (-1.2 + 2.1 * depth)),
            f"{side}_elbow": _axis_angle(y=-0.4 * sign * depth),
        }
    return _grounded_motion(body, rotations, num_frames)


def render_mesh(mesh: PosedMesh, world_from_cam: np.ndarray, size: int, samples: int) -> np.ndarray:
    """Return sRGB values and straight alpha (size, size, 4) in [0, 1], of ``samples`` x ``samples`` per pixel.

    Lambertian: the texture's value times 0.6 + 0.45 max(n . l, 0) with smooth normals n, at most 1; no shadows. Alpha
    is the share of samples that hit the mesh, whose colours are averaged.

    Args:
        mesh: visible from both sides.
        world_from_cam: (4, 4) OpenGL pose; square pixels, centred, ``CAMERA_ANGLE_X`` across.
        size: width and height in pixels.
        samples: per side of a pixel.

    Raises:
        ValueError: the mesh reaches behind the camera.
    """
    rotation, center = world_from_cam[:3, :3], world_from_cam[:3, 3]
    x, up, back = ((mesh.vertices - center) @ rotation).T
    if not (back < 0).all():
        raise ValueError("all vertices must be in front of the camera")
    focal = _focal(size)
    image = np.stack([0.5 * size - focal * x / back, 0.5 * size + focal * up / back, -1.0 / back], axis=-1)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    sums = np.zeros((size * size, 4))
    for k in range(samples * samples):
        sample = np.array([(k % samples + 0.5) / samples, (k // samples + 0.5) / samples, 0.0])
        fragments = rasterize((image - sample)[mesh.faces], size, size)
        sums[fragments.index, :3] += _shaded(mesh, normals, fragments)
        sums[fragments.index, 3] += 1.0
    rgb = sums[:, :3] / np.maximum(sums[:, 3:], 1.0)
    return np.concatenate([rgb, sums[:, 3:] / samples**2], axis=1).reshape(size, size, 4)


def _write_split(
    out: Path, split: str, meshes: list[PosedMesh], cameras: dict[int, np.ndarray], options: HumanOptions
) -> None:
    """Write the pictures of one split and its JSON; nothing without cameras."""
    if not cameras:
        return
    frames = []
    for i, mesh in enumerate(meshes):
        for camera, pose in cameras.items():
            name = f"images/{split}/f{i:03d}_c{camera:02d}.png"
            write_image(out / name, render_mesh(mesh, pose, options.size, options.samples))
            entry: dict[str, object] = {"file_path": name, "frame": i, "camera": camera}
            frames.append(entry | {"time": i / max(len(meshes) - 1, 1), "transform_matrix": pose.tolist()})
    size, focal = options.size, _focal(options.size)
    lens = {"w": size, "h": size, "fl_x": focal, "fl_y": focal, "cx": 0.5 * size, "cy": 0.5 * size}
    write_text(out / f"transforms_{split}.json", json.dumps(lens | {"frames": frames}, indent=1) + "\n")


def _posed_meshes(body: BodyTemplate, motion: Motion, texture: np.ndarray) -> Iterator[PosedMesh]:
    """Yield the mesh of each frame, posed in float64."""
    uv, uv_faces = texture_coordinates(body)
    exact, faces = body.to(dtype=torch.float64), body.faces.cpu().numpy()
    for pose, trans, scale in zip(*(x.double() for x in (motion.poses, motion.trans, motion.scale)), strict=True):
        vertices = posed_vertices(exact, pose[None], trans[None], scale=scale[None])[0].cpu().numpy()
        yield PosedMesh(vertices, faces, uv, uv_faces, texture)


def _grounded_motion(body: BodyTemplate, rotations: dict[str, np.ndarray], num_frames: int) -> Motion:
    """Return the motion of joints rotated by axis-angle (F, 3) or (3,), the lowest vertex always at y = 0."""
    device = body.vertices.device
    poses = torch.zeros(num_frames, len(JOINT_NAMES), 3, device=device)
    for name, rotation in rotations.items():
        poses[:, JOINT_NAMES.index(name)] = torch.from_numpy(rotation).to(poses)
    trans = torch.zeros(num_frames, 3, device=device)
    exact = body.to(dtype=torch.float64)
    for frame, pose in enumerate(poses.double()):
        trans[frame, 1] = (
            -posed_vertices(exact, pose[None], torch.zeros(1, 3, dtype=torch.float64, device=device))[0, :, 1]
            .min()
            .float()
        )
    return Motion(poses, trans, torch.zeros(10, device=device), _FPS, torch.ones(num_frames, device=device))


def _axis_angle(x: np.ndarray | float = 0.0, y: np.ndarray | float = 0.0, z: np.ndarray | float = 0.0) -> np.ndarray:
    """Return axis-angle vectors (F, 3) of rotations about the fixed axes z, then y, then x by angles (F,), rad."""
    angles = np.stack(np.broadcast_arrays(np.atleast_1d(z), y, x), axis=-1)
    return Rotation.from_euler("zyx", angles).as_rotvec()


def _ring(count: int) -> np.ndarray:
    """Return OpenGL camera-to-world poses (count, 4, 4) on a ring, the first in front, alternately low and high."""
    share = np.arange(count) / max(count, 1)
    return _look_at_target(2 * np.pi * share, np.where(np.arange(count) % 2 == 0, 0.9, 1.7))


def _ring_between(count: int, others: int) -> np.ndarray:
    """Return poses (count, 4, 4) on the ring of ``others`` cameras, each midway between two of them."""
    share = (np.arange(count) * others // max(count, 1) + 0.5) / others
    return _look_at_target(2 * np.pi * share, np.full(count, 1.3))


def _look_at_target(azimuths: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Return OpenGL camera-to-world poses (V, 4, 4), y up, of azimuths (V,) from +z to +x, rad, and heights (V,), m."""
    centers = np.stack([_RADIUS * np.sin(azimuths), heights, _RADIUS * np.cos(azimuths)], axis=-1)
    backward = normalized(centers - _TARGET)
    right = normalized(np.cross([0.0, 1.0, 0.0], backward))
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3] = np.stack([right, np.cross(backward, right), backward, centers], axis=-1)
    return poses


def _focal(size: int) -> float:
    """Return the focal length in pixels."""
    return float(0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X))


def _shaded(mesh: PosedMesh, normals: np.ndarray, fragments: Fragments) -> np.ndarray:
    """Return the sRGB values (H, 3) of the fragments."""
    uv = interpolate(fragments.barycentric, mesh.uv[mesh.uv_faces[fragments.faces]])
    normal = normalized(interpolate(fragments.barycentric, normals[mesh.faces[fragments.faces]]))
    light = _AMBIENT + _DIFFUSE * np.maximum(normal @ normalized(_TO_LIGHT), 0.0)
    return np.minimum(_sampled(mesh.texture, uv) * light[:, None], 1.0)


def _sampled(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the values (H, 3) of a texture (S, S, 3) at ``uv`` (H, 2), bilinear between texel centres."""
    last = len(texture) - 1
    column, row = (np.clip(place, 0.0, last) for place in texel_coordinates(uv, len(texture)))
    left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    right, below = np.minimum(left + 1, last), np.minimum(top + 1, last)
    x, y = (column - left)[:, None], (row - top)[:, None]
    upper = (1 - x) * texture[top, left] + x * texture[top, right]
    lower = (1 - x) * texture[below, left] + x * texture[below, right]
    return (1 - y) * upper + y * lower
