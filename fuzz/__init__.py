"""Fuzzing of all readers with damaged and hostile files: ``python -m fuzz READER --minutes N``, see
``--help``.

A case is a small valid input (``fuzz.seeds``) with a few format-aware mutations (``fuzz.mutate``).
A reader (``fuzz.readers``) reads it in a process of its own (``fuzz.worker``), and the outcome is
judged (``fuzz.verdict``).
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

# workers are forked, which thread pools do not survive
os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
if not any((ROOT / "dyngs" / "ops").glob("_core*")):
    # sources without a native core: use the installed package
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != ROOT]
sys.path += [str(ROOT / "tests"), str(ROOT / "tests" / "data")]
