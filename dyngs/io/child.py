"""Python processes that dyngs starts. They find the packages of this process, none in its
folder."""

from __future__ import annotations

import os
import site
import sys
from pathlib import Path

_START = (
    "import runpy, site, sys\n"
    "for folder in {user_sites}: site.addsitedir(folder)\n"
    "own = [place for place in sys.path if place not in {places}]\n"
    "sys.path[:] = [*{places}, *own, {home}]\n"
    "runpy.run_module({module}, run_name='__main__', alter_sys=True)\n"
)


def python_command(module: str, *arguments: str) -> list[str]:
    """Return the command that runs a module of dyngs in another Python process.

    ``python -m`` imports modules from the current folder, which may hold files of strangers.
    ``python -I`` does not, but ignores PYTHONPATH and ``pip install --user``: they are passed on.
    """
    places = [
        os.path.abspath(place) for place in sys.path if place and not _is_current_folder(place)
    ]
    start = _START.format(
        user_sites=ascii([site.getusersitepackages()] if site.ENABLE_USER_SITE else []),
        places=ascii(places),
        # Last, because it is the current folder in a checkout that is not installed.
        home=ascii(str(package_parent())),
        module=ascii(module),
    )
    return [sys.executable, "-I", "-c", start, *arguments]


def package_parent() -> Path:
    """Return the folder that the package dyngs lies in."""
    return Path(__file__).absolute().parents[2]


def _is_current_folder(place: str) -> bool:
    try:
        return os.path.samefile(place, os.curdir)
    except OSError:
        return False
