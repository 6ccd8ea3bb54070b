"""Python processes that dyngs starts: they find the packages of this process, but none in the current folder."""

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
    """Return the command that runs a module of dyngs in a Python process of its own.

    Python's -m would import modules from the current folder, which may hold the downloads of somebody else. With -I it
    does not, but then it ignores PYTHONPATH and the packages of ``pip install --user``, which are passed on here.
    """
    places = [os.path.abspath(place) for place in sys.path if place and not _is_current_folder(place)]
    start = _START.format(
        user_sites=ascii([site.getusersitepackages()] if site.ENABLE_USER_SITE else []),
        places=ascii(places),
        home=ascii(str(home_of_dyngs())),  # last: in a checkout that is not installed, it is the current folder
        module=ascii(module),
    )
    return [sys.executable, "-I", "-c", start, *arguments]


def home_of_dyngs() -> Path:
    """Return the folder that the package dyngs lies in."""
    return Path(__file__).absolute().parents[2]


def _is_current_folder(place: str) -> bool:
    try:
        return os.path.samefile(place, os.curdir)
    except OSError:
        return False
