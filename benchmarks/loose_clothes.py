"""A test capture of a person in loose cloth: ``clothed_people.py`` with a skirt or an open coat that is simulated.

    python benchmarks/loose_clothes.py AVATAR.glb PERFORMANCE OUT [--kind skirt|coat] [--turn 0.6] [--size 200]
                                       [--frames 52] [--new-frames 24]

PERFORMANCE names motions of the free template, one after the other, each as FILE.npz:FIRST:COUNT (frames, 30 per
second; files are looped), blended over 8 frames; all the while the person turns to and fro about the vertical by up to
1.7 ``--turn`` rad. The people of docs/human.md are::

    skirt  Black_F_2_Casual  dance:0:57,walk:0:40,dance:10:31,dance:0:32,run:5:32
    coat   MENA_M_1_Casual   walk:0:60,dance:0:52,walk:30:16,walk:45:32,jump:20:32

with dance_deepmimic_a.npz and the like. The first ``--frames`` at 15 per second are those of training and ``test``,
the next ``--new-frames`` are ``pose``: they follow, so velocities are those of one performance. The cloth is a grid of
points from the waist (the chest) to below the knees, pinned at its first row, with springs along, across and diagonal,
moved by position-based dynamics (Mueller et al. 2007) at 120 Hz with gravity and drag, and kept out of capsules around
legs and trunk. OUT is as ``clothed_people.py`` writes it, without the truth, and ``cloth/SPLIT/`` has masks of what is
cloth.

Local letters: R rows and C columns of the cloth, V = R C points, F frames, M vertices of the avatar.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from clothed_people import (
    SAMPLES,
    TEST_HEIGHTS,
    TRAINING_HEIGHTS,
    Clip,
    Fit,
    Lens,
    acted,
    draw,
    longest_lens,
    ring,
    write_transforms,
)
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation, Slerp
from skinned_avatar import Avatar, posed_mesh, read_avatar

from dyngs.files.write import write_image
from dyngs.human.motion.amass import read_amass, write_amass
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.capture import random_light
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.body_reader import default_template
from dyngs.human.template.mesh import rasterize, vertex_normals

RATE, EVERY = 30.0, 2
"""Frames per second of the performance, and of these, which are captured."""
BLEND = 8  # frames over which one motion becomes the next
SUBSTEPS, SETTLE = 4, 150  # steps of the simulation per frame of the performance, and those before the first
GRAVITY, DRAG, CALM = 9.81, 1.2, 8.0  # m/s^2, and drag of the cloth, and while it settles, 1/s
ROUNDS, FASTEST = 8, 8.0  # passes over all constraints per step, and bound on the speed of a point, m/s
SPRINGS = ((1, 0, 1.0), (0, 1, 0.9), (1, 1, 0.15), (1, -1, 0.15), (2, 0, 0.05), (0, 2, 0.03))
"""Rows and columns from end to end, and the share of the error that a pass corrects."""
FRICTION = 0.1  # share of the motion of a step that a touch takes


def performance(parts: list[tuple[Path, int, int]], body: BodyTemplate, turn: float) -> Motion:
    """Return motions (file, first frame, number of frames) one after the other, in place, turning to and fro."""
    poses, trans = np.empty((0, 55, 4)), np.empty((0, 3))
    for path, first, count in parts:
        motion = read_amass(path, body)
        rows = np.arange(first, first + count) % len(motion)
        own = Rotation.from_rotvec(motion.poses[rows].double().numpy().reshape(-1, 3)).as_quat().reshape(count, 55, 4)
        place = motion.trans[rows].double().numpy()
        drift = np.linspace(0, 1, count)[:, None] * (place[-1] - place[0]) + place[0]
        place = place - drift * np.array([1.0, 0.0, 1.0])
        common = min(BLEND, len(poses))
        share = np.linspace(0, 1, common + 2)[1:-1, None]
        before, after = poses[len(poses) - common :], own[:common]
        after = np.where((before * after).sum(-1, keepdims=True) < 0, -after, after)
        mixed = before * (1 - share[..., None]) + after * share[..., None]
        own[:common] = mixed / np.linalg.norm(mixed, axis=-1, keepdims=True)
        place[:common] = trans[len(trans) - common :] * (1 - share) + place[:common] * share
        poses = np.concatenate([poses[: len(poses) - common], own])
        trans = np.concatenate([trans[: len(trans) - common], place])
    seconds = np.arange(len(poses)) / RATE
    yaw = turn * (0.9 * np.sin(2 * np.pi * seconds / 1.37) + 0.8 * np.sin(2 * np.pi * seconds / 2.9 + 1))
    turned = Rotation.from_quat(poses.reshape(-1, 4)).as_rotvec().reshape(-1, 55, 3)
    heading = Rotation.from_rotvec(yaw[:, None] * np.array([0.0, 1.0, 0.0]))
    turned[:, 0] = (heading * Rotation.from_rotvec(turned[:, 0])).as_rotvec()
    size = torch.ones(len(turned))
    return Motion(torch.from_numpy(turned).float(), torch.from_numpy(trans).float(), torch.zeros(10), RATE, size)


class Cloth:
    """A skirt, pinned to the pelvis, or a coat that is open in front, pinned to the spine; at rest around the avatar.

    Attributes:
        rest: (R, C, 3) m.
        uv: (V, 2).
        faces: (T, 3).
    """

    def __init__(self, avatar: Avatar, kind: str) -> None:
        self.avatar, self.closed = avatar, kind == "skirt"
        at = {name: avatar.joints[i] for name, i in avatar.named.items()}
        self.columns = 44
        if self.closed:
            self.joint, self.rows, flare, below = "pelvis", 22, np.radians(24), 0.12
            top = at["pelvis"][1] + 0.10
            angles = np.arange(self.columns) * 2 * np.pi / self.columns
        else:
            self.joint, self.rows, flare, below = "spine2", 28, np.radians(15), 0.2
            top = 0.45 * at["spine1"][1] + 0.55 * at["spine2"][1]
            angles = np.radians(np.linspace(25, 335, self.columns))
        length = (top - at["left_knee"][1] + below) / np.cos(flare)
        along = np.linspace(0, length, self.rows)[:, None]
        around, centre = _girth(avatar, top, angles)
        radius = around + (around.mean() - around) * np.minimum(along / 0.3, 1) + along * np.sin(flare)
        radius += 0.0 if self.closed else 0.03 * np.minimum(along / 0.2, 1)  # past the hips
        high = np.broadcast_to(top - along * np.cos(flare), radius.shape)
        self.rest = np.stack([centre[0] + radius * np.sin(angles), high, centre[1] + radius * np.cos(angles)], axis=-1)
        self.uv = np.stack(np.broadcast_arrays(angles / np.pi, along / length), axis=-1).reshape(-1, 2)
        grid = np.arange(self.rows * self.columns).reshape(self.rows, self.columns)
        right = np.roll(grid, -1, axis=1)
        quads, wide = (grid[:-1], right[:-1], right[1:], grid[1:]), self.columns - (not self.closed)
        corners = [x[:, :wide].ravel() for x in quads]
        first, second, third, fourth = corners
        self.faces = np.concatenate(
            [np.stack([first, fourth, third], axis=-1), np.stack([first, third, second], axis=-1)]
        )
        self._springs = self._all_springs(grid)
        self._capsules = self._all_capsules(at)

    def _all_springs(self, grid: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, float]]:
        """Return groups of springs that share no point: both ends, lengths (S, 1), and how much a pass corrects."""
        found = []
        for down, across, stiffness in SPRINGS:
            row, column = (x.ravel() for x in np.indices(grid.shape))
            inside = row + down < self.rows
            inside &= self.closed | ((column + across >= 0) & (column + across < self.columns))
            group = (row // down if down else column // max(across, 1)) % 2
            for side in (0, 1):
                chosen = inside & (group == side)
                a = grid[row[chosen], column[chosen]]
                b = grid[row[chosen] + down, (column[chosen] + across) % self.columns]
                rest = self.rest.reshape(-1, 3)
                found.append((a, b, np.linalg.norm(rest[a] - rest[b], axis=1)[:, None], stiffness))
        return found

    def _all_capsules(self, at: dict[str, np.ndarray]) -> list[tuple[str, str, float, float]]:
        """Return joints at both ends and the radii there, m."""
        heaviest = self.avatar.weights.argmax(axis=1)

        def radius(joint: str, end: str) -> float:
            points = self.avatar.vertices[heaviest == self.avatar.named[joint]] - at[joint]
            bone = at[end] - at[joint]
            share = np.clip(points @ bone / (bone @ bone), 0, 1)[:, None]
            return float(np.percentile(np.linalg.norm(points - share * bone, axis=1), 92))

        found = []
        for side in ("left", "right"):
            hip, knee, ankle = (f"{side}_{name}" for name in ("hip", "knee", "ankle"))
            thigh, shin = radius(hip, knee), radius(knee, ankle)
            found += [(hip, knee, thigh + 0.005, shin + 0.015), (knee, ankle, shin + 0.01, 0.7 * shin + 0.01)]
        trunk = 0.9 * radius("pelvis", "left_hip")
        return [*found, ("left_hip", "right_hip", trunk, trunk), ("pelvis", "spine2", trunk, trunk)]

    def simulated(self, clip: Clip) -> np.ndarray:
        """Return the points (F, V, 3) in the frames of a clip at ``RATE``."""
        named, last = self.avatar.named, len(clip.joints) - 1
        ends = {name: clip.joints[:, named[name]] for x in self._capsules for name in (*x[:2], self.joint)}
        turns = Slerp(np.arange(last + 1), Rotation.from_matrix(clip.rotations[:, named[self.joint]]))
        rest = self.rest.reshape(-1, 3) - self.avatar.joints[named[self.joint]]
        points = rest @ clip.rotations[0, named[self.joint]].T + ends[self.joint][0]
        speed, free, step = np.zeros_like(points), np.ones((len(points), 1)), 1 / (RATE * SUBSTEPS)
        free[: self.columns] = 0
        found = []
        for moment in range(-SETTLE, last * SUBSTEPS + 1):
            time = max(moment / SUBSTEPS, 0)
            row = min(int(time), last - 1)
            at = {name: x[row] + (time - row) * (x[row + 1] - x[row]) for name, x in ends.items()}
            before = points
            speed = speed * np.exp(-step * (DRAG if moment >= 0 else CALM))
            points = points + free * (speed * step - np.array([0.0, GRAVITY, 0.0]) * step**2)
            points[: self.columns] = rest[: self.columns] @ turns(time).as_matrix().T + at[self.joint]
            for _ in range(ROUNDS):
                self._pull(points, free)
                self._push(points[self.columns :], before[self.columns :], at)
            points[:, 1] = np.maximum(points[:, 1], 0.01)
            speed = (points - before) / step
            speed *= np.minimum(1, FASTEST / np.maximum(np.linalg.norm(speed, axis=1, keepdims=True), 1e-9))
            if moment >= 0 and moment % SUBSTEPS == 0:
                found.append(points.copy())
        return np.stack(found)

    def _pull(self, points: np.ndarray, free: np.ndarray) -> None:
        """Move the ends of all springs towards their lengths, in place."""
        for a, b, length, stiffness in self._springs:
            apart = points[b] - points[a]
            now = np.linalg.norm(apart, axis=1, keepdims=True)
            change = stiffness * (now - length) / np.maximum(now, 1e-9) / np.maximum(free[a] + free[b], 1) * apart
            points[a] += free[a] * change
            points[b] -= free[b] * change

    def _push(self, points: np.ndarray, before: np.ndarray, at: dict[str, np.ndarray]) -> None:
        """Move points out of all capsules, in place; what touches them is slowed down."""
        for start, end, first, second in self._capsules:
            bone = at[end] - at[start]
            share = np.clip((points - at[start]) @ bone / (bone @ bone), 0, 1)[:, None]
            away = points - at[start] - share * bone
            distance, radius = np.linalg.norm(away, axis=1, keepdims=True), first + share * (second - first)
            touches = distance < radius
            points += np.where(touches, (radius - distance) / np.maximum(distance, 1e-6), 0.0) * away
            points -= np.where(touches, FRICTION, 0.0) * (points - before)


def _girth(avatar: Avatar, height: float, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the hull of the trunk reaches at ``height`` in each direction (C,), and its middle (x, z), m."""
    near = (np.abs(avatar.vertices[:, 1] - height) < 0.02) & (np.abs(avatar.vertices[:, 0]) < 0.3)
    slab = avatar.vertices[near][:, [0, 2]]
    centre = (slab.max(axis=0) + slab.min(axis=0)) / 2
    sides = ConvexHull(slab - centre).equations
    towards = np.stack([np.sin(angles), np.cos(angles)], axis=-1) @ sides[:, :2].T
    return np.where(towards > 1e-9, -sides[:, 2] / np.maximum(towards, 1e-9), np.inf).min(axis=1) + 0.012, centre


