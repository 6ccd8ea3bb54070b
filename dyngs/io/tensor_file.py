"""Files of named tensors with a header and a checksum, in the safetensors format: reading them runs
no code."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dyngs.core.errors import DyngsError, describe_error, require_regular_file
from dyngs.io.write import atomic_file, remove_quietly, temporary_folder_beside


@dataclass(frozen=True)
class FileKind:
    """Key of the metadata that holds the header, name with its article, and the one version that is
    read."""

    key: str
    what: str
    version: int


def write_tensors(
    path: Path,
    kind: FileKind,
    tensors: Mapping[str, Tensor],
    header: Mapping[str, object],
    advice: str = "",
) -> None:
    """Write contiguous tensors and values that JSON can hold, atomically; equal ones give equal
    bytes.

    ``advice`` is the end of the message for a full disk.
    """
    full = {"format": kind.version, **header}
    full["digest"] = _digest(tensors, full)
    with atomic_file(path, durable=True) as temporary:
        # The library writes to a temporary name of its own, which a kill would leave behind: so in
        # a folder of ours.
        folder = temporary_folder_beside(path.with_suffix(""))
        try:
            # One key only: the library writes several in random order.
            save_file(
                dict(tensors),
                folder / path.name,
                metadata={kind.key: json.dumps(full, sort_keys=True)},
            )
            # It makes files that only their owner can read; the folder has what the umask allows.
            os.chmod(folder / path.name, folder.stat().st_mode & 0o666)
            os.replace(folder / path.name, temporary)
        except SafetensorError as error:
            raise DyngsError(f"cannot write {path}: {error}; free some space{advice}") from None
        finally:
            remove_quietly(folder)


def read_tensors(
    path: Path, kind: FileKind, advice: str
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read header and tensors of a file. Raises DyngsError."""
    require_regular_file(path)
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get(kind.key, "null"))
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 (not a dict)
    except Exception as error:  # the library does not document its exceptions
        if isinstance(error, OSError | MemoryError) or "allocate memory" in str(error):
            # not the file's fault
            is_there = not isinstance(error, FileNotFoundError)
            advice = "; the file may be intact: keep it and try again" if is_there else ""
        raise DyngsError(
            f"{path}: cannot be read as {kind.what} ({describe_error(error)}){advice}"
        ) from error
    if not isinstance(header, dict) or "format" not in header:
        raise DyngsError(f"{path}: not {kind.what} of dyngs{advice}")
    if header["format"] != kind.version:
        raise DyngsError(
            f"{path}: written by another version of dyngs; use that version or train again"
        )
    if header.pop("digest", None) != _digest(tensors, header):
        raise DyngsError(f"{path}: damaged or altered, its checksum differs{advice}")
    return header, tensors


def _digest(tensors: Mapping[str, Tensor], header: Mapping[str, object]) -> str:
    """Checksum over the header and the names, types, shapes and bytes of all tensors."""
    total = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(tensors):
        x = tensors[name].contiguous()
        total.update(f"{name} {x.dtype} {tuple(x.shape)}\n".encode())
        total.update(x.reshape(-1).view(torch.uint8).numpy().data)  # numpy lacks some types
    return total.hexdigest()
