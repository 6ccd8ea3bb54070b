"""A synthetic capture of a person: the dressed template in motion, from many cameras, with exact
body parameters.

Rasterized in numpy, independently of the rasterizer of Gaussians. T triangles, U vertices of the
atlas, H fragments, S texels per side.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.data.images.maps import MILLIMETRE
from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X
from dyngs.data.tracks import TrueTracks, write_true_tracks
from dyngs.human.body.body import BodyTemplate, apply_shape, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.mesh import Fragments, interpolate, normalized, rasterize, vertex_normals
from dyngs.human.motion.amass import write_amass
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.clips import random_clip, squat, walk
from dyngs.human.synthetic.clothes import (
    Outfit,
    dress_body,
    paint_texture,
    random_outfit,
    texel_coordinates,
    texture_coordinates,
)
from dyngs.human.synthetic.keypoints import (
    KEYPOINTS_FILE,
    is_seen,
    joint_positions,
    joints_of_triangles,
)
from dyngs.io.outputs import new_folder
from dyngs.io.write import write_image, write_text

_RADIUS = 3.5  # radius of the ring of cameras, m
# of a ring that a seed chooses: cameras lie up to so far above or below its height, m
_UNSTEADY = 0.08
_TARGET = np.array([0.0, 0.95, 0.0])  # the point that all cameras look at, m


@dataclass(frozen=True)
class Lamp:
    """A distant lamp and light from all sides."""

    # (3,) direction to the lamp, of any length
    towards: tuple[float, float, float] = (0.35, 0.75, 0.56)
    # sRGB factors by channel, (3,) or one; ambient + diffuse where the surface faces the lamp
    ambient: tuple[float, ...] = (0.6,)
    diffuse: tuple[float, ...] = (0.45,)


@dataclass(frozen=True)
class HumanOptions:
    """Options of a synthetic capture of a person."""

    size: int = 128  # width and height in pixels
    num_frames: int = 12  # frames of the walk, for the splits train and test
    num_new: int = 6  # frames of another motion, the split ``pose``; 0: no such split
    num_cameras: int = 8  # training cameras, on a ring around the person
    # test cameras, each midway between two training cameras; 0: neither test nor ``pose``
    num_test: int = 2
    # of the outfit, see ``dyngs.human.synthetic.clothes.random_outfit``; the same seed gives the
    # same bytes
    seed: int = 0
    samples: int = 2  # per side of a pixel
    body_seed: int | None = None  # of the person's body shape; None: the template's own
    # of the direction, strength and tint of the light; None: always the same
    light_seed: int | None = None
    # of the clips, see ``dyngs.human.synthetic.clips.random_clip``; None: a walk, then a squat
    clip_seed: int | None = None
    # left mostly as right, back as front and bare hands, instead of clothes that differ everywhere
    usual_clothes: bool = False
    # of radius and height of the ring, whose cameras are nearly level; None: alternately low and
    # high, 3.5 m away
    ring_seed: int | None = None
    with_truth: bool = False  # depth maps, and key points of the body with the views that see them


def varied(options: HumanOptions, seed: int) -> HumanOptions:
    """Return options of another person for each seed: outfit, body shape, light and clips."""
    return replace(options, seed=seed, body_seed=seed, light_seed=seed, clip_seed=seed)


@dataclass(frozen=True)
class PosedMesh:
    """A textured mesh in the world; float64, m."""

    vertices: np.ndarray  # (M, 3) in the world
    faces: np.ndarray  # (T, 3) int64, counter-clockwise from outside
    uv: np.ndarray  # (U, 2) in [0, 1]; row of the texture = (1 - v) * S
    uv_faces: np.ndarray  # (T, 3) int64 into ``uv``
    texture: np.ndarray  # (S, S, 3) sRGB values in [0, 1]

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit normals (M, 3) at the vertices, the same for all cameras."""
        return vertex_normals(self.vertices, self.faces)


