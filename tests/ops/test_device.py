"""Choice of the device, and the message for a GPU that is not usable."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import dyngs
from dyngs.core.errors import DyngsError
from dyngs.ops import device
from dyngs.ops.device import (
    AsyncReadback,
    cpu_fallback_reason,
    deterministic,
    gpu_status,
    gpu_unavailable_reason,
    select_device,
)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """A machine with a usable GPU; each test removes one requirement."""
    gpu_unavailable_reason.cache_clear()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (10**9, 8 * 10**9))
    monkeypatch.setattr(device, "has_cuda_core", lambda: True)
    monkeypatch.setattr(device, "has_nvidia_driver", lambda: True)
    core = SimpleNamespace(runtime_version=lambda: 13000, driver_version=lambda: 13020)
    monkeypatch.setattr(device, "cuda_core", lambda: core)
    yield monkeypatch
    gpu_unavailable_reason.cache_clear()


def refused() -> str:
    with pytest.raises(DyngsError) as caught:
        select_device("cuda")
    line = str(caught.value)
    assert "\n" not in line
    assert select_device("auto") == select_device("cpu") == torch.device("cpu")
    return line


def test_usable_gpu_is_chosen(machine: pytest.MonkeyPatch) -> None:
    assert select_device("auto") == select_device("cuda") == torch.device("cuda:0")
    assert select_device("cpu") == torch.device("cpu")
    assert cpu_fallback_reason("auto") is None
    assert gpu_status() == {
        "torch for": "CUDA 13.0",
        "kernels for GPUs": "built",
        "driver": "found",
        "GPU": "GPU, 8 GB",
    }


def test_cpu_only_torch_is_reported(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.version, "cuda", None)
    assert re.search(
        r"device cuda is not usable: this torch \(.*\) is built without CUDA: install a torch for CUDA",
        refused(),
    )
    assert gpu_status()["GPU"] == "none"


def test_missing_kernels_are_reported(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(device, "has_cuda_core", lambda: False)
    assert (
        "built without its kernels for GPUs: install dyngs with `pip install . -C cmake.define"
        in refused()
    )
    assert gpu_status()["kernels for GPUs"] == "not built"


def test_unloadable_kernels_are_reported(machine: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise DyngsError("the kernels for CUDA GPUs are not there (broken); install them")

    machine.setattr(device, "cuda_core", fail)
    assert "(broken)" in refused()


def test_too_old_driver_is_reported(machine: pytest.MonkeyPatch) -> None:
    core = SimpleNamespace(runtime_version=lambda: 13000, driver_version=lambda: 12040)
    machine.setattr(device, "cuda_core", lambda: core)
    assert (
        "need CUDA 13.0, but the driver supports only 12.4: update the driver, or build"
        in refused()
    )


def test_too_old_gpu_is_reported(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.cuda, "get_device_capability", lambda: (7, 0))
    assert re.search(r"GPU is older than compute capability 7\.5", refused())


def test_auto_explains_cpu_only_with_a_driver(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(device, "has_cuda_core", lambda: False)
    line = cpu_fallback_reason("auto")
    assert line is not None
    assert line.startswith("training on the CPU: dyngs was built without")
    assert cpu_fallback_reason("cpu") is None
    machine.setattr(device, "has_nvidia_driver", lambda: False)
    assert cpu_fallback_reason("auto") is None


def test_other_choices_are_refused() -> None:
    with pytest.raises(DyngsError, match="device must be one of auto, cpu, cuda"):
        select_device("tpu")


def test_torch_is_deterministic_on_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only on a GPU, only inside the context, and only if requested."""
    told: list[tuple[bool, bool]] = []
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    monkeypatch.setattr(
        torch,
        "use_deterministic_algorithms",
        lambda mode, warn_only: told.append((mode, warn_only)),
    )
    for name, wanted in (("cpu", True), ("cuda", False)):
        with deterministic(torch.device(name), wanted):
            assert told == []
    assert "CUBLAS_WORKSPACE_CONFIG" not in os.environ
    filled = torch.utils.deterministic.fill_uninitialized_memory
    with deterministic(torch.device("cuda")):
        assert told == [(True, True)]
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
        assert not torch.utils.deterministic.fill_uninitialized_memory
    assert told[1:] == [(False, False)]
    assert torch.utils.deterministic.fill_uninitialized_memory == filled


# In a process of its own, as the setting cannot be taken back.
PROGRAM = """
import resource
import torch
from dyngs.ops.device import keep_freed_memory

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
    output = subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment
    ).stdout
    before, taken, after = output.split()
    assert taken == "True"
    assert int(after) < int(before) / 10


def test_readback_is_a_snapshot() -> None:
    x = torch.tensor([1.0, 2.5], requires_grad=True)
    read = AsyncReadback(x)
    with torch.no_grad():
        x.zero_()
    assert read.numbers().tolist() == [1.0, 2.5]
