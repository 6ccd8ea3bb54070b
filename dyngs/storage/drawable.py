"""What of a checkpoint is needed for drawing, and how it becomes a checkpoint again.

Tensors have the names of checkpoints (``gaussians.means``, ``model.rows``), but for the harmonics, which are stored as
``gaussians.sh_base`` (N, 3) and ``gaussians.sh_rest`` (N, K - 1, 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

import numpy as np
import torch
from torch import Tensor

from dyngs.config import DynamicModel, SceneModel, TrajectoryField
from dyngs.deform.masks import KeyMasks
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.storage.order import storage_order
from dyngs.storage.quantize import sorted_axes

MOMENTS = "exp_avg", "exp_avg_sq"
LEARNED = "model.field.learned."
CORRECTIONS = "model.learned.weights"
GAUSSIANS = tuple(field.name for field in fields(Gaussians))
_TRAINING_ONLY = ("model.near", "model.colour.frozen", "model.field.buffers.neighbours")
_PER_GAUSSIAN = ("gaussians.", "model.filter_std", "model.anchors.", "model.learned.pose_dirs")
_PER_MOVING = ("model.field.buffers.followed",)
_MASKS = "model.masks."


def drawable(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What drawing needs, in an equivalent form that is cheaper to store.

    Left out are optimizers and what only training looks at. Axes of still Gaussians are sorted by length, learned
    corrections of skinning weights are applied.

    Args:
        tensors: of a checkpoint.

    Raises:
        DyngsError: a value is not finite.
        KeyError: a tensor of the Gaussians lacks.
    """
    kept = {name: x.detach() for name, x in tensors.items() if _is_needed(name)}
    for name, x in kept.items():
        if x.is_floating_point() and not bool(torch.isfinite(x).all()):
            raise DyngsError(f"{name.partition('.')[2]} is not finite; it cannot be stored")
    sh = kept.pop("gaussians.sh")
    kept |= {"gaussians.sh_base": sh[:, 0], "gaussians.sh_rest": sh[:, 1:]}
    sorts = torch.ones(len(sh), dtype=torch.bool)
    sorts[moving_rows(kept)] = False  # a field may change the axes one by one
    quats, log_scales = sorted_axes(kept["gaussians.quats"][sorts].numpy(), kept["gaussians.log_scales"][sorts].numpy())
    for name, values in (("gaussians.quats", quats), ("gaussians.log_scales", log_scales)):
        kept[name] = kept[name].clone()
        kept[name][sorts] = torch.from_numpy(values).to(kept[name])
    if CORRECTIONS in kept:
        kept |= _with_corrected_weights(kept)
    return kept


def completed(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """A checkpoint's tensors from stored ones; what only training needs is zero, and it cannot go on from them.

    Raises:
        KeyError: one lacks that every model has.
        ValueError: the Gaussians' tensors do not fit together.
    """
    full = dict(tensors)
    base, rest = full.pop("gaussians.sh_base"), full.pop("gaussians.sh_rest")
    full["gaussians.sh"] = torch.cat([base[:, None], rest], dim=1)
    gaussians = Gaussians(**{name: full[f"gaussians.{name}"] for name in GAUSSIANS})  # they must fit together
    KeyMasks.restored(_masks(full), len(gaussians))
    for name, x in tensors.items():
        if name.startswith(LEARNED):
            full |= {f"{LEARNED}{moment}.{name[len(LEARNED) :]}": torch.zeros_like(x) for moment in MOMENTS}
    if "model.anchors.weights" in full:
        full[CORRECTIONS] = torch.zeros_like(full["model.anchors.weights"])
    return full


def moving_rows(tensors: Mapping[str, Tensor]) -> Tensor:
    """(M,) ascending indices of the Gaussians that a field moves."""
    if not any(name.startswith(LEARNED) for name in tensors):
        return torch.zeros(0, dtype=torch.long)
    return tensors.get("model.rows", torch.arange(len(tensors["gaussians.means"])))


def in_storage_order(tensors: Mapping[str, Tensor], means: np.ndarray, model: SceneModel) -> dict[str, Tensor]:
    """``tensors`` with neighbours side by side, first those that move; as they are where one's rows are not understood.

    Args:
        tensors: from ``drawable``.
        means: (N, 3) as they will be read again, which decide the order.
        model: whose tensors they are.
    """
    rows = moving_rows(tensors)
    per_moving = _PER_MOVING
    if isinstance(model, DynamicModel) and isinstance(model.deform, TrajectoryField):
        per_moving = (*_PER_MOVING, LEARNED)
    others = [n for n in tensors if not n.startswith((*_PER_GAUSSIAN, *per_moving, "model.rows", _MASKS))]
    if any(x.ndim and len(x) in (len(means), len(rows)) for x in (tensors[name] for name in others)):
        return dict(tensors)
    order = torch.from_numpy(storage_order(means, rows.numpy()))
    of_moving = torch.searchsorted(rows, order[: len(rows)])
    ordered = dict(tensors)
    for name, x in tensors.items():
        if name.startswith(_PER_GAUSSIAN):
            ordered[name] = x[order]
        elif name.startswith(per_moving):
            ordered[name] = x[of_moving]
    if "model.rows" in ordered:
        ordered["model.rows"] = torch.arange(len(rows))
    masks = KeyMasks.restored(_masks(tensors), len(means))
    if masks is not None:
        ordered |= {f"{_MASKS}{name}": x for name, x in masks.select(order).state().items()}
    return ordered


def _masks(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state of the masks; empty without any."""
    return {name[len(_MASKS) :]: x for name, x in tensors.items() if name.startswith(_MASKS)}


def _is_needed(name: str) -> bool:
    is_of_model = name.startswith(("gaussians.", "model.")) and not name.startswith(_TRAINING_ONLY)
    return is_of_model and not any(part in MOMENTS for part in name.split("."))


def _with_corrected_weights(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Skinning weights w e^c, normalised, in place of w and c; see ``dyngs.human.avatar.anchors.skinning_weights``."""
    corrections, weights = tensors.pop(CORRECTIONS), tensors["model.anchors.weights"]
    if not bool(corrections.any()):
        return {}
    shares = weights * corrections.exp()
    return {"model.anchors.weights": shares / shares.sum(1, keepdim=True)}