def write_human_capture(out: Path, options: HumanOptions = HumanOptions()) -> Path:
    """Write images of a walking person in the layout that ``dyngs.data.readers.blender`` reads;
    returns ``out``.

    Files: ``images/SPLIT/fFFF_cCC.png`` (RGBA, straight alpha), ``transforms_SPLIT.json`` (OpenGL
    poses, m, y up, floor at y = 0), and the exact parameters of the default template,
    ``body_train.npz`` and ``body_pose.npz``. The split test shows the frames of train from other
    cameras, ``pose`` another motion. Raises DyngsError: options out of range.
    """
    if min(options.size, options.num_frames, options.num_cameras, options.samples) < 1:
        raise DyngsError(
            "a synthetic person needs size, num_frames, num_cameras and samples of at least 1"
        )
    if min(options.num_new, options.num_test, options.seed) < 0:
        raise DyngsError("a synthetic person needs num_new, num_test and seed of at least 0")
    body, betas = _person(options.body_seed)
    outfit, clothed, texture = _dressed(body, options.seed, options.usual_clothes)
    train, test = _cameras(options)
    seed = options.clip_seed
    lengths = {"train": options.num_frames}
    if options.num_new and test:
        lengths["pose"] = options.num_new
    if seed is None:
        clips = {
            name: (walk if name == "train" else squat)(body, count)
            for name, count in lengths.items()
        }
    else:
        clips = {
            name: random_clip(body, n, 2 * seed + (name == "pose")) for name, n in lengths.items()
        }
    with new_folder(out) as started:
        for name, clip in clips.items():
            motion = replace(
                clip, trans=outfit.size * clip.trans, scale=outfit.size * clip.scale, betas=betas
            )
            meshes = list(_posed_meshes(clothed, motion, texture))
            splits = {"train": train, "test": test} if name == "train" else {"pose": test}
            frames: list[_Frame] = []
            for split, cameras in splits.items():
                frames += _write_split(started, split, meshes, cameras, options)
            if options.with_truth and name == "train":
                write_true_tracks(
                    started, _keypoints(body, motion, meshes, frames, options.size), KEYPOINTS_FILE
                )
            write_amass(
                motion,
                started / f"body_{name}.npz",
                "smpl" if options.body_seed is None else "anny",
            )
    return out


def _keypoints(
    body: BodyTemplate,
    motion: Motion,
    meshes: Sequence[PosedMesh],
    frames: Sequence[_Frame],
    size: int,
) -> TrueTracks:
    """Return the tracks of the key points of ``body``, and which views of ``size`` pixels see
    them."""
    points = joint_positions(body, motion)
    owners = joints_of_triangles(body)
    visible = []
    for frame in frames:
        surface, near = _surface(meshes[frame.row], frame.world_from_cam, size)
        owner = np.full(size * size, -1)
        owner[surface.index] = owners[surface.faces]
        index, depth = _pixels_of(points[frame.row], frame.world_from_cam, size)
        visible.append(is_seen(depth, near[index], np.where(index < 0, -1, owner[index])))
    names = [frame.name.removesuffix(".png") for frame in frames]
    rows = [frame.row for frame in frames]
    times = np.linspace(0.0, 1.0, len(points)) if len(points) > 1 else np.zeros(1)
    return TrueTracks(
        points.astype(np.float32),
        times,
        np.array(names),
        np.array(rows, np.int64),
        np.stack(visible),
    )


