"""Prints what `nvcc -Xptxas -v` said of each kernel as a table; ends with 1 if one spills registers."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ENTRY = re.compile(r"Compiling entry function '(\w+)' for 'sm_(\d+)'")
USED = re.compile(r"Used (\d+) registers(?:.*?(\d+) bytes smem)?")
SPILLED = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores")


def short_name(mangled: str) -> str:
    """The kernel's name with its template arguments, without its parameters."""
    full = subprocess.run(["c++filt", mangled], capture_output=True, text=True, check=True).stdout
    without_enum = re.sub(
        r"\(dyngs::Tally\)", "tally ", full.replace("dyngs::cuda::(anonymous namespace)::", "")
    )
    return re.sub(r"_kernel", "", without_enum.removeprefix("void ").partition("(")[0]).strip()


def main() -> int:
    rows: dict[str, dict[str, str]] = {}
    spilled = []
    name, arch, stack = "", "", ""
    for line in Path(sys.argv[1]).read_text(encoding="utf-8").splitlines():
        if entry := ENTRY.search(line):
            name, arch = short_name(entry[1]), entry[2]
        elif spill := SPILLED.search(line):
            stack = spill[1]
            if spill[2] != "0":
                spilled.append(f"{name}, sm_{arch}: {spill[2]} bytes")
        elif used := USED.search(line):
            shared = f"{int(used[2] or 0) / 1024:.1f}"
            rows.setdefault(name, {})[arch] = f"{used[1]} / {shared}" + (
                f" / {stack} B stack" if stack != "0" else ""
            )
    archs = sorted({arch for row in rows.values() for arch in row}, key=int)
    print("registers / KiB of static shared memory of each kernel")
    print("| kernel |", " | ".join(f"sm_{arch}" for arch in archs), "|")
    print("|---|" + "---|" * len(archs))
    for kernel, row in sorted(rows.items()):
        print(f"| {kernel} |", " | ".join(row.get(arch, "") for arch in archs), "|")
    for line in spilled:
        print("spilled:", line)
    return 1 if spilled else 0


if __name__ == "__main__":
    sys.exit(main())
