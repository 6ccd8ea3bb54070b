"""OpenUSD's ``ParticleField3DGaussianSplat`` (26.03): float32, nothing is lost. Needs ``pip install 'dyngs[usd]'``.

One prim with ``positions``, ``orientations``, linear ``scales``, ``opacities`` in [0, 1] and, per Gaussian, all terms of
its harmonics. y is up, and the stage says so; stages of others may say z.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.conventions import MAX_SH_DEGREE, num_sh_terms
from dyngs.errors import DyngsError
from dyngs.files.limits import require_at_most
from dyngs.gaussians import Gaussians
from dyngs.splats.packing import logit
from dyngs.splats.rotation import turned
from dyngs.splats.similarity import placement_of
from dyngs.splats.splat_file import SplatFile, unit_rotations

_TYPE = "ParticleField3DGaussianSplat"
_MOST_BYTES = 1 << 31
_UP = {"Y": "y", "Z": "z"}


def read_usd(path: Path) -> SplatFile:
    """Read all Gaussians of a .usd, .usda, .usdc or .usdz, placed as their prims say, at the stage's default time.

    Raises:
        DyngsError: usd-core is missing, the file refers to others, holds no Gaussians, or is damaged.
    """
    sdf, usd, geom, _, tf = _packages(path)
    require_at_most(path, path.stat().st_size, _MOST_BYTES, "bytes of a USD file")
    try:
        layer = sdf.Layer.OpenAsAnonymous(str(path))
        if layer is None:
            raise DyngsError(f"{path}: is no USD file; export it again")
        others = layer.GetCompositionAssetDependencies()
        if others:
            raise DyngsError(f"{path}: refers to other files ({others[0]!s:.60}); flatten it into one file first")
        stage = usd.Stage.Open(layer, usd.Stage.LoadNone)
        found = [_gaussians(path, prim, geom) for prim in stage.Traverse() if prim.GetTypeName() == _TYPE]
        up = _UP.get(str(geom.GetStageUpAxis(stage)), "y")
    except tf.ErrorException as error:
        raise DyngsError(f"{path}: cannot be read as USD ({str(error).strip()[-100:]!r}); export it again") from error
    if not found:
        raise DyngsError(f"{path}: holds no Gaussians ({_TYPE})")
    degree = min(g.sh_degree for g in found)
    parts = [g.tensors() | {"sh": g.sh[:, : num_sh_terms(degree)]} for g in found]
    whole = Gaussians(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})
    return SplatFile(whole, up=up)


def write_usd(path: Path, splat: SplatFile) -> None:
    """Write one prim of Gaussians; the suffix chooses text (.usda) or binary (.usd, .usdc)."""
    sdf, usd, geom, vol, _ = _packages(path)
    from pxr import Vt

    gaussians = splat.gaussians
    layer = sdf.Layer.CreateAnonymous(path.suffix)
    stage = usd.Stage.Open(layer)
    axes = {"y": geom.Tokens.y, "z": geom.Tokens.z}
    geom.SetStageUpAxis(stage, axes.get(splat.up or "y", geom.Tokens.y))
    geom.SetStageMetersPerUnit(stage, 1.0)
    prim = vol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians")
    stage.SetDefaultPrim(prim.GetPrim())
    prim.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(gaussians.means.numpy()))
    prim.CreateOrientationsAttr(_quats(gaussians.quats.numpy(), Vt))
    prim.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(gaussians.scales.numpy()))
    prim.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(gaussians.opacities.numpy()))
    prim.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    terms = np.ascontiguousarray(gaussians.sh.numpy().reshape(-1, 3))
    prim.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(terms))
    reach = 3 * gaussians.scales.amax(1, keepdim=True)
    corners = [(gaussians.means - reach).amin(0).tolist(), (gaussians.means + reach).amax(0).tolist()]
    prim.CreateExtentAttr(corners)
    if not layer.Export(str(path)):
        raise DyngsError("the USD library could not write it")


def _packages(path: Path) -> tuple[Any, Any, Any, Any, Any]:
    """Return the modules Sdf, Usd, UsdGeom, UsdVol and Tf."""
    try:
        from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol

        _ = UsdVol.ParticleField3DGaussianSplat
    except (ImportError, AttributeError):
        raise DyngsError(
            f"{path}: USD files need the package usd-core 26.3 or newer: pip install 'dyngs[usd]'"
        ) from None
    return Sdf, Usd, UsdGeom, UsdVol, Tf


def _quats(quats: np.ndarray, types: Any) -> Any:
    """Return quaternions (N, 4) wxyz as an array of USD, which keeps the real part last in memory."""
    return types.QuatfArray.FromNumpy(np.ascontiguousarray(quats[:, [1, 2, 3, 0]]))


def _gaussians(path: Path, prim: Any, geom: Any) -> Gaussians:
    """Return the Gaussians of a prim, in the axes of the stage."""

    def values(name: str, width: int) -> np.ndarray:
        for own in (name, name + "h"):
            attribute = prim.GetAttribute(own)
            found = attribute.Get() if attribute else None
            if found is not None and len(found):
                return np.asarray(found, np.float32).reshape(-1, width)
        raise DyngsError(f"{path}: its Gaussians have no {name}; export it again")

    means = values("positions", 3)
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    if type(degree) is not int or not 0 <= degree <= MAX_SH_DEGREE:
        raise DyngsError(f"{path}: harmonics of degree {degree!r:.20}, only 0 to {MAX_SH_DEGREE} are known")
    sh = values("radiance:sphericalHarmonicsCoefficients", 3)
    scales, opacities, quats = values("scales", 3), values("opacities", 1)[:, 0], values("orientations", 4)
    n, terms = len(means), num_sh_terms(degree)
    if not n == len(scales) == len(opacities) == len(quats) or len(sh) != n * terms:
        raise DyngsError(f"{path}: the attributes of its Gaussians have different lengths; export it again")
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(scales)
    found = Gaussians(
        means=torch.from_numpy(means.copy()),
        quats=unit_rotations(torch.from_numpy(quats[:, [3, 0, 1, 2]].copy())),
        log_scales=torch.from_numpy(log_scales),
        logit_opacities=torch.from_numpy(logit(opacities)),
        sh=torch.from_numpy(sh.reshape(n, terms, 3).copy()),
    )
    world = np.array(geom.Xformable(prim).ComputeLocalToWorldTransform(0.0), np.float64).T
    placement = placement_of(world)
    if placement is None:
        raise DyngsError(f"{path}: a prim distorts or mirrors its Gaussians; apply its transform before exporting")
    return turned(found, placement.rotation, placement.scale, placement.shift_tensor)
