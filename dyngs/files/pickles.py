"""What pickles hold, read without running anything: numbers, text, containers, and arrays of NumPy, SciPy and chumpy.

Captures of people and body files come as pickles, of Python 2 and 3, of ``numpy.save`` and of joblib.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from dyngs.errors import DyngsError
from dyngs.files.unpickler import Machine


def read_pickle(path: Path) -> object:
    """What a pickle holds, if that is numbers, text, containers and arrays; nothing of the file is executed.

    Pickles of Python 2 and uncompressed ones of joblib are read, too. Sparse matrices of SciPy and arrays of chumpy
    (none of which is needed for it) become plain arrays. What is returned never contains itself and is at most 100
    containers deep; with shared parts counted wherever they are, it has two entries for each byte of the file and a
    million more at most, beside those of sparse matrices (``dyngs.files.limits``).

    Raises:
        DyngsError: the file is missing or damaged, or holds anything else, or asks for too much.
    """
    return _unpickled(path, is_array=False)


def read_pickled_array(path: Path) -> object:
    """The Python object that ``numpy.save`` wrapped into an array without axes, read as ``read_pickle`` does.

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
            return Machine(path, file, path.stat().st_size).load()
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
