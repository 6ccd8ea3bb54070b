"""Reader of skeletal animations in glTF 2.0 (``.glb``, ``.gltf``) and VRM animations (``.vrma``).

Symbols: F frames, S joints, K keys of a channel.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.core.errors import wrap_read_errors
from dyngs.human.motion.motion import SkeletonMotion, require_frame_count, sample_times
from dyngs.io.fields import require_at_most
from dyngs.io.gltf import MAX_JOINTS, GltfFile

_KINDS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}
_DEFAULTS = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
_VRM_THUMBS = {
    f"{side}Thumb{new}": f"{side}Thumb{old}"
    for side in ("left", "right")
    for new, old in (("Metacarpal", "Proximal"), ("Proximal", "Intermediate"))
}
"""Names of the first two thumb bones in VRM 1, and their names in VRM 0 and for other fingers."""
_Curve = tuple[np.ndarray, np.ndarray, str]
"""Animation curve of a node property: K ascending times, s; K values (3 K for cubic splines); and
the interpolation."""
_Curves = dict[tuple[int, str], _Curve]


def read_gltf(path: Path, fps: float = 30.0, clip: str | None = None) -> SkeletonMotion:
    """Read the motion of a file's joints at ``fps``, from first to last key; the world is y up.

    Joints are those of the largest skin, with its bind pose (or the node transforms) as rest pose.
    Without a skin all animated nodes are joints; without animation they must form a T-pose or
    A-pose. In VRM animations (VRMC_vrm_animation 1.0) joints have the names of VRM's humanoid;
    expressions and gaze are ignored.

    Args:
        path: of the file.
        fps: frames per second.
        clip: name of the animation, if several move the joints.

    Raises:
        DyngsError: no such animation, or something damaged or unsupported (sparse accessors,
            meshopt compression, mirrored nodes).
    """
    with wrap_read_errors(path):
        file = GltfFile(path)
        vrm = _vrm_animation(file)
        bind = None
        if vrm is not None:
            bones = vrm["humanoid"]["humanBones"]
            joints = [bone["node"] for bone in bones.values()]
            names = [_VRM_THUMBS.get(name, name) for name in bones]
        else:
            if file.json.get("skins"):
                skin = max(file.json["skins"], key=lambda skin: len(skin["joints"]))
                joints = skin["joints"]
                bind = skin.get("inverseBindMatrices")
            else:
                joints = _animated_nodes(file, clip)
            names = [file.nodes[node].get("name", "") for node in joints]
        require_at_most(path, len(joints), MAX_JOINTS, "joints")
        chain = _with_ancestors(file, joints)
        curves = _curves(file, _select_animation(file, chain, clip), chain)
        start = min(times[0] for times, _, _ in curves.values())
        end = max(times[-1] for times, _, _ in curves.values())
        require_frame_count(path, float((end - start) * fps), len(chain))
        times = start + sample_times(end - start, 1.0, fps)
        rotations, positions = _world_transforms(file, chain, joints, curves, times)
        if not (np.abs(positions) < 1e9).all():
            raise file.error("joint positions are out of range; export it again")
        if bind is None:
            rotations_at_rest, positions_at_rest = _world_transforms(
                file, chain, joints, {}, np.zeros(1)
            )
            rest_joints = positions_at_rest[0]
            joint_from_rest = rotations_at_rest[0].swapaxes(1, 2)
        else:
            matrices = _finite_numbers(file, bind, "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)
            matrices = matrices[: len(joints)]
            joint_from_rest = _nearest_rotations(file, matrices[:, :3, :3])
            rest_joints = -np.linalg.solve(matrices[:, :3, :3], matrices[:, :3, 3:])[..., 0]
        return SkeletonMotion(
            path,
            tuple(map(str, names)),
            rest_joints,
            rotations @ joint_from_rest,
            positions,
            fps,
            True,
        )


def _animated_nodes(file: GltfFile, clip: str | None) -> list[int]:
    """Return the nodes that the animation moves, with all their descendants."""
    channels = _select_animation(file, range(len(file.nodes)), clip)["channels"]
    targets = [channel["target"] for channel in channels]
    queue = [target.get("node") for target in targets if target["path"] in _KINDS]
    animated: set[int] = set()
    while queue:
        node = queue.pop()
        if node is not None and node not in animated:
            animated.add(node)
            queue += file.nodes[node].get("children", [])
    return sorted(animated)


def _with_ancestors(file: GltfFile, joints: Sequence[int]) -> dict[int, int | None]:
    """Return the parent of each joint and of its ancestors, parents first; None for roots."""
    parents: dict[int, int] = {}
    for i, owner in enumerate(file.nodes):
        parents.update(dict.fromkeys(owner.get("children", []), i))
    chain: dict[int, int | None] = {}
    for joint in joints:
        ancestors: dict[int, int | None] = {}
        node: int | None = joint
        while node is not None and node not in chain:
            if node in ancestors:
                raise file.error(f"node {joint} is its own ancestor; export it again")
            ancestors[node] = parents.get(node)
            node = ancestors[node]
        chain.update(reversed(ancestors.items()))
    return chain


def _vrm_animation(file: GltfFile) -> dict[str, Any] | None:
    return file.json.get("extensions", {}).get("VRMC_vrm_animation")


def _select_animation(
    file: GltfFile, nodes: Container[int | None], clip: str | None
) -> dict[str, Any]:
    """Return the animation named ``clip``, or the only one that moves one of the nodes."""
    moving = [
        x
        for x in file.json.get("animations", [])
        if any(channel["target"].get("node") in nodes for channel in x["channels"])
    ]
    if not moving:
        raise file.error("no animation moves its joints; export it with the animation")
    matches = [x for x in moving if clip in (None, x.get("name", ""))]
    if not matches or (len(matches) > 1 and clip is None and _vrm_animation(file) is None):
        names = ", ".join(f"{x.get('name', '')!r:.32}" for x in moving[:20])
        problem = (
            "several animations; choose one of" if matches else f"no animation {clip!r}; it has"
        )
        raise file.error(f"has {problem} {names}")
    return matches[0]


def _curves(file: GltfFile, animation: dict[str, Any], chain: dict[int, int | None]) -> _Curves:
    """Return the animation curves of nodes in ``chain``, by node and property."""
    curves: _Curves = {}
    for channel in animation["channels"]:
        node = channel["target"].get("node")
        kind = channel["target"]["path"]
        if node not in chain or kind not in _KINDS:
            continue
        sampler = animation["samplers"][channel["sampler"]]
        interpolation = sampler.get("interpolation", "LINEAR")
        rows = {"LINEAR": 1, "STEP": 1, "CUBICSPLINE": 3}[interpolation]
        times = _finite_numbers(file, sampler["input"], "SCALAR")[:, 0]
        values = _finite_numbers(file, sampler["output"], _KINDS[kind])
        if len(values) != rows * len(times) or (np.diff(times) < 0).any():
            raise file.error(f"invalid {kind} keys of node {node}; export it again")
        curves[node, kind] = (times, values, interpolation)
    if not curves:
        raise file.error("its animation moves no joint; choose another clip")
    return curves


def _finite_numbers(file: GltfFile, index: int, kind: str) -> np.ndarray:
    values = file.numbers(index, kind)
    if not (np.abs(values) < 1e9).all():
        raise file.error(f"accessor {index} holds NaN or huge numbers; export it again")
    return values


def _world_transforms(
    file: GltfFile,
    chain: dict[int, int | None],
    joints: Sequence[int],
    curves: _Curves,
    times: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return world rotations (F, S, 3, 3) and positions (F, S, 3) of joints at ``times`` (F,)."""
    world: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for index, parent in chain.items():
        matrix, rotation = _local(file, index, curves, times)
        if parent is not None:
            parent_matrix, parent_rotation = world[parent]
            matrix = parent_matrix @ matrix
            rotation = parent_rotation @ rotation
        world[index] = (matrix, rotation)
    rotations = np.stack([world[node][1] for node in joints], axis=1)
    return rotations, np.stack([world[node][0][:, :3, 3] for node in joints], axis=1)


