"""A test capture of a clothed person: a skinned avatar in motion from twelve cameras, a body fit
and the truth.

    python benchmarks/clothed_people.py AVATAR.glb MOTION.npz NEW_MOTION.npz OUT [--seed 0]
                                        [--gamma 1] [--size 400] [--frames 20] [--new-frames 8]

AVATAR.glb is a glTF 2.0 file with a skin and the joint names of a common program, in a T-pose that
faces +z, without compression. The motions are AMASS files for the free template (`dyngs data
motion` makes them of other formats). The people of docs/guides/people.md are VALID avatars
(https://github.com/c-frame/valid-avatars-glb, MIT, (c) 2022 Tiffany Do), whose files are
compressed; Node decodes them, once:

    npm i @gltf-transform/core @gltf-transform/extensions @gltf-transform/functions meshoptimizer
    sharp node decode.mjs Black_F_2_Casual.glb plain.glb        # decode.mjs, with "type": "module" in package.json:
        import { NodeIO } from '@gltf-transform/core'
        import { ALL_EXTENSIONS } from '@gltf-transform/extensions'
        import { dequantize, textureCompress } from '@gltf-transform/functions'
        import { MeshoptDecoder } from 'meshoptimizer'
        import sharp from 'sharp'
        await MeshoptDecoder.ready
        const io = new NodeIO().registerExtensions(ALL_EXTENSIONS)
        const file = await io.registerDependencies({ 'meshopt.decoder': MeshoptDecoder
        }).read(process.argv[2]) await file.transform(dequantize(), textureCompress({ encoder:
        sharp, targetFormat: 'png' })) for (const used of file.getRoot().listExtensionsUsed())
            used.dispose()
        await io.write(process.argv[3], file)

OUT gets `images/SPLIT/fFFF_cCC.png` (RGBA, straight alpha, 3 x 3 samples per pixel, Lambert light
fixed in the world, no shadows), `transforms_SPLIT.json` for 8 training cameras, 4 test cameras, and
NEW_MOTION from these (split `pose`). `body_train.npz`, `body_pose.npz` play the part of an
estimated fit, see ``Fit``: its proportions and its surface are not the person's; `iou.json` is the
overlap of its silhouette with the true mask. `truth_joints.npz`: the avatar's own joints `train`
(F, 55, 3) and `pose`, m, in the world, with their `names`; NaN where it has no such joint. The
person's path on the floor is shrunk to 0.3 m.

Local letters: M vertices, T triangles, S joints of the avatar, F frames, H fragments.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from skinned_avatar import Avatar, posed_mesh, read_avatar

from dyngs.human.body.body import BodyTemplate, posed_vertices
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES, JOINT_PARENTS
from dyngs.human.body.mesh import interpolate, normalized, rasterize
from dyngs.human.body.skinning import (
    apply_transforms,
    axis_angle_to_matrix,
    blend_transforms,
    joint_transforms,
)
from dyngs.human.motion.amass import read_amass, write_amass
from dyngs.human.motion.motion import Motion
from dyngs.human.motion.placement import shortest_arc_rotation
from dyngs.human.synthetic.capture import DirectionalLight, random_light
from dyngs.io.write import write_image, write_text

SAMPLES = 3
"""Samples per side of a pixel."""
RADIUS, TRAVEL = 3.0, 0.3
"""Radius of the ring of cameras, and the extent of the person's path on the floor, m."""
TRAINING_HEIGHTS = (0.9, 1.6)
TEST_HEIGHTS = (0.6, 1.25, 1.9, 1.45)
"""Heights of the cameras in their order around the ring, repeated, m."""
MARGIN = 0.03
"""Least distance of the person to the border of an image, as a fraction of its width."""
LIMBS = (("hip", "knee"), ("knee", "ankle"), ("ankle", "foot"))
LIMBS += (("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "middle1"))
LIMBS += tuple(
    (f"{f}{i}", f"{f}{i + 1}")
    for f in ("index", "middle", "pinky", "ring", "thumb")
    for i in (1, 2)
)
"""Bones whose directions are made those of the template: the joints at both ends, without the
side."""
FITTED = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
"""Joints of both sides that the fit is drawn to."""
LIMB_WEIGHT, BENT_WEIGHT = 0.3, 0.3
"""Weights of the squared distances of these joints, and of the turns of the rest pose in square
radians."""
ROUNDS, FAR = 8, 0.08
"""Rounds of the fit, and the distance beyond which a point does not count, m."""


@dataclass(frozen=True)
class Clip:
    """An avatar in F frames, m, in the world.

    Attributes:
        rotations: (F, S, 3, 3) world_from_rest of the joints.
        joints: (F, S, 3).
        fps: frames per second.
    """

    rotations: np.ndarray
    joints: np.ndarray
    fps: float


def acted(avatar: Avatar, body: BodyTemplate, motion: Motion) -> Clip:
    """Return the avatar in a motion of the template, on the floor, its path shrunk to ``TRAVEL``.

    The world rotation of joint b is G_b align(d_b, t_b): G_b of the template's, d_b and t_b the
    directions at rest of the avatar's and the template's bone; the identity instead of ``align``
    off the limbs. Joints that the template lacks follow their parents. The pelvis follows the
    template's times the ratio of heights of the hips.

    Args:
        avatar: the person.
        body: the template of ``motion``.
        motion: F frames, y up.
    """
    transforms = joint_transforms(
        body.joints.double(), body.parents, axis_angle_to_matrix(motion.poses.double())
    )
    turned = transforms[..., :3].numpy()
    ours = dict(zip(JOINT_NAMES, body.joints.double().numpy(), strict=True))
    theirs = {name: avatar.joints[i] for name, i in avatar.named.items()}
    name_of = {i: name for name, i in avatar.named.items()}
    bones = {f"{side}_{a}": f"{side}_{b}" for side in ("left", "right") for a, b in LIMBS}
    rotations = np.empty((len(motion), len(avatar.joints), 3, 3))
    joints = np.empty((len(motion), len(avatar.joints), 3))
    hips = theirs["pelvis"][1] - avatar.vertices[:, 1].min()
    path = (
        hips
        / float(ours["pelvis"][1] - body.vertices[:, 1].min())
        * (motion.trans.numpy() + ours["pelvis"])
    )
    middle = (path.max(0) + path.min(0)) / 2
    extent = np.ptp(path[:, [0, 2]], axis=0).max()
    path[:, [0, 2]] = (path - middle)[:, [0, 2]] * min(1.0, TRAVEL / max(extent, 1e-9))
    for i in avatar.order:
        parent = avatar.parents[i]
        name = name_of.get(i)
        if name is None:
            rotations[:, i] = rotations[:, parent] if parent >= 0 else turned[:, 0]
        else:
            end = bones.get(name, "")
            align = (
                _aligned(theirs[end] - theirs[name], ours[end] - ours[name])
                if end in theirs
                else np.eye(3)
            )
            rotations[:, i] = turned[:, JOINT_NAMES.index(name)] @ align
        if i == avatar.named["pelvis"] or parent < 0:
            joints[:, i] = path
        else:
            joints[:, i] = joints[:, parent] + rotations[:, parent] @ (
                avatar.joints[i] - avatar.joints[parent]
            )
    joints[..., 1] -= min(
        posed_mesh(avatar, r, j)[0][:, 1].min() for r, j in zip(rotations, joints, strict=True)
    )
    return Clip(rotations, joints, motion.fps)


def _aligned(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    return shortest_arc_rotation(start / np.linalg.norm(start), end / np.linalg.norm(end))


class Fit:
    """The template at the height of the avatar, which turns as the avatar does, from another rest
    pose.

    This rest pose, the same in all frames, and the place in each frame are those at which the
    surfaces, and less so the joints of the limbs, lie near each other: nearest points of either
    surface in turn with a search (Besl and McKay 1992). Those far from the other surface, as in
    hair and coats, do not count.

    Args:
        avatar: the person.
        body: the template.
    """

    def __init__(self, avatar: Avatar, body: BodyTemplate) -> None:
        self.avatar, self.body = avatar, body.to(dtype=torch.float64)
        self.scale = avatar.height / float(np.ptp(body.vertices[:, 1].numpy()))
        self.rest_pose = torch.zeros(len(JOINT_NAMES), 3, dtype=torch.float64)
        self._leader: list[int] = []
        for i, name in enumerate(JOINT_NAMES):
            self._leader.append(
                avatar.named[name] if name in avatar.named else self._leader[JOINT_PARENTS[i]]
            )
        self._limbs = [i for i, name in enumerate(JOINT_NAMES) if name.partition("_")[2] in FITTED]

    def placed(self, clip: Clip, *, only_place: bool) -> Motion:
        """Return the motion of the template in ``clip``; the rest pose is found, too, unless
        ``only_place``."""
        pelvis = torch.from_numpy(clip.joints[:, self.avatar.named["pelvis"]])
        place = (pelvis - self.scale * self.body.joints[0]).requires_grad_()
        rest = self.rest_pose.requires_grad_(not only_place)
        thin = slice(None, None, max(1, len(self.avatar.vertices) // 3000))
        frames = zip(clip.rotations, clip.joints, strict=True)
        theirs = torch.from_numpy(
            np.stack([posed_mesh(self.avatar, r, j)[0][thin] for r, j in frames])
        )
        limbs = torch.from_numpy(clip.joints[:, [self._leader[i] for i in self._limbs]])
        for _ in range(ROUNDS):
            frame, mine, other = _nearest(
                self._drawn(clip, rest, place)[0].detach().numpy(), theirs.numpy()
            )
            self._search(clip, rest, place, (frame, mine, other), theirs, limbs)
        self.rest_pose = rest.detach()
        local = _local(self._world(clip, self.rest_pose)).numpy()
        poses = torch.from_numpy(Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()).float()
        scale = torch.full((len(place),), self.scale)
        return Motion(
            poses.reshape(-1, 55, 3), place.detach().float(), torch.zeros(10), clip.fps, scale
        )

    def _search(
        self,
        clip: Clip,
        rest: torch.Tensor,
        place: torch.Tensor,
        pairs: tuple[np.ndarray, ...],
        theirs: torch.Tensor,
        limbs: torch.Tensor,
    ) -> None:
        """Move ``place``, and ``rest`` where it is free, towards the least error of pairs of
        points."""
        free = [value for value in (rest, place) if value.requires_grad]
        search = torch.optim.LBFGS(free, max_iter=8, line_search_fn="strong_wolfe")
        frame, mine, other = pairs

        def error() -> torch.Tensor:
            search.zero_grad()
            surface, joints = self._drawn(clip, rest, place)
            apart = (surface[frame, mine] - theirs[frame, other]).square().sum(-1).mean()
            total = apart + LIMB_WEIGHT * (joints[:, self._limbs] - limbs).square().sum(-1).mean()
            total = 1e3 * total + BENT_WEIGHT * rest.square().sum(1).mean()
            total.backward()
            return total

        search.step(error)  # pyright: ignore[reportArgumentType]

    def _world(self, clip: Clip, rest: torch.Tensor) -> torch.Tensor:
        """Return the world rotations (F, 55, 3, 3) of the joints."""
        at_rest = joint_transforms(self.body.joints, self.body.parents, axis_angle_to_matrix(rest))[
            ..., :3
        ]
        return torch.from_numpy(clip.rotations[:, self._leader]) @ at_rest

    def _drawn(
        self, clip: Clip, rest: torch.Tensor, place: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return every sixth vertex (F, M / 6, 3) and the joints (F, 55, 3)."""
        body = self.body
        transforms = joint_transforms(body.joints, body.parents, _local(self._world(clip, rest)))
        surface = apply_transforms(
            blend_transforms(body.weights[::6], transforms), body.vertices[::6]
        )
        joints = apply_transforms(transforms, body.joints)
        return self.scale * surface + place[:, None], self.scale * joints + place[:, None]


def _local(world: torch.Tensor) -> torch.Tensor:
    """Return rotations (F, 55, 3, 3) relative to the parents of those in the world."""
    return torch.cat(
        [world[:, :1], world[:, JOINT_PARENTS[1:]].transpose(2, 3) @ world[:, 1:]], dim=1
    )


def _nearest(ours: np.ndarray, theirs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frames and rows of pairs of points (F, M, 3) and (F, M', 3): each point and the
    nearest of the others."""
    pairs = []
    for frame, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        (to, nearest), (back, nearest_back) = KDTree(other).query(one), KDTree(one).query(other)
        first = np.flatnonzero(to < FAR)
        second = np.flatnonzero(back < FAR)
        rows = [*first, *np.take(nearest_back, second)], [*np.take(nearest, first), *second]
        pairs.append(np.stack([np.full(len(rows[0]), frame), *rows]))
    frame, mine, other = np.concatenate(pairs, axis=1)
    return frame, mine, other


@dataclass(frozen=True)
class Lens:
    """Square images of ``size`` pixels, centred, of focal length ``focal`` in pixels."""

    size: int
    focal: float

    def projected(self, points: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return column, row, inverse depth (M, 3), of points in the world, in units of samples
        from their centres."""
        x, up, back = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        image = np.stack(
            [0.5 * self.size - self.focal * x / back, 0.5 * self.size + self.focal * up / back],
            axis=-1,
        )
        return np.concatenate([SAMPLES * image - 0.5, -1.0 / back[:, None]], axis=1)


def draw(
    avatar: Avatar,
    posed: tuple[np.ndarray, np.ndarray],
    pose: np.ndarray,
    lens: Lens,
    light: DirectionalLight,
) -> np.ndarray:
    """Return sRGB values and straight alpha (size, size, 4) in [0, 1]: the texture's value times
    the light received."""
    vertices, normals = posed
    wide = SAMPLES * lens.size
    fragments = rasterize(lens.projected(vertices, pose)[avatar.faces], wide, wide)
    corners = avatar.faces[fragments.faces]
    place = interpolate(fragments.barycentric, vertices[corners])
    normal = normalized(interpolate(fragments.barycentric, normals[corners]))
    # hair is seen from both sides
    normal *= np.where(((pose[:3, 3] - place) * normal).sum(1) < 0, -1.0, 1.0)[:, None]
    facing = np.maximum(normal @ normalized(np.array(light.direction)), 0.0)
    received = np.array(light.ambient) + np.array(light.diffuse) * facing[:, None]
    uv = interpolate(
        fragments.barycentric, np.concatenate([avatar.uv, avatar.uv[:, :1]], axis=1)[corners]
    )[:, :2]
    paint = avatar.paint[fragments.faces]
    colours = np.empty((len(uv), 3))
    for i, texture in enumerate(avatar.textures):
        colours[paint == i] = _sampled(texture, uv[paint == i])
    sums = np.zeros((wide * wide, 4))
    sums[fragments.index, :3] = np.minimum(colours * received, 1.0)
    sums[fragments.index, 3] = 1.0
    total = sums.reshape(lens.size, SAMPLES, lens.size, SAMPLES, 4).sum(axis=(1, 3))
    return np.concatenate(
        [total[..., :3] / np.maximum(total[..., 3:], 1.0), total[..., 3:] / SAMPLES**2], axis=-1
    )


def _sampled(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the values (H, 3) at ``uv`` (H, 2), bilinear between texel centres, repeated beyond
    [0, 1]."""
    high, wide = texture.shape[:2]
    column = uv[:, 0] * wide - 0.5
    row = uv[:, 1] * high - 0.5
    left = np.floor(column).astype(np.int64)
    top = np.floor(row).astype(np.int64)
    x = (column - left)[:, None]
    y = (row - top)[:, None]
    left, right, top, below = left % wide, (left + 1) % wide, top % high, (top + 1) % high
    upper = (1 - x) * texture[top, left] + x * texture[top, right]
    return (1 - y) * upper + y * ((1 - x) * texture[below, left] + x * texture[below, right])


def ring(count: int, first: float, heights: tuple[float, ...], target: float) -> np.ndarray:
    """Return OpenGL poses (count, 4, 4) around a point ``target`` m above the origin, from
    ``first`` rad off +z."""
    azimuths = first + 2 * np.pi * np.arange(count) / count
    high = np.resize(heights, count)
    centers = np.stack([RADIUS * np.sin(azimuths), high, RADIUS * np.cos(azimuths)], axis=-1)
    backward = normalized(centers - np.array([0.0, target, 0.0]))
    right = normalized(np.cross([0.0, 1.0, 0.0], backward))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = np.stack([right, np.cross(backward, right), backward, centers], axis=-1)
    return poses


def longest_lens(clouds: list[np.ndarray], cameras: np.ndarray, size: int) -> Lens:
    """Return the lens of the longest focal length that shows all points (M, 3) of all frames in all
    cameras."""
    widest = 0.0
    for points in clouds:
        for pose in cameras:
            x, up, back = ((points - pose[:3, 3]) @ pose[:3, :3]).T
            widest = max(widest, float(np.abs(x / back).max()), float(np.abs(up / back).max()))
    return Lens(size, (0.5 - MARGIN) * size / widest)


def covered(body: BodyTemplate, vertices: np.ndarray, pose: np.ndarray, lens: Lens) -> np.ndarray:
    """Return where the template covers at least half of a pixel (size, size) bool."""
    wide = SAMPLES * lens.size
    hit = np.zeros(wide * wide)
    hit[rasterize(lens.projected(vertices, pose)[body.faces.numpy()], wide, wide).index] = 1.0
    return hit.reshape(lens.size, SAMPLES, lens.size, SAMPLES).mean(axis=(1, 3)) >= 0.5


@dataclass(frozen=True)
class Shots:
    """What a split shows: cameras by their numbers, the avatar in a clip, and the fit of the
    template."""

    cameras: dict[int, np.ndarray]
    clip: Clip
    fit: Motion


def write_split(
    out: Path, split: str, avatar: Avatar, shots: Shots, lens: Lens, light: DirectionalLight
) -> list[float]:
    """Write images and JSON of a split; return the overlap of the fit's silhouette with each
    mask."""
    body = default_template()
    clip = shots.clip
    frames = []
    overlaps = []
    fit = (
        posed_vertices(body, shots.fit.poses, shots.fit.trans, scale=shots.fit.scale)
        .double()
        .numpy()
    )
    for i in range(len(clip.joints)):
        posed = posed_mesh(avatar, clip.rotations[i], clip.joints[i])
        for camera, pose in shots.cameras.items():
            name = f"images/{split}/f{i:03d}_c{camera:02d}.png"
            image = draw(avatar, posed, pose, lens, light)
            write_image(out / name, image)
            mask = image[..., 3] >= 0.5
            other = covered(body, fit[i], pose, lens)
            overlaps.append(float((mask & other).sum() / (mask | other).sum()))
            entry: dict[str, object] = {"file_path": name, "frame": i, "camera": camera}
            frames.append(
                entry
                | {"time": i / max(len(clip.joints) - 1, 1), "transform_matrix": pose.tolist()}
            )
    write_transforms(out / f"transforms_{split}.json", lens, frames)
    return overlaps


def write_transforms(
    path: Path, lens: Lens, frames: list[dict[str, object]], **more: object
) -> None:
    """Write the cameras of a split, all with the same ``lens``, and ``more`` fields of the file."""
    size = lens.size
    focal = lens.focal
    intrinsics = {
        "w": size,
        "h": size,
        "fl_x": focal,
        "fl_y": focal,
        "cx": 0.5 * size,
        "cy": 0.5 * size,
    }
    write_text(path, json.dumps(more | intrinsics | {"frames": frames}, indent=1) + "\n")


def chosen_frames(motion: Motion, count: int, offset: float) -> tuple[Motion, list[int]]:
    """Return ``count`` frames spread over a motion, the first ``offset`` of a step after its start;
    their numbers."""
    step = len(motion) / count
    rows = [math.floor((i + offset) * step) for i in range(count)]
    few = replace(
        motion, poses=motion.poses[rows], trans=motion.trans[rows], scale=motion.scale[rows]
    )
    return replace(few, fps=motion.fps / step), rows


def truth(avatar: Avatar, clip: Clip) -> np.ndarray:
    """Return the avatar's joints (F, 55, 3) in the order of SMPL-X, m, NaN where it has none."""
    found = np.full((len(clip.joints), len(JOINT_NAMES), 3), np.nan)
    for name, i in avatar.named.items():
        found[:, JOINT_NAMES.index(name)] = clip.joints[:, i]
    return found


def arguments() -> argparse.Namespace:
    """Return the words of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("avatar", type=Path)
    parser.add_argument("motion", type=Path)
    parser.add_argument("new_motion", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0, help="of the light")
    parser.add_argument(
        "--gamma",
        type=float,
        default=1.0,
        help="power of the textures' values; below 1 for dark clothes",
    )
    parser.add_argument("--size", type=int, default=400, help="of the images, pixels")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--new-frames", type=int, default=8)
    return parser.parse_args()


def main() -> None:
    """Write the capture."""
    given = arguments()
    body = default_template()
    avatar = read_avatar(given.avatar, given.gamma)
    light = random_light(given.seed)
    training, numbers = chosen_frames(read_amass(given.motion, body), given.frames, 0.0)
    new, new_numbers = chosen_frames(read_amass(given.new_motion, body), given.new_frames, 0.5)
    clips = {"train": acted(avatar, body, training), "pose": acted(avatar, body, new)}
    fit = Fit(avatar, body)
    fits = {split: fit.placed(clip, only_place=split == "pose") for split, clip in clips.items()}
    clouds = [
        posed_mesh(avatar, r, j)[0]
        for c in clips.values()
        for r, j in zip(c.rotations, c.joints, strict=True)
    ]
    target = float(max(x[:, 1].max() for x in clouds)) / 2
    cameras = [*ring(8, 0.0, TRAINING_HEIGHTS, target), *ring(4, np.pi / 8, TEST_HEIGHTS, target)]
    lens = longest_lens(clouds, np.stack(cameras), given.size)
    seen_by = {"train": dict(enumerate(cameras[:8])), "test": dict(enumerate(cameras[8:], 8))}
    iou = {}
    for split, which, ring_of in (
        ("train", "train", "train"),
        ("test", "train", "test"),
        ("pose", "pose", "test"),
    ):
        shots = Shots(seen_by[ring_of], clips[which], fits[which])
        overlaps = write_split(given.out, split, avatar, shots, lens, light)
        iou[split] = {
            "mean": round(fmean(overlaps), 4),
            "min": round(min(overlaps), 4),
            "images": len(overlaps),
        }
        print(
            f"{split}: {len(overlaps)} images, overlap of the fit {fmean(overlaps):.3f}", flush=True
        )
    for split, motion in fits.items():
        write_amass(motion, given.out / f"body_{split}.npz")
    joints = {split: truth(avatar, clip) for split, clip in clips.items()}
    np.savez(
        given.out / "truth_joints.npz",
        names=np.array(JOINT_NAMES),
        train=joints["train"],
        pose=joints["pose"],
    )
    shading = {**vars(light), "texture_gamma": given.gamma}
    sources = {
        "avatar": given.avatar.name,
        "motion": given.motion.name,
        "new_motion": given.new_motion.name,
    }
    frames = {"train": numbers, "pose": new_numbers}
    meta = {
        "height": avatar.height,
        "seed": given.seed,
        "frames": frames,
        "look_at": [0.0, target, 0.0],
    }
    write_text(
        given.out / "meta.json", json.dumps(sources | meta | {"shading": shading}, indent=1) + "\n"
    )
    write_text(given.out / "iou.json", json.dumps(iou, indent=1) + "\n")


if __name__ == "__main__":
    main()
