"""The kinds of model that are installed: ours, and those of other packages.

A kind is an object with the class of its section, see ``dyngs.models.kind``. Other packages name
theirs as entry points of the group ``dyngs.models``, as pyproject.toml does ours. A kind is
imported when it is first asked for, and packages are looked through only for a name that is not
ours.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Protocol, cast

from dyngs.core.errors import DyngsError
from dyngs.core.section import ModelSection

GROUP = "dyngs.models"

OWN = {
    "static": "dyngs.static.kind:STATIC",
    "dynamic": "dyngs.deform.kind:DYNAMIC",
    "human": "dyngs.human.kind:HUMAN",
    "human_predictor": "dyngs.human.predict.kind:HUMAN_PREDICTOR",
    "gps": "dyngs.human.predict.kind:GPS",
    "keypoint_nerf": "dyngs.human.predict.kind:KEYPOINT_NERF",
    "eg_human_nerf": "dyngs.human.predict.kind:EG_HUMAN_NERF",
    "predicted_field": "dyngs.human.predict.kind:PREDICTED_FIELD",
    "ngp": "dyngs.baselines.fields.kind:NGP",
    "nerf": "dyngs.baselines.fields.kind:NERF",
    "bg_triangle": "dyngs.baselines.triangles.kind:BG_TRIANGLE",
}
"""Entry points of dyngs itself, which a source tree that is not installed has, too."""


class InstalledKind(Protocol):
    """The part of a kind that the configuration needs."""

    @property
    def section(self) -> type[ModelSection]: ...


def kind_names() -> list[str]:
    """Return the names of all installed kinds, ours first."""
    return [*OWN, *(name for name in sorted(plugin_kinds()) if name not in OWN)]


def is_kind(name: object) -> bool:
    """Return whether a kind with this name is installed."""
    return name in OWN or name in plugin_kinds()


@cache
def installed_kind(name: str) -> InstalledKind:
    """Return the kind with this name. Raises DyngsError: its package cannot be imported; KeyError:
    there is none."""
    if name in OWN:
        return cast("InstalledKind", EntryPoint(name, OWN[name], GROUP).load())
    entry = plugin_kinds()[name]
    try:
        return cast("InstalledKind", entry.load())
    except Exception as error:
        raise DyngsError(
            f"model.kind={name}: the package {package_of(name)} cannot be imported ({error})"
        ) from error


def section_of_kind(name: str) -> type[ModelSection]:
    """Return the class of the section of a kind. Raises as ``installed_kind``."""
    return installed_kind(name).section


def package_of(name: str) -> str | None:
    """Return the name of the package that a kind is from; None: it is ours, or not installed."""
    entry = None if name in OWN else plugin_kinds().get(name)
    return entry.dist.name if entry is not None and entry.dist is not None else None


@cache
def plugin_kinds() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
