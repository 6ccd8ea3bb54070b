"""OpenUSD's ``ParticleField3DGaussianSplat`` (26.03): float32. Needs ``pip install 'dyngs[usd]'``.

One prim with ``positions``, ``orientations``, linear ``scales``, ``opacities`` in [0, 1] and, per
Gaussian, all terms of its harmonics. y is up, and the stage says so; stages of others may say z.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dyngs.core.conventions import MAX_SH_DEGREE, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.gaussians import Gaussians
from dyngs.io.child import python_command
from dyngs.io.fields import require_at_most
from dyngs.io.formats import usd_child
from dyngs.io.formats.similarity import join_gaussians, similarity_from_matrix
from dyngs.io.formats.splat_file import SplatFile, from_linear, header_comments, parse_comments

_SECONDS = 600.0  # of wall time; the child has less of processor time
_NAMES = ("means", "scales", "opacities", "quats", "sh", "degree", "world")
_MOST_BYTES = 1 << 31
_UP = {"Y": "y", "Z": "z"}


def read_usd(path: Path) -> SplatFile:
    """Read all Gaussians of a .usd, .usda or .usdc in stage coordinates, at its default time.

    Raises DyngsError: usd-core is missing, the file refers to others, holds no Gaussians, or is
    damaged.
    """
    _packages(path)
    require_at_most(path, path.stat().st_size, _MOST_BYTES, "bytes of a USD file")
    with TemporaryDirectory(prefix="dyngs-usd-") as folder:
        out = Path(folder) / "arrays.npz"
        environment = os.environ | {"PXR_WORK_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = python_command(usd_child.__name__, str(path.resolve()), str(out))
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=_SECONDS,
            check=False,
            env=environment,
            errors="replace",
        )
        if done.returncode == 2 and done.stdout.strip():
            raise DyngsError(f"{path}: {done.stdout.strip().splitlines()[-1]:.200}")
        if done.returncode or not out.is_file():
            raise DyngsError(
                f"{path}: the USD library cannot read it within the memory limit; export it again"
            )
        with np.load(out, allow_pickle=False) as arrays:
            read = {name: arrays[name] for name in arrays.files}
    count = int(read["count"])
    if not count:
        raise DyngsError(f"{path}: no Gaussians found ({usd_child.PRIM})")
    found = [_gaussians({name: read[f"{i}.{name}"] for name in _NAMES}) for i in range(count)]
    up = _UP.get(str(read["up"]), "y")
    return parse_comments(
        SplatFile(join_gaussians(found), up=up, comments=tuple(read["comments"].tolist()))
    )


def write_usd(path: Path, splat: SplatFile) -> None:
    """Write one prim of Gaussians; the suffix chooses text (.usda) or binary (.usd, .usdc)."""
    sdf, usd, geom, vol = _packages(path)
    vt = import_module("pxr.Vt")
    gaussians = splat.gaussians
    layer = sdf.Layer.CreateAnonymous(path.suffix)
    stage = usd.Stage.Open(layer)
    axes = {"y": geom.Tokens.y, "z": geom.Tokens.z}
    geom.SetStageUpAxis(stage, axes.get(splat.up or "y", geom.Tokens.y))
    geom.SetStageMetersPerUnit(stage, 1.0)
    layer.customLayerData = {"dyngs": vt.StringArray(header_comments(splat))}
    prim = vol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians")
    stage.SetDefaultPrim(prim.GetPrim())
    prim.CreatePositionsAttr(vt.Vec3fArray.FromNumpy(gaussians.means.numpy()))
    # USD keeps the real part last in memory
    xyzw = np.ascontiguousarray(gaussians.quats.numpy()[:, [1, 2, 3, 0]])
    prim.CreateOrientationsAttr(vt.QuatfArray.FromNumpy(xyzw))
    prim.CreateScalesAttr(vt.Vec3fArray.FromNumpy(gaussians.scales.numpy()))
    prim.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(gaussians.opacities.numpy()))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    terms = np.ascontiguousarray(gaussians.sh.numpy().reshape(-1, 3))
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(vt.Vec3fArray.FromNumpy(terms))
    reach = 3 * gaussians.scales.amax(1, keepdim=True)
    corners = [
        (gaussians.means - reach).amin(0).tolist(),
        (gaussians.means + reach).amax(0).tolist(),
    ]
    prim.CreateExtentAttr(corners)
    with suppress(RuntimeError):  # its own, of many lines
        if layer.Export(str(path)):
            return
    raise OSError("the USD library failed to write it; the disk may be full")


def _packages(path: Path) -> tuple[Any, Any, Any, Any]:
    try:
        sdf, usd, geom, vol = (
            import_module(f"pxr.{name}") for name in ("Sdf", "Usd", "UsdGeom", "UsdVol")
        )
        _ = vol.ParticleField3DGaussianSplat
    except (ImportError, AttributeError):
        raise DyngsError(
            f"{path}: USD files need the package usd-core 26.3 or newer: pip install 'dyngs[usd]'"
        ) from None
    return sdf, usd, geom, vol


def _gaussians(arrays: Mapping[str, np.ndarray]) -> Gaussians:
    """Return the Gaussians of a prim, in the axes of the stage."""
    degree = int(arrays["degree"])
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise ValueError(f"SH degree {degree} is not supported, only 0 to {MAX_SH_DEGREE}")
    means = arrays["means"]
    sh = arrays["sh"].reshape(len(means), num_sh_terms(degree), 3)
    found = from_linear(means, arrays["quats"], arrays["scales"], arrays["opacities"], sh)
    place = similarity_from_matrix(arrays["world"])
    if place is None:
        raise ValueError("a prim transform shears or mirrors its Gaussians; apply it first")
    return place.gaussians(found.replace(means=found.means.double()))
