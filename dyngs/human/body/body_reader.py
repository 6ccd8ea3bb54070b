"""Reader of body templates: SMPL, SMPL-H and SMPL-X in ``.npz`` or ``.pkl``, and the free template.

Local letters: T triangles, n any number.
"""

from __future__ import annotations

import io
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, reading, reason
from dyngs.data.capture import BodyFrames
from dyngs.human.body.body import BodyTemplate, apply_shape, bone_shapes
from dyngs.human.keys import HumanModel
from dyngs.io.fields import read_limited, require_at_most
from dyngs.io.numpy_files import read_arrays
from dyngs.io.pickles import read_pickle

_Coordinates = tuple[np.ndarray, np.ndarray]
"""Texture coordinates (U, 2) in [0, 1] and the triangles (T, 3) that index them."""


def require_unit_square(path: Path, uv: np.ndarray) -> np.ndarray:
    """Return texture coordinates (U, 2), rounding errors clipped; raises DyngsError where they
    leave [0, 1]."""
    outside = ~((uv > -1e-4) & (uv < 1 + 1e-4)).all(1)
    if outside.any():
        row = int(np.argmax(outside))
        raise DyngsError(
            f"{path}: texture coordinate {row} is {uv[row, 0]:g} {uv[row, 1]:g}; they must lie in [0, 1], on one tile"
        )
    return uv.clip(0, 1)


def read_obj(path: Path, faces: np.ndarray, num_vertices: int) -> _Coordinates:
    """Read the texture coordinates of an ``.obj``, indexed by the corners of the triangles
    ``faces`` (T, 3).

    Its triangles may come in any order, as ``f v/vt v/vt v/vt``; ``faces`` (T, 3) are those of the
    body with ``num_vertices``. Raises DyngsError: the file cannot be read, or belongs to another
    body.
    """
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: is not a file; name the .obj made for this body")
    try:
        lines = io.StringIO(read_limited(path).decode("latin-1"))
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({reason(error)})") from error
    count = 0
    uv = []
    corners = []
    for number, line in enumerate(lines, 1):
        if count > num_vertices or len(corners) > len(faces) or len(uv) > 3 * len(faces):
            break  # it belongs to another body, however long it is
        kind, *words = line.split() or [""]
        try:
            if kind == "v":
                count += 1
            elif kind == "vt":
                uv.append([float(words[0]), float(words[1])])
            elif kind == "f":
                one, two, three = words
                numbers = [
                    [int(number) for number in word.split("/")[:2]] for word in (one, two, three)
                ]
                corners.append(
                    [
                        (v - 1 if v > 0 else count + v, t - 1 if t > 0 else len(uv) + t)
                        for v, t in numbers
                    ]
                )
        except (ValueError, IndexError):
            raise DyngsError(
                f"{path}, line {number}: {line.strip()[:60]!r} is not understood; texture coordinates are written "
                "'vt u v', triangles 'f v/vt v/vt v/vt'"
            ) from None
    if count != num_vertices or len(corners) != len(faces):
        raise DyngsError(
            f"{path}: has {count} vertices and {len(corners)} triangles, the body has {num_vertices} and {len(faces)}; "
            "give the .obj made for this body"
        )
    found = np.array(corners)
    if found.min() < 0 or (found.max((0, 1)) >= (count, len(uv))).any():
        raise DyngsError(f"{path}: a face names a vertex or texture coordinate that does not exist")
    return require_unit_square(path, np.array(uv)), _matched(
        path, faces, found[..., 0], found[..., 1]
    )


