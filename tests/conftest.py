"""How the tests draw their examples, and fixtures that several folders of tests share.

Examples of property tests are fixed by default (profile ``ci``): a run passes or fails whoever
starts it. The profile ``random`` draws as many at random, ``long`` ten times as many; they say how
to draw a failing one again::

    HYPOTHESIS_PROFILE=random pytest -m hypothesis --hypothesis-seed=3
    HYPOTHESIS_PROFILE=long pytest tests/ops

What it finds becomes an ``@example`` of its test.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

# `python -m pytest` searches the working directory first; its core may not be compiled
if os.getcwd() in sys.path and not [*Path("dyngs/ops").glob("_core_*")]:
    sys.path.remove(os.getcwd())

if "PYTEST_XDIST_WORKER" in os.environ:
    # `pytest -n 2`: processes share the cores, their threads would fight for them
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    # Commands and runs that name no number of threads take all cores; where these wait for work
    # they must not spin.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from itertools import count as numbers

import pytest
import torch
from hypothesis import settings
from scenes import Scene, random_scene
from smpl_like import write_smpl_like
from tiny_captures import random_pixels, write_colmap, write_frames, write_image
from tiny_fields import write_tiny_capture

from dyngs.cli.output import print_messages
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.human.fit import fitted_capture
from dyngs.human.fit.capture_fit import FitEffort
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.ops.native import built_isas, core

SHARED = Path(__file__).parents[1] / "../shared/data"

LONGEST = (
    "test_emulated_gpu.py",
    "test_fuzz.py",
    "test_quality.py",
    "test_pretend_gpu.py",
    "test_train.py",
    "test_following.py",
    "test_docs.py",
    "test_choose.py",
    "test_captures.py",
)
"""Test files in the order of the processor time that they take."""
FEW, MANY = 100, 1000  # examples of a test that does not say how many
# No deadlines: whether a busy machine is slow says nothing about what is tested.
settings.register_profile("ci", derandomize=True, max_examples=FEW, deadline=None)
settings.register_profile(
    "random", derandomize=False, max_examples=FEW, print_blob=True, deadline=None
)
settings.register_profile(
    "long", derandomize=False, max_examples=MANY, print_blob=True, deadline=None
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest modules: in the end no process waits for another one.

    Tests that say how many examples they need in ``ci`` draw more by the same factor in ``long``.
    """
    items.sort(
        key=lambda item: (
            LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST)
        )
    )
    factor = settings.default.max_examples // FEW
    for test in {
        id(item.obj): item.obj for item in items if isinstance(item, pytest.Function)
    }.values():
        # hypothesis has no public way to reach these
        own = getattr(test, "_hypothesis_internal_use_settings", None)
        if factor > 1 and own is not None and own.max_examples < settings.default.max_examples:
            test._hypothesis_internal_use_settings = settings(
                own, max_examples=factor * own.max_examples
            )


def pytest_collection() -> None:
    """Modules and tests are no garbage: to look for it among them takes a third of the
    collection."""
    gc.disable()


def pytest_collection_finish() -> None:
    """From here on garbage is looked for, among what tests make, and less often than usual, which
    takes a twentieth."""
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


def pytest_sessionfinish() -> None:
    """Compiled modules complain of what is left at the exit."""
    gc.unfreeze()


@pytest.fixture(scope="session")
def numbered_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Empty folders. (Each numbered folder of pytest lists all before it: a minute, for those of
    all tests.)"""
    base = tmp_path_factory.mktemp("tests")

    def made(number: int) -> Path:
        folder = base / f"t{number}"
        folder.mkdir()
        return folder

    return map(made, numbers())


@pytest.fixture
def tmp_path(numbered_folders: Iterator[Path]) -> Path:
    """A folder of this test alone."""
    return next(numbered_folders)


@pytest.fixture(autouse=True)
def empty_folder(numbered_folders: Iterator[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Every test runs in an empty folder, as a user would: nothing is left in the checkout, and
    processes that a test starts import the installed package, not the sources beside them. The
    user's cache is another empty folder."""
    monkeypatch.chdir(next(numbered_folders))
    monkeypatch.setenv("DYNGS_CACHE_DIR", str(next(numbered_folders)))


