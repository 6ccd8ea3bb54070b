"""Reuse of freed memory by the process."""

from __future__ import annotations

from dyngs.ops.native import core


def keep_freed_memory() -> bool:
    """Keep freed blocks for reuse from now on; return whether that worked. Call it once, before training.

    Why: by default glibc takes a block of 32 MiB or more (in a fresh process 128 KiB or more) from the system at each
    allocation and gives it back at each release, and the kernel clears all its pages again at first touch. A training
    step allocates and frees images and gradients of such sizes, so that much of its time goes into page faults.

    What it costs: memory once used stays with the process until it ends. As torch's aligned blocks rarely fit exactly
    where one was freed, the first steps take fresh memory until the gaps suit: expect the large temporary blocks two or
    three times over (measured: 600 MB resident instead of 225 MB for a loop over one tensor of 48 MB). Results do not
    change, so programs that embed dyngs and have other plans for their memory may leave it out. Without glibc (macOS,
    musl) nothing happens and the answer is False.
    """
    return core.keep_freed_memory()
