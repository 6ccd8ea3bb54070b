"""Reader of body templates: SMPL, SMPL-H and SMPL-X files (``.npz``, ``.pkl``), and the free
template.

Symbols: M vertices, T triangles, U UV vertices, J joints.
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
_MAX_VERTICES = 250_000  # SMPL-X has 10,475; the limit on triangles is four times higher


def read_body(path: Path, uv: Path | None = None) -> BodyTemplate:
    """Read a body template from ``.npz`` or ``.pkl``, with an optional UV map from an ``.obj``
    file.

    The number of joints (24, 52 or 55) distinguishes SMPL, SMPL-H and SMPL-X. Expression blend
    shapes of SMPL-X are skipped. Pickles are read without executing code.

    Raises:
        DyngsError: names the file and what is missing or wrong.
    """
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".pkl"):
        raise DyngsError(f"{path}: a body file must end in .npz or .pkl")
    with wrap_read_errors(path, "give a body file of SMPL, SMPL-H or SMPL-X"):

        def select_keys(names: Collection[str]) -> list[str]:
            keys = (*_TEMPLATE, *_TEMPLATE_SHAPES) if "weights_idx" in names else _SMPL
            return [key for key in (*keys, "vt", "ft") if key in names]

        if suffix == ".npz":
            arrays = read_arrays(path, select_keys)
        else:
            loaded: Any = read_pickle(path)
            arrays = {key: np.asarray(loaded[key]) for key in select_keys(loaded)}
        file = _BodyFile(path, arrays)
        parents = file.parents()
        count = len(parents)
        vertices = file.numbers("v_template", None, 3)
        size = len(vertices)
        require_at_most(path, size, _MAX_VERTICES, "vertices")
        faces = file.indices("f", None, 3, below=size)
        require_at_most(path, len(faces), 4 * _MAX_VERTICES, "triangles")
        uv_map = None
        if uv is not None:
            uv_map = read_obj(uv, faces)
        elif "vt" in arrays or "ft" in arrays:
            coordinates = _check_uv(path, file.numbers("vt", None, 2))
            uv_map = (coordinates, file.indices("ft", len(faces), 3, below=len(coordinates)))
        pose_dirs = None
        if "weights_idx" in arrays:  # layout of the free template
            joint_indices = file.indices("weights_idx", size, None, below=count)
            values = _normalized(path, file.numbers("weights_val", *joint_indices.shape))
            weights = np.zeros((size, count))
            np.add.at(weights, (np.arange(size)[:, None], joint_indices), values)
            joints = file.numbers("J", count, 3)
            rounded = (x.astype(np.float32).astype(np.float64) for x in (vertices, joints, weights))
            rest_vertices, rest_joints, rest_weights = rounded
            dirs, joint_dirs = bone_shape_directions(
                rest_vertices, rest_joints, parents, rest_weights
            )
            if "J_shapedirs" in arrays:  # body shapes come before the directions of bones
                shapes = file.numbers("shapedirs", size, 3, None)
                joint_shapes = file.numbers("J_shapedirs", count, 3, shapes.shape[2])
                dirs = np.concatenate([shapes, dirs], axis=2)
                joint_dirs = np.concatenate([joint_shapes, joint_dirs], axis=2)
        else:
            weights = _normalized(path, file.numbers("weights", size, count))
            regressor = file.numbers("J_regressor", count, size)
            joints = regressor @ vertices
            dirs = file.numbers("shapedirs", size, 3, None)
            if count == 55:  # drop expressions, which come after 300 (or 10) shapes
                dirs = dirs[..., : 10 if dirs.shape[2] == 20 else 300]
            joint_dirs = np.einsum("jm,mkb->jkb", regressor, dirs, optimize=True)
            pose_dirs = file.numbers("posedirs", size, 3, 9 * (count - 1)).reshape(3 * size, -1).T
        return BodyTemplate(
            name="anny" if "weights_idx" in arrays else _NAMES[count],
            vertices=_float(vertices),
            faces=torch.from_numpy(faces),
            uv=None if uv_map is None else _float(uv_map[0]),
            uv_faces=None if uv_map is None else torch.from_numpy(uv_map[1]),
            weights=_float(weights),
            parents=parents,
            joints=_float(joints),
            shape_dirs=_float(dirs),
            joint_shape_dirs=_float(joint_dirs),
            pose_dirs=None if pose_dirs is None else _float(pose_dirs),
        )


@dataclass(frozen=True)
class _BodyFile:
    """Arrays of a body file by key, with validation."""

    path: Path
    arrays: dict[str, np.ndarray]

    def numbers(self, key: str, *shape: int | None) -> np.ndarray:
        """Return the finite float64 array at ``key``; None in ``shape`` is any positive size."""
        value = self.arrays[key]
        if value.dtype.kind not in "biuf":
            raise DyngsError(f"{self.path}: '{key}' must hold numbers, not {value.dtype}")
        matching = tuple(n if w is None else w for w, n in zip(shape, value.shape, strict=False))
        if not value.size or len(shape) != value.ndim or matching != value.shape:
            wanted_text = " x ".join("n" if n is None else str(n) for n in shape)
            raise DyngsError(
                f"{self.path}: '{key}' must have shape {wanted_text}, got "
                f"{' x '.join(map(str, value.shape))}; give a SMPL, SMPL-H or SMPL-X file"
            )
        with np.errstate(invalid="ignore"):  # signalling NaNs are rejected below
            value = value.astype(np.float64)
        if not (np.abs(value) < 1e10).all():
            raise DyngsError(f"{self.path}: '{key}' holds NaN or huge numbers; export it again")
        return value

    def indices(self, key: str, *shape: int | None, below: int) -> np.ndarray:
        """Return the integers at ``key``, int64 in [0, below)."""
        value = self.numbers(key, *shape)
        if not ((value >= 0) & (value < below) & (value % 1 == 0)).all():
            raise DyngsError(f"{self.path}: '{key}' must hold integers from 0 to {below - 1}")
        return value.astype(np.int64)

    def parents(self) -> tuple[int, ...]:
        """Return the parent of each joint; the first joint is the root (-1)."""
        table = self.numbers("kintree_table", 2, None)
        count = table.shape[1]
        if count not in _NAMES:
            raise DyngsError(
                f"{self.path}: 'kintree_table' has {count} joints; SMPL has 24, SMPL-H 52, SMPL-X "
                "55"
            )
        above = table[0, 1:]
        rows = np.arange(count)
        if ((above < 0) | (above >= rows[1:]) | (above % 1 != 0)).any() or (table[1] != rows).any():
            raise DyngsError(
                f"{self.path}: the second row of 'kintree_table' must number joints from 0, with "
                "parents before their children"
            )
        return (-1, *(int(parent) for parent in above))


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))


def _normalized(path: Path, weights: np.ndarray) -> np.ndarray:
    """Return skinning weights with rows that sum to 1, despite half-precision errors of files."""
    sums = weights.sum(1)
    if (np.abs(sums - 1) > 1e-3).any() or weights.min() < -1e-6:
        raise DyngsError(f"{path}: skinning weights must be non-negative and sum to 1")
    return weights / sums[:, None]


def _check_uv(path: Path, uv: np.ndarray) -> np.ndarray:
    """Return UV coordinates (U, 2) clipped to [0, 1]; raise DyngsError if they exceed it by more
    than rounding."""
    if not ((uv > -1e-4) & (uv < 1 + 1e-4)).all():
        raise DyngsError(f"{path}: UV coordinates must lie in [0, 1] (a single tile)")
    return uv.clip(0, 1)


def read_obj(path: Path, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read the UV map of an ``.obj``: coordinates (U, 2) and triangles (T, 3) in the order of
    ``faces``.

    Triangles ``f v/vt v/vt v/vt`` of the file may come in any order. Raises DyngsError: the file
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
        matches = [
            [triangles[tuple(sorted(face))][vertex] for vertex in face]
            for face in (faces + 1).tolist()
        ]
        uv_faces = np.array(matches) - 1
        if uv_faces.min() < 0 or uv_faces.max() >= len(uv):
            raise DyngsError(f"{path}: a face refers to a UV coordinate that does not exist")
        return _check_uv(path, np.array(uv)), uv_faces


DEFAULT_TEMPLATE = Path(__file__).parent / "files" / "anny_smplx55.npz"
"""File of the free template, part of the package."""


@cache
def default_template() -> BodyTemplate:
    """Return the free template: an adult of 1.76 m in T-pose, with the 55 joints of SMPL-X.

    It is read once and shared; do not modify its tensors in place.
    """
    return read_body(DEFAULT_TEMPLATE)


def template_path(model: HumanModel) -> Path:
    """Return the body file of ``model``, or that of the free template."""
    return DEFAULT_TEMPLATE if model.body is None else model.body


def load_template(model: HumanModel) -> BodyTemplate:
    """Return the template of ``model``, or the free one; the last file is cached.

    Raises DyngsError: a file cannot be read.
    """
    if model.body is None and model.uv is None:
        return default_template()
    if model.body is None:
        raise DyngsError(
            f"model.uv={model.uv} needs model.body; the free template has its own UV map"
        )
    try:
        stats = [path.stat() for path in (model.body, model.uv) if path is not None]
    except OSError:
        return read_body(model.body, model.uv)  # raises the error that names the missing file
    return _read_cached(
        model.body, model.uv, tuple((x.st_ino, x.st_size, x.st_mtime_ns) for x in stats)
    )


@lru_cache(maxsize=1)
def _read_cached(
    body: Path, uv: Path | None, state: tuple[tuple[int, int, int], ...]
) -> BodyTemplate:
    """Read a template; ``state`` (inode, size, time of change) invalidates the cache when a file
    changes."""
    return read_body(body, uv)


def has_same_shape_space(body: BodyTemplate, given: BodyFrames) -> bool:
    """True if the shape parameters of ``given`` apply to ``body``, as far as the files tell.

    All SMPL-family files count as the same shape space, except that a fit by dyngs names the file
    it belongs to.
    """
    if body.name == "anny" or given.shape_space == "anny":
        return given.shape_space == body.name
    return given.fitted_to in ("", body.fingerprint)


def rest_shape(body: BodyTemplate, given: BodyFrames) -> tuple[Tensor, Tensor]:
    """Return rest-pose vertices (M, 3) and joints (J, 3) in the shape of ``given``.

    Surplus shape parameters are ignored; with another shape space the template keeps its mean
    shape.
    """
    if not has_same_shape_space(body, given):
        return body.vertices, body.joints
    with torch.no_grad():
        return apply_shape(body, torch.from_numpy(given.betas).to(body.vertices)[: body.num_shapes])
