"""``dyngs doctor``: check the installation."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from dyngs.cli.arguments import Commands, add_command, add_json
from dyngs.core.errors import DyngsError

_OPTIONAL = {
    "viser": "view",
    "lpips": "metrics",
    "matplotlib": "plots",
    "tensorboard": "tensorboard",
    "wandb": "wandb",
    "rerun-sdk": "rerun",
    "zstandard": "zstd",
    "usd-core": "usd",
    "fourdgs": "4dgs",
    "h5py": "people",
    "pillow-heif": "heic",
    "ray": "ray",
}
"""Optional packages and the extras of dyngs that install them."""


@dataclass(frozen=True)
class Check:
    """One row of the report; the verdict "absent" marks missing optional parts."""

    name: str
    value: str
    verdict: Literal["ok", "absent", "broken"] = "ok"


def add_parser(commands: Commands) -> None:
    about = "check the installation: versions, cores, instruction set, GPU, optional packages"
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
        raise DyngsError(f"the installation is broken: {', '.join(broken)}; install dyngs again")
    return 0


def examine() -> Iterator[Check]:
    yield Check("dyngs", _version("dyngs") or "not installed (run from a source folder)")
    yield Check("python", f"{platform.python_version()} on {platform.platform()}")
    yield Check("cores", f"{_usable_cores()} usable of {os.cpu_count()}")
    yield from _examine_packages()
    yield from _examine_core()
    yield from _examine_gpu()


def _examine_packages() -> Iterator[Check]:
    """Yield the versions of required and optional packages."""
    requirements = metadata.requires("dyngs") or [] if _version("dyngs") else []
    for line in requirements:
        if "extra ==" not in line:
            name = re.split(r"[^\w.-]", line, maxsplit=1)[0]
            version = _version(name)
            needed = "absent" if ";" in line else "broken"  # a marker: not for all platforms
            yield Check(name, version or "missing", needed if version is None else "ok")
    for name, extra in _OPTIONAL.items():
        version = _version(name)
        advice = f"pip install 'dyngs[{extra}]'"
        yield Check(name, version or advice, "absent" if version is None else "ok")


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
        value += (
            f"; this CPU supports {newest} ({ISA_NAMES[newest]}): reinstall dyngs from source "
            "for more speed"
        )
    yield Check("native core", value)
    runtimes = openmp_runtimes()
    if runtimes:
        yield Check("OpenMP runtimes", f"{len(runtimes)}: {', '.join(runtimes)}")


def _examine_gpu() -> Iterator[Check]:
    """Yield the state of the CUDA GPU, which is optional."""
    try:
        from dyngs.ops.device import gpu_status, gpu_unavailable_reason
    except (ImportError, DyngsError):
        return
    reason = gpu_unavailable_reason()
    for name, value in gpu_status().items():
        yield Check(name, value, "absent" if value in ("none", "not built") else "ok")
    if reason is None:
        yield Check("device", "cuda")
    else:
        yield Check("device", f"cpu; no GPU: {reason}", "absent")


def openmp_runtimes() -> list[str]:
    """Return the OpenMP runtimes loaded in this process; several would compete for the cores."""
    maps = Path("/proc/self/maps")
    text = maps.read_text() if maps.is_file() else ""
    return sorted(set(re.findall(r"/(lib(?:g|i)?omp[^/\n]*)$", text, re.MULTILINE)))


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _usable_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
