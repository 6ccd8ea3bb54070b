"""``dyngs doctor``: versions and state of this installation."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Literal

from dyngs.cli.arguments import Commands, add_command, add_json
from dyngs.core.errors import DyngsError

_SAME = (
    "torch",
    "numpy",
    "pydantic",
    "safetensors",
    "rich",
    "pycolmap",
    "trimesh",
    "kornia",
    "OpenImageIO",
    "scipy",
)
_REQUIRED = {name: name for name in (*_SAME, "av", "argcomplete")} | {
    "pyyaml": "yaml",
    "scikit-image": "skimage",
}
"""Packages, and the modules that they have."""
_OPTIONAL = {
    "flip-evaluator": ("flip_evaluator", "the FLIP metric: pip install 'dyngs[metrics]'"),
    "lpips": ("lpips", "the LPIPS metric: pip install 'dyngs[metrics]'"),
    "matplotlib": ("matplotlib", "the plot of `dyngs tradeoff`: pip install 'dyngs[plots]'"),
    "tensorboard": ("tensorboard", "train.tensorboard=true: pip install 'dyngs[tensorboard]'"),
}


@dataclass(frozen=True)
class Check:
    """One row of the report; ``verdict`` is "ok", "absent" (optional and missing) or "broken"."""

    name: str
    value: str
    verdict: Literal["ok", "absent", "broken"] = "ok"


def add_parser(commands: Commands) -> None:
    about = "report versions, cores, instruction set and optional packages"
    add_json(add_command(commands, "doctor", run, about))


def run(arguments: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    findings = list(examine())
    if arguments.json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
        return 0
    table = Table(show_header=False, box=None, pad_edge=False)
    colours = {"ok": "green", "absent": "yellow", "broken": "red"}
    for finding in findings:
        table.add_row(
            finding.name, f"[{colours[finding.verdict]}]{finding.verdict}", escape(finding.value)
        )
    Console().print(table)
    broken = [finding.name for finding in findings if finding.verdict == "broken"]
    if broken:
        raise DyngsError(
            f"this installation cannot work: {', '.join(broken)} (see the rows marked broken)"
        )
    return 0


def examine() -> Iterator[Check]:
    yield Check("dyngs", _version("dyngs") or "not installed (run from a source folder)")
    yield Check("python", f"{platform.python_version()} on {platform.platform()}")
    yield Check("cores", f"{_usable_cores()} usable of {os.cpu_count()}")
    for name, module in _REQUIRED.items():
        yield (
            Check(name, _version(name) or "")
            if util.find_spec(module)
            else Check(name, "missing", "broken")
        )
    yield from _examine_core()
    yield from _examine_gpu()
    for name, (module, purpose) in _OPTIONAL.items():
        found = util.find_spec(module) is not None
        yield (
            Check(name, _version(name) or "")
            if found
            else Check(name, f"needed for {purpose}", "absent")
        )


def _examine_core() -> Iterator[Check]:
    try:
        from dyngs.ops.native import ISA_NAMES, active_isa, built_isas, core
    except (ImportError, DyngsError) as error:
        yield Check("native core", str(error), "broken")
        return
    isa = active_isa()
    newest = core.best_isa()
    value = f"instruction set {isa} ({ISA_NAMES[isa]}), compiled: {', '.join(built_isas())}"
    if newest not in built_isas():
        value += f"; this processor also runs {newest} ({ISA_NAMES[newest]}): install again on it for more speed"
    yield Check("native core", value)
    runtimes = openmp_runtimes()
    if runtimes is not None:
        yield Check(
            "OpenMP runtimes", f"{len(runtimes)}: {', '.join(path.name for path in runtimes)}"
        )


def _examine_gpu() -> Iterator[Check]:
    """Yield what there is of a CUDA GPU; without one dyngs works, too."""
    try:
        from dyngs.ops.device import findings, why_no_gpu
    except (ImportError, DyngsError):
        return
    reason = why_no_gpu()
    for name, value in findings().items():
        yield Check(name, value)
    yield (
        Check("device", "cuda")
        if reason is None
        else Check("device", f"cpu; for a GPU: {reason}", "absent")
    )


def openmp_runtimes() -> list[Path] | None:
    """Return the OpenMP runtimes loaded in this process (several compete for the cores); None where
    unknown."""
    maps = Path("/proc/self/maps")
    if not maps.is_file():
        return None
    paths = {
        Path(line.split(maxsplit=5)[5]) for line in maps.read_text().splitlines() if line.count("/")
    }
    return sorted(path for path in paths if path.name.startswith(("libgomp", "libiomp", "libomp")))


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
