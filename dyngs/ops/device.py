"""Selection of the device (CPU or CUDA GPU), GPU memory and asynchronous copies."""

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
OLDEST = (7, 5)  # compute capability of the oldest supported GPUs

_TORCH = "install a torch for CUDA, see pytorch.org"
_BUILD = "install dyngs with `pip install . -C cmake.define.DYNGS_CUDA=ON`, which needs nvcc (`dyngs docs gpu`)"


def select_device(choice: str) -> torch.device:
    """Return the device for ``auto``, ``cpu`` or ``cuda``; auto: a GPU if usable, else the CPU."""
    check_choice("device", choice, CHOICES)
    if choice == "cpu":
        return CPU
    reason = gpu_unavailable_reason()
    if reason is None:
        return torch.device("cuda", torch.cuda.current_device())
    if choice == "cuda":
        raise DyngsError(f"device cuda is not usable: {reason}, or use device cpu")
    return CPU


def cpu_fallback_reason(choice: str) -> str | None:
    """Return a message if ``choice`` falls back to the CPU on a machine with a GPU, else None."""
    if choice != "auto" or not has_nvidia_driver():
        return None
    reason = gpu_unavailable_reason()
    return (
        None
        if reason is None
        else f"training on the CPU: {reason}; set device=cpu to hide this message"
    )


def gpu_memory(device: torch.device) -> tuple[int, int] | None:
    """Return free and total bytes of GPU memory; None for the CPU."""
    return torch.cuda.mem_get_info(device) if device.type == "cuda" else None


@contextmanager
def deterministic(device: torch.device, wanted: bool = True) -> Generator[None]:
    """Make torch's GPU operators deterministic inside this context; dyngs ops always are.

    Where torch has no deterministic operator, it warns. CPU operators need no setting.
    """
    if device.type != "cuda" or not wanted:
        yield
        return
    # required by cuBLAS before its first use
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before = (
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
    )
    memory: Any = torch.utils.deterministic
    filled = memory.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True, warn_only=True)
    memory.fill_uninitialized_memory = False  # all dyngs ops write their outputs completely
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0], warn_only=before[1])
        memory.fill_uninitialized_memory = filled


def keep_freed_memory() -> bool:
    """Let glibc keep freed memory blocks for reuse; return whether that is supported.

    Call it once, before training. By default glibc requests blocks of 32 MiB or more from the
    system at each allocation, and a large part of a training step is spent on page faults. Memory
    then stays with the process. Results do not change.
    """
    return core.keep_freed_memory()


def synchronize(device: torch.device) -> None:
    """Wait until ``device`` has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def has_nvidia_driver() -> bool:
    """Return whether an NVIDIA driver seems to be installed."""
    return Path("/proc/driver/nvidia/version").exists() or shutil.which("nvidia-smi") is not None


@cache
def gpu_unavailable_reason() -> str | None:
    """Return why no GPU can be used and the remedy, in lower case; None if one can be used."""
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
    if driver < built // 1000 * 1000:  # minor versions of CUDA are compatible
        return (
            f"the kernels need CUDA {_format_cuda_version(built)}, but the driver supports only "
            f"{_format_cuda_version(driver)}: update the driver, or build dyngs with an older nvcc"
        )
    if torch.cuda.get_device_capability() < OLDEST:
        return (
            f"{torch.cuda.get_device_name()} is older than compute capability 7.5: use another GPU"
        )
    return None


def gpu_status() -> Mapping[str, str]:
    """Return the status of torch's CUDA, driver, GPU and GPU kernels by name, for ``dyngs
    doctor``."""
    version = torch.version.cuda
    gpu = "none"
    if version is not None and torch.cuda.is_available():
        gpu = f"{torch.cuda.get_device_name()}, {torch.cuda.mem_get_info()[1] / 1e9:.0f} GB"
    return {
        "torch for": "CPU only" if version is None else f"CUDA {version}",
        "kernels for GPUs": "built" if has_cuda_core() else "not built",
        "driver": "found" if has_nvidia_driver() else "none",
        "GPU": gpu,
    }


def _format_cuda_version(version: int) -> str:
    """Format a CUDA version number: 13020 is 13.2."""
    return f"{version // 1000}.{version % 1000 // 10}"


def copy_async(x: Tensor, device: torch.device | str) -> Tensor:
    """Copy ``x`` to ``device``; copies from the CPU are queued.

    The driver reads pageable memory before the call returns, so that ``x`` may be changed
    immediately.
    """
    return x.to(device, non_blocking=x.device.type == "cpu")


class AsyncReadback:
    """Asynchronous copy of a tensor from the GPU to the CPU."""

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
        """Return the tensor on the CPU; wait for its copy only, not for work queued later."""
        if self._ready is not None:
            self._ready.synchronize()
        return self._numbers
