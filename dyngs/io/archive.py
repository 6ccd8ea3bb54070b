"""Captures in a .zip: unpacked once, into the user's cache, under names that cannot leave their
folder."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import zipfile
from pathlib import Path, PurePosixPath

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.io.fields import require_at_most
from dyngs.io.write import cache_folder, temporary_folder_beside

SUFFIXES = (".zip", ".r3d")
"""Endings of archives; the app Record3D calls its own .r3d."""
MOST_FILES = 200_000
MOST_BYTES = 2**36
MOST_SMALL_BYTES = 2**27
"""Bytes that any archive may hold; beyond, the compression ratio is limited."""
HIGHEST_RATIO = 50
"""Images do not shrink in an archive; text of points and cameras does, about ten times; bombs a
thousand."""
_CHUNK = 2**20
_JUNK = ("__MACOSX", ".")
"""Beginnings of names that systems add to archives, or hide."""
_BAD_PART = re.compile(
    r"\.\.|[a-z]:.*|.*[\x00-\x1f].*|(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE
)
"""Parts of a path that lead elsewhere, at least on Windows, or name a device there."""
_ADVICE = "download it again, or unpack it and give the folder"


def is_archive(path: Path) -> bool:
    """Whether ``path`` is a file that ``unpacked`` unpacks."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def unpack_archive(path: Path) -> Path:
    """Return the folder in the cache with the files of an archive; the same archive is unpacked
    once.

    Raises DyngsError: a damaged or encrypted archive; too many files or bytes; a name that leads
    out of the folder, a link; no room on the disk. Nothing is left in the cache then.
    """
    with wrap_read_errors(path, _ADVICE), zipfile.ZipFile(path) as archive:
        members = _checked_members(path, archive)
        status = path.stat()
        content = [(name, info.file_size, info.CRC) for name, info in members.items()]
        digest = hashlib.sha256(
            repr((status.st_size, status.st_mtime_ns, content)).encode()
        ).hexdigest()[:16]
        folder = (
            cache_folder("captures") / f"{re.sub(r'[^A-Za-z0-9-]', '_', path.stem)[:40]}.{digest}"
        )
        if folder.is_dir():
            return folder
        temporary = temporary_folder_beside(folder)
        try:
            for name, info in members.items():
                target = temporary / name
                target.parent.mkdir(parents=True, exist_ok=True)
                # Of a member, ZipFile yields no more bytes than the archive states, which were
                # counted above.
                with archive.open(info) as source, target.open("xb") as file:
                    shutil.copyfileobj(source, file, _CHUNK)
            os.rename(temporary, folder)
        except OSError:
            if not folder.is_dir():  # otherwise another process was faster
                raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return folder


def _checked_members(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the files of an archive by their paths below its folder, without junk."""
    found: dict[str, zipfile.ZipInfo] = {}
    require_at_most(path, len(archive.filelist), MOST_FILES, "files")
    for info in archive.infolist():
        name = info.filename.replace("\\", "/")
        parts = PurePosixPath(name).parts
        if name.startswith("/") or any(_BAD_PART.fullmatch(part) for part in parts):
            raise DyngsError(f"{path}: unsafe file name {name!r:.80} in the archive; pack it again")
        if name.endswith("/") or any(part.startswith(_JUNK) for part in parts):
            continue
        is_link = stat.S_ISLNK(info.external_attr >> 16)
        is_plain = info.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        if is_link or not is_plain or info.flag_bits & 1:
            raise DyngsError(
                f"{path}: {name!r:.80} is a link, encrypted, or compressed by an unsupported "
                "method; unpack it and give the folder"
            )
        found[name] = info
    total = sum(info.file_size for info in found.values())
    require_at_most(
        path,
        total,
        min(MOST_BYTES, max(MOST_SMALL_BYTES, HIGHEST_RATIO * path.stat().st_size)),
        "bytes",
    )
    return found
