"""File lookup by names from other programs, which may differ in separators, case, Unicode form or
root."""

from __future__ import annotations

import glob
import ntpath
import os
import re
import unicodedata
from pathlib import Path, PureWindowsPath

from dyngs.io.containment import check_inside


def normalize_name(name: str) -> str:
    """Return a name or path as a key independent of separators, case and Unicode form."""
    return unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()


class FileFinder:
    """Finds files below ``root`` by the names in a capture; folder listings are cached."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._listings: dict[Path, dict[str, list[str]]] = {}

    def find(self, written: str) -> Path:
        """Return the file that ``written`` names, relative to ``root``; if it is missing, its path.

        Backslashes separate folders, too. Case and Unicode form may differ if a single file fits.
        Of an absolute path that does not exist, the longest end that is a file below ``root`` is
        taken.
        """
        for text in (written, written.replace("\\", "/")):
            path = Path(os.path.normpath(self.root / text))
            if path.is_file():
                return path
        pure = PureWindowsPath(ntpath.normpath(written))
        parts = pure.parts[1:] if pure.anchor else pure.parts
        for begin in range(len(parts) if pure.anchor else 1):
            found = self._below(parts[begin:])
            if found is not None:
                return found
        return path

    def _below(self, parts: tuple[str, ...]) -> Path | None:
        path = self.root
        for part in parts:
            name = None if part == ".." else self._entry(path, part)
            if name is None:
                return None
            path /= name
        return path if path.is_file() else None

    def _entry(self, folder: Path, part: str) -> str | None:
        """Return the entry of a folder with this name, else the only one with this key, else
        None."""
        if folder not in self._listings:
            entries: dict[str, list[str]] = {}
            for name in os.listdir(folder) if check_inside(folder).is_dir() else ():
                entries.setdefault(normalize_name(name), []).append(name)
            self._listings[folder] = entries
        alike = self._listings[folder].get(normalize_name(part), [])
        fitting = [part] if part in alike else alike
        if not alike and part == "images":
            fitting = [images_folder(folder).name]
        return fitting[0] if len(fitting) == 1 else None


def images_folder(root: Path) -> Path:
    """Return the folder ``images`` below ``root``; if it is absent, that of the largest copies."""
    images = root / "images"
    copies = {} if images.is_dir() else downscaled_image_folders(images)
    return copies[min(copies)] if copies else images


def downscaled_image_folders(images: Path) -> dict[int, Path]:
    """Map factors to the folders of copies that are so much smaller: 4 to ``images_4``."""
    beside = images.parent.glob(f"{glob.escape(images.name)}_*") if images.name else ()
    found = ((re.fullmatch(r"_(\d{1,3})", path.name[len(images.name) :]), path) for path in beside)
    return {int(match[1]): path for match, path in found if match and path.is_dir()}
