"""Readers under damaged and hostile files: run by hand with ``python -m fuzz READER --minutes N``, see ``--help``.

A case is a small valid input (``fuzz.seeds``) with a few changes that know the format (``fuzz.mutate``). A reader
(``fuzz.readers``) runs it in a process of its own (``fuzz.worker``), and what it does is judged (``fuzz.verdict``).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # workers are forked, and a pool of threads does not survive that
ROOT = Path(__file__).resolve().parents[1]
if not any((ROOT / "dyngs" / "ops").glob("_core*")):  # bare sources: the installed package is meant
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != ROOT]
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "data")]
