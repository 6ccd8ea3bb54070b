"""The CUDA core compiled for the emulated GPU of csrc/tests, so that CPUs run its Python path."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import util
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import pytest
import torch
from torch import Tensor

from dyngs.ops import native

ROOT = Path(__file__).resolve().parents[1]
KERNELS = tuple(sorted((ROOT / "csrc/cuda").glob("*.cu")))
BINDINGS = tuple(sorted((ROOT / "csrc/bind").glob("bind_*.cpp")))
NAME = "_core_emulated"
OWN_NAME = re.compile(
    r"^struct (?:alignas\(\d+\) )?(\w+)|\b(k[A-Z]\w*) = |^(?:__device__|constexpr|DYNGS_HD|inline) [^=]*?(\w+)\(",
    re.M,
)
"""Constants, structures and functions of one source, as they are defined in csrc."""


def compiler() -> str:
    """The C++ compiler, preferably Clang, which is faster. Skips the test if there is none."""
    found = shutil.which("clang++") or shutil.which("c++") or shutil.which("g++")
    if found is None:
        pytest.skip("no C++ compiler here")
    return found


def compiled(folder: Path, sources: Iterable[Path], flags: Iterable[str]) -> list[str]:
    """Object files of C++ sources."""
    command = [compiler(), "-std=gnu++20", "-fPIC", "-w", "-O0", f"-I{ROOT / 'csrc'}", *flags]

    def compile_one(source: Path) -> str:
        target = str(folder / f"{source.name}.o")
        subprocess.run([*command, "-c", str(source), "-o", target], check=True, timeout=500)
        return target

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(compile_one, sources))


def as_one(file: Path, sources: Iterable[Path]) -> Path:
    """One source that includes the others, so that shared headers are compiled once.

    Headers come first, so that names local to one source can be made unique.
    """
    texts = {source: source.read_text(encoding="utf-8") for source in sources}
    lines = dict.fromkeys(
        line
        for text in texts.values()
        for line in text.splitlines()
        if line.startswith('#include "')
    )
    parts = [*lines]
    for source, text in texts.items():
        names = sorted({name for found in OWN_NAME.findall(text) for name in found if name})
        own = [f"#define {name} {name}_{source.stem}" for name in names]
        parts += [*own, f'#include "{source}"', *(f"#undef {name}" for name in names)]
    file.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return file


def digest_of_all(folders: Iterable[Path]) -> str:
    """A digest of the sources, this file, the compiler and the Python version."""
    found = hashlib.sha256()
    below = (
        x
        for folder in folders
        for x in sorted(folder.rglob("*"))
        if x.is_file() and x.suffix != ".pyc"
    )
    version = subprocess.run([compiler(), "--version"], capture_output=True, check=True).stdout
    for text in (
        sys.version.encode(),
        version,
        *(x.read_bytes() for x in (Path(__file__), *below)),
    ):
        found.update(len(text).to_bytes(8, "little") + text)
    return found.hexdigest()[:20]


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """A lock that excludes other processes."""
    with open(folder / "lock", "w", encoding="utf-8") as lock:
        if sys.platform != "win32":
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def build_module(cache: Path) -> ModuleType:
    """The module, compiled unless ``cache`` holds one of the same sources.

    Skips the test if nanobind or the Python headers are missing.
    """
    nanobind = pytest.importorskip("nanobind")
    python = Path(sysconfig.get_paths()["include"])
    if not (python / "Python.h").is_file():
        pytest.skip("Python's headers are not here")
    sources = Path(nanobind.source_dir())
    includes = (nanobind.include_dir(), sources / "../ext/robin_map/include", python)
    names = {
        "DYNGS_GPU": 1,
        "DYNGS_EMULATED": 1,
        "DYNGS_MODULE": NAME,
        "NB_DOMAIN": "dyngs_emulated",
    }
    flags = [
        "-fvisibility=hidden",
        "-ffp-contract=off",
        *(f"-I{x}" for x in includes),
        *(f"-D{k}={v}" for k, v in names.items()),
    ]
    own = [
        *sorted((ROOT / "csrc/bind_cuda").glob("*.cpp")),
        *BINDINGS,
        ROOT / "csrc/cpu/memory.cpp",
    ]
    library = cache / f"{digest_of_all([ROOT / 'csrc', Path(nanobind.__file__).parent])}.so"
    with alone_in(cache):
        if library.exists():
            return loaded(library)
        for old in cache.glob("*.so"):
            old.unlink()
        with TemporaryDirectory(dir=cache) as work:
            bindings, kernels = (
                as_one(Path(work) / f"{name}.cpp", x)
                for name, x in (("bind", own), ("cuda", KERNELS))
            )
            objects = compiled(Path(work), [bindings, kernels, sources / "nb_combined.cpp"], flags)
            linked = Path(work) / library.name
            subprocess.run([compiler(), "-shared", *objects, "-o", str(linked)], check=True)
            os.replace(linked, library)
        return loaded(library)


def loaded(library: Path) -> ModuleType:
    """The module loaded from a file."""
    spec = util.spec_from_file_location(NAME, library)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def on_emulated_gpu(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> None:
    """Run ops of CPU tensors on the emulated GPU, whose kernels only access memory passed to them."""
    to_dlpack: Callable[[Tensor], object] = native.to_dlpack

    def noted(x: Tensor) -> object:
        module.note_memory(x.data_ptr(), x.numel() * x.element_size(), x.element_size())
        return to_dlpack(x)

    def lend(size: int, _: int) -> Tensor:
        return torch.full((size,), 0xFF, dtype=torch.uint8)  # NaN wherever it is read

    monkeypatch.setattr(native, "core", module)
    monkeypatch.setattr(native, "to_dlpack", noted)
    monkeypatch.setattr(native, "lend", lend)
