"""Validation of options, finite tensors and sizes: errors name the argument and its value."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import dyngs
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians.rendering import RenderOptions
from dyngs.ops.native import core
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions, Tally, bin_tiles, rasterize, tally
from dyngs.ops.registration import (
    MAX_SIDE,
    check_finite,
    check_size,
    finite_rows,
)

pytestmark = pytest.mark.usefixtures("one_thread")

WRONG: dict[str, list[Any]] = {
    "eps2d": [-0.1, math.nan, math.inf, "0.3", None],
    "near": [-0.1, math.nan, math.inf, None],
    "far": [-1.0, 0.1, math.nan, None],
    "alpha_min": [-0.1, 1.1, math.nan, None],
    "alpha_max": [-0.1, 1.0, 1 - 1e-9, math.nan],
    "transmittance_min": [-0.1, 1.1, math.nan],
    "radius_clip": [-0.1, math.nan, math.inf],
    "sh_degree": [-1, 5, 1.5, True],
    "mode": ["mip", None, 3],
    "depth": ["metric", None],
    "nonfinite": ["ignore", None],
}
CASES = [
    (kind, name, value)
    for kind in (ProjectionOptions, BlendOptions, RenderOptions)
    for name, values in WRONG.items()
    for value in values
    if name in kind.__dataclass_fields__ and not (name == "sh_degree" and value is None)
]


@pytest.mark.parametrize(("kind", "name", "value"), CASES)
def test_options_out_of_range_are_refused_by_name(kind: type, name: str, value: Any) -> None:
    """NaN used to give an empty image, and an unknown word the last choice."""
    with pytest.raises(DyngsError, match=f"^{name} must "):
        kind(**{name: value})


@pytest.mark.parametrize(
    "options",
    [
        {"near": 0, "far": math.inf, "eps2d": 0, "alpha_min": 0, "transmittance_min": 0},
        {
            "alpha_max": 0.999,
            "sh_degree": 0,
            "mode": "antialiased",
            "depth": "expected",
            "nonfinite": "skip",
        },
    ],
)
def test_range_limits_are_inclusive(options: dict[str, Any]) -> None:
    assert RenderOptions(**options).projection.near >= 0


BAD = [float("nan"), float("inf"), -float("inf")]
DTYPES = [torch.float32, torch.float64]


@settings(max_examples=20, deadline=None)
@given(
    dtype=st.sampled_from(DTYPES),
    places=st.sets(st.tuples(st.integers(0, 49), st.integers(0, 2)), max_size=9),
    bad=st.sampled_from(BAD),
)
def test_nonfinite_elements_and_rows_are_counted(
    dtype: torch.dtype, places: set[tuple[int, int]], bad: float
) -> None:
    x = torch.randn(50, 3, dtype=dtype)
    for row, column in places:
        x[row, column] = bad
    rows = {row for row, _ in places}
    assert torch.nonzero(~finite_rows([x]))[:, 0].tolist() == sorted(rows)
    if not places:
        return check_finite({"means": x})
    with pytest.raises(
        DyngsError, match=rf"^means holds {len(places)} NaN .* in {len(rows)} of 50 rows"
    ):
        check_finite({"fine": torch.zeros(3), "means": x})
    return None


@pytest.mark.parametrize("dtype", DTYPES)
def test_extreme_but_finite_numbers_pass(dtype: torch.dtype) -> None:
    info = torch.finfo(dtype)
    check_finite(
        {
            "x": torch.tensor(
                [info.max, -info.max, info.tiny, info.smallest_normal / 4, 0.0, -0.0], dtype=dtype
            )
        }
    )


def test_rows_are_finite_only_if_they_are_in_every_tensor() -> None:
    one = torch.zeros(3, 2)
    two = torch.zeros(3)
    one[0, 1], two[2] = float("nan"), float("inf")
    assert finite_rows([one, two]).tolist() == [False, True, False]


def veils(count: int = 1) -> Projection:
    """Gaussians that cover any image."""
    return Projection(
        means2d=torch.full((1, count, 2), 32.0),
        depths=torch.ones(1, count),
        factors=torch.tensor([1e-9, 0, 1e-9]).repeat(1, count, 1),
        compensations=torch.ones(1, count),
        radii=torch.full((1, count, 2), 10**9, dtype=torch.int32),
    )


@pytest.mark.parametrize("side", [-1, 0, MAX_SIDE + 1, 10**9, 2**31 - 8, 2**31, 2**63, 10**30])
def test_impossible_image_sizes_are_refused(side: int) -> None:
    """2^31 - 8 + 15 overflows an int; 2^63 does not fit the kernels' arguments."""
    message = f"^render refused: an image of {side}x5 px; its sides can be 1 to 8388608 px$"
    with pytest.raises(DyngsError, match=message):
        check_size(side, 5)
    with pytest.raises(DyngsError, match=message):
        bin_tiles(veils(), torch.ones(1, 1), (side, 5))
    with pytest.raises(DyngsError, match=message):
        tally(veils(), torch.ones(1, 1), (side, 5), Tally.WEIGHTS)
    if side > 0:
        cameras = Cameras(torch.eye(4)[None], torch.eye(3)[None], side, 5)
        with pytest.raises(DyngsError, match=message):
            project(torch.ones(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1), cameras)


