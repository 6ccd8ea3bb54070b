"""glTF's ``KHR_gaussian_splatting`` (release candidate of July 2026) in a ``.glb``: float32, nothing is lost.

A primitive of points with the attributes ``KHR_gaussian_splatting:ROTATION`` (xyzw), ``SCALE`` (linear), ``OPACITY``
and ``SH_DEGREE_l_COEF_n`` up to degree 3, and ``COLOR_0`` (linear RGB) for viewers that know only points. y is up.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.conventions import SH_C0, num_sh_terms
from dyngs.gaussians import Gaussians
from dyngs.splats.glb_file import GlbFile
from dyngs.splats.packing import logit
from dyngs.splats.rotation import turned
from dyngs.splats.splat_file import SplatFile, unit_rotations

EXTENSION = "KHR_gaussian_splatting"
_FLOAT, _POINTS, _ARRAY_BUFFER = 5126, 0, 34962
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def read_gltf(path: Path) -> SplatFile:
    """Read all Gaussians of a .glb, placed as its nodes say.

    Raises:
        DyngsError: no primitive of Gaussians, a kernel or colour space other than those of 3DGS, or damaged contents.
    """
    file = GlbFile(path)
    found: list[Gaussians] = []
    for primitive, placement in file.primitives(EXTENSION):
        own = _gaussians(file, primitive)
        found.append(turned(own, placement.rotation, placement.scale, placement.shift_tensor))
    if not found:
        raise file.error(f"holds no Gaussians ({EXTENSION})")
    degree = min(g.sh_degree for g in found)
    parts = [g.tensors() | {"sh": g.sh[:, : num_sh_terms(degree)]} for g in found]
    return SplatFile(Gaussians(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]}))


def write_gltf(path: Path, splat: SplatFile) -> None:
    """Write a .glb with one primitive of Gaussians, harmonics up to degree 3."""
    arrays = gaussian_attributes(splat.gaussians)
    views, accessors, start = [], [], 0
    for name, values in arrays.items():
        size = 4 * values.size
        views.append({"buffer": 0, "byteOffset": start, "byteLength": size, "target": _ARRAY_BUFFER})
        accessor: dict[str, Any] = {"bufferView": len(views) - 1, "componentType": _FLOAT, "count": len(values)}
        accessor["type"] = _KINDS[values.shape[1]]
        if name == "POSITION":
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
        start += size
    document = {
        "asset": {"version": "2.0", "generator": "dyngs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [gaussian_primitive({name: i for i, name in enumerate(arrays)})]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with open(path, "wb") as out:
        out.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + start))
        out.write(struct.pack("<I4s", len(text), b"JSON") + text)
        out.write(struct.pack("<I4s", start, b"BIN\0"))
        for values in arrays.values():
            out.write(np.ascontiguousarray(values, "<f4").tobytes())


def gaussian_attributes(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the numbers (N, D) of Gaussians by attribute of a primitive, harmonics up to degree 3."""
    sh = gaussians.sh.numpy()
    arrays = {
        "POSITION": gaussians.means.numpy(),
        "COLOR_0": np.concatenate([_linear(sh[:, 0] * SH_C0 + 0.5), gaussians.opacities.numpy()[:, None]], axis=1),
        f"{EXTENSION}:ROTATION": gaussians.quats.numpy()[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": gaussians.scales.numpy(),
        f"{EXTENSION}:OPACITY": gaussians.opacities.numpy()[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        first = num_sh_terms(degree - 1)
        for k in range(first, num_sh_terms(degree)):
            arrays[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - first}"] = sh[:, k]
    return arrays


def gaussian_primitive(attributes: dict[str, int]) -> dict[str, Any]:
    """Return a primitive of Gaussians with accessors by attribute."""
    own = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    own |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    return {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: own}}


def _linear(srgb: np.ndarray) -> np.ndarray:
    """Return linear values of sRGB ones, clamped to [0, 1]."""
    inside = srgb.clip(0, 1)
    return np.where(inside <= 0.04045, inside / 12.92, ((inside + 0.055) / 1.055) ** 2.4)


def _gaussians(file: GlbFile, primitive: dict[str, Any]) -> Gaussians:
    """Return the Gaussians of a primitive, in the axes of its node."""
    own = primitive["extensions"][EXTENSION]
    if "extensions" in own:
        raise file.error("its Gaussians are compressed by another extension; export them without")
    for key, known in (("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display")):
        if own.get(key) != known:
            raise file.error(f"{key} {own.get(key)!r:.40} is not supported, only {known}")
    names = primitive.get("attributes")
    if not isinstance(names, dict):
        raise file.error("its Gaussians have no attributes; export it again")

    def numbers(name: str, width: int) -> np.ndarray:
        if name not in names:
            raise file.error(f"its Gaussians have no {name:.60}; export it again")
        return file.numbers(names[name], width)

    means = numbers("POSITION", 3)
    terms = []
    for degree in range(4):
        keys = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
        if degree and keys[0] not in names:
            break
        terms += [numbers(key, 3) for key in keys]
    scales, opacities = numbers(f"{EXTENSION}:SCALE", 3), numbers(f"{EXTENSION}:OPACITY", 1)[:, 0]
    rotations = numbers(f"{EXTENSION}:ROTATION", 4)
    if any(len(x) != len(means) for x in (*terms, scales, opacities, rotations)):
        raise file.error("the attributes of its Gaussians have different lengths; export it again")
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(scales)
    return Gaussians(
        means=torch.from_numpy(means),
        quats=unit_rotations(torch.from_numpy(rotations[:, [3, 0, 1, 2]])),
        log_scales=torch.from_numpy(log_scales),
        logit_opacities=torch.from_numpy(logit(opacities)),
        sh=torch.from_numpy(np.stack(terms, axis=1)),
    )
