"""Reader of skeletal animations in glTF 2.0 files (``.glb``, ``.gltf``), and of VRM animations
(``.vrma``).

Local letters: S joints, K keys of a channel.
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
_AT_REST = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
_VRM_THUMBS = {
    f"{side}Thumb{new}": f"{side}Thumb{old}"
    for side in ("left", "right")
    for new, old in (("Metacarpal", "Proximal"), ("Proximal", "Intermediate"))
}
"""Names of the thumb's first two bones in VRM 1, and what VRM 0, and all other fingers, call
these."""
_Curve = tuple[np.ndarray, np.ndarray, str]
"""Animation curve of one property of a node: K ascending times, s, K values, or 3 K for a cubic
spline, and the interpolation."""
_Curves = dict[tuple[int, str], _Curve]


def read_gltf(path: Path, fps: float = 30.0, clip: str | None = None) -> SkeletonMotion:
    """Read the motion of a file's joints at ``fps`` frames per second, from first to last key; the
    world is y up.

    The joints are those of the largest skin, at rest in the bind pose, or without inverse bind
    matrices as the nodes stand. Without a skin all animated nodes are joints, and must show a
    T-pose or an A-pose without animation. ``clip`` names the animation, where several move the
    joints. Of a VRM animation (extension VRMC_vrm_animation 1.0), which stands in a T-pose without
    animation, joints have the names of VRM's humanoid, and the first animation counts unless
    ``clip`` names another; expressions and the gaze are left out. Raises DyngsError: no such
    animation, anything broken or not supported (sparse accessors, meshopt compression, mirrored
    nodes); names the file.
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
        curves = _curves(file, _chosen(file, chain, clip), chain)
        start = min(times[0] for times, _, _ in curves.values())
        end = max(times[-1] for times, _, _ in curves.values())
        require_frame_count(path, float((end - start) * fps), len(chain))
        times = start + sample_times(end - start, 1.0, fps)
        rotations, positions = _world_transforms(file, chain, joints, curves, times)
        if not (np.abs(positions) < 1e9).all():
            raise file.error("its joints move beyond all bounds; export it again")
        if bind is None:
            turned, still = _world_transforms(file, chain, joints, {}, np.zeros(1))
            rest = still[0]
            joint_from_rest = turned[0].swapaxes(1, 2)
        else:
            matrices = _finite(file, bind, "MAT4").reshape(-1, 4, 4).swapaxes(1, 2)
            matrices = matrices[: len(joints)]
            joint_from_rest = _nearest_rotations(file, matrices[:, :3, :3])
            rest = -np.linalg.solve(matrices[:, :3, :3], matrices[:, :3, 3:])[..., 0]
        return SkeletonMotion(
            path, tuple(map(str, names)), rest, rotations @ joint_from_rest, positions, fps, True
        )


def _animated_nodes(file: GltfFile, clip: str | None) -> list[int]:
    """Return the nodes that the animation moves, and all below them."""
    channels = _chosen(file, range(len(file.nodes)), clip)["channels"]
    targets = [channel["target"] for channel in channels]
    waiting = [target.get("node") for target in targets if target["path"] in _KINDS]
    found: set[int] = set()
    while waiting:
        node = waiting.pop()
        if node is not None and node not in found:
            found.add(node)
            waiting += file.nodes[node].get("children", [])
    return sorted(found)


def _with_ancestors(file: GltfFile, joints: Sequence[int]) -> dict[int, int | None]:
    """Return the parent of each joint and of all their ancestors, parents first; None for roots."""
    parents: dict[int, int] = {}
    for i, owner in enumerate(file.nodes):
        parents.update(dict.fromkeys(owner.get("children", []), i))
    chain: dict[int, int | None] = {}
    for joint in joints:
        above: dict[int, int | None] = {}
        node: int | None = joint
        while node is not None and node not in chain:
            if node in above:
                raise file.error(f"node {joint} is its own ancestor; export it again")
            above[node] = parents.get(node)
            node = above[node]
        chain.update(reversed(above.items()))
    return chain


