"""How the process treats freed memory."""

from __future__ import annotations

from dyngs.ops.native import core

LARGEST_KEPT_BYTES = 1 << 30
SMALLER_LIMIT_BYTES = 32 << 20
"""What older versions of glibc accept at most."""


def keep_freed_memory() -> bool:
    """Whether freed blocks are now kept for reuse; call it once, before training.

    Why: by default glibc takes a large block (32 MiB and up, in a fresh process 128 KiB and up) from the system on each
    allocation and gives it back on each release, and the kernel clears every page of it again at first touch. A training
    step allocates and frees pictures and gradients of that size, so that part of its time goes into page faults.

    What it costs: memory once used stays with the process, so its resident size remains at the peak, and blocks of very
    different sizes may leave gaps that count too. Programs that embed dyngs and care may leave it out: results do not
    change. Without glibc (macOS, musl) nothing happens and the answer is False.
    """
    return core.keep_freed_memory(LARGEST_KEPT_BYTES) or core.keep_freed_memory(SMALLER_LIMIT_BYTES)