def _pixels_of(
    points: np.ndarray, world_from_cam: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel (P,) of each of the points (P, 3), -1 outside of the image, and their depth
    (P,), m."""
    x, y, inverse = _image_of(points, world_from_cam, size).T
    inside = (x >= 0) & (x < size) & (y >= 0) & (y < size)
    return np.where(inside, y.astype(int) * size + x.astype(int), -1), 1.0 / inverse


def _surface(
    mesh: PosedMesh, world_from_cam: np.ndarray, size: int
) -> tuple[Fragments, np.ndarray]:
    """Return what is seen at pixel centres, and its depth (size^2,) along the view axis, m; 0 where
    nothing is."""
    image = _image_of(mesh.vertices, world_from_cam, size) - [0.5, 0.5, 0.0]
    surface = rasterize(image[mesh.faces], size, size)
    depth = np.zeros(size * size)
    corners = 1.0 / image[mesh.faces[surface.faces], 2:]
    depth[surface.index] = interpolate(surface.barycentric, corners)[:, 0]
    return surface, depth


def _person(seed: int | None) -> tuple[BodyTemplate, Tensor]:
    """Return the template in a random shape, and its shape parameters (B,)."""
    body = default_template()
    if seed is None:
        return body, torch.zeros(10, device="cpu")
    betas = torch.randn(
        body.num_shapes, generator=torch.Generator().manual_seed(seed), device="cpu"
    )
    vertices, joints = apply_shape(body, betas)
    return replace(body, vertices=vertices, joints=joints), betas


@lru_cache(maxsize=4)  # several captures of a person, of other clips or cameras, are painted once
def _dressed(
    body: BodyTemplate, seed: int, usual_clothes: bool
) -> tuple[Outfit, BodyTemplate, np.ndarray]:
    """Return the clothes of ``seed``, the body with them on, and its texture (S, S, 3)."""
    outfit = random_outfit(seed, usual_clothes)
    return outfit, dress_body(body, outfit), paint_texture(body, outfit)


def random_light(seed: int | None) -> Lamp:
    """Return the light of ``seed``, from any side and above, of which three quarters to all reach a
    white surface that faces it; None: ``Lamp()``."""
    if seed is None:
        return Lamp()
    make = np.random.default_rng([seed, 3])
    azimuth = make.uniform(-np.pi, np.pi)
    height = make.uniform(0.0, 1.2)
    diffuse = make.uniform(0.2, 0.6)
    ambient = make.uniform(0.75, 1.05) - diffuse
    tint = 1.0 + make.uniform(-0.06, 0.06) * np.array([1.0, 0.0, -1.0])
    red, green, blue = (float(diffuse * part) for part in tint)
    return Lamp(
        (float(np.sin(azimuth)), float(height), float(np.cos(azimuth))),
        (float(ambient),),
        (red, green, blue),
    )


def render_mesh(
    mesh: PosedMesh, world_from_cam: np.ndarray, size: int, samples: int, light: Lamp = Lamp()
) -> np.ndarray:
    """Return sRGB values and straight alpha (size, size, 4) in [0, 1], of ``samples`` x ``samples``
    per pixel.

    Lambertian: the texture times ambient + diffuse max(n . l, 0) with smooth normals n, at most 1.
    ``world_from_cam`` (4, 4) is an OpenGL pose; pixels are square, centred, ``CAMERA_ANGLE_X``
    across. Raises ValueError: the mesh reaches behind it.
    """
    image = _image_of(mesh.vertices, world_from_cam, size)
    corners = image[mesh.faces]
    sums = np.zeros((size * size, 4))
    for k in range(samples * samples):
        sample = np.array([(k % samples + 0.5) / samples, (k // samples + 0.5) / samples, 0.0])
        fragments = rasterize(corners - sample, size, size)
        sums[fragments.index, :3] += _shaded(mesh, fragments, light)
        sums[fragments.index, 3] += 1.0
    rgb = sums[:, :3] / np.maximum(sums[:, 3:], 1.0)
    return np.concatenate([rgb, sums[:, 3:] / samples**2], axis=1).reshape(size, size, 4)


def _image_of(points: np.ndarray, world_from_cam: np.ndarray, size: int) -> np.ndarray:
    """Return column, row and inverse depth (P, 3) of ``points`` (P, 3). Raises ValueError: one lies
    behind."""
    x, up, back = ((points - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    if not (back < 0).all():
        raise ValueError("all vertices must be in front of the camera")
    focal = _focal(size)
    return np.stack(
        [0.5 * size - focal * x / back, 0.5 * size + focal * up / back, -1.0 / back], axis=-1
    )


@dataclass(frozen=True)
class _Frame:
    """An image to render: its path below the root, what it shows, the OpenGL pose, and further keys
    of its entry."""

    name: str
    mesh: PosedMesh
    world_from_cam: np.ndarray
    keys: dict[str, object]
    row: int = 0  # of its mesh among those of the clip


def _write_split(
    out: Path,
    split: str,
    meshes: list[PosedMesh],
    cameras: dict[int, np.ndarray],
    options: HumanOptions,
) -> list[_Frame]:
    frames = [
        _Frame(
            f"images/{split}/f{i:03d}_c{camera:02d}.png",
            mesh,
            pose,
            {"frame": i, "camera": camera, "time": i / max(len(meshes) - 1, 1)},
            i,
        )
        for i, mesh in enumerate(meshes)
        for camera, pose in cameras.items()
    ]
    if frames:
        _write_frames(out, split, frames, options)
    return frames


def _write_frames(out: Path, split: str, frames: Sequence[_Frame], options: HumanOptions) -> None:
    entries = []
    light = random_light(options.light_seed)
    size = options.size
    for frame in frames:
        image = render_mesh(frame.mesh, frame.world_from_cam, size, options.samples, light)
        write_image(out / frame.name, image)
        keys = dict(frame.keys)
        if options.with_truth:
            keys["depth_file_path"] = path = f"depth/{frame.name.removeprefix('images/')}"
            depth = _surface(frame.mesh, frame.world_from_cam, size)[1].reshape(size, size)
            write_image(out / path, (depth / MILLIMETRE + 0.5).astype(np.uint16))
        entries.append(
            {"file_path": frame.name, **keys, "transform_matrix": frame.world_from_cam.tolist()}
        )
    focal = _focal(size)
    lens = {"w": size, "h": size, "fl_x": focal, "fl_y": focal, "cx": 0.5 * size, "cy": 0.5 * size}
    write_text(
        out / f"transforms_{split}.json", json.dumps(lens | {"frames": entries}, indent=1) + "\n"
    )


def _posed_meshes(body: BodyTemplate, motion: Motion, texture: np.ndarray) -> Iterator[PosedMesh]:
    uv, uv_faces = texture_coordinates(body)
    exact = body.to(dtype=torch.float64)
    faces = body.faces.cpu().numpy()
    for pose, trans, scale in zip(
        *(x.double() for x in (motion.poses, motion.trans, motion.scale)), strict=True
    ):
        vertices = (
            posed_vertices(exact, pose[None], trans[None], scale=scale[None])[0].cpu().numpy()
        )
        yield PosedMesh(vertices, faces, uv, uv_faces, texture)


def _cameras(options: HumanOptions) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Return the OpenGL poses (4, 4) of the training and the test cameras by number, on a ring
    around the person."""
    count = options.num_cameras
    others = options.num_test
    around = np.arange(count) / max(count, 1)
    between = (np.arange(others) * count // max(others, 1) + 0.5) / count
    if options.ring_seed is None:
        train = _on_ring(around, np.where(np.arange(count) % 2 == 0, 0.9, 1.7))
        test = _on_ring(between, np.full(others, 1.3))
    else:
        make = np.random.default_rng([options.ring_seed, 5])
        radius = make.uniform(3.3, 4.2)
        height = make.uniform(0.7, 1.6)
        train = _on_ring(around, height + make.uniform(-_UNSTEADY, _UNSTEADY, count), radius)
        test = _on_ring(between, np.full(others, height), radius)
    return dict(enumerate(train)), {len(train) + i: pose for i, pose in enumerate(test)}


def _on_ring(fractions: np.ndarray, heights: np.ndarray, radius: float = _RADIUS) -> np.ndarray:
    """Return OpenGL camera-to-world poses (V, 4, 4), y up, at ``fractions`` (V,) of a turn from +z
    to +x, and ``heights`` (V,), m."""
    azimuths = 2 * np.pi * fractions
    centers = np.stack([radius * np.sin(azimuths), heights, radius * np.cos(azimuths)], axis=-1)
    backward = normalized(centers - _TARGET)
    right = normalized(np.cross([0.0, 1.0, 0.0], backward))
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3] = np.stack([right, np.cross(backward, right), backward, centers], axis=-1)
    return poses


def _focal(size: int) -> float:
    return float(0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X))


