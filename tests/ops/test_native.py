"""Selection of the compiled kernels, thread counts, and the C++ unit tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib import util
from pathlib import Path
from types import ModuleType

import pytest
import torch

from dyngs.core.errors import DyngsError
from dyngs.ops import native
from dyngs.ops.native import (
    choose_isa,
    core,
    kernel_threads,
    num_threads,
)

ROOT = Path(__file__).parents[2]


def imported_with(isa: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """A second ``dyngs.ops.native``, imported as in a new process."""
    monkeypatch.setenv("DYNGS_ISA", isa)
    monkeypatch.setattr(os, "register_at_fork", lambda **_: None)
    spec = util.spec_from_file_location("native_again", native.__file__)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("built", "newest", "requested", "chosen"),
    [
        (("v2", "v3", "v4"), "v4", None, "v4"),
        (("v2", "v3", "v4"), "v3", None, "v3"),
        (("v2", "v3", "v4"), "v4", "v2", "v2"),
        (("v3",), "v4", None, "v3"),
        (("v4",), "v4", "v4", "v4"),
    ],
)
def test_newest_supported_instruction_set_is_chosen(
    built: tuple[str, ...], newest: str, requested: str | None, chosen: str
) -> None:
    assert choose_isa(built, newest, requested) == chosen


@pytest.mark.parametrize(
    ("built", "newest", "requested", "message"),
    [
        (
            ("v4",),
            "v3",
            None,
            "dyngs was compiled for processors with AVX-512, which this one lacks; reinstall it",
        ),
        (
            ("v3", "v4"),
            "v2",
            "v2",
            "dyngs was compiled for processors with AVX2, which this one lacks",
        ),
        (
            ("v2", "v3", "v4"),
            "v3",
            "v4",
            "DYNGS_ISA=v4 is not supported here; unset it or use v2, v3",
        ),
        (("v4",), "v4", "v2", "DYNGS_ISA=v2 is not supported here; unset it or use v4"),
    ],
)
def test_kernels_that_would_crash_are_refused(
    built: tuple[str, ...], newest: str, requested: str | None, message: str
) -> None:
    with pytest.raises(DyngsError, match=f"^{re.escape(message)}"):
        choose_isa(built, newest, requested)


def test_an_unknown_instruction_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DyngsError, match=r"^DYNGS_ISA=v9 is not supported here; unset it or use v"):
        imported_with("v9", monkeypatch)


def test_thread_counts_are_restored_after_an_error() -> None:
    before = torch.get_num_threads()
    with pytest.raises(RuntimeError), kernel_threads(3):
        raise RuntimeError
    assert (num_threads(), torch.get_num_threads()) == (before, before)


def test_arrays_of_the_wrong_size_are_refused_before_they_are_read() -> None:
    means = torch.zeros(4, 3)
    quats = torch.zeros(4, 4)
    scales = torch.zeros(3, 3)
    opacities = torch.zeros(4)
    arrays = core.GaussianArraysF32(
        means, quats, scales, opacities, torch.zeros(1, 4, 4), torch.zeros(1, 3, 3)
    )
    sizes = core.ProjectSettings(8, 8, 0.3, 0.2, 1e10, 0.0, 0.0, False, 1)
    outputs = (torch.zeros(1, 4, 2), torch.zeros(1, 4), torch.zeros(1, 4, 3), torch.zeros(1, 4))
    with pytest.raises(ValueError, match="scales has 9 elements, expected 12"):
        core.project_forward(arrays, sizes, *outputs, torch.zeros(1, 4, 2, dtype=torch.int32))


def test_strided_arrays_are_refused() -> None:
    means = torch.zeros(4, 3)
    quats = torch.zeros(4, 4)
    scales = torch.zeros(4, 3)
    opacities = torch.zeros(4)
    with pytest.raises(TypeError):
        core.GaussianArraysF32(
            means.T.contiguous().T,
            quats,
            scales,
            opacities,
            torch.zeros(1, 4, 4),
            torch.zeros(1, 3, 3),
        )


def test_formulas_link_only_libm() -> None:
    allowed = {"cmath", "cstdint", "limits", "type_traits", "utility"}
    headers = sorted((ROOT / "csrc/math").glob("*.hpp"))
    assert headers
    for header in headers:
        text = header.read_text(encoding="utf-8")
        assert set(re.findall(r"#include <(\S+)>", text)) <= allowed, header.name
        assert all(f.startswith("math/") for f in re.findall(r'#include "(\S+)"', text)), (
            header.name
        )
        assert not re.findall(r"\bnew\b *[\w(\[]|malloc|vector_size|#pragma omp", text), header.name


# --- after a fork
# -------------------------------------------------------------------------------------------------

FORKED = """
import os, signal, sys, warnings
import torch
from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.ops.native import kernel_threads, num_threads
from dyngs.gaussians.rendering import render

def draw(count):
    fields = torch.zeros(count, 3) + torch.tensor([0.0, 0, 3]), torch.ones(count, 4), torch.full((count, 3), -2.0)
    gaussians = Gaussians(*fields, torch.zeros(count), torch.zeros(count, 1, 3))
    intrinsics = torch.tensor([[[200.0, 0, 100], [0, 200, 100], [0, 0, 1]]])
    return render(gaussians, Cameras(torch.eye(4)[None], intrinsics, 200, 200)).rgb

def fork(before):
    child = os.fork()
    if child == 0:
        signal.alarm(100)  # ends a child that hangs
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            after = draw(5000)
            with kernel_threads(4):
                again = draw(5000)
                threads = num_threads()
        same = torch.equal(after, again) and (before is None or torch.equal(before, after))
        print(same, torch.get_num_threads(), threads, *[w.message for w in caught], flush=True)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code:
        sys.exit(code)

fork(None)
fork(draw(5000))
fork(draw(5000))
"""


def drawn_after_forks(threads: int) -> list[str]:
    """Warnings after forking a single-threaded process, and after two forks of one with threads."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
        "OMP_NUM_THREADS": str(threads),
    }
    # Python looks in the working directory first: there is the package under test.
    package_parent = Path(native.__file__).parents[2]
    run = subprocess.run(
        [sys.executable, "-c", FORKED],
        cwd=package_parent,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr[-2000:]
    return run.stdout.splitlines()


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_fork_of_process_with_threads_uses_one_thread_and_warns() -> None:
    """Kernels used to wait forever for threads that exist only in the parent. A second fork is
    also tested, since the first one ends the threads of OpenBLAS.
    """
    told = (
        "True 1 1 dyngs and torch use one thread: this process was forked from a process with "
        "threads; use multiprocessing's 'spawn' start method for more threads"
    )
    assert drawn_after_forks(2) == ["True 2 4", told, told]


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_forked_single_threaded_process_may_use_threads() -> None:
    assert drawn_after_forks(1) == ["True 1 4"] * 3
