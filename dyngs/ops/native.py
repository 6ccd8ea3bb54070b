"""Loading of the compiled kernels for the CPU and CUDA, thread counts, and passing of tensors.

There is one module per x86-64 level; the newest that the processor supports is imported.
``DYNGS_ISA=v2|v3|v4`` selects an older one for tests. The CUDA module (docs/guides/gpu.md) is
imported for the first tensor on a GPU.
"""

from __future__ import annotations

import os
import platform
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib import import_module, util
from types import ModuleType

import torch  # imported first, so that both use its libgomp
from torch import Tensor
from torch.utils.dlpack import to_dlpack  # pyright: ignore[reportPrivateImportUsage]

from dyngs.core.errors import DyngsError

_BASELINE = "SSE4.2" if platform.machine() in ("x86_64", "AMD64") else "NEON"
# x86-64 levels and their instruction sets, oldest first
ISA_NAMES = {"v2": _BASELINE, "v3": "AVX2", "v4": "AVX-512"}


def built_isas() -> tuple[str, ...]:
    """Return the instruction sets that kernels were compiled for, oldest first."""
    return tuple(isa for isa in ISA_NAMES if util.find_spec(f"dyngs.ops._core_{isa}") is not None)


def choose_isa(built: tuple[str, ...], newest: str, requested: str | None) -> str:
    """Return the instruction set to load.

    ``built``: compiled ones, oldest first. ``requested``: value of ``DYNGS_ISA``, or None. Raises
    DyngsError if the processor supports none, or not the requested one.
    """
    usable = [isa for isa in built if isa <= newest]
    if not usable:
        raise DyngsError(
            f"dyngs was compiled for processors with {ISA_NAMES[built[0]]}, which this one lacks; "
            "reinstall it on this machine, or from a wheel, which has kernels for all processors"
        )
    if requested is None:
        return usable[-1]
    if requested not in usable:
        raise DyngsError(
            f"DYNGS_ISA={requested} is not supported here; unset it or use {', '.join(usable)}"
        )
    return requested


def _load_core() -> tuple[ModuleType, str]:
    built = built_isas() or ("v2",)
    try:
        # everything but kernels runs on any processor
        newest_core = import_module(f"dyngs.ops._core_{built[-1]}")
        isa = choose_isa(built, newest_core.best_isa(), os.environ.get("DYNGS_ISA"))
        return import_module(f"dyngs.ops._core_{isa}"), isa
    except ImportError as error:
        advice = "install with `pip install .`, and run Python outside the source folder, which hides the installed one"
        raise ImportError(f"the compiled core of dyngs is missing ({error}); {advice}") from error


_CUDA_CORE = "dyngs.ops._core_cuda"

core, _ISA = _load_core()


def has_cuda_core() -> bool:
    """Return whether dyngs was built with CUDA kernels."""
    return util.find_spec(_CUDA_CORE) is not None


@cache
def cuda_core() -> ModuleType:
    """Return the compiled CUDA core. Raises DyngsError if it was not built or cannot be loaded."""
    try:
        return import_module(_CUDA_CORE)
    except ImportError as error:
        advice = "install with `pip install . -C cmake.define.DYNGS_CUDA=ON`, which needs nvcc"
        raise DyngsError(f"the CUDA kernels cannot be loaded ({error}); {advice}") from error


def core_for(x: Tensor) -> ModuleType:
    """Return the compiled core for the device of ``x``; on a GPU it uses torch's current stream.

    Raises DyngsError for float64 on a GPU.
    """
    if x.is_cpu:
        return core
    if x.dtype == torch.float64:
        raise DyngsError("float64 is not supported on a GPU; use float32")
    module = cuda_core()
    index = x.get_device()
    module.use_queue(index, torch._C._cuda_getCurrentRawStream(index))  # pyright: ignore
    return module


def lend(size: int, device: int) -> Tensor:
    """Allocate ``size`` bytes of GPU memory for the CUDA core, which frees them after queuing its
    work."""
    return torch.empty(size, dtype=torch.uint8, device=_gpu(device))


@cache
def _gpu(index: int) -> torch.device:
    return torch.device("cuda", index)


def active_isa() -> str:
    """Return the instruction set of the kernels: ``v2``, ``v3`` (AVX2) or ``v4`` (AVX-512)."""
    return _ISA


_kernel_threads: ContextVar[int | None] = ContextVar("kernel_threads", default=None)


class _Threads:
    """State of OpenMP threads in a process made by ``os.fork``.

    The child inherits the list of waiting threads but not the threads, so that the next parallel
    loop would hang. If the parent's kernels had started threads, the child uses one thread.
    """

    started = False
    lost = False
    warned = False


def _begin_child() -> None:
    """Limit the number of threads; called in the child after the fork."""
    _Threads.lost = _Threads.started
    _Threads.warned = False
    if _Threads.lost:
        torch.set_num_threads(1)


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_begin_child)


def num_threads() -> int:
    """Return the number of kernel threads: of ``kernel_threads``, else torch's; 1 after a fork."""
    wanted = _kernel_threads.get() or torch.get_num_threads()
    if not _Threads.lost:
        _Threads.started |= wanted > 1
        return wanted
    if not _Threads.warned and torch.utils.data.get_worker_info() is None:
        _Threads.warned = True
        warnings.warn(
            "dyngs and torch use one thread: this process was forked from a process with threads; "
            "use multiprocessing's 'spawn' start method for more threads",
            RuntimeWarning,
            stacklevel=2,
        )
    return 1


@contextmanager
def kernel_threads(count: int) -> Generator[None]:
    """Run kernels on ``count`` threads and torch's own operators on one inside this context.

    torch only does small element-wise work between kernels, for which its threads cost more than
    they save. Its sums are then independent of the number of threads.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    token = _kernel_threads.set(count)
    try:
        yield
    finally:
        _kernel_threads.reset(token)
        torch.set_num_threads(before)


def array(x: Tensor) -> object:
    """Return ``x`` as a C-contiguous DLPack capsule, valid for one call.

    A capsule takes 0.5 us, passing the tensor 5 us; a training step passes a hundred.
    """
    return to_dlpack(x if x.is_contiguous() else x.detach().contiguous())


def writable(x: Tensor) -> object:
    """Return ``x`` like ``array``, for a kernel that writes to it; increments its version for
    autograd.

    Raises DyngsError if ``x`` is not contiguous, because the kernel would write to a copy.
    """
    if not x.is_contiguous():
        raise DyngsError(
            "a tensor that is updated in place must be contiguous; call .contiguous() first"
        )
    torch.autograd.graph.increment_version(x)
    return to_dlpack(x)


def num_cores() -> int:
    """Return the number of cores available to this process."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1
