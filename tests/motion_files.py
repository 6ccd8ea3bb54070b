"""A tiny body template, skinning in plain loops, and writers of BVH and GLB files, for tests of
motion files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.motion.motion import Motion

ABOVE = {
    "pelvis": "",
    "spine1": "pelvis",
    "spine2": "spine1",
    "spine3": "spine2",
    "neck": "spine3",
    "head": "neck",
}
ABOVE |= {"jaw": "head"}
PLACES = {
    "pelvis": (0, 0.95, 0),
    "spine1": (0, 1.05, -0.01),
    "spine2": (0, 1.18, -0.01),
    "spine3": (0, 1.25, 0),
}
PLACES |= {"neck": (0, 1.45, -0.02), "head": (0, 1.53, 0), "jaw": (0, 1.55, 0.03)}
LIMBS = {
    "hip": ("pelvis", (0.09, 0.88, 0)),
    "knee": ("left_hip", (0.1, 0.48, 0.01)),
    "ankle": ("left_knee", (0.1, 0.08, -0.02)),
    "foot": ("left_ankle", (0.11, 0.02, 0.1)),
    "collar": ("spine3", (0.06, 1.4, 0)),
    "shoulder": ("left_collar", (0.17, 1.42, 0)),
    "elbow": ("left_shoulder", (0.43, 1.42, -0.01)),
    "wrist": ("left_elbow", (0.68, 1.42, 0)),
    "eye": ("head", (0.03, 1.58, 0.07)),
}
for row, finger in enumerate(("thumb", "index", "middle", "ring", "pinky")):
    for i in (1, 2, 3):
        above = f"left_{finger}{i - 1}" if i > 1 else "left_wrist"
        LIMBS[f"{finger}{i}"] = (above, (0.74 + 0.03 * i, 1.42 - 0.005 * i, 0.05 - 0.02 * row))
for limb, (above, (x, y, z)) in LIMBS.items():
    for side, sign in (("left", 1), ("right", -1)):
        ABOVE[f"{side}_{limb}"] = above.replace("left", side)
        PLACES[f"{side}_{limb}"] = (sign * x, y, z)


@dataclass(frozen=True)
class Skeleton:
    """Names, parents and rest positions of S joints, parents first."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: np.ndarray  # (S, 3)


def skeleton(names: Sequence[str] = JOINT_NAMES) -> Skeleton:
    """The named joints in T-pose, metres, y up, facing +z; each is a child of its nearest ancestor
    among them."""
    parents = []
    for name in names:
        above = ABOVE[name]
        while above and above not in names:
            above = ABOVE[above]
        parents.append(names.index(above) if above else -1)
    return Skeleton(
        tuple(names), tuple(parents), np.array([PLACES[name] for name in names], dtype=np.float64)
    )


def tiny_body(count: int = 55, shapes: int = 0) -> BodyTemplate:
    """165 vertices around 55 (or 52, 24) joints, with random weights and optionally shape
    directions."""
    torch.manual_seed(count)
    names = [JOINT_NAMES[i] for i in SMPLX_ROWS[count]]
    own = skeleton(names)
    joints = torch.tensor(own.rest).float()
    parents = own.parents
    if count == 24:
        joints = torch.cat([joints, joints[-2:] + 0.05])
        parents = (*parents, 20, 21)
    weights = torch.rand(3 * count, count) ** 8
    dirs = torch.randn(3 * count, 3, shapes) / 50 if shapes else None
    return BodyTemplate(
        name={55: "smplx", 52: "smplh", 24: "smpl"}[count],
        vertices=joints.repeat(3, 1) + 0.05 * torch.randn(3 * count, 3),
        faces=torch.zeros(0, 3).long(),
        uv=None,
        uv_faces=None,
        weights=weights / weights.sum(1, keepdim=True),
        parents=parents,
        joints=joints,
        shape_dirs=dirs,
        joint_shape_dirs=torch.randn(count, 3, shapes) / 50 if shapes else None,
    )


def random_motion(frames: int = 4, angle: float = 1.0, seed: int = 0) -> Motion:
    """Every joint rotated by up to about ``angle`` rad, translations within a metre."""
    make = torch.Generator().manual_seed(seed)
    poses = angle * (2 * torch.rand(frames, 55, 3, generator=make) - 1)
    return Motion(
        poses, torch.rand(frames, 3, generator=make), torch.zeros(10), 30.0, torch.ones(frames)
    )


def world_rotations(poses: np.ndarray, parents: Sequence[int]) -> np.ndarray:
    """World rotations (F, S, 3, 3) of axis-angle vectors (F, S, 3) relative to the parents."""
    world = np.empty((*poses.shape, 3))
    for frame, pose in enumerate(poses):
        for i, parent in enumerate(parents):
            own = Rotation.from_rotvec(pose[i]).as_matrix()
            world[frame, i] = own if parent < 0 else world[frame, parent] @ own
    return world


