"""Loose cloth: Gaussians are offset as a small network says of the pose and of how the body has moved until then.

Skirts and coats follow no joint: they hang, lag and swing. The network gives the offsets of M control nodes on the
surface at rest in the frame of the pelvis, as a sum of learned shapes; Gaussians are offset as the nodes around them.
Local letters: N Gaussians, M nodes, J joints, F frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.gaussians import Gaussians
from dyngs.gaussians.parameters import Parameters
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.motion.motion import CapturedMotion, MotionClip
from dyngs.ops.perceptron import Layer, perceptron
from dyngs.state import fields_moved_to

NODES, APART = 300, 0.02  # most nodes, and the raster of the points that they are chosen from, m
AROUND = 6  # nodes that a Gaussian follows
SHAPES, WIDTH = 16, 32  # number of learned shapes of all nodes, and of the network's hidden units
FARTHEST = 0.25  # bound on the offset of a node along each axis, m
NOISE = 0.3
"""Standard deviation of what is added to the network's inputs in training: few frames must not be learned by heart."""
BENT = (1, 2, 3, 4, 5)  # joints whose rotations are inputs: hips, the lowest of the spine, knees
SWUNG = (1, 2, 4, 5)  # joints whose velocities are: hips and knees
LAGS = (0.0, 0.15, 0.4)  # time constants of the averages of the pelvis's velocities, s
TURN_RATE, SPEED, BEND_RATE = 3.0, 0.5, 4.0  # units of the inputs: rad/s and m/s of the pelvis, rad/s of joints
PAST = 6 * len(LAGS) + 3 + 3 * len(SWUNG)  # number of values that tell how the body has moved
INPUTS = 3 * len(BENT) + 3 + PAST
LR = {"cloth_nodes": 0.0, "cloth_shapes": 2e-2, "cloth_in": 4e-3, "cloth_in_bias": 4e-3, "cloth_out": 4e-3}
LR |= {"cloth_out_bias": 4e-3}
"""Learning rates; nodes stay."""


def nodes_on(points: Tensor) -> Tensor:
    """Return at most ``NODES`` of the points (N, 3) at rest, on a raster, each the farthest from those before it."""
    left = np.unique(np.round(points.detach().double().cpu().numpy() / APART), axis=0) * APART
    chosen = [left[0]]
    away = np.linalg.norm(left - left[0], axis=1)
    while len(chosen) < NODES and away.max() > 0:
        chosen.append(left[away.argmax()])
        away = np.minimum(away, np.linalg.norm(left - chosen[-1], axis=1))
    return torch.from_numpy(np.stack(chosen)).to(points)


def first_cloth(nodes: Tensor) -> dict[str, Tensor]:
    """Return what is learned of cloth on nodes (M, 3), which hangs as the skin at first: names as in ``LR``."""
    make = torch.Generator("cpu").manual_seed(0)
    first = torch.randn(WIDTH, INPUTS, generator=make, device="cpu") / math.sqrt(INPUTS)
    bias = 0.3 * torch.randn(WIDTH, generator=make, device="cpu")
    last = torch.randn(SHAPES, WIDTH, generator=make, device="cpu") * math.sqrt(2 / WIDTH)
    return {
        "cloth_nodes": nodes,
        "cloth_shapes": nodes.new_zeros(SHAPES, 3 * len(nodes)),
        "cloth_in": first.to(nodes),
        "cloth_in_bias": bias.to(nodes),
        "cloth_out": last.to(nodes),
        "cloth_out_bias": nodes.new_zeros(SHAPES),
    }


@dataclass(frozen=True)
class Hold:
    """Which nodes hold each of N Gaussians."""

    rows: Tensor  # (N, K) int64
    weights: Tensor  # (N, K), rows sum to 1

    def to(self, *, device: torch.device | str) -> Hold:
        """Return the same on ``device``."""
        return fields_moved_to(self, device)

    def select(self, index: Tensor) -> Hold:
        """Return the rows at ``index`` (long)."""
        return Hold(self.rows[index], self.weights[index])


def hold_of(points: Tensor, nodes: Tensor) -> Hold:
    """Return the nodes around each of ``points`` (N, 3) at rest, weighted by a Gaussian of their distance.

    Its width is the median distance to the third nearest node.
    """
    from scipy.spatial import KDTree

    count = min(AROUND, len(nodes))
    places, held = (x.detach().double().cpu().numpy() for x in (nodes, points))
    away, rows = (np.asarray(x).reshape(len(held), count) for x in KDTree(places).query(held, k=count))
    wide = max(float(np.median(away[:, min(2, count - 1)])), 1e-6) if len(away) else 1.0
    near = np.exp(-np.square(away / wide) + np.square(away[:, :1] / wide))
    weights = near / near.sum(1, keepdims=True)
    return Hold(torch.from_numpy(rows).long().to(points.device), torch.from_numpy(weights).to(points))


