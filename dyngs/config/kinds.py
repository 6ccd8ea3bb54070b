"""Registry of the installed kinds of model: built-in ones and plugins.

A kind is a ``dyngs.models.kind.ModelKind`` with the class of its config section. Plugins register
kinds as entry points of the group ``dyngs.models``. A kind is imported on first use, and entry
points are searched only for names that are not built in.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Protocol, cast

from dyngs.core.errors import DyngsError
from dyngs.core.section import ModelSection

GROUP = "dyngs.models"

BUILT_IN = {
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
"""Entry points of dyngs itself, listed here so that a source tree works without installation."""


class InstalledKind(Protocol):
    """The part of a kind that the configuration needs."""

    @property
    def section(self) -> type[ModelSection]: ...


def kind_names() -> list[str]:
    """Return the names of all installed kinds, built-in ones first."""
    return [*BUILT_IN, *(name for name in sorted(plugin_kinds()) if name not in BUILT_IN)]


def is_kind(name: object) -> bool:
    """Return whether a kind with this name is installed."""
    return name in BUILT_IN or name in plugin_kinds()


@cache
def installed_kind(name: str) -> InstalledKind:
    """Return the kind with this name.

    Raises DyngsError: its package cannot be imported; KeyError: unknown kind.
    """
    if name in BUILT_IN:
        return cast("InstalledKind", EntryPoint(name, BUILT_IN[name], GROUP).load())
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
    """Return the name of the plugin package of a kind; None if it is built in or not installed."""
    entry = None if name in BUILT_IN else plugin_kinds().get(name)
    return entry.dist.name if entry is not None and entry.dist is not None else None


@cache
def plugin_kinds() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
