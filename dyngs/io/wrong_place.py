"""What a path is that was given where something else belongs, and the command that takes it."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

from dyngs.core.errors import as_word

PHOTO_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".gif", ".heic", ".heif", ".hif"}
)
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
_MOST_ENTRIES = 2000
_CAPTURE = (
    "transforms.json",
    "transforms_train.json",
    "cameras.json",
    "poses_bounds.npy",
    "sparse",
    "dataset.json",
)


def command_for(path: Path, *, captures: bool = True) -> str | None:
    """Return what the path is and the command that takes it, in a few words; None for anything
    else.

    Only names are looked at, those directly in a folder and in ``images`` below it.
    """
    where = as_word(path)
    static, dynamic = (
        f"`dyngs train {preset} data.root={where}`" for preset in ("static", "dynamic")
    )
    try:
        if path.is_file():
            if path.suffix.lower() not in VIDEO_SUFFIXES:
                return None
            return f"it is a video, make a scene of it with {static}, or {dynamic} if things move"
        if not path.is_dir():
            return None
        if (path / "config.yaml").is_file():
            return f"it is a run, for `dyngs eval {where}`, `dyngs render {where}` or `dyngs train --resume {where}`"
        if captures and any((path / name).exists() for name in _CAPTURE):
            return f"it is a capture, make a scene of it with {static}, or {dynamic} if things move"
        suffixes = [
            _suffix(entry) for folder in (path, path / "images") for entry in _entries(folder)
        ]
    except OSError:
        return None
    photos = sum(x in PHOTO_SUFFIXES for x in suffixes)
    videos = sum(x in VIDEO_SUFFIXES for x in suffixes)
    if photos >= 3:
        return f"it holds photos, make a scene of them with {static}"
    if videos > 1:
        return f"it holds {videos} videos, make a scene of them with {dynamic}"
    return "it holds one video; give that" if videos else None


def _entries(folder: Path) -> list[Path]:
    return list(islice(folder.iterdir(), _MOST_ENTRIES)) if folder.is_dir() else []


def _suffix(path: Path) -> str:
    return "" if path.name.startswith(".") else path.suffix.lower()