@pytest.fixture(autouse=True)
def printed_messages() -> None:
    """Messages of the package are printed, as by the command line."""
    print_messages()


@pytest.fixture(autouse=True)
def same_numbers() -> None:
    """What a test draws without a generator of its own does not depend on the tests before it.

    Of the CPU alone: ``torch.manual_seed`` keeps a stack of calls for each kind of device that is
    not here, each time.
    """
    torch.default_generator.manual_seed(0)


@pytest.fixture
def scene() -> Scene:
    """20 Gaussians, 2 views, 37x29 px, float64."""
    return random_scene()


@pytest.fixture(params=["v2", "v3", "v4"])
def isa(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The ops run on the kernels of this instruction set."""
    if request.param not in built_isas() or request.param > core.best_isa():
        pytest.skip(f"{request.param} is not compiled, or not of this processor")
    module = import_module(f"dyngs.ops._core_{request.param}")
    monkeypatch.setattr("dyngs.ops.native.core", module)
    return request.param


@pytest.fixture
def one_thread(set_threads: Callable[[int], None]) -> None:
    """For tests of tiny images, where waking threads would take most of the time, above all on a
    busy machine."""
    set_threads(1)


@pytest.fixture
def set_threads() -> Iterator[Callable[[int], None]]:
    """``torch.set_num_threads``, undone afterwards."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four images of 16 px; nothing moves."""
    folder = tmp_path_factory.mktemp("capture")
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


@pytest.fixture(scope="session")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Something moves."""
    return write_tiny_capture(tmp_path_factory.mktemp("capture"))


@pytest.fixture(scope="session")
def person(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three cameras, three frames of 32 px."""
    folder = tmp_path_factory.mktemp("capture") / "person"
    return write_human_capture(
        folder, HumanOptions(size=32, num_frames=3, num_pose_frames=2, num_cameras=3, num_test=1)
    )


@pytest.fixture
def blender_root(tmp_path: Path) -> Path:
    """16 train and 2 test RGBA images of 12x8."""
    for split, count in (("train", 16), ("test", 2)):
        names = [f"./{split}/r_{i}" for i in range(count)]
        for i, name in enumerate(names):
            write_image(tmp_path / f"{name}.png", random_pixels(8, 12, 4, seed=i))
        write_frames(tmp_path / f"transforms_{split}.json", names, {"camera_angle_x": 0.7})
    return tmp_path


@pytest.fixture
def nerfstudio_root(tmp_path: Path) -> Path:
    """10 JPEG images of 12x8 with OPENCV distortion."""
    names = [f"images/{i:02d}.jpg" for i in range(10)]
    for i, name in enumerate(names):
        write_image(tmp_path / name, random_pixels(8, 12, 3, seed=i))
    fields = {
        "w": 12,
        "h": 8,
        "fl_x": 10.0,
        "fl_y": 11.0,
        "cx": 6.5,
        "cy": 3.5,
        "camera_model": "OPENCV",
    }
    write_frames(tmp_path / "transforms.json", names, {**fields, "k1": 0.1, "p2": -0.01})
    return tmp_path


@pytest.fixture
def colmap_root(tmp_path: Path) -> Path:
    """Nine images in two subfolders, binary model."""
    return write_colmap(tmp_path)


@pytest.fixture
def short_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bodies are fitted to captures in two steps, on squares of 32 px."""
    effort = FitEffort(side=32, steps=2, draws_per_frame=0)
    for name in ("fit_capture", "place_new_poses"):
        monkeypatch.setattr(
            fitted_capture, name, partial(getattr(fitted_capture, name), effort=effort)
        )


@pytest.fixture(scope="session")
def smpl_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A file in the layout of SMPL with the mesh of the free template, and the .obj with its
    texture coordinates."""
    return write_smpl_like(tmp_path_factory.mktemp("bodies"), "smpl")


@pytest.fixture
def shared() -> Path:
    """The folder of real captures."""
    if not SHARED.is_dir():
        pytest.skip("the real captures of ../shared/data are not here")
    return SHARED
