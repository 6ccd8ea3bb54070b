"""Rules that hold for the whole repository: safety, portability and the cost of an import."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import dyngs

ROOT = Path(__file__).resolve().parents[1]
PYTHON_FILES = sorted((ROOT / "dyngs").rglob("*.py"))


HEAVY = (
    "pycolmap",
    "trimesh",
    "kornia",
    "OpenImageIO",
    "skimage",
    "av",
    "rich",
    "tensorboard",
    "wandb",
    "rerun",
    "lpips",
    "matplotlib",
)


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    """Every file of the package, parsed."""
    return {relative(path): ast.parse(path.read_text(encoding="utf-8")) for path in PYTHON_FILES}


@pytest.fixture(scope="module")
def nodes(trees: dict[str, ast.Module]) -> dict[str, list[ast.AST]]:
    """All that it consists of, by file."""
    return {file: list(ast.walk(tree)) for file, tree in trees.items()}


def test_no_paths_of_one_machine() -> None:
    homes = "|".join(("work", "home", "root", "opt", "mnt", "Users"))
    pattern = re.compile(rf"[\"'(\s=](/({homes})/|[A-Z]:\\Users)")
    folders = [
        f
        for f in ("dyngs", "csrc", "tests", "fuzz", "configs", "docs", "benchmarks", ".ci")
        if (ROOT / f).is_dir()
    ]
    files = [
        f
        for folder in folders
        for f in (ROOT / folder).rglob("*")
        if f.is_file() and f.stat().st_size < 2**20
    ]
    files += [
        ROOT / f for f in ("README.md", "pyproject.toml", "CMakeLists.txt") if (ROOT / f).is_file()
    ]
    found = [
        relative(f)
        for f in files
        if f != Path(__file__) and pattern.search(f.read_text("utf-8", "ignore"))
    ]
    assert [name for name in found if "__pycache__" not in name] == []


def test_no_code_from_data(nodes: dict[str, list[ast.AST]]) -> None:
    """Untrusted files never run code: no pickle, no eval, no unsafe YAML, no shell."""
    forbidden_modules = {"pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
    found = []
    for file, own in nodes.items():
        for node in own:
            if isinstance(node, ast.Import):
                names = {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                names = {(node.module or "").split(".")[0]}
            elif isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                names = (
                    {"pickle"}
                    if called in ("eval", "exec", "yaml.load", "torch.load", "os.system")
                    else set()
                )
                if called == "torch.load" and "weights_only=True" in ast.unparse(node):
                    names = set()  # its unpickler calls nothing but what makes tensors
            else:
                continue
            # it takes the unpickler in Python apart: see tests/io/test_pickles.py
            allowed = {"pickle"} if file == "dyngs/io/pickles.py" else set()
            if names & forbidden_modules - allowed:
                found.append(f"{file}:{node.lineno}")
    assert found == []


def test_only_ops_imports_the_native_core() -> None:
    pattern = re.compile(r"\bdyngs\.(ops\.)?_core|^\s*from \S+ import .*\b_core\b", re.M)
    importers = [relative(f) for f in PYTHON_FILES if pattern.search(f.read_text(encoding="utf-8"))]
    assert [name for name in importers if not name.startswith("dyngs/ops/")] == []


FACTORIES = {
    "zeros",
    "ones",
    "full",
    "empty",
    "tensor",
    "arange",
    "linspace",
    "logspace",
    "eye",
    "rand",
    "randn",
} | {
    "randint",
    "randperm",
    "tril_indices",
    "triu_indices",
}
"""Functions of torch that make a tensor on the CPU unless told otherwise."""


def test_every_tensor_is_made_on_a_named_device(nodes: dict[str, list[ast.AST]]) -> None:
    """A tensor made without ``device`` is on the CPU, also where another device is needed. Write
    ``device="cpu"`` where the CPU is right."""
    found = []
    for file, own in nodes.items():
        for node in own:
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            made = ast.unparse(node.func.value) == "torch" and node.func.attr in FACTORIES
            if made and "device" not in {keyword.arg for keyword in node.keywords}:
                found.append(f"{file}:{node.lineno}")
    assert found == []


def test_no_code_relies_on_posix(
    nodes: dict[str, list[ast.AST]], trees: dict[str, ast.Module]
) -> None:
    """Windows: modules of POSIX are imported where they may be missing, names below a folder are
    written with slashes, and only where /proc is a process forks; nothing makes symbolic links, for
    which a user needs rights there."""
    found = []
    for file, tree in trees.items():
        imported = [y.name for x in tree.body if isinstance(x, ast.Import) for y in x.names]
        found += [
            f"{file}: {name}"
            for name in ({"fcntl", "resource", "pwd", "grp", "termios"} & {*imported})
        ]
        for node in (x for x in nodes[file] if isinstance(x, ast.Call)):
            call = ast.unparse(node)
            if re.match(
                r"(os\.(fork|symlink)|multiprocessing\.)\b|.*\.(symlink_to|hardlink_to)\(", call
            ):
                found += [f"{file}:{node.lineno}: {call}"] if (file, call) not in FORKS else []
            if re.match(r"str\(.*\brelative_to\(", call):
                found.append(f"{file}:{node.lineno}: {call}: use as_posix()")
    assert found == []


FORKS: set[tuple[str, str]] = set()
"""Begun only where there is /proc/self/status."""


def test_every_file_can_lie_on_every_system() -> None:
    """Names that differ by more than case, that Windows has no devices of, and no links."""
    folders = (
        "dyngs",
        "configs",
        "docs",
        "csrc",
        "tests",
        "benchmarks",
        "examples",
        "fuzz",
        "packaging",
        ".github",
    )
    files = [
        x for folder in folders for x in (ROOT / folder).rglob("*") if "__pycache__" not in x.parts
    ]
    assert len(files) > 800
    assert len({relative(file).casefold() for file in files}) == len(files)
    device = re.compile(
        r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)|.*[<>:\"|?*\\]|.*[. ]$", re.IGNORECASE
    )
    assert [relative(file) for file in files if device.match(file.name) or file.is_symlink()] == []


def run_python(code: str) -> str:
    """Return the output of ``code`` in a separate process that imports the dyngs under test."""
    environment = os.environ | {"PYTHONPATH": str(Path(dyngs.__file__).resolve().parents[1])}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_mutation_names_a_place_and_its_tests() -> None:
    """``benchmarks/mutate.py`` breaks places by their text, which must be there once."""
    table = next(
        node.value
        for node in ast.parse((ROOT / "benchmarks/mutate.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "MUTATIONS"
    )
    for file, text, changed, tests in ast.literal_eval(table):
        assert (ROOT / "dyngs" / file).read_text(encoding="utf-8").count(text) == 1, (file, text)
        assert text != changed
        assert tests.split(), file
        assert all((ROOT / "tests" / test).is_file() for test in tests.split()), (file, tests)


def test_import_is_cheap_and_leaves_heavy_packages_alone() -> None:
    """One of three processes suffices, because a busy machine only ever makes it slower."""
    code = (
        "import sys, time, torch, numpy; before = set(sys.modules); "
        "t = time.process_time(); import dyngs\n"
        "print(time.process_time() - t); import dyngs.gaussians.rendering\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules and m not in before])\n"
        "import dyngs.evaluate.report, dyngs.export.images, dyngs.export.choose_path\n"
        f"print([m for m in {FOR_FEW_SCENES!r} if m in sys.modules])"
    )
    for _ in range(3):
        seconds, heavy, for_few = run_python(code).splitlines()
        assert heavy == "[]"
        assert for_few == "[]", "drawing and evaluating import what few scenes need"
        if float(seconds) < 1.0:
            return
    pytest.fail(f"dyngs takes {seconds} s to import")


FOR_FEW_SCENES = (
    "scipy",
    "skimage",
    "trimesh",
    "av",
    "pycolmap",
    "kornia",
    "sympy",
    "torch._dynamo",
)


def test_the_conda_recipe_needs_what_pip_does() -> None:
    """Versions, too; two packages have other names on conda-forge.

    Packages that are not for all platforms are left out.
    """
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    recipe = yaml.safe_load((ROOT / "packaging" / "recipe.yaml").read_text(encoding="utf-8"))
    wanted = re.findall(
        r'^  "([\w-]+)([^";]*)",',
        project.split("dependencies = [")[1].split("\n]")[0],
        re.MULTILINE,
    )
    names = {"torch": "pytorch", "OpenImageIO": "py-openimageio"}
    assert recipe["requirements"]["run"][1:] == [
        f"{names.get(name, name)} {versions}" for name, versions in wanted
    ]
    assert f'version = "{recipe["context"]["version"]}"' in project


def test_newer_versions_of_torch_are_allowed() -> None:
    """Pip must not downgrade the torch of an environment; constraints.txt names the version of the
    tests."""
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    allowed = re.search(r'"torch([^"]*)"', project)
    pinned = re.search(
        r"^torch==([\d.]+)$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert allowed is not None
    assert "<" not in allowed[1]
    assert pinned is not None
    oldest = tuple(int(x) for x in allowed[1].removeprefix(">=").split("."))
    assert tuple(int(x) for x in pinned[1].split(".")) >= oldest
