"""Readers of body templates: SMPL, SMPL-H and SMPL-X in ``.npz`` or ``.pkl``, the free template, UVs from an ``.obj``.

Local letters: J joints, M vertices, T triangles, U UV vertices, n any number.
"""

from __future__ import annotations

import io
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError, reading, reason
from dyngs.files.limits import require_at_most
from dyngs.files.numpy_files import read_arrays
from dyngs.files.pickles import read_pickle
from dyngs.human.template.body import BodyTemplate

_SMPL = ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs", "posedirs")
_TEMPLATE = ("v_template", "f", "weights_idx", "weights_val", "kintree_table", "J")
_UV = ("vt", "ft")
_NAMES = {24: "smpl", 52: "smplh", 55: "smplx"}
_NO_PARENT = 2**32 - 1
"""-1 as unsigned 32-bit, which is how SMPL files mark the root."""
_MOST_VERTICES = 250_000
"""SMPL-X has 10,475; of triangles four times as many are read."""
_LARGEST = 1e10
"""No number of a body is larger, in whatever unit; one that is comes from damage."""


def read_body(path: Path, uv: Path | None = None) -> BodyTemplate:
    """The body of a ``.npz`` or ``.pkl`` file, with the texture coordinates of ``uv`` or else its own, if any.

    SMPL, SMPL-H and SMPL-X are told apart by their 24, 52 or 55 joints. SMPL-X keeps shape and expression in one array:
    300 and the rest, or 10 and 10. Only the keys that matter are read. No file can run code: arrays with Python
    objects are refused, and of a pickle only numbers, text and arrays are read.

    Args:
        path: the file.
        uv: an ``.obj`` with the triangles of the body in any order, as ``f v/vt v/vt v/vt``.

    Raises:
        DyngsError: names the file and what is missing or wrong.
    """
    path = Path(path)
    if path.is_dir():
        raise DyngsError(f"{path}: is a folder; name the .npz or .pkl file of one body in it")
    if path.suffix.lower() not in (".npz", ".pkl"):
        raise DyngsError(f"{path}: a body file must end in .npz or .pkl")
    with reading(path):
        is_npz = path.suffix.lower() == ".npz"
        arrays = _Arrays(path, read_arrays(path, lambda names: _wanted(path, names)) if is_npz else _read_pickle(path))
        return _body(arrays, None if uv is None else Path(uv))


def _body(arrays: _Arrays, uv: Path | None) -> BodyTemplate:
    """The body of the arrays, with the texture coordinates of the file ``uv``, or their own where that is None."""
    parents = _parents(arrays)
    vertices = arrays.floats("v_template", (None, 3))
    require_at_most(arrays.path, len(vertices), _MOST_VERTICES, "vertices")
    faces = arrays.indices("f", (None, 3), len(vertices), "vertices")
    require_at_most(arrays.path, len(faces), 4 * _MOST_VERTICES, "triangles")
    corners = _own_uv(arrays, len(faces)) if uv is None else _read_obj(uv, faces, len(vertices))
    is_template = "weights_idx" in arrays.values
    weights, joints = (_template_skin if is_template else _smpl_skin)(arrays, vertices, len(parents))
    body = BodyTemplate(
        name="anny" if is_template else _NAMES[len(parents)],
        vertices=_float(vertices),
        faces=torch.from_numpy(faces),
        uv=None if corners is None else _float(corners.uv),
        uv_faces=None if corners is None else torch.from_numpy(corners.faces),
        weights=_float(weights),
        parents=parents,
        joints=_float(joints),
    )
    return body if is_template else _with_blend_shapes(body, arrays)