def test_image_larger_than_memory_is_refused() -> None:
    side = MAX_SIDE
    with pytest.raises(
        DyngsError,
        match=r"^render refused: .* 8388608x8388608 px have tiles .* GB of memory are available",
    ):
        bin_tiles(veils(), torch.ones(1, 1), (side, side))
    nothing = bin_tiles(veils(), torch.zeros(1, 1), (16, 16))
    with pytest.raises(
        DyngsError,
        match=r"^render refused: 1 image\(s\) .* 3 channels take 1407374.9 GB; .* available",
    ):
        rasterize(veils(), torch.ones(1, 1), torch.ones(1, 1, 3), (side, side), entries=nothing)


def test_too_many_tile_pairs_are_refused_early() -> None:
    """A million Gaussians on 8 million tiles are 8e12 pairs, of which only some are counted."""
    count = 10**6
    with pytest.raises(
        DyngsError, match=r"meet at least \d+ tiles, more than the limit of 2147483647"
    ):
        bin_tiles(veils(count), torch.ones(1, count), (2**14, 2**17))


# --- what the system says
# ---------------------------------------------------------------------------------------------


def system(folder: Path, files: dict[str, str]) -> str:
    files = {"proc/meminfo": "MemTotal: 9 kB\nMemAvailable:    8000000 kB\n"} | files
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return str(folder)


def test_memory_of_the_machine(tmp_path: Path) -> None:
    assert core.available_memory(system(tmp_path, {})) == 8_192_000_000


def test_smallest_cgroup_limit_applies(tmp_path: Path) -> None:
    """The page cache, which the kernel can drop, counts as free memory."""
    group = "sys/fs/cgroup/user.slice"
    files = {
        "proc/self/cgroup": "1:name=systemd:/x\n0::/user.slice/app\n",
        f"{group}/memory.max": "3000000000\n",
        f"{group}/memory.current": "2000000000\n",
        f"{group}/memory.stat": "anon 1\ninactive_file 500000000\n",
        f"{group}/app/memory.max": "max\n",
    }
    assert core.available_memory(system(tmp_path, files)) == 1_500_000_000


# --- in a process with little memory
# ----------------------------------------------------------------------------------

CHILD = """
import resource, torch
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.ops.native import core
from dyngs.gaussians.rendering import render

def draw(count, side):
    means = torch.tensor([[0.0, 0, 3]]).repeat(count, 1).requires_grad_()
    veils = Gaussians(means, torch.ones(count, 4), torch.full((count, 3), 9.0), torch.full((count,), 9.0),
                      torch.zeros(count, 1, 3))
    intrinsics = torch.tensor([[[30.0, 0, side / 2], [0, 30, side / 2], [0, 0, 1]]])
    return render(veils, Cameras(torch.eye(4)[None], intrinsics, side, side)).rgb.sum()

def refusal(megabytes, act):
    pages, hard = int(open("/proc/self/statm").read().split()[0]), resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + megabytes * 10**6, hard))
    try:
        act()
    except DyngsError as error:
        print(error)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))

torch.set_num_threads(2)
drawn = draw(300, 2048)
refusal(1000, lambda: draw(2000, 4096))
refusal(500, lambda: draw(1, 8192))
refusal(100, drawn.backward)
x, params = torch.zeros(9216, 1), torch.zeros(3 * 2**19 + 1)
refusal(150, lambda: core.perceptron_forward(x, params, torch.zeros(9216, 1), None, [1, 2**19, 1], 0, 2))
print(float(draw(3, 64)))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_AS")
def test_render_beyond_memory_is_refused() -> None:
    """Pairs, an image, gradients and scratch memory of threads. Smaller renders work afterwards."""
    path = os.pathsep.join([str(Path(dyngs.__file__).parents[1]), *(p for p in sys.path if p)])
    environment = os.environ | {"PYTHONPATH": path}
    run = subprocess.run(
        [sys.executable, "-c", CHILD], env=environment, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr[-2000:]
    pairs, image, gradients, scratch, drawn = run.stdout.splitlines()
    left, remedy = (
        r"\d\.\d\d?\d? GB of memory are available",
        "lower the resolution, the scales or the number of views",
    )
    assert re.fullmatch(
        r"render refused: 2000 Gaussians in 1 view\(s\) of 4096x4096 px meet 131072000 tiles, "
        rf"whose lists take 2\.6 GB; {left}; {remedy}",
        pairs,
    )
    assert re.fullmatch(
        rf"render refused: 1 image\(s\) of 8192x8192 px with 3 channels take 1\.3 GB; {left}; {remedy}",
        image,
    )
    assert re.fullmatch(
        rf"render refused: the gradients of 4915200 \(Gaussian, tile\) pairs take 0\.2 GB; {left}; {remedy}",
        gradients,
    )
    assert re.fullmatch(r"out of memory: \d\.\d* GB are available; ask for less at once", scratch)
    assert float(drawn) > 0
