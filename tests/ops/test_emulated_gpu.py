"""Every op on the emulated GPU compared with the CPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from types import ModuleType

import pytest
import torch
from emulated_gpu import build_module, on_emulated_gpu
from op_cases import CASES, ON_GPU
from scenes import random_scene
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import render
from dyngs.ops import native
from dyngs.ops.perceptron import GPU_LAYERS, GPU_WIDTH, perceptron_op

pytestmark = pytest.mark.usefixtures("one_thread")

Made = list[Tensor]


@pytest.fixture(scope="module")
def module(request: pytest.FixtureRequest) -> ModuleType:
    return build_module(request.config.cache.mkdir("emulated_gpu"))


@pytest.fixture
def gpu(module: ModuleType) -> Callable[[], object]:
    """A context in which ops run on the emulated GPU."""

    @contextmanager
    def use() -> Iterator[ModuleType]:
        with pytest.MonkeyPatch.context() as patch:
            on_emulated_gpu(patch, module)
            yield module

    return use


def computed(name: str, count: int = 60) -> list[Tensor]:
    return CASES[name](count, torch.float32).results()


@pytest.mark.parametrize("name", ON_GPU)
def test_emulated_gpu_equals_cpu(gpu: Callable, name: str) -> None:
    """Values and gradients, to float32: sums of some hundred numbers in another order."""
    expected = computed(name)
    with gpu():
        found = computed(name)
        again = computed(name)
    for a, b, c in zip(found, expected, again, strict=True):
        assert a.dtype == b.dtype
        scale = float(b.abs().nan_to_num().max()) if b.is_floating_point() else 1.0
        atol = 2e-5 * max(scale, 1e-6)
        torch.testing.assert_close(a, b, rtol=1e-4, atol=atol, equal_nan=True)
        assert torch.equal(a.nan_to_num(), c.nan_to_num()), "other bytes when repeated"


def test_only_the_number_of_tile_entries_is_read_back(gpu: Callable) -> None:
    for name in ON_GPU:
        with gpu() as module:
            before = module.host_reads()
            computed(name)
            reads = module.host_reads() - before
        assert reads == {"render": 1, "tally": 3}.get(name, 0), name


def test_recycled_memory_counts_as_new_arrays(
    gpu: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Torch recycles memory of freed arrays; the emulation must not attribute it to them."""
    pool = torch.zeros(1 << 20, dtype=torch.uint8)
    with gpu() as module:
        monkeypatch.setattr(native, "lend", lambda size, _: pool[:size])
        expected = computed("planes")
        for byte in range(8, 512, 8):
            module.note_memory(pool.data_ptr() + byte, 8, 8)
        for a, b in zip(computed("planes"), expected, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_scenes_without_gaussians_and_images_without_splats(gpu: Callable) -> None:
    tensors = CASES["render"](12, torch.float32).inputs[:5]
    nothing = Gaussians(*(x.detach()[:0] for x in tensors))
    behind = Gaussians(*(x.detach() for x in tensors))
    behind = behind.replace(means=behind.means - torch.tensor([0.0, 0, 1000]))
    cameras = random_scene().to(torch.float32).cameras
    for gaussians in (nothing, behind):
        expected = render(gaussians, cameras)
        with gpu():
            found = render(gaussians, cameras)
        assert torch.equal(found.rgb, expected.rgb)
        assert torch.equal(found.alpha, torch.zeros_like(found.alpha))


def test_the_limits_of_networks_are_those_of_the_kernel(gpu: Callable) -> None:
    def run(*widths: int) -> Tensor:
        params = torch.zeros(sum((a + 1) * b for a, b in pairwise(widths)))
        return perceptron_op(torch.ones(1, widths[0]), params, list(widths), 0, False)[0]

    with gpu():
        assert run(2, GPU_WIDTH, GPU_WIDTH, 1).tolist() == [[0.0]]
        assert run(*[1] * (GPU_LAYERS + 1)).tolist() == [[0.0]]
        for widths in ([2, GPU_WIDTH + 1, 1], [GPU_WIDTH + 1, 1], [1] * (GPU_LAYERS + 2)):
            with pytest.raises(DyngsError, match="up to 16 layers of up to 256 features"):
                run(*widths)


def test_arrays_of_the_wrong_size_are_refused(gpu: Callable) -> None:
    with gpu() as module, pytest.raises(ValueError, match="count has 2 elements, expected 1"):
        module.count_nonfinite(
            native.array(torch.zeros(3)),
            native.array(torch.zeros(2, dtype=torch.int32)),
            native.num_threads(),
        )


def test_boundary_weights_are_refused(gpu: Callable) -> None:
    with gpu(), pytest.raises(DyngsError, match="boundary weights run on the CPU only"):
        computed("boundaries")