def pattern(seed: int, kind: str) -> np.ndarray:
    """Return a texture (256, 256, 3) of patches, stripes and seams."""
    make = np.random.default_rng(seed)
    patches = make.uniform(0.75, 1.35, (16, 16, 1)) * make.uniform(0.85, 1.15, (16, 16, 3))
    image = np.kron(patches, np.ones((16, 16, 1))) * np.array(
        [0.62, 0.2, 0.25] if kind == "skirt" else [0.2, 0.35, 0.55]
    )
    image[np.arange(256) % 64 < 8] = [0.9, 0.85, 0.6]
    image[:, np.arange(256) % 128 < 6] = [0.15, 0.15, 0.2]
    return np.clip(image, 0.02, 1)


def dressed(avatar: Avatar, cloth: Cloth, texture: np.ndarray) -> Avatar:
    """Return the avatar with the cloth behind its own vertices and faces; its skin is not that of the cloth."""
    points = cloth.rest.reshape(-1, 3)
    return replace(
        avatar,
        vertices=np.concatenate([avatar.vertices, points]),
        normals=np.concatenate([avatar.normals, np.zeros_like(points)]),
        uv=np.concatenate([avatar.uv, cloth.uv]),
        faces=np.concatenate([avatar.faces, cloth.faces + len(avatar.vertices)]),
        paint=np.concatenate([avatar.paint, np.full(len(cloth.faces), len(avatar.textures))]),
        textures=(*avatar.textures, texture),
    )