def slow_vertices(body: BodyTemplate, motion: Motion) -> np.ndarray:
    """Vertices (F, M, 3) by linear blend skinning as in the SMPL paper, with 4x4 matrices and
    loops; float64."""
    betas = motion.betas.double().numpy()[: body.num_shapes]
    vertices = body.vertices.double().numpy()
    joints = body.joints.double().numpy()
    if body.shape_dirs is not None and body.joint_shape_dirs is not None:
        vertices = vertices + body.shape_dirs.double().numpy() @ betas
        joints = joints + body.joint_shape_dirs.double().numpy() @ betas
    poses = motion.for_joints(len(joints)).poses.double().numpy()
    out = np.empty((len(motion), len(vertices), 3))
    for frame, pose in enumerate(poses):
        world = np.zeros((len(joints), 4, 4))
        for i, parent in enumerate(body.parents):
            own = np.eye(4)
            own[:3, :3] = Rotation.from_rotvec(pose[i]).as_matrix()
            own[:3, 3] = joints[i] - (joints[parent] if parent >= 0 else 0)
            world[i] = world[parent] @ own if parent >= 0 else own
        for i in range(len(joints)):
            world[i, :3, 3] -= world[i, :3, :3] @ joints[i]
        blend = np.einsum("mj,jab->mab", body.weights.double().numpy(), world)
        posed = np.einsum("mab,mb->ma", blend[:, :3, :3], vertices) + blend[:, :3, 3]
        out[frame] = float(motion.scale[frame]) * posed + motion.trans[frame].double().numpy()
    return out


def pelvis_path(body: BodyTemplate, motion: Motion) -> np.ndarray:
    """Positions (F, 3) of the root joint."""
    return (body.joints[0] + motion.trans).double().numpy()


# --- BVH
# ----------------------------------------------------------------------------------------------


def write_bvh(
    path: Path,
    own: Skeleton,
    local: np.ndarray,
    root: np.ndarray,
    order: str = "ZXY",
    fps: float = 30.0,
) -> Path:
    """Write a BVH of local rotations (F, S, 3, 3) and root positions (F, 3), with Euler angles in
    ``order``."""
    lines = ["HIERARCHY"]

    def block(i: int, depth: int) -> None:
        pad = "\t" * depth
        parent = own.parents[i]
        offset = own.rest[i] - (own.rest[parent] if parent >= 0 else own.rest[i])
        places = "Xposition Yposition Zposition " if parent < 0 else ""
        turns = " ".join(f"{axis}rotation" for axis in order)
        lines.extend([f"{pad}{'JOINT' if parent >= 0 else 'ROOT'} {own.names[i]}", pad + "{"])
        lines.append(f"{pad}\tOFFSET " + " ".join(f"{x:.9f}" for x in offset))
        lines.append(f"{pad}\tCHANNELS {6 if places else 3} {places}{turns}")
        children = [c for c, p in enumerate(own.parents) if p == i]
        for child in children:
            block(child, depth + 1)
        if not children:
            lines.extend([f"{pad}\tEnd Site", pad + "\t{", f"{pad}\t\tOFFSET 0 0.1 0", pad + "\t}"])
        lines.append(pad + "}")

    block(0, 0)
    sequence = depth_first(own.parents)
    lines += ["MOTION", f"Frames: {len(local)}", f"Frame Time: {1 / fps:.9f}"]
    for frame, place in zip(local, root, strict=True):
        angles = Rotation.from_matrix(frame[sequence]).as_euler(order, degrees=True)
        lines.append(" ".join(f"{x:.9f}" for x in [*place, *angles.ravel()]))
    path.write_text("\n".join(lines) + "\n")
    return path


def depth_first(parents: Sequence[int]) -> list[int]:
    """The joints in the order in which a BVH writes them."""
    found: list[int] = []

    def visit(i: int) -> None:
        found.append(i)
        for child, parent in enumerate(parents):
            if parent == i:
                visit(child)

    visit(0)
    return found


# --- GLB
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clip:
    """An animation for ``glb_of``: local rotations (F, S, 3, 3), root positions (F, 3), and
    options."""

    local: np.ndarray
    root: np.ndarray
    fps: float = 30.0
    interpolation: str = "LINEAR"
    # 4x4 matrix of a node above the root; the mesh was bound without it
    above: np.ndarray | None = None
    bind_matrices: bool = True
    # (S, 3, 3) of the joints in the rest pose; None is those of the world
    axes: np.ndarray | None = None


class Glb:
    """A glTF document that grows, and its buffer."""

    def __init__(self) -> None:
        self.json: dict = {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "nodes": [],
        }
        self.data = b""

    def add(self, values: np.ndarray, kind: str) -> int:
        """Add an accessor of float32 ``values``; return its number."""
        content = np.ascontiguousarray(values, dtype="<f4").tobytes()
        view: dict = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.json["bufferViews"].append(view)
        self.data += content
        accessor: dict = {
            "bufferView": len(self.json["bufferViews"]) - 1,
            "componentType": 5126,
            "count": len(values),
        }
        self.json["accessors"].append({**accessor, "type": kind})
        return len(self.json["accessors"]) - 1

    def write(self, path: Path) -> Path:
        """Write it, as ``.glb``."""
        document = {**self.json, "buffers": [{"byteLength": max(len(self.data), 1)}]}
        text = json.dumps(document).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + b"\0" * (-len(self.data) % 4)
        body = (
            len(text).to_bytes(4, "little")
            + b"JSON"
            + text
            + len(data).to_bytes(4, "little")
            + b"BIN\0"
            + data
        )
        path.write_bytes(
            b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body
        )
        return path


