"""Registry of the installed kinds of model: built-in ones and plugins.

A kind is a ``dyngs.models.kind.ModelKind`` with the class of its config section. Plugins register
kinds as entry points of the group ``dyngs.models``. A kind is imported on first use, and entry
points are searched only for names that are not built in.
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint
from typing import Protocol, cast

from dyngs.core.plugins import MODELS as GROUP
from dyngs.core.plugins import load_plugin, load_plugins, package_name, plugin_entries
from dyngs.core.section import ModelSection

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
    def name(self) -> str: ...

    @property
    def section(self) -> type[ModelSection]: ...


def kind_names() -> list[str]:
    """Return the names of all kinds that can be imported, built-in ones first."""
    plugins = load_plugins(GROUP, object, tuple(BUILT_IN))
    return [*BUILT_IN, *(cast("InstalledKind", kind).name for kind in plugins)]


def is_kind(name: object) -> bool:
    """Return whether a kind with this name is installed."""
    return name in BUILT_IN or name in plugin_entries(GROUP)


@cache
def installed_kind(name: str) -> InstalledKind:
    """Return the kind with this name.

    Raises DyngsError: its package cannot be imported; KeyError: unknown kind.
    """
    if name in BUILT_IN:
        return cast("InstalledKind", EntryPoint(name, BUILT_IN[name], GROUP).load())
    return cast("InstalledKind", load_plugin(GROUP, name, object))


def section_of_kind(name: str) -> type[ModelSection]:
    """Return the class of the section of a kind. Raises as ``installed_kind``."""
    return installed_kind(name).section


def package_of(name: str) -> str | None:
    """Return the name of the plugin package of a kind; None if it is built in or not installed."""
    entry = None if name in BUILT_IN else plugin_entries(GROUP).get(name)
    return None if entry is None else package_name(entry)
