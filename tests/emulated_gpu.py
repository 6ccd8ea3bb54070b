"""The core for CUDA GPUs, compiled over the emulation of csrc/tests, so that a CPU runs its whole Python path."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from importlib import util
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import Tensor

from dyngs.ops import native

ROOT = Path(__file__).resolve().parents[1]
KERNELS = tuple(sorted((ROOT / "csrc/cuda").glob("*.cu")))
BINDINGS = tuple(sorted((ROOT / "csrc/bind").glob("bind_*.cpp")))
NAME = "_core_emulated"


def compiler() -> str:
    """The C++ compiler; skips the test where there is none."""
    found = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if found is None:
        pytest.skip("no C++ compiler here")
    return found


def compiled(folder: Path, sources: Iterable[Path], flags: Iterable[str], common: Iterable[str] = ()) -> list[str]:
    """Object files of ``sources`` in ``folder``, each compiled unless it is there.

    Args:
        folder: that exists; of these sources and flags alone.
        sources: C++, also with the endings of CUDA.
        flags: of the compiler.
        common: headers below csrc that most of them include; they are read once for all.
    """
    command = [compiler(), "-std=gnu++20", "-fPIC", "-w", f"-I{ROOT / 'csrc'}", *flags]
    headers = folder / "common.hpp"
    headers.write_text("".join(f'#include "{name}"\n' for name in common), encoding="utf-8")
    if common and not (folder / "common.hpp.gch").exists():
        own = ["-x", "c++-header", str(headers), "-o", f"{headers}.gch"]
        subprocess.run([*command, *own], check=True, timeout=500)
    command += ["-include", str(headers), "-x", "c++", "-c"]

    def compile_one(source: Path) -> str:
        target = folder / f"{source.name}.o"
        if not target.exists():
            subprocess.run([*command, str(source), "-o", f"{target}.part"], check=True, timeout=500)
            os.replace(f"{target}.part", target)
        return str(target)

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(compile_one, sources))


def emulated_kernels(base: Path) -> list[str]:
    """Object files of csrc/cuda for the emulation, compiled once for all processes of a test session.

    Args:
        base: folder of the session.
    """
    folder = base / "emulated_kernels"
    folder.mkdir(exist_ok=True)
    with open(folder / "lock", "w", encoding="utf-8") as lock:
        if sys.platform != "win32":
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX)
        # nothing contracted, as in CMakeLists.txt
        return compiled(folder, KERNELS, ["-O1", "-ffp-contract=off"], ("cuda/device.hpp", "cuda/sort.hpp"))


def session_folder(factory: pytest.TempPathFactory) -> Path:
    """The folder that all processes of a test session share."""
    base = factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


def build_module(base: Path, folder: Path) -> ModuleType:
    """The module, compiled in ``folder``; skips the test where nanobind or Python's headers are missing."""
    nanobind = pytest.importorskip("nanobind")
    python = Path(sysconfig.get_paths()["include"])
    if not (python / "Python.h").is_file():
        pytest.skip("Python's headers are not here")
    sources = Path(nanobind.source_dir())
    includes = (nanobind.include_dir(), sources / "../ext/robin_map/include", python)
    names = {"DYNGS_GPU": 1, "DYNGS_EMULATED": 1, "DYNGS_MODULE": NAME, "NB_DOMAIN": "dyngs_emulated"}
    flags = ["-O0", "-fvisibility=hidden", *(f"-I{x}" for x in includes), *(f"-D{k}={v}" for k, v in names.items())]
    own = [*sorted((ROOT / "csrc/bind_cuda").glob("*.cpp")), *BINDINGS, ROOT / "csrc/cpu/memory.cpp"]
    objects = compiled(folder, [*own, sources / "nb_combined.cpp"], flags)
    library = folder / f"{NAME}.so"
    subprocess.run([compiler(), "-shared", *objects, *emulated_kernels(base), "-o", str(library)], check=True)
    spec = util.spec_from_file_location(NAME, library)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def on_emulated_gpu(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> None:
    """Make ops of CPU tensors run on the emulated GPU: kernels see only memory that an op has handed to them."""
    to_dlpack: Callable[[Tensor], object] = native.to_dlpack

    def noted(x: Tensor) -> object:
        module.note_memory(x.data_ptr(), x.numel() * x.element_size(), x.element_size())
        return to_dlpack(x)

    def lend(size: int, _: int) -> Tensor:
        return torch.full((size,), 0xFF, dtype=torch.uint8)  # NaN wherever it is read

    monkeypatch.setattr(native, "core", module)
    monkeypatch.setattr(native, "to_dlpack", noted)
    monkeypatch.setattr(native, "lend", lend)
