"""Tensors out of files of ``torch.save``, without executing anything in them.

Such a file is a zip that is not compressed: a pickle, in which a tensor names a member and a place in it, and a
member of raw numbers for each storage. Only the members of requested tensors are read.
"""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from dyngs.errors import DyngsError, reading
from dyngs.files.limits import require_at_most
from dyngs.files.pickled_arrays import Arrays, Name
from dyngs.files.pickles import Unpickler

_REBUILD = "torch._utils._rebuild_tensor_v2"
_PARAMETER = "torch._utils._rebuild_parameter"
_TYPES = {"torch.FloatStorage": "<f4", "torch.HalfStorage": "<f2", "torch.DoubleStorage": "<f8"}
_MOST_PICKLE_BYTES = 1 << 26


@dataclass(frozen=True)
class StoredTensor:
    """Where a tensor lies in its file, as that says: the member and type of its storage, and the numbers of it."""

    member: str
    kind: str
    first: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


class TorchFile:
    """A file of ``torch.save``.

    Attributes:
        contents: dictionaries, lists, numbers and text, with ``StoredTensor`` for tensors.
    """

    def __init__(self, path: Path) -> None:
        """Read the pickle. Raises DyngsError: no file of torch 1.6 or newer, or it holds anything but numbers."""
        self._path = path
        if not zipfile.is_zipfile(path):
            raise DyngsError(f"{path}: is no file of torch.save (a zip, since torch 1.6), or is cut off; copy it again")
        with reading(path, "export a .ply with the program that wrote it"), zipfile.ZipFile(path) as archive:
            found = [name for name in archive.namelist() if PurePosixPath(name).name == "data.pkl"]
            if len(found) != 1:
                raise ValueError("it is no file of torch.save: it has no data.pkl")
            self._folder = PurePosixPath(found[0]).parent
            data = self._member(archive, "data.pkl", _MOST_PICKLE_BYTES)
            self.contents = _TorchUnpickler(path, io.BytesIO(data), len(data)).load()

    def numbers(self, tensor: StoredTensor) -> np.ndarray:
        """Return a tensor as float32. Raises DyngsError: it holds no floats, or lies outside its member."""
        if tensor.kind not in _TYPES:
            raise DyngsError(f"{self._path}: a tensor of it is a {tensor.kind[:40]}, not of floats; export a .ply")
        dtype = np.dtype(_TYPES[tensor.kind])
        with reading(self._path), zipfile.ZipFile(self._path) as archive:
            data = self._member(archive, f"data/{tensor.member}", self._path.stat().st_size)
            if math.prod(tensor.shape) * dtype.itemsize > len(data):
                raise ValueError("a tensor of it is larger than its numbers")
            strides = [dtype.itemsize * stride for stride in tensor.strides]
            return np.ndarray(tensor.shape, dtype, data, dtype.itemsize * tensor.first, strides).astype(np.float32)

    def _member(self, archive: zipfile.ZipFile, name: str, most: int) -> bytes:
        info = archive.getinfo(str(self._folder / name))
        if info.compress_type != zipfile.ZIP_STORED:
            raise ValueError("it is compressed, which torch.save does not do")
        require_at_most(self._path, info.file_size, most, "bytes of a member")
        with archive.open(info) as member:
            return member.read(info.file_size)


class _TorchUnpickler(Unpickler):
    def __init__(self, path: Path, file: io.BytesIO, size: int) -> None:
        super().__init__(path, file, size)
        self._arrays = _Tensors(path, size, self.read)

    def persistent(self, key: object) -> object:
        """Return the storage that a pickle names: its type and member."""
        match key:
            case ("storage", Name() as kind, str() as member, str(), int()):
                return kind.text, member
        raise ValueError("it names something that is no storage of numbers")


class _Tensors(Arrays):
    """Interpretation of the names that ``torch.save`` adds to those of arrays."""

    def named(self, module: object, name: object) -> Name:
        key = f"{module!s:.200}.{name!s:.200}"
        is_storage = module == "torch" and key.endswith("Storage")
        return Name(key) if is_storage or key in (_REBUILD, _PARAMETER) else super().named(module, name)

    def called(self, name: object, arguments: object) -> object:
        match name, arguments:
            case Name(text=text), ((str() as kind, str() as member), first, shape, strides, *_) if text == _REBUILD:
                return StoredTensor(member, kind, first, shape, strides)
            case Name(text=text), (StoredTensor() as tensor, *_) if text == _PARAMETER:
                return tensor
        return super().called(name, arguments)

    def build(self, target: object, state: object) -> None:
        """Leave out the state of a dictionary, which holds the versions of modules."""
        if not isinstance(target, dict):
            super().build(target, state)
