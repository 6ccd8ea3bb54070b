"""Checkpoints of nerfstudio's splatfacto (``.ckpt``) and of gsplat's examples (``.pt``): read, never written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dyngs.conventions import MAX_SH_DEGREE, SH_C0, num_sh_terms
from dyngs.errors import DyngsError
from dyngs.files.limits import require_at_most
from dyngs.files.torch_files import StoredTensor, TorchFile
from dyngs.gaussians import Gaussians
from dyngs.splats.splat_file import MOST_GAUSSIANS, SplatFile, unit_rotations

_HINT = "export a .ply with the program that wrote it, such as `ns-export gaussian-splat`"
_SHAPES = {"means": 3, "scales": 3, "quats": 4, "opacities": 1}
_NERFSTUDIO = "features_dc", "features_rest"
_GSPLAT = "sh0", "shN"


def read_checkpoint(path: Path) -> SplatFile:
    """Read the Gaussians of a checkpoint of torch. Raises DyngsError: it holds none, or is damaged."""
    file = TorchFile(path)
    found = _tensors_of(file.contents)
    names = _NERFSTUDIO if _NERFSTUDIO[0] in found else _GSPLAT
    if not {*_SHAPES, *names} <= found.keys():
        raise DyngsError(f"{path}: holds no Gaussians as nerfstudio's splatfacto and gsplat store them; {_HINT}")
    count = found["means"].shape[0] if found["means"].shape else 0
    require_at_most(path, count, MOST_GAUSSIANS, "Gaussians")

    def numbers(name: str, width: int) -> np.ndarray:
        values = file.numbers(found[name])
        if values.size != count * width:
            raise DyngsError(f"{path}: {name} should hold {count:,} x {width} numbers; {_HINT}")
        return values.reshape(count, width)

    values = {name: torch.from_numpy(numbers(name, width)) for name, width in _SHAPES.items()}
    base, shape = numbers(names[0], 3), found[names[1]].shape
    terms = 1 + (shape[1] if len(shape) == 3 else 0)
    if terms not in [num_sh_terms(degree) for degree in range(MAX_SH_DEGREE + 1)]:
        raise DyngsError(f"{path}: {terms} harmonics for each Gaussian are of no degree that is known; {_HINT}")
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
    notes = ["in the frame of its training, which the program may have turned and scaled; z is taken for up"]
    ranks = list(path.parent.glob(f"{path.stem.rpartition('_rank')[0]}_rank*{path.suffix}"))
    if len(ranks) > 1 and path in ranks:
        notes.append(f"one of {len(ranks)} parts, one for each GPU: `dyngs edit --merge` adds the others")
    return SplatFile(gaussians, notes=tuple(notes))


def _tensors_of(contents: object) -> dict[str, StoredTensor]:
    """Return the tensors beside that called ``means``, by their names without what stands before that one."""
    for key in ("pipeline", "splats"):
        if isinstance(contents, dict) and isinstance(contents.get(key), dict):
            contents = contents[key]
    if not isinstance(contents, dict):
        return {}
    tensors = {name: value for name, value in contents.items() if isinstance(value, StoredTensor)}
    prefixes = [name.removesuffix("means") for name in tensors if name == "means" or str(name).endswith(".means")]
    if len(prefixes) != 1:
        return {}
    return {name.removeprefix(prefixes[0]): tensor for name, tensor in tensors.items() if name.startswith(prefixes[0])}
