"""That freed memory is kept, seen from outside: no page faults when blocks are allocated again."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

import dyngs

# In a process of its own, as the setting cannot be taken back.
PROGRAM = """
import resource
import torch
from dyngs.ops.memory import keep_freed_memory

def faults(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        torch.ones(12_000_000)  # 48 MB, beyond what glibc keeps by itself
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

before = faults(4)
taken = keep_freed_memory()
faults(12)  # aligned blocks need a few rounds to settle
print(before, taken, faults(4))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has the setting")
def test_blocks_are_reused_without_page_faults() -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(dyngs.__file__).resolve().parents[1])}
    command = [sys.executable, "-c", PROGRAM]
    output = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    before, taken, after = output.split()
    assert taken == "True"
    assert int(after) < int(before) / 10
