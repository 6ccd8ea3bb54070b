"""Checkpoints of nerfstudio's splatfacto (``.ckpt``) and of gsplat's examples (``.pt``): read,
never written."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from dyngs.core.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.gaussians import Gaussians
from dyngs.io.fields import require_at_most
from dyngs.io.formats.splat_file import MAX_GAUSSIANS, SplatFile, unit_rotations

_HINT = "export a .ply with the program that wrote it, such as `ns-export gaussian-splat`"
_SHAPES = {"means": 3, "scales": 3, "quats": 4, "opacities": 1}
_NERFSTUDIO = "features_dc", "features_rest"
_GSPLAT = "sh0", "shN"


def read_checkpoint(path: Path) -> SplatFile:
    """Read the Gaussians of a checkpoint of torch. Raises DyngsError: it holds none, or is
    damaged."""
    found = _tensors_of(_load(path))
    names = _NERFSTUDIO if _NERFSTUDIO[0] in found else _GSPLAT
    if not {*_SHAPES, *names} <= found.keys():
        raise DyngsError(
            f"{path}: no Gaussians of nerfstudio's splatfacto or gsplat found; {_HINT}"
        )
    count = len(found["means"])
    require_at_most(path, count, MAX_GAUSSIANS, "Gaussians")
    means, scales, quats, opacities = (
        found[name].detach().float().reshape(count, width) for name, width in _SHAPES.items()
    )
    base, rest = (found[name].detach().float().reshape(count, -1, 3) for name in names)
    if rest.shape[1] + 1 not in [num_sh_terms(degree) for degree in range(MAX_SH_DEGREE + 1)]:
        raise ValueError(f"{rest.shape[1] + 1} SH coefficients do not match any supported degree")
    if not rest.shape[1] and names == _NERFSTUDIO:  # then splatfacto stores logits of colours
        base = (base.sigmoid() - 0.5) / SH_C0
    gaussians = Gaussians(
        means=means,
        quats=unit_rotations(quats),
        log_scales=scales,
        logit_opacities=opacities[:, 0],
        sh=torch.cat([base, rest], dim=1),
    )
    note = "coordinates are those of its training, which may be rotated and scaled; z is assumed to be up"
    return SplatFile(gaussians, notes=(note,))


def _load(path: Path) -> object:
    """Load a file of ``torch.save`` without executing code in it. Raises DyngsError: it is damaged,
    or needs code."""
    if not zipfile.is_zipfile(path):
        raise DyngsError(
            f"{path}: not a torch.save file (torch 1.6 or newer), or truncated; copy it again"
        )
    try:
        return torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except OSError:
        raise
    except Exception as error:  # a damaged pickle may raise any; the text of torch misleads
        raise DyngsError(
            f"{path}: damaged, or contains Python objects, which are not loaded; {_HINT}"
        ) from error


def _tensors_of(contents: object) -> dict[str, Tensor]:
    """Return the tensors beside that called ``means``, by their names without what stands before
    that one."""
    for key in ("pipeline", "splats"):
        if isinstance(contents, Mapping) and isinstance(contents.get(key), Mapping):
            contents = contents[key]
    if not isinstance(contents, Mapping):
        return {}
    tensors = {
        str(name): value
        for name, value in contents.items()
        if isinstance(value, Tensor)
        and value.layout == torch.strided
        and value.device.type == "cpu"
    }
    prefixes = [name.removesuffix("means") for name in tensors if f".{name}".endswith(".means")]
    if len(prefixes) != 1:
        return {}
    (prefix,) = prefixes
    return {name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}
