"""Mutations of files of Gaussians, meshes and motions: PLY, BVH, glTF, COLMAP, safetensors,
scene.dyngs, HDF5."""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
from random import Random
from typing import Any

import numpy as np
import torch

from fuzz.blobs import NUMBERS, TEXTS, bytes_changed, head_changed, strings_changed, text_changed
from fuzz.trees import json_bytes, json_changed, tree_changed

_ODD = (math.nan, math.inf, 0.0, -1.0, 1e30, -3e38, 1e-40, 1e9)
_DTYPES = (torch.float16, torch.float64, torch.int64, torch.uint8, torch.bool, torch.bfloat16)


def ply_changed(data: bytes, rng: Random) -> bytes:
    """Return a PLY after one mutation of its header or its numbers."""
    end = data.find(b"end_header\n") + len(b"end_header\n")
    if end < 12 or rng.random() < 0.1:
        return bytes_changed(data, rng)
    head = data[:end]
    body = data[end:]
    change = rng.randrange(6)
    if change == 0:
        lines = b"".join(b"property float extra%d\n" % i for i in range(rng.choice((1, 3, 2000))))
        return head.replace(b"end_header\n", lines + b"end_header\n") + body
    if change == 1:
        kinds = (b"double", b"uchar", b"list uchar int", b"int8", b"float64", b"string", b"")
        return head.replace(b"float", rng.choice(kinds), rng.choice((1, -1))) + body
    if change == 2:
        return head + bytes_changed(body, rng)
    if change == 3:
        formats = (b"ascii", b"binary_big_endian", b"binary_little_endian")
        return head.replace(b"binary_little_endian", rng.choice(formats)) + body
    return text_changed(head, rng) + body


def bvh_changed(data: bytes, rng: Random) -> bytes:
    """Return a BVH after one mutation of its text."""
    change = rng.randrange(8)
    if change == 0:
        return strings_changed(data, rng)
    if change == 1:
        head, mark, rest = data.partition(b"Frame Time: ")
        value = rng.choice(NUMBERS).encode()
        return head + mark + value + rest[rest.find(b"\n") :]
    if change == 2:
        head, mark, rest = data.partition(b"Frames: ")
        return head + mark + rng.choice(NUMBERS).encode() + rest[rest.find(b"\n") :]
    if change == 3:
        return data.replace(
            b"JOINT", b"JOINT a {\nOFFSET 0 0 0\nCHANNELS 0\n" * rng.choice((1, 300)) + b"JOINT", 1
        )
    return text_changed(data, rng)


def glb_changed(data: bytes, rng: Random) -> bytes:
    """Return a GLB after one mutation of its JSON or its numbers, the lengths of its chunks
    right."""
    size = int.from_bytes(data[12:16], "little")
    text = data[20 : 20 + size]
    body = data[20 + size + 8 :]
    if rng.random() < 0.1 or not text.startswith(b"{"):
        return head_changed(data, rng, 20) if rng.random() < 0.5 else bytes_changed(data, rng)
    if rng.random() < 0.25:
        body = bytes_changed(body, rng)
    else:
        text = json_changed(text, rng)
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    content = (
        len(text).to_bytes(4, "little")
        + b"JSON"
        + text
        + len(body).to_bytes(4, "little")
        + b"BIN\0"
        + body
    )
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(content)).to_bytes(4, "little") + content


def colmap_changed(data: bytes, rng: Random) -> bytes:
    """Return a binary COLMAP file after one mutation of a count, a name or a number."""
    change = rng.randrange(5)
    if change == 0:
        count = rng.choice((0, 1, 2, 255, 2**31, 2**32, 2**61, 2**64 - 1))
        return count.to_bytes(8, "little") + data[8:]
    if change == 1:
        return strings_changed(data, rng)
    if change == 2 and len(data) > 24:
        at = rng.randrange(8, len(data) - 8)
        return data[:at] + struct.pack("<d", rng.choice(_ODD)) + data[at + 8 :]
    return bytes_changed(data, rng)


def safetensors_changed(data: bytes, rng: Random) -> bytes:
    """Return a tensor file after one mutation, mostly with the right checksum."""
    if rng.random() < 0.2:
        return bytes_changed(data, rng)
    size = int.from_bytes(data[:8], "little")
    if rng.random() < 0.2:
        text = json_changed(data[8 : 8 + size], rng)
        return len(text).to_bytes(8, "little") + text + data[8 + size :]
    try:
        return _tensors_changed(data, rng)
    except Exception:  # changed before so that it cannot be read
        return bytes_changed(data, rng)


def dyngs_changed(data: bytes, rng: Random) -> bytes:
    """Return a ``scene.dyngs`` after one mutation, mostly with the right checksum."""
    from dyngs.runs.stored_file import MAGIC, MAX_HEADER, compress_lzma, decompress_lzma

    if rng.random() < 0.1:
        return bytes_changed(data, rng)
    start = len(MAGIC) + 4
    end = start + int.from_bytes(data[len(MAGIC) : start], "little")
    header = data[start:end]
    blocks = data[end:-32]
    if rng.random() < 0.6:
        try:
            tree = tree_changed(json.loads(decompress_lzma(header, MAX_HEADER, exact=False)), rng)
            header = compress_lzma(json_bytes(tree), room=MAX_HEADER)
        except Exception:  # changed before so that it cannot be read
            header = bytes_changed(header, rng)
    elif rng.random() < 0.2:
        header = bytes_changed(header, rng)
    else:
        blocks = bytes_changed(blocks, rng)
    body = MAGIC + len(header).to_bytes(4, "little") + header + blocks
    return body + hashlib.sha256(body).digest()


