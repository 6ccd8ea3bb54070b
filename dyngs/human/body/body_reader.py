"""Reader of body templates: SMPL, SMPL-H and SMPL-X in ``.npz`` or ``.pkl``, and the free template.

Local letters: M vertices, T triangles, U texture coordinates.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.capture import BodyFrames
from dyngs.human.body.body import BodyTemplate, apply_shape, bone_shape_directions
from dyngs.human.keys import HumanModel
from dyngs.io.fields import read_limited, require_at_most
from dyngs.io.numpy_files import read_arrays
from dyngs.io.pickles import read_pickle

_SMPL = ("v_template", "f", "weights", "kintree_table", "J_regressor", "shapedirs", "posedirs")
_TEMPLATE = ("v_template", "f", "weights_idx", "weights_val", "kintree_table", "J")
_TEMPLATE_SHAPES = ("shapedirs", "J_shapedirs")
_NAMES = {24: "smpl", 52: "smplh", 55: "smplx"}
_MOST_VERTICES = 250_000  # SMPL-X has 10,475; four times as many triangles are allowed


def read_body(path: Path, uv: Path | None = None) -> BodyTemplate:
    """Read the body template of a ``.npz`` or ``.pkl`` file, with the texture coordinates of an
    ``.obj`` ``uv``.

    The number of joints (24, 52 or 55) tells SMPL, SMPL-H and SMPL-X apart. SMPL-X keeps shape and
    expression in one array, of which the shapes are read: 300, or 10 of 20. A file cannot run code:
    only numbers, text and arrays are read from a pickle. Raises DyngsError: names the file and what
    is missing or wrong.
    """
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".pkl"):
        raise DyngsError(f"{path}: a body file must end in .npz or .pkl")
    with wrap_read_errors(path, "give a body file of SMPL, SMPL-H or SMPL-X"):

        def wanted(names: Collection[str]) -> list[str]:
            keys = (*_TEMPLATE, *_TEMPLATE_SHAPES) if "weights_idx" in names else _SMPL
            return [key for key in (*keys, "vt", "ft") if key in names]

        if suffix == ".npz":
            arrays = read_arrays(path, wanted)
        else:
            loaded: Any = read_pickle(path)
            arrays = {key: np.asarray(loaded[key]) for key in wanted(loaded)}
        file = _BodyFile(path, arrays)
        parents = file.parents()
        count = len(parents)
        vertices = file.numbers("v_template", None, 3)
        size = len(vertices)
        require_at_most(path, size, _MOST_VERTICES, "vertices")
        faces = file.indices("f", None, 3, below=size)
        require_at_most(path, len(faces), 4 * _MOST_VERTICES, "triangles")
        corners = None
        if uv is not None:
            corners = read_obj(uv, faces)
        elif "vt" in arrays or "ft" in arrays:
            places = _on_unit_square(path, file.numbers("vt", None, 2))
            corners = (places, file.indices("ft", len(faces), 3, below=len(places)))
        pose_dirs = None
        if "weights_idx" in arrays:  # the free template
            followed = file.indices("weights_idx", size, None, below=count)
            values = _normalized(path, file.numbers("weights_val", *followed.shape))
            weights = np.zeros((size, count))
            np.add.at(weights, (np.arange(size)[:, None], followed), values)
            joints = file.numbers("J", count, 3)
            rest = (x.astype(np.float32).astype(np.float64) for x in (vertices, joints, weights))
            bare, bones, skin = rest
            dirs, joint_dirs = bone_shape_directions(bare, bones, parents, skin)
            if "J_shapedirs" in arrays:  # before the directions of bones
                own = file.numbers("shapedirs", size, 3, None)
                own_joints = file.numbers("J_shapedirs", count, 3, own.shape[2])
                dirs = np.concatenate([own, dirs], axis=2)
                joint_dirs = np.concatenate([own_joints, joint_dirs], axis=2)
        else:
            weights = _normalized(path, file.numbers("weights", size, count))
            regressor = file.numbers("J_regressor", count, size)
            joints = regressor @ vertices
            dirs = file.numbers("shapedirs", size, 3, None)
            if count == 55:  # expressions come after the shapes
                dirs = dirs[..., : 10 if dirs.shape[2] == 20 else 300]
            joint_dirs = np.einsum("jm,mkb->jkb", regressor, dirs, optimize=True)
            pose_dirs = file.numbers("posedirs", size, 3, 9 * (count - 1)).reshape(3 * size, -1).T
        return BodyTemplate(
            name="anny" if "weights_idx" in arrays else _NAMES[count],
            vertices=_float(vertices),
            faces=torch.from_numpy(faces),
            uv=None if corners is None else _float(corners[0]),
            uv_faces=None if corners is None else torch.from_numpy(corners[1]),
            weights=_float(weights),
            parents=parents,
            joints=_float(joints),
            shape_dirs=_float(dirs),
            joint_shape_dirs=_float(joint_dirs),
            pose_dirs=None if pose_dirs is None else _float(pose_dirs),
        )


@dataclass(frozen=True)
class _BodyFile:
    """The arrays of a file under the keys that are needed."""

    path: Path
    arrays: dict[str, np.ndarray]

    def numbers(self, key: str, *shape: int | None) -> np.ndarray:
        """Return the finite float64 numbers at ``key``; None in the shape matches any positive
        size."""
        value = self.arrays[key]
        if value.dtype.kind not in "biuf":
            raise DyngsError(f"{self.path}: '{key}' must hold numbers, not {value.dtype}")
        wanted = tuple(n if w is None else w for w, n in zip(shape, value.shape, strict=False))
        if not value.size or len(shape) != value.ndim or wanted != value.shape:
            expected = " x ".join("n" if n is None else str(n) for n in shape)
            raise DyngsError(
                f"{self.path}: '{key}' must be {expected}, is {' x '.join(map(str, value.shape))}; is it another kind "
                "of body?"
            )
        with np.errstate(invalid="ignore"):  # signalling NaNs, which are refused just below
            value = value.astype(np.float64)
        if not (np.abs(value) < 1e10).all():
            raise DyngsError(f"{self.path}: '{key}' holds NaN or huge numbers; export it again")
        return value

    def indices(self, key: str, *shape: int | None, below: int) -> np.ndarray:
        """Return the whole numbers at ``key``, int64 in [0, below)."""
        value = self.numbers(key, *shape)
        if not ((value >= 0) & (value < below) & (value % 1 == 0)).all():
            raise DyngsError(f"{self.path}: '{key}' must hold whole numbers from 0 to {below - 1}")
        return value.astype(np.int64)

    def parents(self) -> tuple[int, ...]:
        """Return the parent of each joint, -1 for the root, the first one."""
        table = self.numbers("kintree_table", 2, None)
        count = table.shape[1]
        if count not in _NAMES:
            raise DyngsError(
                f"{self.path}: 'kintree_table' has {count} joints; SMPL has 24, SMPL-H 52, SMPL-X 55"
            )
        above = table[0, 1:]
        rows = np.arange(count)
        if ((above < 0) | (above >= rows[1:]) | (above % 1 != 0)).any() or (table[1] != rows).any():
            raise DyngsError(
                f"{self.path}: 'kintree_table' must number the joints from 0 in its second row, and list parents "
                "before their children"
            )
        return (-1, *(int(parent) for parent in above))


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _normalized(path: Path, weights: np.ndarray) -> np.ndarray:
    """Return the weights with rows that sum to 1 exactly; a file may miss it by half precision."""
    sums = weights.sum(1)
    if (np.abs(sums - 1) > 1e-3).any() or weights.min() < -1e-6:
        raise DyngsError(f"{path}: skinning weights must be non-negative and sum to 1")
    return weights / sums[:, None]


def _on_unit_square(path: Path, uv: np.ndarray) -> np.ndarray:
    """Return texture coordinates (U, 2), rounding errors clipped; raises DyngsError where they
    leave [0, 1]."""
    if not ((uv > -1e-4) & (uv < 1 + 1e-4)).all():
        raise DyngsError(f"{path}: texture coordinates must lie in [0, 1], on one tile")
    return uv.clip(0, 1)


def read_obj(path: Path, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read the texture coordinates (U, 2) of an ``.obj`` and the triangles (T, 3) that index them,
    in the order of the triangles ``faces`` (T, 3) of a body.

    Those of the file may come in any order, as ``f v/vt v/vt v/vt``. Raises DyngsError: the file
    cannot be read, or belongs to another body.
    """
    with wrap_read_errors(
        path, "give the .obj made for this body, with triangles 'f v/vt v/vt v/vt'"
    ):
        uv = []
        triangles: dict[tuple[int, ...], dict[int, int]] = {}
        for line in read_limited(path).decode("latin-1").splitlines():
            kind, *words = line.split() or [""]
            if kind == "vt":
                uv.append([float(word) for word in words[:2]])
            elif kind == "f":
                corners = {int(v): int(vt) for v, vt, *_ in (x.split("/") for x in words)}
                triangles[tuple(sorted(corners))] = corners
        matched = [
            [triangles[tuple(sorted(face))][vertex] for vertex in face]
            for face in (faces + 1).tolist()
        ]
        uv_faces = np.array(matched) - 1
        if uv_faces.min() < 0 or uv_faces.max() >= len(uv):
            raise DyngsError(f"{path}: a face names a texture coordinate that does not exist")
        return _on_unit_square(path, np.array(uv)), uv_faces


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


def has_same_shape_space(body: BodyTemplate, given: BodyFrames) -> bool:
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
    if not has_same_shape_space(body, given):
        return body.vertices, body.joints
    with torch.no_grad():
        return apply_shape(body, torch.from_numpy(given.betas).to(body.vertices)[: body.num_shapes])