def shown_cloth(faces: np.ndarray, first: int, vertices: np.ndarray, pose: np.ndarray, lens: Lens) -> np.ndarray:
    """Return where faces from ``first`` on are seen in at least half of a pixel (size, size) bool."""
    wide = SAMPLES * lens.size
    fragments = rasterize(lens.projected(vertices, pose)[faces], wide, wide)
    hit = np.zeros(wide * wide)
    hit[fragments.index[fragments.faces >= first]] = 1.0
    return hit.reshape(lens.size, SAMPLES, lens.size, SAMPLES).mean(axis=(1, 3)) >= 0.5


def arguments() -> argparse.Namespace:
    """Return the words of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("avatar", type=Path)
    parser.add_argument("performance", help="FILE.npz:FIRST:COUNT, more after commas")
    parser.add_argument("out", type=Path)
    parser.add_argument("--kind", choices=("skirt", "coat"), default="skirt")
    parser.add_argument("--turn", type=float, default=0.6, help="how far the person turns to and fro")
    parser.add_argument("--seed", type=int, default=0, help="of the light and the pattern")
    parser.add_argument("--size", type=int, default=200, help="of the images, pixels")
    parser.add_argument("--frames", type=int, default=52)
    parser.add_argument("--new-frames", type=int, default=24)
    return parser.parse_args()


def main() -> None:
    """Write the capture."""
    given, body = arguments(), default_template()
    parts = [part.rsplit(":", 2) for part in given.performance.split(",")]
    motion = performance([(Path(file), int(first), int(count)) for file, first, count in parts], body, given.turn)
    needed = EVERY * (given.frames + given.new_frames - 1) + 1
    if len(motion) < needed:
        raise SystemExit(f"the performance has {len(motion)} frames, {needed} are needed; name more")
    avatar, light = read_avatar(given.avatar, 1.0), random_light(given.seed)
    clip, cloth = acted(avatar, body, motion), Cloth(avatar, given.kind)
    points, whole = cloth.simulated(clip), dressed(avatar, cloth, pattern(given.seed, given.kind))
    rows = EVERY * np.arange(given.frames + given.new_frames)
    posed = {}
    for row in rows.tolist():
        skin, normals = posed_mesh(avatar, clip.rotations[row], clip.joints[row])
        own = vertex_normals(points[row], cloth.faces)
        posed[row] = np.concatenate([skin, points[row]]), np.concatenate([normals, own])
    target = max(float(vertices[:, 1].max()) for vertices, _ in posed.values()) / 2
    cameras = [*ring(8, 0.0, TRAINING_HEIGHTS, target), *ring(4, np.pi / 8, TEST_HEIGHTS, target)]
    lens = longest_lens([vertices for vertices, _ in posed.values()], np.stack(cameras), given.size)
    frames_of = {"train": rows[: given.frames], "test": rows[: given.frames], "pose": rows[given.frames :]}
    for split, shown in frames_of.items():
        entries: list[dict[str, object]] = []
        for i, row in enumerate(shown.tolist()):
            for camera, pose in list(enumerate(cameras))[slice(8) if split == "train" else slice(8, 12)]:
                name = f"{split}/f{i:03d}_c{camera:02d}.png"
                write_image(given.out / "images" / name, draw(whole, posed[row], pose, lens, light))
                mask = shown_cloth(whole.faces, len(avatar.faces), posed[row][0], pose, lens)
                write_image(given.out / "cloth" / name, np.repeat(mask[..., None].astype(np.float64), 3, axis=2))
                entry = {"file_path": f"images/{name}", "frame": i, "camera": camera, "time": i / (len(shown) - 1)}
                entries.append(entry | {"transform_matrix": pose.tolist()})
        write_transforms(given.out / f"transforms_{split}.json", lens, entries, fps=RATE / EVERY)
        print(f"{split}: {len(entries)} images", flush=True)
    fit = Fit(avatar, body)
    for split in ("train", "pose"):
        part = Clip(clip.rotations[frames_of[split]], clip.joints[frames_of[split]], RATE / EVERY)
        write_amass(fit.placed(part, only_place=split == "pose"), given.out / f"body_{split}.npz")


if __name__ == "__main__":
    main()