def hdf5_changed(data: bytes, rng: Random) -> bytes:
    """Return an HDF5 file after one mutation of a data set or its bytes."""
    if rng.random() < 0.35:
        return bytes_changed(data, rng)
    import h5py

    buffer = io.BytesIO(data)
    try:
        with h5py.File(buffer, "r+") as file:
            _data_set_changed(file, rng.choice(sorted(file)), rng)
    except Exception:  # changed before so that it cannot be opened
        return bytes_changed(data, rng)
    return buffer.getvalue()


def _data_set_changed(file: Any, name: str, rng: Random) -> None:
    import h5py

    found = file[name]
    # A virtual data set, made by a mutation before, may be a view of itself: HDF5 reads it until
    # the stack is full.
    readable = isinstance(found, h5py.Dataset) and not found.is_virtual and found.nbytes < 1e6
    values = found[()] if readable else np.zeros((2, 3, 4))
    del file[name]
    change = rng.randrange(14)
    if change == 0:
        file.create_group(name)
    elif change == 1:
        file[name] = h5py.SoftLink(rng.choice(("/" + name, "/none", "/")))
    elif change == 2:
        file[name] = h5py.ExternalLink(
            rng.choice(("../precious/keep.h5", "/dev/zero", name)), "/" + name
        )
    elif change == 3:
        shape = rng.choice(
            ((2**20, 2**20), (2**40,), (2**31, 12, 16), (6, 2**16, 2**16), (0, 12, 16), (6, 0))
        )
        file.create_dataset(name, shape, rng.choice(("u1", "f8")), chunks=True, fillvalue=1)
    elif change == 4:
        values = values.astype(float)
        values.reshape(-1)[rng.randrange(max(values.size, 1)) :][:1] = rng.choice(_ODD)
        file[name] = values
    elif change == 5:
        file[name] = rng.choice(
            (values[:-1], values[None], values.ravel(), np.zeros(()), np.zeros((0,)))
        )
    elif change == 6:
        kinds = ("f2", "f4", ">f8", "c16", "S4", "i8", "?", [("a", "f8"), ("b", "i4")])
        file[name] = np.zeros(values.shape, kinds[rng.randrange(len(kinds))])
    elif change == 7:
        file.create_dataset(
            name, data=[rng.choice(TEXTS).replace("\0", "").replace("\ud800", "")] * 3
        )
    elif change == 8:
        file.create_dataset(name, (3,), h5py.vlen_dtype(np.float64))
    elif change == 9:
        file.create_dataset(name, (3,), h5py.ref_dtype)
    elif change == 10:
        file.create_dataset(
            name,
            values.shape,
            "u1",
            external=[(rng.choice(("/dev/zero", "../precious/keep.txt")), 0, 10**9)],
        )
    elif change == 11:
        layout = h5py.VirtualLayout((6, 12, 16), "u1")
        layout[:] = h5py.VirtualSource(rng.choice((".", "../precious/keep.h5")), name, (6, 12, 16))
        file.create_virtual_dataset(name, layout)
    elif change == 12:
        file[name] = h5py.Empty("f8")
    else:
        file.create_dataset(name, data=values, compression="gzip", shuffle=True, fletcher32=True)


def _tensors_changed(data: bytes, rng: Random) -> bytes:
    """Change tensors or header and write them as dyngs does."""
    from safetensors.torch import save

    from dyngs.io.tensor_file import _digest

    size = int.from_bytes(data[:8], "little")
    metadata = json.loads(data[8 : 8 + size])["__metadata__"]
    key = next(iter(metadata))
    header = json.loads(metadata[key])
    tensors = _loaded(data)
    if rng.random() < 0.4:
        header = tree_changed(header, rng)
    else:
        _one_tensor_changed(tensors, rng)
    if isinstance(header, dict):
        header.pop("digest", None)
        text = json_bytes(header).decode()
        header["digest"] = _digest(tensors, json.loads(text))
    return save(
        {name: x.contiguous().clone() for name, x in tensors.items()},
        {key: json_bytes(header).decode()},
    )


def _loaded(data: bytes) -> dict[str, torch.Tensor]:
    from safetensors.torch import load

    return load(data)


def _one_tensor_changed(tensors: dict[str, torch.Tensor], rng: Random) -> None:
    name = rng.choice(sorted(tensors))
    x = tensors[name]
    change = rng.randrange(9)
    if change == 0:
        del tensors[name]
    elif change == 1:
        tensors[
            rng.choice(
                (name + "x", name.rpartition(".")[0], "", "model.field.x", "model.colour.x", "a\nb")
            )
        ] = x
    elif change == 2:
        tensors[name] = x.to(rng.choice(_DTYPES))
    elif change == 3:
        tensors[name] = (
            rng.choice((x[:0], x[None], x.reshape(-1), x.transpose(0, -1))) if x.dim() else x[None]
        )
    elif change == 4:
        tensors[name] = torch.cat([x, x]) if x.dim() else x.repeat(3)
    elif change == 5 and x.dim():
        tensors[name] = x[:-1]
    elif change == 6:
        tensors[name] = tensors[rng.choice(sorted(tensors))].clone()
    elif x.numel():
        x = x.clone()
        value = (
            rng.choice(_ODD)
            if x.is_floating_point()
            else rng.choice((0, 1, -1, 2**31, -(2**63), 99, 255))
        )
        x.reshape(-1)[rng.randrange(x.numel())] = torch.tensor(value).to(x.dtype)
        tensors[name] = x
