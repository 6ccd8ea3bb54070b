"""Checkpoints of nerfstudio's splatfacto (``.ckpt``) and of gsplat's examples (``.pt``): read,
never written."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.gaussians import Gaussians
from dyngs.io.fields import require_at_most
from dyngs.io.formats.splat_file import MOST_GAUSSIANS, SplatFile, unit_rotations

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
            f"{path}: holds no Gaussians as nerfstudio's splatfacto and gsplat store them; {_HINT}"
        )
    count = found["means"].shape[0] if found["means"].shape else 0
    require_at_most(path, count, MOST_GAUSSIANS, "Gaussians")

    def numbers(name: str, width: int) -> np.ndarray:
        tensor = found[name]
        if tensor.numel() != count * width or not tensor.is_floating_point():
            raise DyngsError(f"{path}: {name} should hold {count:,} x {width} floats; {_HINT}")
        return tensor.detach().float().reshape(count, width).numpy()

    values = {name: torch.from_numpy(numbers(name, width)) for name, width in _SHAPES.items()}
    base = numbers(names[0], 3)
    shape = found[names[1]].shape
    terms = 1 + (shape[1] if len(shape) == 3 else 0)
    if terms not in [num_sh_terms(degree) for degree in range(MAX_SH_DEGREE + 1)]:
        raise DyngsError(
            f"{path}: {terms} harmonics for each Gaussian are of no degree that is known; {_HINT}"
        )
    if terms == 1 and names == _NERFSTUDIO:  # then splatfacto stores logits of colours
        base = (1 / (1 + np.exp(-base)) - 0.5) / SH_C0
    rest = numbers(names[1], 3 * (terms - 1)).reshape(count, terms - 1, 3)
    gaussians = Gaussians(
        means=values["means"],
        quats=unit_rotations(values["quats"]),
        log_scales=values["scales"],
        logit_opacities=values["opacities"][:, 0],
        sh=torch.from_numpy(np.concatenate([base[:, None], rest], axis=1).astype(np.float32)),
    )
    note = "in the frame of its training, which the program may have turned and scaled; z is taken for up"
    return SplatFile(gaussians, notes=(note,))


def _load(path: Path) -> object:
    """Load a file of ``torch.save`` without executing code in it. Raises DyngsError: it is damaged,
    or needs code."""
    if not zipfile.is_zipfile(path):
        raise DyngsError(
            f"{path}: is no file of torch.save (a zip, since torch 1.6), or is cut off; copy it again"
        )
    try:
        return torch.load(path, map_location="cpu", mmap=True, weights_only=True)
    except OSError:
        raise
    except Exception as error:  # a damaged pickle may raise any; the text of torch misleads
        raise DyngsError(
            f"{path}: is damaged, or holds objects that only code could restore; {_HINT}"
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
