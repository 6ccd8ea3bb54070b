"""Keys and kinds of former versions: what they are called today, or that they are constants now.

A preset or an override with a former name is refused in a line that says the new one. The resolved configuration of a
run is read with either, because it says what was trained.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from dyngs.config.yaml_reader import Leaf
from dyngs.errors import DyngsError, printable

KEYS = {
    "model.coarse": "model.motion_from",
    "model.moving_error": "model.motion_threshold",
    "model.seeds": "model.num_random_moving",
    "model.first_views": "model.time_window",
    "model.first_views_until": "model.time_window_grows_from",
    "model.all_views_at": "model.time_window_full_at",
    "model.still_below": "model.freeze_below_px",
    "model.heights": "model.scaffold_heights",
    "model.carve": "model.min_silhouette_fraction",
    "model.views": "model.source_views",
    "model.inputs": "model.source_sets",
    "model.targets": "model.target_views",
    "budget.max_minutes": "train.minutes",
    "train.coarsest": "train.initial_downscale",
    "train.sharpen_from": "train.resolution_grows_from",
    "train.sharpen_to": "train.resolution_full_at",
    "compact": "prune",
    "compact.prune": "prune.fraction",
    "compact.masks": "prune.mask_times",
}
"""Former dotted key to the present one; that of a section also stands for the keys in it that have no line here."""

KINDS = {
    "model.kind": {"human_net": "human_predictor"},
    "model.deform.kind": {"skeleton": "control_nodes"},
    "colour.kind": {"dcac": "network"},
}
"""Key to its former values and the present ones."""

CONSTANTS: dict[str, dict[str, float]] = {
    "model.deform.lr_decay": {"hexplane": 0.01, "mlp": 0.002, "trajectory": 0.01, "control_nodes": 0.2},
    "model.deform.lr_quats": {"trajectory": 1e-3, "control_nodes": 6e-3},
    "model.deform.lr_scales": {"control_nodes": 1e-3},
    "model.deform.lr_opacities": {"control_nodes": 1e-2},
    "model.deform.lr_colors": {"control_nodes": 2e-3},
    "model.lr_poses": {"human": 1e-3},
    "model.lr_trans": {"human": 5e-4},
    "model.lr_turns": {"human": 1e-3},
    "model.lr_joints": {"human": 5e-4},
    "model.lr_log_scale": {"human": 2e-4},
    "model.lr_weights": {"human": 5e-3},
    "model.lr_decay": {"human": 0.1},
    "model.lr_pose_offsets": {"human": 1e-4},
    "model.pose_weight": {"human": 1e-4},
    "model.weights_weight": {"human": 1e-3},
    "model.warm_up": {"human_predictor": 0.05},
    "model.weight_decay": {"human_predictor": 1e-5},
    "model.clip": {"human_predictor": 1.0},
    "strategy.dense_fraction": {"default": 0.01},
    "strategy.prune_scale": {"default": 0.1},
    "strategy.init_opacity": {"mcmc": 0.5},
    "strategy.init_scale": {"mcmc": 0.1},
    "optim.eps": {"": 1e-15},
}
"""Keys that there are no more, with the value that is always taken by the kind of their section ("": it has none)."""

REMOVED = {
    "prune.max_loss": "the stage removes just prune.fraction; `dyngs prune RUN --out RUN2 --max-loss DB` finds it",
}
"""Keys that there are no more, whatever their value was, and what to do instead. Runs that have them are read."""

PRESETS = {"human_net": "human_predictor"}
"""Former name of a packaged preset to the present one."""

_SHOWN = 60
"""Characters of a value that a message repeats."""


@dataclass(frozen=True)
class _Change:
    """A value under its present name.

    Attributes:
        leaf: the value.
        told: what changed, for a person; "" if nothing did.
    """

    leaf: Leaf
    told: str = ""


def present(leaves: Iterable[Leaf]) -> list[Leaf]:
    """Return the values of a resolved configuration under their present names, without those that are no more.

    Raises:
        DyngsError: a key is there under its former and its present name, or a constant now had another value.
    """
    found: dict[tuple[str, ...], Leaf] = {}
    leaves = [_present(leaf).leaf for leaf in leaves]
    kinds = {leaf.keys[:-1]: str(leaf.value) for leaf in leaves if leaf.keys[-1] == "kind"}
    for now in leaves:
        if ".".join(now.keys) in REMOVED:
            continue
        constant = CONSTANTS.get(".".join(now.keys), {}).get(kinds.get(now.keys[:-1], ""))
        if constant is not None:
            _require_constant(now, constant)
            continue
        if now.keys in found:
            dotted = ".".join(now.keys)
            raise DyngsError(f"{now.origin}: {dotted} is given twice, also under its former name; keep one of the two")
        found[now.keys] = now
    return list(found.values())


def require_present(leaf: Leaf) -> None:
    """Raise DyngsError, with the present name, if ``leaf`` is a key or a kind of a former version."""
    if ".".join(leaf.keys) in CONSTANTS:
        raise DyngsError(f"{leaf.origin}: {'.'.join(leaf.keys)} can no longer be chosen; leave it out")
    change = _present(leaf)
    removed = REMOVED.get(".".join(change.leaf.keys))
    if removed is not None:
        raise DyngsError(f"{leaf.origin}: {'.'.join(leaf.keys)} can no longer be chosen; {removed}")
    if change.told:
        raise DyngsError(f"{leaf.origin}: {change.told}")


def _require_constant(leaf: Leaf, value: float) -> None:
    if isinstance(leaf.value, bool) or not isinstance(leaf.value, (int, float)) or float(leaf.value) != value:
        raise DyngsError(
            f"{leaf.origin}: {'.'.join(leaf.keys)} can no longer be chosen, it is always {value:g} and not "
            f"{printable(leaf.text, _SHOWN)}; train anew, or use the version that this run was trained with"
        )


def _present(leaf: Leaf) -> _Change:
    keys, dotted = _present_keys(leaf.keys), ".".join(leaf.keys)
    if keys != leaf.keys:
        return _Change(replace(leaf, keys=keys), f"{dotted} is called {'.'.join(keys)} now; write that")
    kind = KINDS.get(dotted, {}).get(leaf.value) if isinstance(leaf.value, str) else None
    if kind is not None:
        return _Change(replace(leaf, value=kind, text=kind), f"{dotted}={leaf.value} is called {kind} now; write that")
    return _Change(leaf)


def _present_keys(keys: tuple[str, ...]) -> tuple[str, ...]:
    for length in range(len(keys), 0, -1):
        new = KEYS.get(".".join(keys[:length]))
        if new is not None:
            return (*new.split("."), *keys[length:])
    return keys
