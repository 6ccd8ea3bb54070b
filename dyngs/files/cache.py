"""The user's cache: what dyngs has worked out from files of others and can work out again."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

CACHE_VARIABLE = "DYNGS_CACHE_DIR"


def cache_folder(kind: Literal["frames", "poses", "bodies"]) -> Path:
    """Return the folder of one kind of cached files: in ``$DYNGS_CACHE_DIR``, else in the system's cache of the user.

    Args:
        kind: frames of videos, or captures of photos and videos whose poses were estimated.
    """
    chosen = os.environ.get(CACHE_VARIABLE, "")
    if chosen:
        return Path(chosen).expanduser().absolute() / kind
    from platformdirs import user_cache_path

    return user_cache_path("dyngs", appauthor=False) / kind
