"""Keys and kinds of former versions: what they are called today.

A preset or an override with a former name is refused in a line that says the new one. The resolved configuration of a
run is read with either, because it says what was trained.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from dyngs.config.yaml_reader import Leaf
from dyngs.errors import DyngsError

KEYS = {
    "model.coarse": "model.motion_from",
    "model.moving_error": "model.motion_threshold",
    "model.seeds": "model.num_random_moving",
    "model.first_views": "model.time_window",
    "model.first_views_until": "model.time_window_grows_from",
    "model.all_views_at": "model.time_window_full_at",
    "model.still_below": "model.freeze_below_px",
    "model.heights": "model.scaffold_heights",
    "model.carve": "model.min_silhouette_share",
    "model.views": "model.source_views",
    "model.inputs": "model.source_sets",
    "model.targets": "model.target_views",
    "train.coarsest": "train.initial_downscale",
    "train.sharpen_from": "train.resolution_grows_from",
    "train.sharpen_to": "train.resolution_full_at",
    "compact": "prune",
    "compact.prune": "prune.share",
    "compact.masks": "prune.mask_times",
}
"""Former dotted key to the present one; that of a section also stands for the keys in it that have no line here."""

KINDS = {
    "model.kind": {"human_net": "human_predictor"},
    "model.deform.kind": {"skeleton": "control_nodes"},
    "colour.kind": {"dcac": "network"},
}
"""Key to its former values and the present ones."""

PRESETS = {"human_net": "human_predictor"}
"""Former name of a packaged preset to the present one."""


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
    """Return the values of a resolved configuration under their present names.

    Raises:
        DyngsError: a key is there under its former and its present name.
    """
    found: dict[tuple[str, ...], Leaf] = {}
    for leaf in leaves:
        now = _present(leaf).leaf
        if now.keys in found:
            dotted = ".".join(now.keys)
            raise DyngsError(f"{leaf.origin}: {dotted} is given twice, also under its former name; keep one of the two")
        found[now.keys] = now
    return list(found.values())


def require_present(leaf: Leaf) -> None:
    """Raise DyngsError, with the present name, if ``leaf`` is a key or a kind of a former version."""
    change = _present(leaf)
    if change.told:
        raise DyngsError(f"{leaf.origin}: {change.told}")


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
