"""The package of ``examples/plugin`` as if it were installed, for the time of a test module."""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dyngs.config import kinds
from dyngs.core import plugins

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pytest needs it there

SOURCE = Path(__file__).parents[1] / "examples" / "plugin"
_HELD = tempfile.TemporaryDirectory()  # removed at exit
FOLDER = Path(_HELD.name)


def write_package(folder: Path, name: str, entries: dict[str, dict[str, str]]) -> None:
    """Write what pip writes of a package beside its modules."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = []
    for group, own in entries.items():
        lines += [f"[{group}]", *(f"{key} = {value}" for key, value in own.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


def _install() -> None:
    project = tomllib.loads((SOURCE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    shutil.copytree(SOURCE / "dyngs_toy", FOLDER / "dyngs_toy")
    write_package(FOLDER, project["name"], project["entry-points"])


_install()


@contextmanager
def installed(folder: Path = FOLDER) -> Iterator[None]:
    """Let the plug-ins in ``folder`` be found."""
    sys.path.insert(0, str(folder))
    forget()
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        forget()


def forget() -> None:
    kinds.installed_kind.cache_clear()
    plugins.plugin_entries.cache_clear()
    plugins.load_plugins.cache_clear()