def _shaded(mesh: PosedMesh, fragments: Fragments, light: Lamp) -> np.ndarray:
    uv = interpolate(fragments.barycentric, mesh.uv[mesh.uv_faces[fragments.faces]])
    normal = normalized(
        interpolate(fragments.barycentric, mesh.normals[mesh.faces[fragments.faces]])
    )
    facing = np.maximum(normal @ normalized(np.array(light.towards)), 0.0)
    received = np.array(light.ambient) + np.array(light.diffuse) * facing[:, None]
    return np.minimum(_sampled(mesh.texture, uv) * received, 1.0)


def _sampled(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the values (H, 3) of a texture (S, S, 3) at ``uv`` (H, 2), bilinear between texel
    centres."""
    last = len(texture) - 1
    column, row = (np.clip(place, 0.0, last) for place in texel_coordinates(uv, len(texture)))
    left = np.floor(column).astype(np.int64)
    top = np.floor(row).astype(np.int64)
    right = np.minimum(left + 1, last)
    below = np.minimum(top + 1, last)
    x = (column - left)[:, None]
    y = (row - top)[:, None]
    upper = (1 - x) * texture[top, left] + x * texture[top, right]
    lower = (1 - x) * texture[below, left] + x * texture[below, right]
    return (1 - y) * upper + y * lower
