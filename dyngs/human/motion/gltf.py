"""Reader of skeletal animations in glTF 2.0 files (``.glb``, ``.gltf``), and of VRM animations
(``.vrma``).

Local letters: S joints, K keys of a channel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.core.errors import reading
from dyngs.human.motion.motion import (
    SkeletonMotion,
    frame_chunks,
    require_frame_count,
    sample_times,
)
from dyngs.io.fields import require_at_most
from dyngs.io.gltf import MOST_JOINTS, GltfFile

_KINDS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}
_AT_REST = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
_VRM_THUMBS = {
    f"{side}Thumb{new}": f"{side}Thumb{old}"
    for side in ("left", "right")
    for new, old in (("Metacarpal", "Proximal"), ("Proximal", "Intermediate"))
}
"""Names of the thumb's first two bones in VRM 1, and what VRM 0, and all other fingers, call
these."""


@dataclass(frozen=True)
class _Curve:
    """Animation curve of one property of a node: K ascending times, s, and K values, or 3 K for a
    cubic spline."""

    times: np.ndarray
    values: np.ndarray
    interpolation: str


@dataclass(frozen=True)
class _Transforms:
    """Transforms of a node in F frames: linear part and rotation (F, 3, 3), position (F, 3)."""

    linear: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray


@dataclass(frozen=True)
class _Rig:
    """The joints of a file: nodes, names, and inverse bind matrices (an accessor); None: the nodes
    stand at rest."""

    joints: tuple[int, ...]
    names: tuple[str, ...]
    bind: int | None = None


def read_gltf(path: Path, fps: float = 30.0, clip: str | None = None) -> SkeletonMotion:
    """Read the motion of a file's joints at ``fps`` frames per second, from first to last key; the
    world is y up.

    The joints are those of the largest skin, at rest in the bind pose, or without inverse bind
    matrices as the nodes stand. Without a skin all animated nodes are joints, and must show a
    T-pose or an A-pose without animation. ``clip`` names the animation, where several move the
    joints. Raises DyngsError: no such animation, anything broken or not supported (sparse
    accessors, meshopt compression, mirrored nodes); names the file.
    """
    with reading(path):
        file = GltfFile(path)
        rig = _skin(file) or _animated_nodes(file, clip)
        return _motion(file, rig, fps, _chosen(file, _with_ancestors(file, rig.joints), clip))


def read_vrm_animation(path: Path, fps: float = 30.0, clip: str | None = None) -> SkeletonMotion:
    """Read a VRM animation (``.vrma``, extension VRMC_vrm_animation 1.0): the bones have the names
    of VRM's humanoid.

    Without animation the nodes stand in a T-pose. The first animation counts unless ``clip`` names
    another. Expressions and the gaze are left out. Raises DyngsError: as ``read_gltf``, or the
    extension is missing.
    """
    with reading(path):
        file = GltfFile(path)
        extension = file.json.get("extensions", {}).get("VRMC_vrm_animation")
        if extension is None:
            raise file.error("has no VRMC_vrm_animation; a plain glTF animation ends in .glb")
        bones = extension["humanoid"]["humanBones"]
        rig = _Rig(
            tuple(bone["node"] for bone in bones.values()),
            tuple(_VRM_THUMBS.get(name, name) for name in bones),
        )
        chain = _with_ancestors(file, rig.joints)
        moving = _moving(file, chain)
        chosen = moving[0] if moving and clip is None else _chosen(file, chain, clip)
        return _motion(file, rig, fps, chosen)


def _skin(file: GltfFile) -> _Rig | None:
    if not file.json.get("skins"):
        return None
    largest = max(file.json["skins"], key=lambda skin: len(skin["joints"]))
    joints = tuple(largest["joints"])
    names = tuple(file.nodes[node].get("name", "") for node in joints)
    return _Rig(joints, names, largest.get("inverseBindMatrices"))


def _animated_nodes(file: GltfFile, clip: str | None) -> _Rig:
    nodes = file.nodes
    channels = _chosen(file, dict.fromkeys(range(len(nodes))), clip)["channels"]
    targets = [channel["target"] for channel in channels]
    waiting = [x["node"] for x in targets if x["path"] in _KINDS and "node" in x]
    found: set[int] = set()
    while waiting:
        node = waiting.pop()
        if node not in found and node < len(nodes):
            found.add(node)
            waiting += nodes[node].get("children", [])
    joints = tuple(sorted(found))
    if not joints:
        raise file.error("its animation moves no node; export it again")
    return _Rig(joints, tuple(nodes[node].get("name", "") for node in joints))


def _motion(file: GltfFile, rig: _Rig, fps: float, animation: dict[str, Any]) -> SkeletonMotion:
    joints = rig.joints
    require_at_most(file.path, len(joints), MOST_JOINTS, "joints")
    chain = _with_ancestors(file, joints)
    curves = _curves(file, animation, chain)
    start = min(c.times[0] for c in curves.values())
    end = max(c.times[-1] for c in curves.values())
    require_frame_count(file.path, float((end - start) * fps), len(chain))
    times = start + sample_times(end - start, 1.0, fps)
    rotations = np.empty((len(times), len(joints), 3, 3))
    positions = np.empty((len(times), len(joints), 3))
    for part in frame_chunks(len(times)):
        moving = _world_transforms(file, chain, curves, times[part])
        for i, node in enumerate(joints):
            rotations[part, i] = moving[node].rotations
            positions[part, i] = moving[node].positions
    if not (np.abs(positions) < 1e9).all():
        raise file.error("its joints move beyond all bounds; export it again")
    if rig.bind is None:
        still = _world_transforms(file, chain, {}, np.zeros(1))
        rest = np.stack([still[node].positions[0] for node in joints])
        rest_from_joint = np.stack([still[node].rotations[0] for node in joints])
    else:
        rest, rest_from_joint = _bind_pose(file, rig.bind, len(joints))
    for part in frame_chunks(len(times)):
        rotations[part] = rotations[part] @ rest_from_joint.swapaxes(1, 2)
    return SkeletonMotion(file.path, rig.names, rest, rotations, positions, fps, world_is_y_up=True)


def _with_ancestors(file: GltfFile, joints: tuple[int, ...]) -> dict[int, int | None]:
    """Return the parent of each joint and of all their ancestors, parents first; None for roots."""
    nodes = file.nodes
    parents: dict[int, int] = {}
    for i, owner in enumerate(nodes):
        for child in owner.get("children", []):
            if child >= len(nodes) or child in parents:
                raise file.error(f"node {child} is missing or has two parents; export it again")
            parents[child] = i
    chain: dict[int, int | None] = {}
    for joint in joints:
        if not 0 <= joint < len(nodes):
            raise file.error(f"the skin's joint {joint} is missing; export it again")
        above: list[int] = []
        node: int | None = joint
        while node is not None and node not in chain:
            above.append(node)
            node = parents.get(node)
            if len(above) > len(nodes):
                raise file.error(f"node {joint} is its own ancestor; export it again")
        chain.update((x, parents.get(x)) for x in reversed(above))
    return chain


def _chosen(file: GltfFile, chain: dict[int, int | None], clip: str | None) -> dict[str, Any]:
    """Return the animation of that name, or the only one that moves a node of the chain."""
    moving = _moving(file, chain)
    named = [a for a in moving if clip in (None, a.get("name", ""))]
    names = ", ".join(f"{a.get('name', '')!r:.32}" for a in moving[:20])
    if not moving:
        raise file.error("no animation moves its joints; export it with the animation")
    if not named:
        raise file.error(f"has no animation {clip!r}; it has {names}")
    if clip is None and len(named) > 1:
        raise file.error(f"has several animations; choose a clip of {names}")
    return named[0]


def _moving(file: GltfFile, chain: dict[int, int | None]) -> list[dict[str, Any]]:
    return [
        animation
        for animation in file.json.get("animations", [])
        if any(channel["target"].get("node") in chain for channel in animation["channels"])
    ]


def _curves(
    file: GltfFile, animation: dict[str, Any], chain: dict[int, int | None]
) -> dict[tuple[int, str], _Curve]:
    curves: dict[tuple[int, str], _Curve] = {}
    for channel in animation["channels"]:
        node = channel["target"].get("node")
        kind = channel["target"]["path"]
        if node not in chain or kind not in _KINDS:
            continue
        if "matrix" in file.nodes[node]:
            raise file.error(f"node {node} is animated but has a matrix; export it again")
        sampler = animation["samplers"][channel["sampler"]]
        interpolation = sampler.get("interpolation", "LINEAR")
        per_key = {"LINEAR": 1, "STEP": 1, "CUBICSPLINE": 3}[interpolation]
        times = _finite(file, sampler["input"], "SCALAR")[:, 0]
        values = _finite(file, sampler["output"], _KINDS[kind])
        if len(values) != len(times) * per_key:
            raise file.error(
                f"a {kind} of node {node} has {len(times)} times but {len(values)} values"
            )
        if (np.diff(times) < 0).any():
            raise file.error(f"the times of a {kind} of node {node} do not ascend; export it again")
        curves[node, kind] = _Curve(times, values, interpolation)
    if not curves:
        raise file.error("its animation moves no joint; choose another clip")
    return curves


def _finite(file: GltfFile, index: int, kind: str) -> np.ndarray:
    values = file.numbers(index, kind)
    if not (np.abs(values) < 1e9).all():
        raise file.error(f"accessor {index} holds NaN or huge numbers; export it again")
    return values


def _world_transforms(
    file: GltfFile,
    chain: dict[int, int | None],
    curves: dict[tuple[int, str], _Curve],
    times: np.ndarray,
) -> dict[int, _Transforms]:
    """Return the transforms of the nodes of the chain in the world at ``times`` (F,)."""
    placed: dict[int, _Transforms] = {}
    for index, parent in chain.items():
        local = _local(file, index, curves, times)
        if parent is None:
            placed[index] = local
            continue
        above = placed[parent]
        position = above.positions + (above.linear @ local.positions[..., None])[..., 0]
        placed[index] = _Transforms(
            above.linear @ local.linear, above.rotations @ local.rotations, position
        )
    return placed


def _local(
    file: GltfFile, index: int, curves: dict[tuple[int, str], _Curve], times: np.ndarray
) -> _Transforms:
    """Return the transforms of a node relative to its parent: T R S, or its matrix."""
    node = file.nodes[index]
    frames = len(times)
    if "matrix" in node:
        matrix = np.array(node["matrix"], np.float64).reshape(4, 4).T
        rotation = _rotation_of(file, matrix[None, :3, :3])
        still = (matrix[:3, :3], rotation[0], matrix[:3, 3])
        return _Transforms(*(np.broadcast_to(x, (frames, *x.shape)) for x in still))
    values: dict[str, np.ndarray] = {}
    for kind, still_value in _AT_REST.items():
        curve = curves.get((index, kind))
        fixed = np.tile(np.array(node.get(kind, still_value), np.float64), (frames, 1))
        values[kind] = fixed if curve is None else _sampled(file, curve, times)
    rotation = _rotations(file, values["rotation"]).as_matrix()
    if (values["scale"].prod(axis=1) < 0).any():
        raise file.error(f"node {index} is mirrored; export it without negative scale")
    return _Transforms(rotation * values["scale"][:, None], rotation, values["translation"])


def _sampled(file: GltfFile, curve: _Curve, times: np.ndarray) -> np.ndarray:
    """Return values (F, 3) or (F, 4) at ``times`` (F,), clamped to the first and the last key."""
    # keys are float32: rounding must not miss a step
    slack = 1e-4 if curve.interpolation == "STEP" else 0.0
    after = np.searchsorted(curve.times, times + slack, side="right")
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(curve.times) - 1)
    span = curve.times[after] - curve.times[before]
    fraction = ((times - curve.times[before]) / np.where(span > 0, span, 1.0))[:, None]
    if curve.interpolation == "CUBICSPLINE":
        arriving, keys, leaving = curve.values.reshape(len(curve.times), 3, -1).transpose(1, 0, 2)
        ease = fraction * fraction * (3 - 2 * fraction)
        bend = (
            span[:, None]
            * fraction
            * (1 - fraction)
            * ((1 - fraction) * leaving[before] - fraction * arriving[after])
        )
        return keys[before] + ease * (keys[after] - keys[before]) + bend
    if curve.interpolation == "STEP":
        return curve.values[before]
    start = curve.values[before]
    end = curve.values[after]
    if start.shape[1] == 3:
        return start + fraction * (end - start)
    turned = _rotations(file, start)
    return (
        turned * Rotation.from_rotvec(fraction * (turned.inv() * _rotations(file, end)).as_rotvec())
    ).as_quat()


def _rotations(file: GltfFile, quats: np.ndarray) -> Rotation:
    largest = np.abs(quats).max(axis=1, keepdims=True)
    if (largest == 0).any():
        raise file.error("a rotation is a quaternion of zeros; export it again")
    return Rotation.from_quat(quats / largest)


def _bind_pose(file: GltfFile, index: int, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Return joints (S, 3) and rotations rest_from_joint (S, 3, 3) of the bind pose."""
    matrices = _finite(file, index, "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)[:joints]
    if len(matrices) < joints:
        raise file.error(
            f"has {len(matrices)} inverse bind matrices for {joints} joints; export it again"
        )
    joint_from_rest = _rotation_of(file, matrices[:, :3, :3])
    rest = -np.linalg.solve(matrices[:, :3, :3], matrices[:, :3, 3:])[..., 0]
    return rest, joint_from_rest.swapaxes(1, 2)


def _rotation_of(file: GltfFile, linear: np.ndarray) -> np.ndarray:
    """Return the nearest rotations (S, 3, 3): U V^T of the singular value decomposition U D V^T."""
    left, stretch, right = np.linalg.svd(linear)
    if (stretch[:, 2] <= 1e-9 * stretch[:, 0]).any() or (np.linalg.det(left @ right) < 0).any():
        raise file.error("a matrix is flat or mirrored; export it without negative scale")
    return left @ right
