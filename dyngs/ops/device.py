"""Which device computes, the CPU or a CUDA GPU that torch, driver and compiled core can use; its
memory and copies."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.native import core, cuda_core, has_cuda_core
from dyngs.ops.registration import check_choice

CPU = torch.device("cpu")
CHOICES = ("auto", "cpu", "cuda")
OLDEST = (7, 5)  # compute capability of the oldest GPUs that the kernels are compiled for

_TORCH = "install a torch for CUDA, see pytorch.org"
_BUILD = "install dyngs with `pip install . -C cmake.define.DYNGS_CUDA=ON`, which needs nvcc (docs/gpu.md)"


def select_device(choice: str) -> torch.device:
    """Return the device for ``auto``, ``cpu`` or ``cuda``; auto is a GPU where one can be used,
    else the CPU."""
    check_choice("device", choice, CHOICES)
    if choice == "cpu":
        return CPU
    reason = gpu_unavailable_reason()
    if reason is None:
        return torch.device("cuda", torch.cuda.current_device())
    if choice == "cuda":
        raise DyngsError(f"device cuda: {reason}, or give device cpu")
    return CPU


def cpu_fallback_reason(choice: str) -> str | None:
    """Return a line on why ``choice`` means the CPU although the machine seems to have a GPU; None
    otherwise."""
    if choice != "auto" or not has_nvidia_driver():
        return None
    reason = gpu_unavailable_reason()
    return None if reason is None else f"computing on the CPU: {reason}; device=cpu ends this line"


def gpu_memory(device: torch.device) -> tuple[int, int] | None:
    """Return the bytes of a GPU's memory that nobody has taken, and all that it has; None where it
    is no GPU."""
    return torch.cuda.mem_get_info(device) if device.type == "cuda" else None


@contextmanager
def deterministic(device: torch.device, wanted: bool = True) -> Generator[None]:
    """Let torch's operators on a GPU give the same bytes every time, inside this context; ours
    always do.

    Where torch has no such operator it warns. The CPU's need nothing of this.
    """
    if device.type != "cuda" or not wanted:
        yield
        return
    # what cuBLAS needs for it, before it begins
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = (
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
    )
    memory: Any = torch.utils.deterministic
    filled = memory.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    memory.fill_uninitialized_memory = False  # every op of ours writes its outputs in full
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
        memory.fill_uninitialized_memory = filled


def keep_freed_memory() -> bool:
    """Keep freed blocks for reuse from now on; return whether that worked. Call it once, before
    training.

    By default glibc takes blocks of 32 MiB or more from the system at each allocation, and the
    kernel clears their pages again: much of a training step goes into page faults. Memory once used
    then stays with the process; the first steps take large temporary blocks two or three times
    over. Results do not change. Without glibc nothing happens: False.
    """
    return core.keep_freed_memory()


def synchronize(device: torch.device) -> None:
    """Wait until ``device`` has done what was asked of it, so that it can be timed."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def has_nvidia_driver() -> bool:
    """Return whether a driver of NVIDIA seems to be installed."""
    return Path("/proc/driver/nvidia/version").exists() or shutil.which("nvidia-smi") is not None


@cache
def gpu_unavailable_reason() -> str | None:
    """Return why no GPU can be used and what to do, beginning with a small letter; None where one
    can be."""
    if torch.version.cuda is None:
        return f"this torch ({torch.__version__}) is built without CUDA: {_TORCH}"
    if not torch.cuda.is_available():
        return "torch finds no GPU: see `nvidia-smi`, and CUDA_VISIBLE_DEVICES if it is set"
    if not has_cuda_core():
        return f"dyngs was built without its kernels for GPUs: {_BUILD}"
    try:
        kernels = cuda_core()
    except DyngsError as error:
        return str(error)
    built = kernels.runtime_version()
    driver = kernels.driver_version()
    if driver < built // 1000 * 1000:  # CUDA's minor versions are compatible
        versions = f"the kernels were built with CUDA {_said(built)}, but the driver knows {_said(driver)} at most"
        return f"{versions}: update the driver, or build dyngs with an older nvcc"
    if torch.cuda.get_device_capability() < OLDEST:
        return (
            f"{torch.cuda.get_device_name()} is older than compute capability 7.5: use another GPU"
        )
    return None


def gpu_status() -> Mapping[str, str]:
    """Return what there is of torch's CUDA, driver, GPU and compiled core, by name; for ``dyngs
    doctor``."""
    version = torch.version.cuda
    gpu = "none"
    if version is not None and torch.cuda.is_available():
        gpu = f"{torch.cuda.get_device_name()}, {torch.cuda.mem_get_info()[1] / 1e9:.0f} GB"
    return {
        "torch for": "the CPU alone" if version is None else f"CUDA {version}",
        "kernels for GPUs": "built" if has_cuda_core() else "not built",
        "driver": "there" if has_nvidia_driver() else "none",
        "GPU": gpu,
    }


def _said(version: int) -> str:
    """Return a version as CUDA writes it, 13020, for people: 13.2."""
    return f"{version // 1000}.{version % 1000 // 10}"


def copy_async(x: Tensor, device: torch.device | str) -> Tensor:
    """Return ``x`` on ``device``; the copy of a tensor of the CPU is queued.

    The driver has taken a copy of pageable memory before the call returns, so that ``x`` may change
    at once.
    """
    return x.to(device, non_blocking=x.device.type == "cpu")


class AsyncReadback:
    """Numbers of a tensor, which a GPU copies to the CPU as soon as it has them, while more work is
    queued."""

    def __init__(self, x: Tensor) -> None:
        self._ready: torch.cuda.Event | None = None
        if x.device.type != "cuda":
            self._numbers = x.detach().to("cpu", copy=True)
            return
        self._numbers = torch.empty(x.shape, dtype=x.dtype, device="cpu", pin_memory=True)
        self._numbers.copy_(x.detach(), non_blocking=True)
        self._ready = torch.cuda.Event()
        self._ready.record(torch.cuda.current_stream(x.device))

    def numbers(self) -> Tensor:
        """Return them on the CPU; waits until the GPU has come to them, not for what was queued
        later."""
        if self._ready is not None:
            self._ready.synchronize()
        return self._numbers