def draped(
    gaussians: Gaussians, learned: Parameters, hold: Hold, posing: BodyPose, up: Tensor, noise: Tensor | None = None
) -> Gaussians:
    """Return posed Gaussians with what the cloth does in this pose; ``up`` (3,) is a unit vector of the world.

    A pose without a past is one in which the body stands still. ``noise`` (``INPUTS``,) is added to the inputs.
    """
    root = posing.rotations[0]
    past = root.new_zeros(PAST) if posing.past is None else posing.past
    bent = posing.rotations[list(BENT)]
    skew = bent - bent.transpose(1, 2)
    sines = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=-1) / 2
    inputs = torch.cat([sines.flatten(), root.T @ up - root.new_tensor([0.0, 1.0, 0.0]), past])
    inputs = inputs if noise is None else inputs + noise
    layers = [Layer(learned[f"cloth_{name}"], learned[f"cloth_{name}_bias"]) for name in ("in", "out")]
    nodes = (perceptron(inputs[None], layers)[0] @ learned["cloth_shapes"]).unflatten(0, (-1, 3))
    nodes = (FARTHEST * nodes.tanh()) @ root.T
    parts = nodes.index_select(0, hold.rows.flatten()).unflatten(0, hold.rows.shape)
    offsets = (hold.weights[..., None] * parts).sum(1)
    return gaussians.replace(means=gaussians.means + posing.scale * offsets)


def training_noise(step: int, like: Tensor) -> Tensor:
    """Return what is added to the inputs in a step of training (``INPUTS``,); the same for the same step."""
    return NOISE * torch.randn(INPUTS, generator=torch.Generator("cpu").manual_seed(step), device="cpu").to(like)


def past_motion(clip: MotionClip, seconds: np.ndarray) -> Tensor:
    """Return how the body has moved until each frame of a clip (F, ``PAST``), in the frame of the pelvis.

    Velocities of the pelvis (rotation, then translation) by central differences and their averages, which forget with
    the time constants ``LAGS``; those of the joints ``SWUNG``; the squares of the pelvis's rotation, which lifts a
    skirt to all sides alike. ``seconds`` (F,) ascending, of the frames.
    """
    from scipy.spatial.transform import Rotation

    count = len(clip)
    if count < 2:
        return clip.poses.new_zeros(count, PAST)
    poses = clip.poses.detach().double().cpu().numpy()
    root = Rotation.from_rotvec(poses[:, 0])
    place = clip.trans.detach().double().cpu().numpy() / float(clip.scale.mean())
    before, after = np.maximum(np.arange(count) - 1, 0), np.minimum(np.arange(count) + 1, count - 1)
    apart = (seconds[after] - seconds[before])[:, None]
    last, following = (Rotation.from_rotvec(poses[rows, 0]) for rows in (before, after))
    turning = (following * last.inv()).as_rotvec() / apart / TURN_RATE
    world = np.concatenate([turning, (place[after] - place[before]) / apart / SPEED], axis=1)
    found = []
    for lag in LAGS:
        average = world.copy()
        for row in range(1, count if lag else 0):
            share = 1 - math.exp(-(seconds[row] - seconds[row - 1]) / lag)
            average[row] = average[row - 1] + share * (world[row] - average[row - 1])
        found += [root.inv().apply(average[:, :3]), root.inv().apply(average[:, 3:])]
    for joint in SWUNG:
        last, following = (Rotation.from_rotvec(poses[rows, joint]) for rows in (before, after))
        found.append((last.inv() * following).as_rotvec() / apart / BEND_RATE)
    found.append(np.square(found[0]))
    return torch.from_numpy(np.concatenate(found, axis=1)).to(clip.poses)


def remembering(shown: CapturedMotion, fps: float | None) -> MotionClip:
    """Return the clip of captured frames at ``fps`` per second with its ``past_motion``; the same where it is None."""
    clip = shown.clip
    if fps is None:
        return clip
    seconds = (np.array(shown.frames, np.float64) / fps)[: len(clip)]
    return replace(clip, past=past_motion(clip, seconds))