def _matched(path: Path, faces: np.ndarray, others: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return ``values`` (T, 3) of the corners of ``others``, reordered to the same triangles in
    ``faces``."""
    here = np.argsort(faces, axis=1, kind="stable")
    there = np.argsort(others, axis=1, kind="stable")
    sorted_here = np.take_along_axis(faces, here, 1)
    sorted_there = np.take_along_axis(others, there, 1)
    rows = np.lexsort(sorted_here.T)
    other_rows = np.lexsort(sorted_there.T)
    differ = (sorted_here[rows] != sorted_there[other_rows]).any(1)
    if differ.any():
        odd = " ".join(str(v + 1) for v in others[other_rows[np.argmax(differ)]])
        raise DyngsError(
            f"{path}: the body has no triangle of the vertices {odd}; give the .obj made for this body"
        )
    matched = np.empty_like(values)
    ordered = np.empty_like(values)
    ordered[rows] = np.take_along_axis(values, there, 1)[other_rows]
    np.put_along_axis(matched, here, ordered, 1)
    return matched


_SMPL = ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs", "posedirs")
_TEMPLATE = ("v_template", "f", "weights_idx", "weights_val", "kintree_table", "J")
_UV = ("vt", "ft")
_TEMPLATE_SHAPES = ("shapedirs", "J_shapedirs")
_NAMES = {24: "smpl", 52: "smplh", 55: "smplx"}
_NO_PARENT = 2**32 - 1  # -1 as an unsigned 32-bit number: the parent of the root in SMPL files
_MOST_VERTICES = 250_000  # SMPL-X has 10,475; four times as many triangles are allowed
_LARGEST = 1e10  # a larger number in a body file, in whatever unit, means that the file is damaged


def read_body(path: Path, uv: Path | None = None) -> BodyTemplate:
    """Read the body template of a ``.npz`` or ``.pkl`` file, with the texture coordinates of an
    ``.obj`` ``uv``.

    The number of joints (24, 52 or 55) tells SMPL, SMPL-H and SMPL-X apart. SMPL-X keeps shape and
    expression in one array: 300 and the rest, or 10 and 10. A file cannot run code: only numbers,
    text and arrays are read from a pickle. Raises DyngsError: names the file and what is missing or
    wrong.
    """
    path = Path(path)
    if path.is_dir():
        raise DyngsError(f"{path}: is a folder; name the .npz or .pkl file of one body")
    if path.suffix.lower() not in (".npz", ".pkl"):
        raise DyngsError(f"{path}: a body file must end in .npz or .pkl")
    with reading(path):
        is_npz = path.suffix.lower() == ".npz"
        arrays = _Arrays(
            path,
            read_arrays(path, lambda names: _wanted(path, names)) if is_npz else _read_pickle(path),
        )
        return _body(arrays, None if uv is None else Path(uv))


def _body(arrays: _Arrays, uv: Path | None) -> BodyTemplate:
    """Return the template of the arrays, with the texture coordinates of the file ``uv``; None:
    their own."""
    parents = _parents(arrays)
    vertices = arrays.floats("v_template", (None, 3))
    require_at_most(arrays.path, len(vertices), _MOST_VERTICES, "vertices")
    faces = arrays.indices("f", (None, 3), len(vertices), "vertices")
    require_at_most(arrays.path, len(faces), 4 * _MOST_VERTICES, "triangles")
    corners = _own_uv(arrays, len(faces)) if uv is None else read_obj(uv, faces, len(vertices))
    is_template = "weights_idx" in arrays.values
    weights, joints = _skin(arrays, vertices, len(parents), is_template)
    body = BodyTemplate(
        name="anny" if is_template else _NAMES[len(parents)],
        vertices=_float(vertices),
        faces=torch.from_numpy(faces),
        uv=None if corners is None else _float(corners[0]),
        uv_faces=None if corners is None else torch.from_numpy(corners[1]),
        weights=_float(weights),
        parents=parents,
        joints=_float(joints),
    )
    return _with_shapes(body, arrays) if is_template else _with_blend_shapes(body, arrays)


@dataclass(frozen=True)
class _Arrays:
    """The arrays of a file under the keys that are needed."""

    path: Path
    values: dict[str, np.ndarray]

    def floats(self, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """Return the finite float64 numbers at ``key``; None in the shape stands for any positive
        number."""
        value = self.values[key]
        if value.dtype.kind not in "biuf":
            raise DyngsError(f"{self.path}: '{key}' must hold numbers, not {value.dtype}")
        fits = value.ndim == len(shape) and all(
            n > 0 if w is None else n == w for n, w in zip(value.shape, shape, strict=True)
        )
        if not fits:
            wanted = " x ".join("n" if n is None else str(n) for n in shape)
            got = " x ".join(map(str, value.shape)) or "one number"
            raise DyngsError(
                f"{self.path}: '{key}' must be {wanted}, is {got}; is it another kind of body?"
            )
        with np.errstate(invalid="ignore"):  # signalling NaNs, which are refused just below
            value = value.astype(np.float64)
        if not (np.abs(value) < _LARGEST).all():
            raise DyngsError(
                f"{self.path}: '{key}' holds NaN or huge numbers; copy or export the file again"
            )
        return value

    def indices(self, key: str, shape: tuple[int | None, ...], count: int, what: str) -> np.ndarray:
        """Return the whole numbers at ``key``, int64 in [0, count)."""
        value = self.floats(key, shape)
        if not ((value >= 0) & (value < count) & (value % 1 == 0)).all():
            raise DyngsError(
                f"{self.path}: '{key}' must hold whole numbers from 0 to {count - 1}, one of {count} {what}"
            )
        return value.astype(np.int64)


def _skin(
    arrays: _Arrays, vertices: np.ndarray, joints: int, is_template: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (M, J) and joints (J, 3): the free template's file holds both, SMPL regresses
    joints."""
    count = len(vertices)
    path = arrays.path
    if not is_template:
        weights = arrays.floats("weights", (count, joints))
        return _normalized(path, "weights", weights), arrays.floats(
            "J_regressor", (joints, count)
        ) @ vertices
    followed = arrays.indices("weights_idx", (count, None), joints, "joints")
    values = _normalized(path, "weights_val", arrays.floats("weights_val", followed.shape))
    weights = np.zeros((count, joints))
    np.add.at(weights, (np.arange(count)[:, None], followed), values)
    return weights, arrays.floats("J", (joints, 3))


def _with_blend_shapes(body: BodyTemplate, arrays: _Arrays) -> BodyTemplate:
    m, j = body.weights.shape
    directions = arrays.floats("shapedirs", (m, 3, None))
    pose_dirs = arrays.floats("posedirs", (m, 3, 9 * (j - 1)))
    joint_directions = np.einsum(
        "jm,mkb->jkb", arrays.floats("J_regressor", (j, m)), directions, optimize=True
    )
    shapes = count = directions.shape[2]
    if j == 55:  # only SMPL-X has expressions, after the shapes
        shapes = 10 if count == 20 else min(count, 300)
    return replace(
        body,
        shape_dirs=_float(directions[..., :shapes]),
        expression_dirs=_float(directions[..., shapes:]) if shapes < count else None,
        joint_shape_dirs=_float(joint_directions[..., :shapes]),
        joint_expression_dirs=_float(joint_directions[..., shapes:]) if shapes < count else None,
        pose_dirs=_float(pose_dirs.reshape(3 * m, -1).T),
    )


def _with_shapes(body: BodyTemplate, arrays: _Arrays) -> BodyTemplate:
    """Return the free template with its shape space: directions of the file, if there are any, then
    those of bones."""
    vertices, joints, weights = (
        x.double().numpy() for x in (body.vertices, body.joints, body.weights)
    )
    directions, joint_directions = bone_shapes(vertices, joints, body.parents, weights)
    if set(_TEMPLATE_SHAPES) <= set(arrays.values):
        m, j = weights.shape
        own = arrays.floats("shapedirs", (m, 3, None))
        own_joints = arrays.floats("J_shapedirs", (j, 3, own.shape[2]))
        directions = np.concatenate([own, directions], axis=2)
        joint_directions = np.concatenate([own_joints, joint_directions], axis=2)
    return replace(body, shape_dirs=_float(directions), joint_shape_dirs=_float(joint_directions))


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _normalized(path: Path, key: str, weights: np.ndarray) -> np.ndarray:
    """Return the weights with rows that sum to 1 exactly; a file may miss it by half precision."""
    sums = weights.sum(1)
    bad = (np.abs(sums - 1) > 1e-3) | (weights.min(1) < -1e-6)
    if bad.any():
        row = int(np.argmax(bad))
        lowest = weights[row].min()
        wrong = f"include {lowest:.4g}" if lowest < -1e-6 else f"sum to {sums[row]:.4g}"
        raise DyngsError(
            f"{path}: '{key}' of vertex {row} {wrong}; skinning weights must be non-negative and sum to 1"
        )
    return weights / sums[:, None]


def _parents(arrays: _Arrays) -> tuple[int, ...]:
    path = arrays.path
    where = "'kintree_table'"
    table = arrays.floats("kintree_table", (2, None))
    count = table.shape[1]
    if count not in _NAMES:
        raise DyngsError(f"{path}: {where} has {count} joints; SMPL has 24, SMPL-H 52, SMPL-X 55")
    if not np.array_equal(table[1], np.arange(count)):
        raise DyngsError(
            f"{path}: {where} must number the joints 0 to {count - 1} in its second row"
        )
    parents = np.where(table[0] == _NO_PARENT, -1, table[0])
    known = (parents >= -1) & (parents < count) & (parents % 1 == 0)
    if not known.all():
        joint = int(np.argmin(known))
        raise DyngsError(
            f"{path}: {where} gives joint {joint} the parent {table[0][joint]:g}, which does not exist"
        )
    tree = [int(parent) for parent in parents]
    for joint, parent in enumerate(tree):
        if parent == -1 and joint > 0:
            raise DyngsError(
                f"{path}: {where} is not a tree: joint {joint} has no parent; only joint 0 may have none"
            )
        if parent >= joint:
            raise DyngsError(
                f"{path}: {where} must list parents before their children, but joint {joint} has the parent {parent}"
            )
    return tuple(tree)


def _own_uv(arrays: _Arrays, triangles: int) -> _Coordinates | None:
    given = [key for key in _UV if key in arrays.values]
    if not given:
        return None
    if len(given) == 1:
        other = _UV[1 - _UV.index(given[0])]
        raise DyngsError(
            f"{arrays.path}: has '{given[0]}' but not '{other}'; texture coordinates need both"
        )
    uv = require_unit_square(arrays.path, arrays.floats("vt", (None, 2)))
    return uv, arrays.indices("ft", (triangles, 3), len(uv), "texture coordinates")


def _wanted(path: Path, present: Collection[object]) -> list[str]:
    needed = _TEMPLATE if "weights_idx" in present else _SMPL
    missing = [f"'{key}'" for key in needed if key not in present]
    if missing:
        raise DyngsError(
            f"{path}: lacks {', '.join(missing)}; give a body file of SMPL, SMPL-H or SMPL-X"
        )
    optional = (*_UV, *_TEMPLATE_SHAPES) if needed is _TEMPLATE else _UV
    return [*needed, *(key for key in optional if key in present)]


def _read_pickle(path: Path) -> dict[str, np.ndarray]:
    loaded = read_pickle(path)
    if not isinstance(loaded, dict):
        raise DyngsError(
            f"{path}: does not hold a dictionary; give a body file of SMPL, SMPL-H or SMPL-X"
        )
    found = {key: loaded[key] for key in _wanted(path, loaded)}
    for key, value in found.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind == "O":
            raise DyngsError(f"{path}: '{key}' is not an array of numbers; export it again")
    return found


DEFAULT_TEMPLATE = Path(__file__).parent / "files" / "anny_smplx55.npz"
"""The file of the free template that comes with the package."""


@cache
def default_template() -> BodyTemplate:
    """Return the free template of the package, read once: an adult of 1.76 m in T-pose, 55 joints
    as those of SMPL-X.

    All share its tensors: none may be changed in place.
    """
    return read_body(DEFAULT_TEMPLATE)


def template_path(model: HumanModel) -> Path:
    """Return the path of the body file that ``model`` names, or of the free template."""
    return DEFAULT_TEMPLATE if model.body is None else model.body


def load_template(model: HumanModel) -> BodyTemplate:
    """Read the template that ``model`` names, or the free one; files once, as a command asks
    several times.

    Raises DyngsError: a file cannot be read.
    """
    if model.body is None and model.uv is None:
        return default_template()
    if model.body is None:
        raise DyngsError(
            f"model.uv={model.uv} goes with model.body; the free template has its own texture coordinates"
        )
    try:
        found = [path.stat() for path in (model.body, model.uv) if path is not None]
    except OSError:
        return read_body(model.body, model.uv)  # says which is missing
    return _read_once(
        model.body, model.uv, tuple((x.st_ino, x.st_size, x.st_mtime_ns) for x in found)
    )


@lru_cache(maxsize=1)
def _read_once(
    body: Path, uv: Path | None, state: tuple[tuple[int, int, int], ...]
) -> BodyTemplate:
    """Return the template of files that are in a ``state``: where it is another, they are read
    again."""
    return read_body(body, uv)


def has_same_shapes(body: BodyTemplate, given: BodyFrames) -> bool:
    """Return whether the shape parameters of ``given`` are of the shape space of ``body``, as far
    as the files say.

    Those of SMPL's family are taken as one, except for a fit of dyngs, which says to which file it
    was fitted.
    """
    if body.name == "anny" or given.shape_space == "anny":
        return given.shape_space == body.name
    return given.fitted_to in ("", body.fingerprint)


def rest_shape(body: BodyTemplate, given: BodyFrames) -> tuple[Tensor, Tensor]:
    """Return vertices (M, 3) and joints (J, 3) at rest in the shape of ``given``; what ``body``
    lacks is ignored.

    A template with another shape space than that of ``given`` stays as it is.
    """
    if not has_same_shapes(body, given):
        return body.vertices, body.joints
    with torch.no_grad():
        return apply_shape(body, torch.from_numpy(given.betas).to(body.vertices)[: body.num_shapes])