def glb_of(own: Skeleton, clip: Clip) -> Glb:
    """A skin of the skeleton's joints and one animation of it."""
    glb = Glb()
    count = len(own.names)
    axes = np.tile(np.eye(3), (count, 1, 1)) if clip.axes is None else clip.axes
    above = [np.eye(3) if parent < 0 else axes[parent] for parent in own.parents]
    for i, name in enumerate(own.names):
        parent = own.parents[i]
        place = above[i].T @ (own.rest[i] - (own.rest[parent] if parent >= 0 else 0))
        turn = Rotation.from_matrix(above[i].T @ axes[i]).as_quat()
        children = [c for c, p in enumerate(own.parents) if p == i]
        node = {"name": name, "translation": place.tolist(), "rotation": turn.tolist()}
        glb.json["nodes"].append(node | ({"children": children} if children else {}))
    if clip.above is not None:
        glb.json["nodes"].append(
            {"name": "Armature", "children": [0], "matrix": clip.above.T.ravel().tolist()}
        )
    skin: dict = {"joints": list(range(count))}
    glb.json["skins"] = [skin]
    if clip.bind_matrices:
        bind = np.tile(np.eye(4), (count, 1, 1))
        bind[:, :3, :3] = axes
        bind[:, :3, 3] = own.rest
        skin["inverseBindMatrices"] = glb.add(
            np.linalg.inv(bind).swapaxes(1, 2).reshape(-1, 16), "MAT4"
        )
    times = glb.add(np.arange(len(clip.local)) / clip.fps, "SCALAR")
    samplers = []
    channels = []

    def animate(node: int, kind: str, values: np.ndarray) -> None:
        if clip.interpolation == "CUBICSPLINE":
            values = np.stack(
                [np.zeros_like(values), values, np.zeros_like(values)], axis=1
            ).reshape(-1, values.shape[1])
        output = glb.add(values, "VEC4" if kind == "rotation" else "VEC3")
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": kind}})
        samplers.append({"input": times, "output": output, "interpolation": clip.interpolation})

    for i in range(count):
        animate(
            i, "rotation", Rotation.from_matrix(above[i].T @ clip.local[:, i] @ axes[i]).as_quat()
        )
    animate(0, "translation", clip.root)
    glb.json["animations"] = [{"name": "Walk", "samplers": samplers, "channels": channels}]
    return glb


def as_local(motion: Motion, own: Skeleton) -> np.ndarray:
    """Local rotations (F, S, 3, 3) of the joints that the skeleton has; the others are ignored."""
    rows = [JOINT_NAMES.index(name) for name in own.names]
    poses = motion.poses.double().numpy()[:, rows]
    return Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)


# --- VRM animations
# ----------------------------------------------------------------------------------------------

VRM = {
    "pelvis": "hips",
    "spine1": "spine",
    "spine2": "chest",
    "spine3": "upperChest",
    "neck": "neck",
    "head": "head",
}
_VRM_LIMBS = {
    "collar": "Shoulder",
    "shoulder": "UpperArm",
    "elbow": "LowerArm",
    "wrist": "Hand",
    "hip": "UpperLeg",
}
_VRM_LIMBS |= {"knee": "LowerLeg", "ankle": "Foot", "foot": "Toes"}
_VRM_FINGERS = {"index": "Index", "middle": "Middle", "ring": "Ring", "pinky": "Little"}
for _side in ("left", "right"):
    VRM |= {f"{_side}_{ours}": _side + theirs for ours, theirs in _VRM_LIMBS.items()}
    for _i, _word in enumerate(("Proximal", "Intermediate", "Distal"), 1):
        VRM |= {
            f"{_side}_{ours}{_i}": f"{_side}{theirs}{_word}"
            for ours, theirs in _VRM_FINGERS.items()
        }
    VRM |= {
        f"{_side}_thumb{i}": f"{_side}Thumb{x}"
        for i, x in enumerate(("Metacarpal", "Proximal", "Distal"), 1)
    }


def vrma_of(own: Skeleton, clip: Clip) -> Glb:
    """Return a VRM animation whose bones are named by the extension and not by the nodes."""
    glb = glb_of(own, clip)
    glb.json.pop("skins")
    for i, node in enumerate(glb.json["nodes"]):
        node["name"] = f"node {i}"
    bones = {VRM[name]: {"node": i} for i, name in enumerate(own.names)}
    glb.json["extensions"] = {
        "VRMC_vrm_animation": {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
    }
    return glb
