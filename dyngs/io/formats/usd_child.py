"""USD reader for a separate process: ``python -m dyngs.io.formats.usd_child IN OUT.npz``.

The USD library takes unbounded memory for damaged binary files, or ends the process. Here that
harms nothing else. Prints one line and exits with 2 where the file is refused.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

PRIM = "ParticleField3DGaussianSplat"
_BASE_BYTES = 1 << 32
_BYTES_PER_BYTE = 16
_SECONDS = 60


class RefusedError(Exception):
    """A file that cannot be read, with the reason."""


def main() -> int:
    """Read the file named on the command line; return the exit code."""
    path = Path(sys.argv[1])
    out = Path(sys.argv[2])
    try:
        _limit(path.stat().st_size)
        np.savez(out, allow_pickle=False, **arrays_of(path))
    except RefusedError as error:
        print(error)
        return 2
    return 0


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Return the attributes of all prims of Gaussians as ``0.means`` and so on, with their
    ``world`` matrices.

    And ``up`` and ``comments`` of the stage.

    Raises RefusedError: it refers to other files, holds no Gaussians, or is damaged.
    """
    sdf, tf, usd, geom = (import_module(f"pxr.{name}") for name in ("Sdf", "Tf", "Usd", "UsdGeom"))
    try:
        layer = sdf.Layer.OpenAsAnonymous(str(path))
        if layer is None:
            raise RefusedError("not a USD file; export it again")
        others = layer.GetCompositionAssetDependencies()
        if others:
            raise RefusedError(
                f"refers to other files ({others[0]!s:.60}); flatten it into one file first"
            )
        stage = usd.Stage.Open(layer, usd.Stage.LoadNone)
        prims = [prim for prim in stage.Traverse() if prim.GetTypeName() == PRIM]
        up = str(geom.GetStageUpAxis(stage))
        found = {"up": np.array(up), "count": np.array(len(prims))}
        comments = layer.customLayerData.get("dyngs")
        is_own = isinstance(comments, import_module("pxr.Vt").StringArray)
        found["comments"] = np.array(list(comments) if is_own else [], dtype=str)
        for i, prim in enumerate(prims):
            found |= {f"{i}.{name}": values for name, values in _attributes(prim, geom).items()}
    except tf.ErrorException as error:
        raise RefusedError(
            f"cannot be read as USD ({str(error).strip()[-100:]!r}); export it again"
        ) from error
    return found


def _attributes(prim: Any, geom: Any) -> dict[str, np.ndarray]:
    def values(name: str, width: int) -> np.ndarray:
        for own in (name, name + "h"):
            attribute = prim.GetAttribute(own)
            found = attribute.Get() if attribute else None
            if found is not None and len(found):
                return np.asarray(found, np.float32).reshape(-1, width)
        raise RefusedError(f"its Gaussians have no {name}; export it again")

    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    return {
        "means": values("positions", 3),
        "scales": values("scales", 3),
        "opacities": values("opacities", 1)[:, 0],
        "quats": values("orientations", 4)[:, [3, 0, 1, 2]],
        "sh": values("radiance:sphericalHarmonicsCoefficients", 3),
        "degree": np.array(degree if type(degree) is int else -1),
        "world": np.array(geom.Xformable(prim).ComputeLocalToWorldTransform(0.0), np.float64).T,
    }


def _limit(size: int) -> None:
    """Bound memory and processor time, where the system can: not on Windows."""
    try:
        import resource
    except ImportError:
        return
    for kind, limit in (
        (resource.RLIMIT_AS, _BASE_BYTES + _BYTES_PER_BYTE * size),
        (resource.RLIMIT_CPU, _SECONDS + size // 10**6),
    ):
        with suppress(ValueError, OSError):  # it is lower already
            resource.setrlimit(kind, (limit, limit))


if __name__ == "__main__":
    sys.exit(main())