def _vrm_animation(file: GltfFile) -> dict[str, Any] | None:
    return file.json.get("extensions", {}).get("VRMC_vrm_animation")


def _chosen(file: GltfFile, nodes: Container[int | None], clip: str | None) -> dict[str, Any]:
    """Return the animation of that name, or the only one that moves one of the nodes."""
    moving = [
        x
        for x in file.json.get("animations", [])
        if any(channel["target"].get("node") in nodes for channel in x["channels"])
    ]
    if not moving:
        raise file.error("no animation moves its joints; export it with the animation")
    named = [x for x in moving if clip in (None, x.get("name", ""))]
    if not named or (len(named) > 1 and clip is None and _vrm_animation(file) is None):
        names = ", ".join(f"{x.get('name', '')!r:.32}" for x in moving[:20])
        problem = (
            "several animations; choose a clip of" if named else f"no animation {clip!r}; it has"
        )
        raise file.error(f"has {problem} {names}")
    return named[0]


def _curves(file: GltfFile, animation: dict[str, Any], chain: dict[int, int | None]) -> _Curves:
    """Return the curves of an animation that move nodes of the chain, by node and property."""
    curves: _Curves = {}
    for channel in animation["channels"]:
        node = channel["target"].get("node")
        kind = channel["target"]["path"]
        if node not in chain or kind not in _KINDS:
            continue
        sampler = animation["samplers"][channel["sampler"]]
        interpolation = sampler.get("interpolation", "LINEAR")
        rows = {"LINEAR": 1, "STEP": 1, "CUBICSPLINE": 3}[interpolation]
        times = _finite(file, sampler["input"], "SCALAR")[:, 0]
        values = _finite(file, sampler["output"], _KINDS[kind])
        if len(values) != rows * len(times) or (np.diff(times) < 0).any():
            raise file.error(f"the keys of a {kind} of node {node} are broken; export it again")
        curves[node, kind] = (times, values, interpolation)
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
    joints: Sequence[int],
    curves: _Curves,
    times: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotations (F, S, 3, 3) and positions (F, S, 3) of joints in the world at ``times``
    (F,)."""
    placed: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for index, parent in chain.items():
        matrix, rotation = _local(file, index, curves, times)
        if parent is not None:
            above, turn = placed[parent]
            matrix = above @ matrix
            rotation = turn @ rotation
        placed[index] = (matrix, rotation)
    rotations = np.stack([placed[node][1] for node in joints], axis=1)
    return rotations, np.stack([placed[node][0][:, :3, 3] for node in joints], axis=1)


def _local(
    file: GltfFile, index: int, curves: _Curves, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the transform (F, 4, 4) of a node relative to its parent, T R S or its matrix, and its
    rotation (F, 3, 3)."""
    node = file.nodes[index]
    matrix = np.tile(np.eye(4), (len(times), 1, 1))
    if "matrix" in node:
        matrix[:] = np.reshape(node["matrix"], (4, 4)).T
        return matrix, _nearest_rotations(file, matrix[:, :3, :3])
    values = {
        kind: _sampled(curves[index, kind], times)
        if (index, kind) in curves
        else np.tile(np.array(node.get(kind, still), np.float64), (len(times), 1))
        for kind, still in _AT_REST.items()
    }
    if (values["scale"].prod(axis=1) < 0).any():
        raise file.error(f"node {index} is mirrored; export it without negative scale")
    rotation = Rotation.from_quat(values["rotation"]).as_matrix()
    matrix[:, :3, :3] = rotation * values["scale"][:, None]
    matrix[:, :3, 3] = values["translation"]
    return matrix, rotation


def _sampled(curve: _Curve, times: np.ndarray) -> np.ndarray:
    """Return values (F, 3) or (F, 4) at ``times`` (F,), clamped to the first and the last key."""
    keys, values, interpolation = curve
    # Keys are float32: rounding must not miss a step.
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
    """Return the nearest rotations (S, 3, 3): U V^T of the singular value decomposition U D V^T."""
    if not (np.linalg.det(linear) > 0).all():
        raise file.error("a matrix is flat or mirrored; export it without negative scale")
    left, _, right = np.linalg.svd(linear)
    return left @ right
