"""Plug-ins: objects of other packages, found by their entry points when they are first needed."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import TypeVar

from dyngs.core.errors import DyngsError, log_warning

MODELS = "dyngs.models"
READERS = "dyngs.readers"
EXPORTERS = "dyngs.exporters"

T = TypeVar("T")


@cache
def plugin_entries(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of other packages in a group, by name."""
    found = sorted(entry_points(group=group), key=lambda entry: (entry.name, entry.value))
    return {entry.name: entry for entry in found if package_name(entry) != "dyngs"}


def package_name(entry: EntryPoint) -> str:
    return "unknown" if entry.dist is None else entry.dist.name


def load_plugin(group: str, name: str, wanted: type[T]) -> T:
    """Import a plug-in. Raises DyngsError: it cannot be imported, or is not a ``wanted``."""
    entry = plugin_entries(group)[name]
    where = f"the plug-in {name} ({group}) of the package {package_name(entry)}"
    try:
        found = entry.load()
    except Exception as error:
        raise DyngsError(f"{where} cannot be imported ({error}); update or remove it") from error
    if not isinstance(found, wanted) or getattr(found, "name", name) != name:
        raise DyngsError(f"{where} is not a {wanted.__name__} with that name; update or remove it")
    return found


@cache
def load_plugins(group: str, wanted: type[T], built_in: tuple[str, ...]) -> tuple[T, ...]:
    """Import all plug-ins of a group.

    A broken plug-in, or one with the name of a ``built_in``, is left out with a warning.
    """
    found = []
    for name, entry in plugin_entries(group).items():
        if name in built_in:
            log_warning(
                f"the plug-in {name} of the package {package_name(entry)} is ignored: built in"
            )
            continue
        try:
            found.append(load_plugin(group, name, wanted))
        except DyngsError as error:
            log_warning(str(error))
    return tuple(found)