def _local(
    file: GltfFile, index: int, curves: _Curves, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return a node's transform (F, 4, 4) relative to its parent, and its rotation (F, 3, 3)."""
    node = file.nodes[index]
    matrix = np.tile(np.eye(4), (len(times), 1, 1))
    if "matrix" in node:
        matrix[:] = np.reshape(node["matrix"], (4, 4)).T
        return matrix, _nearest_rotations(file, matrix[:, :3, :3])
    values = {
        kind: _evaluate_curve(curves[index, kind], times)
        if (index, kind) in curves
        else np.tile(np.array(node.get(kind, default), np.float64), (len(times), 1))
        for kind, default in _DEFAULTS.items()
    }
    if (values["scale"].prod(axis=1) < 0).any():
        raise file.error(f"node {index} is mirrored; export it without negative scale")
    rotation = Rotation.from_quat(values["rotation"]).as_matrix()
    matrix[:, :3, :3] = rotation * values["scale"][:, None]
    matrix[:, :3, 3] = values["translation"]
    return matrix, rotation


def _evaluate_curve(curve: _Curve, times: np.ndarray) -> np.ndarray:
    """Return curve values (F, 3) or (F, 4) at ``times`` (F,), clamped to the keys."""
    keys, values, interpolation = curve
    # Keys are float32; the tolerance keeps rounding from missing a step.
    slack = 1e-4 if interpolation == "STEP" else 0.0
    after = np.searchsorted(keys, times + slack, side="right")
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, len(keys) - 1)
    if interpolation == "STEP":
        return values[before]
    span = keys[after] - keys[before]
    fraction = ((times - keys[before]) / np.where(span > 0, span, 1.0))[:, None]
    if interpolation == "CUBICSPLINE":
        arriving, points, leaving = values.reshape(len(keys), 3, -1).transpose(1, 0, 2)
        ease = fraction * fraction * (3 - 2 * fraction)
        slopes = (1 - fraction) * leaving[before] - fraction * arriving[after]
        bend = span[:, None] * fraction * (1 - fraction) * slopes
        return points[before] + ease * (points[after] - points[before]) + bend
    start = values[before]
    end = values[after]
    if start.shape[1] == 3:
        return start + fraction * (end - start)
    first = Rotation.from_quat(start)
    turn = first.inv() * Rotation.from_quat(end)
    return (first * Rotation.from_rotvec(fraction * turn.as_rotvec())).as_quat()


def _nearest_rotations(file: GltfFile, linear: np.ndarray) -> np.ndarray:
    """Return the nearest rotations (S, 3, 3): U V^T of the SVD U D V^T."""
    if not (np.linalg.det(linear) > 0).all():
        raise file.error("a matrix is flat or mirrored; export it without negative scale")
    left, _, right = np.linalg.svd(linear)
    return left @ right