@dataclass(frozen=True)
class _Arrays:
    """What a file holds under the keys that matter."""

    path: Path
    values: dict[str, np.ndarray]

    def floats(self, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """The finite float64 numbers at ``key``; None in the shape is any positive number."""
        value = self.values[key]
        if value.dtype.kind not in "biuf":
            raise DyngsError(f"{self.path}: '{key}' must hold numbers, not {value.dtype}")
        fits = value.ndim == len(shape) and all(
            n > 0 if w is None else n == w for n, w in zip(value.shape, shape, strict=True)
        )
        if not fits:
            wanted = " x ".join("n" if n is None else str(n) for n in shape)
            got = " x ".join(map(str, value.shape)) or "one number"
            raise DyngsError(f"{self.path}: '{key}' must be {wanted}, is {got}; is it a body of another kind?")
        with np.errstate(invalid="ignore"):  # of odd NaNs, which are refused just below
            value = value.astype(np.float64)
        if not (np.abs(value) < _LARGEST).all():
            raise DyngsError(f"{self.path}: '{key}' holds NaN or huge numbers; copy or export the file again")
        return value

    def indices(self, key: str, shape: tuple[int | None, ...], count: int, what: str) -> np.ndarray:
        """The whole numbers at ``key``, int64 in [0, count)."""
        value = self.floats(key, shape)
        if not ((value >= 0) & (value < count) & (value % 1 == 0)).all():
            raise DyngsError(
                f"{self.path}: '{key}' must hold whole numbers from 0 to {count - 1}, one of {count} {what}"
            )
        return value.astype(np.int64)


@dataclass(frozen=True)
class _Corners:
    """Texture coordinates (U, 2) and the triangles (T, 3) into them."""

    uv: np.ndarray
    faces: np.ndarray


def _template_skin(arrays: _Arrays, vertices: np.ndarray, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights (M, J) and joints (J, 3) of the free template, which stores the weights that are not 0."""
    followed = arrays.indices("weights_idx", (len(vertices), None), joints, "joints")
    shares = _normalised(arrays.path, "weights_val", arrays.floats("weights_val", followed.shape))
    weights = np.zeros((len(vertices), joints))
    np.add.at(weights, (np.arange(len(vertices))[:, None], followed), shares)
    return weights, arrays.floats("J", (joints, 3))


def _smpl_skin(arrays: _Arrays, vertices: np.ndarray, joints: int) -> tuple[np.ndarray, np.ndarray]:
    """Weights (M, J) and joints (J, 3), which SMPL takes from the vertices."""
    weights = arrays.floats("weights", (len(vertices), joints))
    regressor = arrays.floats("J_regressor", (joints, len(vertices)))
    return _normalised(arrays.path, "weights", weights), regressor @ vertices


def _with_blend_shapes(body: BodyTemplate, arrays: _Arrays) -> BodyTemplate:
    m, j = body.weights.shape
    directions = arrays.floats("shapedirs", (m, 3, None))
    pose_dirs = arrays.floats("posedirs", (m, 3, 9 * (j - 1)))
    joint_directions = np.einsum("jm,mkb->jkb", arrays.floats("J_regressor", (j, m)), directions, optimize=True)
    shapes, count = _num_shapes(j, directions.shape[2]), directions.shape[2]
    return replace(
        body,
        shape_dirs=_float(directions[..., :shapes]),
        expression_dirs=_float(directions[..., shapes:]) if shapes < count else None,
        joint_shape_dirs=_float(joint_directions[..., :shapes]),
        joint_expression_dirs=_float(joint_directions[..., shapes:]) if shapes < count else None,
        pose_dirs=_float(pose_dirs.reshape(3 * m, -1).T),
    )


def _num_shapes(joints: int, directions: int) -> int:
    """How many of the blend shapes are of shape; the others are expressions, which only SMPL-X has."""
    if joints != 55:
        return directions
    return 10 if directions == 20 else min(directions, 300)


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _normalised(path: Path, key: str, weights: np.ndarray) -> np.ndarray:
    """The same with rows that sum to 1 as exactly as they can; half precision is good enough for a file."""
    sums = weights.sum(1)
    bad = (np.abs(sums - 1) > 1e-3) | (weights.min(1) < -1e-6)
    if bad.any():
        row = int(np.argmax(bad))
        lowest = weights[row].min()
        wrong = f"include {lowest:.4g}" if lowest < -1e-6 else f"sum to {sums[row]:.4g}"
        raise DyngsError(
            f"{path}: '{key}' of vertex {row} {wrong}; the skinning weights of each vertex must be shares of 1"
        )
    return weights / sums[:, None]


def _parents(arrays: _Arrays) -> tuple[int, ...]:
    """(J,) of a tree whose root is joint 0 and where parents come before their children."""
    path, where = arrays.path, "'kintree_table'"
    table = arrays.floats("kintree_table", (2, None))
    count = table.shape[1]
    if count not in _NAMES:
        raise DyngsError(f"{path}: {where} has {count} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
    if not np.array_equal(table[1], np.arange(count)):
        raise DyngsError(f"{path}: {where} must number the joints 0 to {count - 1} in its second row")
    parents = np.where(table[0] == _NO_PARENT, -1, table[0])
    known = (parents >= -1) & (parents < count) & (parents % 1 == 0)
    if not known.all():
        joint = int(np.argmin(known))
        raise DyngsError(f"{path}: {where} gives joint {joint} the parent {table[0][joint]:g}, which does not exist")
    tree = [int(parent) for parent in parents]
    for joint, parent in enumerate(tree):
        above = joint
        for _ in range(count):
            above = tree[above] if above >= 0 else -1
        if above >= 0:
            raise DyngsError(f"{path}: {where} is no tree: joint {above} is its own ancestor")
        if parent == -1 and joint > 0:
            raise DyngsError(f"{path}: {where} is no tree: joint {joint} has no parent; only joint 0 may have none")
        if parent > joint:
            raise DyngsError(
                f"{path}: {where} must have parents before their children, but {parent} is that of {joint}"
            )
    return tuple(tree)


# --- texture coordinates ----------------------------------------------------------------------------------------------


def _own_uv(arrays: _Arrays, triangles: int) -> _Corners | None:
    given = [key for key in _UV if key in arrays.values]
    if not given:
        return None
    if len(given) == 1:
        other = _UV[1 - _UV.index(given[0])]
        raise DyngsError(f"{arrays.path}: has '{given[0]}' but not '{other}'; texture coordinates need both")
    uv = _in_unit_square(arrays.path, arrays.floats("vt", (None, 2)))
    return _Corners(uv, arrays.indices("ft", (triangles, 3), len(uv), "texture coordinates"))


def _in_unit_square(path: Path, uv: np.ndarray) -> np.ndarray:
    outside = ~((uv > -1e-4) & (uv < 1 + 1e-4)).all(1)
    if outside.any():
        row = int(np.argmax(outside))
        raise DyngsError(
            f"{path}: texture coordinate {row} is {uv[row, 0]:g} {uv[row, 1]:g}; they must lie in [0, 1], on one tile"
        )
    return uv.clip(0, 1)


def _read_obj(path: Path, faces: np.ndarray, num_vertices: int) -> _Corners:
    """Texture coordinates of an ``.obj`` and, for each corner of the triangles ``faces`` (T, 3), which is its own."""
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: is no file; name the .obj made for this body")
    try:
        lines = io.StringIO(path.read_text("latin-1"))
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({reason(error)})") from error
    count, uv, corners = 0, [], []
    for number, line in enumerate(lines, 1):
        if count > num_vertices or len(corners) > len(faces) or len(uv) > 3 * len(faces):
            break  # it is of another body, however long it is
        kind, *words = line.split() or [""]
        try:
            if kind == "v":
                count += 1
            elif kind == "vt":
                uv.append([float(words[0]), float(words[1])])
            elif kind == "f":
                one, two, three = words
                corners.append([_corner(word, count, len(uv)) for word in (one, two, three)])
        except (ValueError, IndexError):
            raise DyngsError(
                f"{path}, line {number}: {line.strip()[:60]!r} is not understood; lines with texture coordinates are "
                "'vt u v', those of triangles 'f v/vt v/vt v/vt'"
            ) from None
    if count != num_vertices or len(corners) != len(faces):
        raise DyngsError(
            f"{path}: has {count} vertices and {len(corners)} triangles, the body has {num_vertices} and {len(faces)}; "
            "give the .obj made for this body"
        )
    found = np.array(corners)
    if found.min() < 0 or (found.max((0, 1)) >= (count, len(uv))).any():
        raise DyngsError(f"{path}: a face names a vertex or texture coordinate that does not exist")
    return _Corners(_in_unit_square(path, np.array(uv)), _matched(path, faces, found[..., 0], found[..., 1]))


def _corner(word: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Vertex and texture coordinate, from 0, of ``v/vt`` or ``v/vt/vn``; negative numbers count from the last."""
    vertex, coordinate = (int(number) for number in word.split("/")[:2])
    return (
        vertex - 1 if vertex > 0 else vertices + vertex,
        coordinate - 1 if coordinate > 0 else coordinates + coordinate,
    )


def _matched(path: Path, faces: np.ndarray, others: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(T, 3) the ``values`` at the corners of the triangles ``others``, which are ``faces`` in any order, at theirs."""
    here, there = np.argsort(faces, axis=1, kind="stable"), np.argsort(others, axis=1, kind="stable")
    sorted_here, sorted_there = np.take_along_axis(faces, here, 1), np.take_along_axis(others, there, 1)
    rows, other_rows = np.lexsort(sorted_here.T), np.lexsort(sorted_there.T)
    differ = (sorted_here[rows] != sorted_there[other_rows]).any(1)
    if differ.any():
        odd = " ".join(str(v + 1) for v in others[other_rows[np.argmax(differ)]])
        raise DyngsError(
            f"{path}: the triangle of vertices {odd} is not one of the body; give the .obj made for this body"
        )
    matched = np.empty_like(values)
    ordered = np.empty_like(values)
    ordered[rows] = np.take_along_axis(values, there, 1)[other_rows]
    np.put_along_axis(matched, here, ordered, 1)
    return matched


# --- archives of arrays -----------------------------------------------------------------------------------------------


def _wanted(path: Path, present: Collection[object]) -> list[str]:
    """The keys to read, of those that are there."""
    needed = _TEMPLATE if "weights_idx" in present else _SMPL
    missing = [f"'{key}'" for key in needed if key not in present]
    if missing:
        raise DyngsError(f"{path}: lacks {', '.join(missing)}; give a body file of SMPL, SMPL-H or SMPL-X")
    return [*needed, *(key for key in _UV if key in present)]


def _read_pickle(path: Path) -> dict[str, np.ndarray]:
    loaded = read_pickle(path)
    if not isinstance(loaded, dict):
        raise DyngsError(f"{path}: holds no dictionary; give a body file of SMPL, SMPL-H or SMPL-X")
    found = {key: loaded[key] for key in _wanted(path, loaded)}
    for key, value in found.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind == "O":
            raise DyngsError(f"{path}: '{key}' is not an array of numbers; export it again")
    return found
