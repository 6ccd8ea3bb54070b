"""Mutations of images and videos: chunks, segments, attributes and boxes."""

from __future__ import annotations

import re
import struct
import zlib
from random import Random

from fuzz.blobs import bytes_changed, head_changed, strings_changed

_SIZES = (0, 1, 2, 5, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1, 20_000, 100_000)
_PNG = b"\x89PNG\r\n\x1a\n"
_CONTAINERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf")


def png_changed(data: bytes, rng: Random) -> bytes:
    """Return a PNG after one mutation of a chunk, with the right checksum."""
    chunks = _png_chunks(data)
    if not chunks or rng.random() < 0.15:
        return bytes_changed(data, rng)
    i = rng.randrange(len(chunks))
    change = rng.randrange(8)
    kind, content = chunks[i]
    if change == 0:
        del chunks[i]
    elif change == 1:
        chunks.insert(i, chunks[rng.randrange(len(chunks))])
    elif change == 2:
        chunks[i] = (kind, bytes_changed(content, rng))
    elif change == 3:
        chunks.insert(1, rng.choice(_extra_chunks()))
    elif change == 4:
        chunks[i] = (rng.choice((b"abcd", b"IDAT", b"tRNS", b"PLTE", b"\xff\xff\xff\xff")), content)
    elif chunks[0][0] == b"IHDR" and len(chunks[0][1]) == 13:
        header = bytearray(chunks[0][1])
        if rng.random() < 0.5:
            at = rng.choice((0, 4))
            header[at : at + 4] = rng.choice(_SIZES).to_bytes(4, "big")
        else:
            header[rng.randrange(8, 13)] = rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
        chunks[0] = (b"IHDR", bytes(header))
    return _PNG + b"".join(_png_chunk(kind, content) for kind, content in chunks)


def jpeg_changed(data: bytes, rng: Random) -> bytes:
    """Return a JPEG after one mutation of a segment."""
    marks = [m.start() for m in re.finditer(rb"\xff[\xc0-\xfe]", data)]
    if len(marks) < 2 or rng.random() < 0.2:
        return bytes_changed(data, rng)
    change = rng.randrange(6)
    at = rng.choice(marks)
    if change == 0:
        after = next((m for m in marks if m > at), len(data))
        return data[:at] + data[after:]
    if change == 1:
        text = rng.choice((b"caf\xe9", b"\0" * 9, b"x" * 300))
        return data[:2] + b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text + data[2:]
    if change == 2:
        return data[: at + 1] + bytes([rng.randrange(0xC0, 0xFF)]) + data[at + 2 :]
    if change == 3:
        return (
            data[: at + 2]
            + rng.choice((0, 1, 2, 3, 255, 65535)).to_bytes(2, "big")
            + data[at + 4 :]
        )
    frame = next((m for m in marks if data[m + 1] in (0xC0, 0xC1, 0xC2)), at)
    place = frame + rng.choice((4, 5, 7, 9, 10, 11))
    return (
        data[:place]
        + rng.choice((0, 1, 3, 255, 65535, 20_000)).to_bytes(2, "big")
        + data[place + 2 :]
    )


def exr_changed(data: bytes, rng: Random) -> bytes:
    """Return an EXR after one mutation of its attributes or pixels."""
    change = rng.randrange(4)
    if change == 0:
        return strings_changed(data[:400], rng) + data[400:]
    if change == 1:
        name = rng.choice((b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"))
        at = data.find(name)
        if at >= 0:
            at += len(name) + 4 + 4 * rng.randrange(4)
            return data[:at] + struct.pack("<I", rng.choice(_SIZES)) + data[at + 4 :]
    return head_changed(data, rng, 400) if change == 2 else bytes_changed(data, rng)


def video_changed(data: bytes, rng: Random) -> bytes:
    """Return an MP4 after one mutation of a box."""
    boxes = _boxes(data, 0, len(data))
    if not boxes or rng.random() < 0.1:
        return bytes_changed(data, rng)
    begin, end, kind = rng.choice(boxes)
    change = rng.randrange(7)
    if change == 0:
        return data[:begin] + data[end:]
    if change == 1:
        return data[:end] + data[begin:end] + data[end:]
    if change == 2:
        return (
            data[:begin]
            + rng.choice((0, 1, 4, 7, 2**31, 2**32 - 1)).to_bytes(4, "big")
            + data[begin + 4 :]
        )
    if change == 3:
        return (
            data[: begin + 4]
            + rng.choice((b"free", b"moov", b"\xa9nam", b"caf\xe9"))
            + data[begin + 8 :]
        )
    if change == 4 and kind != b"mdat":
        return data[:begin] + strings_changed(data[begin:end], rng) + data[end:]
    return data[: begin + 8] + bytes_changed(data[begin + 8 : end], rng) + data[end:]


def _png_chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    chunks = []
    at = len(_PNG)
    while data.startswith(_PNG) and at + 12 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return chunks


def _png_chunk(kind: bytes, content: bytes) -> bytes:
    return (
        len(content).to_bytes(4, "big")
        + kind
        + content
        + zlib.crc32(kind + content).to_bytes(4, "big")
    )


def _extra_chunks() -> tuple[tuple[bytes, bytes], ...]:
    return (
        (b"tEXt", b"Title\0caf\xe9"),
        (b"tEXt", b"\xff\xfe\0\xff"),
        (b"iTXt", b"Title\0\0\0\0\0\xff\xff"),
        (b"zTXt", b"Title\0\0" + zlib.compress(bytes(1 << 20))),
        (b"iCCP", b"p\0\0" + zlib.compress(bytes(1 << 20))),
        (b"gAMA", bytes(4)),
        (b"cHRM", b"\xff" * 32),
        (b"tRNS", bytes(6)),
        (b"acTL", b"\0\0\0\2" + bytes(4)),
        (b"eXIf", b"MM\0*\0\0\0\x08\xff\xff"),
        (b"pHYs", b"\xff" * 9),
    )


def _boxes(data: bytes, begin: int, end: int) -> list[tuple[int, int, bytes]]:
    """List begin, end and kind of all boxes, nested ones included."""
    found = []
    at = begin
    while at + 8 <= end and len(found) < 500:
        size = int.from_bytes(data[at : at + 4], "big")
        kind = data[at + 4 : at + 8]
        if size < 8 or at + size > end:
            break
        found.append((at, at + size, kind))
        if kind in _CONTAINERS:
            found += _boxes(data, at + 8, at + size)
        at += size
    return found
