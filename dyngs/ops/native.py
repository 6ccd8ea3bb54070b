"""The compiled cores for this processor and for CUDA GPUs, the number of threads, and tensors
passed to a core.

There is one module per x86-64 level; the newest that the processor runs is imported,
``DYNGS_ISA=v2|v3|v4`` picks an older one, for tests. The module for CUDA
GPUs (docs/guides/gpu.md) is imported when the first tensor on a GPU is used.
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

import torch  # first: its libgomp is then the one that both use
from torch import Tensor
from torch.utils.dlpack import to_dlpack  # pyright: ignore[reportPrivateImportUsage]

from dyngs.core.errors import DyngsError

_BASELINE = "SSE4.2" if platform.machine() in ("x86_64", "AMD64") else "NEON"
# instruction sets, x86-64 levels, oldest first
ISA_NAMES = {"v2": _BASELINE, "v3": "AVX2", "v4": "AVX-512"}


def built_isas() -> tuple[str, ...]:
    """Return the instruction sets for which kernels were compiled, oldest first."""
    return tuple(isa for isa in ISA_NAMES if util.find_spec(f"dyngs.ops._core_{isa}") is not None)


def choose_isa(built: tuple[str, ...], newest: str, requested: str | None) -> str:
    """Return the instruction set to load.

    ``built``: instruction sets that were compiled, oldest first. ``requested``: value of
    ``DYNGS_ISA``; None where unset. Raises DyngsError: the processor runs none of these, or not the
    requested one.
    """
    usable = [isa for isa in built if isa <= newest]
    if not usable:
        raise DyngsError(
            f"dyngs was compiled for processors with {ISA_NAMES[built[0]]}, which this one lacks; "
            "install it again on this machine, or from a wheel, which has kernels for all"
        )
    if requested is None:
        return usable[-1]
    if requested not in usable:
        raise DyngsError(
            f"DYNGS_ISA={requested}: here run {', '.join(usable)}; unset the variable or choose one of these"
        )
    return requested


def _load_core() -> tuple[ModuleType, str]:
    built = built_isas() or ("v2",)
    try:
        # all but its kernels runs on every processor
        asked = import_module(f"dyngs.ops._core_{built[-1]}")
        isa = choose_isa(built, asked.best_isa(), os.environ.get("DYNGS_ISA"))
        return import_module(f"dyngs.ops._core_{isa}"), isa
    except ImportError as error:
        advice = "install with `pip install .`, and run Python outside the source folder, which hides the installed one"
        raise ImportError(f"the compiled core of dyngs is missing ({error}); {advice}") from error


_CUDA_CORE = "dyngs.ops._core_cuda"

core, _ISA = _load_core()


def has_cuda_core() -> bool:
    """Return whether dyngs was built with its kernels for CUDA GPUs."""
    return util.find_spec(_CUDA_CORE) is not None


@cache
def cuda_core() -> ModuleType:
    """Return the compiled core for CUDA GPUs. Raises DyngsError: it was not built, or cannot be
    loaded."""
    try:
        return import_module(_CUDA_CORE)
    except ImportError as error:
        advice = "install with `pip install . -C cmake.define.DYNGS_CUDA=ON`, which needs nvcc"
        raise DyngsError(f"the kernels for CUDA GPUs are not there ({error}); {advice}") from error


def core_for(x: Tensor) -> ModuleType:
    """Return the compiled core that computes where ``x`` lies; on a GPU it goes on in torch's
    current stream there.

    Raises DyngsError: ``x`` is float64 on a GPU.
    """
    if x.is_cpu:
        return core
    if x.dtype == torch.float64:
        raise DyngsError("float64 is not there on a GPU; use float32")
    module = cuda_core()
    index = x.get_device()
    module.use_queue(index, torch._C._cuda_getCurrentRawStream(index))  # pyright: ignore
    return module


def lend(size: int, device: int) -> Tensor:
    """Return ``size`` bytes of a GPU's memory; called by its core, which gives them back when its
    work is queued."""
    return torch.empty(size, dtype=torch.uint8, device=_gpu(device))


@cache
def _gpu(index: int) -> torch.device:
    return torch.device("cuda", index)


def active_isa() -> str:
    """Return the instruction set of the loaded kernels: ``v2``, ``v3`` (AVX2) or ``v4``
    (AVX-512)."""
    return _ISA


_kernel_threads: ContextVar[int | None] = ContextVar("kernel_threads", default=None)


class _Threads:
    """Threads of OpenMP in a process made by ``os.fork``.

    The child has the parent's list of waiting threads, but not the threads: the next parallel loop
    would wait without end. Where kernels of the parent had started any, the child runs kernels and
    torch's operators on one thread.
    """

    started = False
    lost = False
    warned = False


def _begin_child() -> None:
    """Set the number of threads; called in the child just after the fork."""
    _Threads.lost = _Threads.started
    _Threads.warned = False
    if _Threads.lost:
        torch.set_num_threads(1)


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_begin_child)


def num_threads() -> int:
    """Return the number of threads of the kernels: of ``kernel_threads``, else torch's; 1, with a
    warning, after a fork that lost threads."""
    wanted = _kernel_threads.get() or torch.get_num_threads()
    if not _Threads.lost:
        _Threads.started |= wanted > 1
        return wanted
    if not _Threads.warned and torch.utils.data.get_worker_info() is None:
        _Threads.warned = True
        warnings.warn(
            "dyngs and torch run on one thread: this process was forked from one that had "
            "started threads, which it has not got; start processes with multiprocessing's "
            "'spawn' method to use more",
            RuntimeWarning,
            stacklevel=2,
        )
    return 1


@contextmanager
def kernel_threads(count: int) -> Generator[None]:
    """Run kernels on ``count`` threads and torch's own operators on one inside this context.

    Why: around the kernels torch only does small element-wise work, where its threads cost more
    than they save, most of all on a machine that does other things too; and its sums then do not
    depend on the number of threads.
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
    """Return ``x`` as the kernels take it: C-contiguous, in a DLPack capsule (good for one call).

    A capsule costs 0.5 us where handing over the tensor itself costs 5 us, and a training step
    passes a hundred.
    """
    return to_dlpack(x if x.is_contiguous() else x.detach().contiguous())


def writable(x: Tensor) -> object:
    """Return ``x`` as ``array`` does, for a kernel that writes to it; autograd then counts ``x`` as
    changed.

    Raises DyngsError: ``x`` is not contiguous, so that the kernel would write to a copy.
    """
    if not x.is_contiguous():
        raise DyngsError(
            "a tensor that is updated in place must be contiguous; call .contiguous() first"
        )
    torch.autograd.graph.increment_version(x)
    return to_dlpack(x)


def num_cores() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1
