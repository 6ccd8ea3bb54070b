"""Reading of pickles without executing them: numbers, text, containers, arrays of NumPy, SciPy and chumpy.

Captures of people and body templates are distributed as pickles of Python 2 and 3, of ``numpy.save`` and of joblib.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from dyngs.errors import DyngsError
from dyngs.files.unpickler import Unpickler


def read_pickle(path: Path) -> object:
    """Read a pickle of numbers, text, containers and arrays; nothing in the file is executed.

    Pickles of Python 2 and uncompressed ones of joblib are read, too. Sparse matrices of SciPy and arrays of chumpy
    become plain arrays; neither package is needed. The result never contains itself and is at most 100 containers deep.
    With shared parts counted at each occurrence, it has at most two entries per byte of the file and a million more,
    beside those of sparse matrices (``dyngs.files.limits``).

    Raises:
        DyngsError: the file is missing or damaged, or holds anything else, or asks for too much.
    """
    return _unpickled(path, is_array=False)


def read_pickled_array(path: Path) -> object:
    """Read the Python object that ``numpy.save`` wrapped into a 0-dimensional array, as ``read_pickle`` does.

    Raises:
        DyngsError: the file is missing or damaged, or holds something else.
    """
    array = _unpickled(path, is_array=True)
    if not isinstance(array, np.ndarray) or array.shape != () or array.dtype.kind != "O":
        raise DyngsError(f"{path}: must hold one dictionary, saved with numpy.save; export it again")
    return array.item()


def _unpickled(path: Path, is_array: bool) -> object:
    if not path.is_file():
        raise DyngsError(f"{path}: no such file; restore it")
    try:
        with path.open("rb") as file:
            if is_array:
                _skip_array_header(file)
            return Unpickler(path, file, path.stat().st_size).load()
    except DyngsError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        raise DyngsError(
            f"{path}: cannot be read as a pickle ({reason}); copy it again, or export it as arrays"
        ) from error


def _skip_array_header(file: BinaryIO) -> None:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    if read(file)[2].kind != "O":
        raise ValueError("an array of Python objects was expected")
