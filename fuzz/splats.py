"""Mutations of compressed files of Gaussians: what is inside is changed and packed again."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from random import Random

from fuzz.blobs import bytes_changed
from fuzz.trees import json_changed

_COUNTS = (0, 1, 6, 1 << 16, 1 << 24, (1 << 32) - 1)


def spz_changed(data: bytes, rng: Random) -> bytes:
    """Return a .spz after one mutation of its header, its numbers or its gzip stream."""
    try:
        content = bytearray(gzip.decompress(data))
    except (OSError, EOFError, zlib.error):
        return bytes_changed(data, rng)
    change = rng.randrange(6)
    if change == 0 or len(content) < 16:
        return bytes_changed(data, rng)
    if change == 1:
        content[8:12] = struct.pack("<I", rng.choice(_COUNTS))
    elif change == 2:
        content[rng.choice((4, 12, 13, 14, 15))] = rng.choice((0, 1, 2, 3, 4, 5, 23, 24, 25, 255))
    elif change == 3:
        content = content[: rng.randrange(len(content))]
    elif change == 4:
        content = bytearray(bytes_changed(bytes(content), rng))
    else:
        content += bytes(rng.choice((1, 1000, 1 << 24)))
    return gzip.compress(bytes(content), 1)


def sog_changed(data: bytes, rng: Random) -> bytes:
    """Return a .sog after one mutation of an image, of meta.json or of the archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile, NotImplementedError, zlib.error):
        return bytes_changed(data, rng)
    if not members or rng.random() < 0.15:
        return bytes_changed(data, rng)
    name = rng.choice(sorted(members)) if rng.random() < 0.5 else "meta.json"
    if name == "meta.json" and name in members:
        members[name] = json_changed(members[name], rng)
    elif rng.random() < 0.3:
        members[name] = members[rng.choice(sorted(members))]
    else:
        members[name] = bytes_changed(members.get(name, b""), rng)
    buffer = io.BytesIO()
    with zipfile.ZipFile(
        buffer, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ) as archive:
        for own, content in members.items():
            archive.writestr(own, content)
    return buffer.getvalue()
