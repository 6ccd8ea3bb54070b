"""Random bodies with the keys, types and layout of SMPL files, writers of such files, and their
pose in slow loops.

The real files may not be passed on. J joints, M vertices, T triangles, F frames.
"""

from __future__ import annotations

import io
import pickle
import struct
from itertools import combinations
from pathlib import Path
from types import FunctionType
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

Arrays = dict[str, Any]

M, T = 30, 40
NUM_JOINTS = {"smpl": 24, "smplh": 52, "smplx": 55}
NUM_SHAPES = {"smpl": 10, "smplh": 16, "smplx": 10}
BODY = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)


def parents_of(kind: str) -> list[int]:
    def fingers(wrist: int, first: int) -> list[int]:
        return [wrist if i % 3 == 0 else first + i - 1 for i in range(15)]

    if kind == "smpl":
        return [*BODY, 20, 21]
    if kind == "smplh":
        return [*BODY, *fingers(20, 22), *fingers(21, 37)]
    return [*BODY, 15, 15, 15, *fingers(20, 25), *fingers(21, 40)]


def model(kind: str, seed: int = 0, directions: int | None = None) -> Arrays:
    """The arrays of a random body of M vertices, as large as a person, with all keys of the real
    files."""
    generator = np.random.default_rng(seed)
    j = NUM_JOINTS[kind]
    b = NUM_SHAPES[kind] if directions is None else directions
    parents = np.array(parents_of(kind), dtype=np.int64)
    parents[0] = 2**32 - 1
    triangles = generator.permutation(list(combinations(range(M), 3)))
    arrays: Arrays = {
        "v_template": generator.uniform(-0.9, 0.9, (M, 3)),
        "f": generator.permuted(triangles[:T], axis=1).astype(np.uint32),
        "shapedirs": 0.02 * generator.standard_normal((M, 3, b)),
        "posedirs": 0.001 * generator.standard_normal((M, 3, 9 * (j - 1))),
        "J_regressor": generator.dirichlet(np.full(M, 0.1), j),
        "weights": generator.dirichlet(np.full(j, 0.1), M),
        "kintree_table": np.stack([parents, np.arange(j)]).astype(np.uint32),
    }
    if kind == "smpl":
        return arrays | {
            "J": generator.uniform(-1, 1, (j, 3)),
            "bs_style": "lbs",
            "bs_type": "lrotmin",
        }
    hands = {
        f"hands_{x}{side}": generator.standard_normal(45)
        for x in ("mean", "coeffs")
        for side in "lr"
    }
    if kind == "smplh":
        return arrays | hands
    corners = generator.integers(0, M + 9, (T, 3)).astype(np.uint32)
    return arrays | hands | {"vt": generator.uniform(0, 1, (M + 9, 2)), "ft": corners}


def slow_vertices(
    arrays: Arrays, poses: np.ndarray, trans: np.ndarray, beta: np.ndarray
) -> np.ndarray:
    """(F, M, 3) as the SMPL paper has it, from the raw arrays, in loops. ``beta`` are all
    directions of the file."""
    raw = {key: np.asarray(value) for key, value in arrays.items()}
    parents = raw["kintree_table"][0].astype(np.int64)
    frames = []
    for pose, shift in zip(poses, trans, strict=True):
        v = raw["v_template"] + np.einsum("mkb,b->mk", raw["shapedirs"], beta)
        joints = raw["J_regressor"] @ v
        turned = [Rotation.from_rotvec(p).as_matrix() for p in pose]
        v = v + raw["posedirs"] @ np.concatenate([(r - np.eye(3)).ravel() for r in turned[1:]])
        chain: list[np.ndarray] = []
        for j, rotation in enumerate(turned):
            local = np.eye(4)
            local[:3, :3] = rotation
            local[:3, 3] = joints[j] - (joints[parents[j]] if j else 0)
            chain.append(chain[parents[j]] @ local if j else local)
        frame = np.zeros((len(v), 3))
        for i in range(len(v)):
            for j, at in enumerate(chain):
                frame[i] += raw["weights"][i, j] * (at[:3, :3] @ (v[i] - joints[j]) + at[:3, 3])
        frames.append(frame + shift)
    return np.array(frames)


def write_npz(path: Path, arrays: Arrays) -> Path:
    np.savez(path, **arrays)
    return path


def write_pickle(path: Path, content: object, protocol: int = 2) -> Path:
    path.write_bytes(pickle.dumps(content, protocol))
    return path


PythonPickler: Any = pickle._Pickler


class Python2Pickler(PythonPickler):
    """Writes as Python 2 did: bytes as strings, NumPy's and SciPy's modules under their old
    names."""

    def save_old_bytes(self, value: bytes) -> None:
        if self.proto == 0:
            self.write(b"S" + repr(value)[1:].encode("ascii") + b"\n")
        else:
            self.write(b"T" + struct.pack("<i", len(value)) + value)
        self.memoize(value)

    def save_global(self, value: Any, name: str | None = None) -> None:
        name = name or value.__qualname__
        old = {"numpy._core": "numpy.core", "copyreg": "copy_reg", "builtins": "__builtin__"}
        module = value.__module__.replace("scipy.sparse._", "scipy.sparse.")
        for new, former in old.items():
            module = module.replace(new, former)
        self.write(f"c{module}\n{name}\n".encode("ascii"))
        self.memoize(value)

    dispatch: ClassVar[dict] = {
        **PythonPickler.dispatch,
        bytes: save_old_bytes,
        type: save_global,
        FunctionType: save_global,
    }


def write_python2_pickle(path: Path, content: object, protocol: int) -> Path:
    buffer = io.BytesIO()
    Python2Pickler(buffer, protocol).dump(content)
    path.write_bytes(buffer.getvalue())
    return path


def write_obj(
    path: Path, faces: np.ndarray, uv: np.ndarray, uv_faces: np.ndarray, vertices: int = M
) -> Path:
    lines = [
        "# a comment",
        "mtllib none.mtl",
        *["v 0 0 0"] * vertices,
        *(f"vt {u:.9g} {v:.9g}" for u, v in uv),
        "vn 0 0 1",
    ]
    for face, corners in zip(faces + 1, uv_faces + 1, strict=True):
        lines.append("f " + " ".join(f"{v}/{t}/1" for v, t in zip(face, corners, strict=True)))
    path.write_text("\r\n".join(lines))
    return path
