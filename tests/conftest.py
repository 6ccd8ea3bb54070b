"""Fixtures of the rasterizer's tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module

import pytest
import torch
from scenes import Scene, random_scene

from dyngs.ops.native import core

OPS_WITH_A_CORE = ("projection", "harmonics", "rasterization", "finite", "offsets", "shading")


@pytest.fixture(autouse=True)
def empty_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test runs in an empty folder, as a user would: nothing is left in the checkout, and processes that a test
    starts import the installed package, not the sources beside them."""
    monkeypatch.chdir(tmp_path_factory.mktemp("empty"))


@pytest.fixture
def scene() -> Scene:
    """20 Gaussians, 2 views, 37x29 px, float64."""
    return random_scene()


@pytest.fixture(params=["v2", "v3", "v4"])
def isa(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The rasterizer runs on the kernels of this instruction set."""
    if request.param > core.best_isa():
        pytest.skip(f"this processor has no {request.param}")
    module = import_module(f"dyngs.ops._core_{request.param}")
    for name in OPS_WITH_A_CORE:
        monkeypatch.setattr(f"dyngs.ops.{name}.core", module)
    return request.param


@pytest.fixture
def one_thread(set_threads: Callable[[int], None]) -> None:
    """For tests of tiny pictures, where waking threads would take most of the time, above all on a busy machine."""
    set_threads(1)


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """``torch.set_num_threads``, undone afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)
