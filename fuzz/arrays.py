"""Mutations of NumPy files: wrong headers, other types, odd numbers, members of archives."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from ast import literal_eval
from functools import cache
from random import Random

import numpy as np

from fuzz.blobs import bytes_changed, head_changed
from fuzz.opcodes import pickle_changed

_MAGIC = b"\x93NUMPY"
_TYPES = (
    "|O",
    "<f8",
    "<f4",
    "<f2",
    ">f8",
    "<i8",
    "|u1",
    "|b1",
    "<c16",
    "<U3",
    "<U1000000",
    "|S4",
    "|V8",
    "<M8[ns]",
    "<u8",
)
_SHAPES = (
    (),
    (0,),
    (1,),
    (2**31,),
    (2**40,),
    (2**62, 4),
    (-1,),
    (2**20, 2**20),
    (0, 2**40),
    (3, 0),
    (1,) * 40,
)
_ODD = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e300, -1e30, 1e-310, 1e19, 1e9, 1e-30, 5e-324)
_BLOCK = 1 << 20
_LARGEST = 1 << 24


def npy_changed(data: bytes, rng: Random) -> bytes:
    """Return a ``.npy`` file after one mutation of its header or its numbers."""
    try:
        version, header, body = _parts(data)
    except Exception:  # not a .npy, or no longer
        return bytes_changed(data, rng)
    change = rng.randrange(10)
    if change == 0:
        return bytes_changed(data, rng)
    if change == 1:
        return head_changed(data, rng, 128)
    if "O" in str(header["descr"]) and rng.random() < 0.8:
        return _joined(version, header, pickle_changed(body, rng))
    if change == 2:
        header["descr"] = rng.choice((*_TYPES, [("a", "<f8"), ("b", "|O")], "x", None, 5))
    elif change in (3, 4):
        shape = header["shape"]
        near = [
            shape[::-1],
            (*shape, 1),
            shape[:-1],
            (1, *shape),
            tuple(n + 1 for n in shape),
            tuple(n - 1 for n in shape),
        ]
        header["shape"] = rng.choice((*_SHAPES, *near, *near))
    elif change == 5:
        header["fortran_order"] = rng.choice((True, 1, None))
    else:
        return _values_changed(data, rng)
    return _joined(version, header, body)


def npz_changed(data: bytes, rng: Random) -> bytes:
    """Return a ``.npz`` file after one mutation of a member or of the archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(info.file_size for info in archive.infolist()) > _LARGEST:
                return bytes_changed(data, rng)
            members = [(name, archive.read(name)) for name in archive.namelist()]
    except Exception:  # a broken archive is an input like others
        return bytes_changed(data, rng)
    if not members:
        return bytes_changed(data, rng)
    i = rng.randrange(len(members))
    change = rng.randrange(30)
    name, content = members[i]
    if change == 0:
        return bytes_changed(data, rng)
    if change == 1:
        del members[i]
    elif change == 2:
        members[i] = (
            rng.choice(("x.npy", "../x.npy", name.removesuffix(".npy"), "a" * 300, "")),
            content,
        )
    elif change == 3:
        members.append(members[rng.randrange(len(members))])
    elif change == 4:
        return _with_bomb(members, i, rng)
    elif change == 5:
        members[i] = (name, rng.choice((b"", b"text", b"\x80\x04N.")))
    else:
        members[i] = (name, npy_changed(content, rng))
    return _archive(members, rng)


def _parts(data: bytes) -> tuple[bytes, dict, bytes]:
    """Split a file into version, header and data."""
    if not data.startswith(_MAGIC):
        raise ValueError
    version = data[6:8]
    size, start = (2, 10) if version[0] == 1 else (4, 12)
    end = start + int.from_bytes(data[8 : 8 + size], "little")
    header = literal_eval(data[start:end].decode())
    return version, dict(header), data[end:]


def _joined(version: bytes, header: dict, body: bytes) -> bytes:
    text = repr(header).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return (
        _MAGIC + version + len(text).to_bytes(2 if version[0] == 1 else 4, "little") + text + body
    )


def _values_changed(data: bytes, rng: Random) -> bytes:
    """Change numbers, type or shape to other valid ones."""
    try:
        array = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception:  # a header that lies
        return bytes_changed(data, rng)
    if array.dtype.kind not in "fiub" or not array.size or array.nbytes > 1e7:
        return head_changed(data, rng, 200)
    change = rng.randrange(5)
    with np.errstate(all="ignore"):
        if change == 0:
            array = array.astype(
                rng.choice(("f2", "f4", "f8", "i4", "u1", "b1", "c16", "U4", "S3"))
            )
        elif change == 1:
            array = (
                rng.choice((array[:-1], array[None], array.ravel(), array.T))
                if array.ndim
                else array[None]
            )
        else:
            array = (
                array.astype("f8")
                if array.dtype.kind != "f" and rng.random() < 0.5
                else array.copy()
            )
            for _ in range(rng.choice((1, 1, 4))):
                value = (
                    rng.choice(_ODD)
                    if array.dtype.kind == "f"
                    else rng.choice((0, -1, 1, 127, 2**31 - 1, 255))
                )
                array.reshape(-1)[rng.randrange(array.size)] = np.array(value).astype(array.dtype)
            if change == 2:
                array = np.full_like(array, array.reshape(-1)[rng.randrange(array.size)])
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _archive(members: list[tuple[str, bytes]], rng: Random) -> bytes:
    buffer = io.BytesIO()
    method = rng.choice(
        (zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA)
    )
    with warnings.catch_warnings(), zipfile.ZipFile(buffer, "w", method) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, content in members:
            info = zipfile.ZipInfo(name or "x", date_time=(1980, 1, 1, 0, 0, 0))
            info.compress_type = method
            archive.writestr(info, content)
    return buffer.getvalue()


@cache
def _zeros() -> bytes:
    """A deflated block of zeros that can be repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(bytes(_BLOCK)) + packer.flush(zlib.Z_FULL_FLUSH)


def _with_bomb(members: list[tuple[str, bytes]], which: int, rng: Random) -> bytes:
    """An archive one of whose members is 2 GB of zeros in 2 MB, written by hand as zipfile would
    compress it slowly."""
    count = rng.choice((64, 2048))
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = _zeros()
    size = count * _BLOCK
    header = _joined(
        b"\x01\x00", {"descr": "<f8", "fortran_order": False, "shape": (size // 8,)}, b""
    )
    first = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH)
    content = first + block * count + packer.flush()
    name = members[which][0].encode()
    total = size + len(header)
    fields = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 33, 0, len(content), total, len(name), 0)
    local = b"PK\x03\x04" + fields + name + content
    central = (
        b"PK\x01\x02" + struct.pack("<H", 20) + fields + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    )
    return (
        local
        + central
        + b"PK\x05\x06"
        + struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)
    )
