"""The tensors of a scene that a .dyngs file stores, and their conversion back to those of a checkpoint.

Tensors have the names of checkpoints (``gaussians.means``, ``model.rows``), but for the harmonics, which are stored as
``gaussians.sh_base`` (N, 3) and ``gaussians.sh_rest`` (N, K - 1, 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.scene import Scene
from dyngs.state import tensors_of
from dyngs.storage.order import storage_order
from dyngs.storage.quantize import sorted_axes

FIELD = "model.field.learned."
"""Prefix of the learned tensors of a deformation field."""
GAUSSIANS = tuple(field.name for field in fields(Gaussians))


def drawable(scene: Scene) -> dict[str, Tensor]:
    """Return the tensors for drawing in an equivalent form that is cheaper to store: axes sorted by length.

    Not those of Gaussians whose axes a field changes one by one.

    Raises:
        DyngsError: a value is not finite.
    """
    kept = tensors_of(scene.drawing_state())
    for name, x in kept.items():
        if x.is_floating_point() and not bool(torch.isfinite(x).all()):
            raise DyngsError(f"{name.partition('.')[2]} is not finite; it cannot be stored")
    sh = kept.pop("gaussians.sh")
    kept |= {"gaussians.sh_base": sh[:, 0], "gaussians.sh_rest": sh[:, 1:]}
    sorts = torch.ones(len(sh), dtype=torch.bool, device=sh.device)
    sorts[scene.offset_rows] = False
    quats, log_scales = sorted_axes(kept["gaussians.quats"][sorts].numpy(), kept["gaussians.log_scales"][sorts].numpy())
    for name, values in (("gaussians.quats", quats), ("gaussians.log_scales", log_scales)):
        kept[name] = kept[name].clone()
        kept[name][sorts] = torch.from_numpy(values).to(kept[name])
    return kept


def completed(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint that can be drawn, but not trained on, from stored ones.

    Raises:
        KeyError: one is missing that every scene has.
        ValueError: the Gaussians' tensors do not fit together.
    """
    full = dict(tensors)
    base, rest = full.pop("gaussians.sh_base"), full.pop("gaussians.sh_rest")
    full["gaussians.sh"] = torch.cat([base[:, None], rest], dim=1)
    Gaussians(**{name: full[f"gaussians.{name}"] for name in GAUSSIANS})  # they must fit together
    return full


def stored_edit(scene: Scene, means: np.ndarray) -> TopologyEdit:
    """Return the edit that puts Gaussians beside their neighbours in space, first those that a field moves.

    Args:
        scene: N Gaussians.
        means: (N, 3) as they will be read again, which decide the order.
    """
    return TopologyEdit.select(torch.from_numpy(storage_order(means, scene.offset_rows.numpy())))
