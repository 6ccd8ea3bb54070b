"""Instructions of each kernel, by valgrind, against stored figures: no change makes a step slower
unnoticed.

    python benchmarks/instructions.py BUILD_FOLDER [--write]

BUILD_FOLDER was configured with ``-DDYNGS_TESTS=ON -DDYNGS_ISAS=v3`` (AVX2: valgrind knows no
AVX-512) and has the program count_instructions_v3. Ends with 1 where a kernel takes more than
``TOLERANCE`` over its figure in ``instructions.json``; ``--write`` stores the figures. Where
valgrind is absent, or the compiler is another one than that of the figures, it says so and ends
with 0.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

STORED = Path(__file__).with_suffix(".json")
TOLERANCE = 0.03  # Another minor version of the compiler changes less
KERNELS = [
    *(
        "project_forward",
        "project_backward",
        "harmonics_forward",
        "harmonics_backward",
        "bin_tiles",
    ),
    *(
        "rasterize_forward",
        "rasterize_backward",
        "l1_ssim_loss",
        "adam_step",
        "skinning_forward",
        "skinning_backward",
    ),
    *("nodes_at", "nodes_at_backward", "node_penalties", "hash_grid_forward", "hash_grid_backward"),
    *("march_count", "march_samples", "composite_forward", "composite_backward", "reached_samples"),
    *("patch_values_forward", "patch_values_backward", "visible_patches", "patch_ends"),
    *("blend_patches_forward", "blend_patches_backward"),
]
LINE = re.compile(r"^\s*([\d,]+) .*\bdyngs::(\w+)(?:<float>)?\(")


def compiler(folder: Path) -> str:
    """Return the compiler's name and major version, from CMake's notes."""
    for path in sorted(folder.glob("CMakeFiles/*/CMakeCXXCompiler.cmake")):
        found = dict(
            re.findall(
                r'set\(CMAKE_CXX_COMPILER_(ID|VERSION) "([^"]*)"\)',
                path.read_text(encoding="utf-8"),
            )
        )
        return f"{found['ID']} {found['VERSION'].partition('.')[0]}"
    raise SystemExit(f"{folder}: not a build folder of CMake")


def counted(program: Path) -> dict[str, int]:
    """Return the instructions of each kernel, what it calls included."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "callgrind.out"
        collect = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}", str(program)]
        subprocess.run(
            collect,
            check=True,
            capture_output=True,
            env={"OMP_NUM_THREADS": "1", "PATH": "/usr/bin:/bin"},
        )
        show = ["callgrind_annotate", "--inclusive=yes", "--threshold=100", str(out)]
        table = subprocess.run(show, check=True, capture_output=True, text=True).stdout
    found = [
        (m[2], int(m[1].replace(",", ""))) for line in table.splitlines() if (m := LINE.match(line))
    ]
    # parts of a kernel bear its name, too
    return {name: max(count for kernel, count in found if kernel == name) for name in KERNELS}


def main() -> int:
    folder = Path(sys.argv[1])
    if shutil.which("valgrind") is None:
        print("skipped: valgrind is not here")
        return 0
    stored = (
        json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {"compiler": None}
    )
    built_by = compiler(folder)
    if "--write" not in sys.argv and stored["compiler"] != built_by:
        print(
            f"skipped: the figures are of {stored['compiler']}, and {built_by} compiled these kernels"
        )
        return 0
    found = counted(folder / "count_instructions_v3")
    slower = []
    print("| kernel | thousands of instructions | stored | |\n|---|---|---|---|")
    for name, count in found.items():
        before = stored.get("instructions", {}).get(name, count)
        slower += [name] if count > (1 + TOLERANCE) * before else []
        print(
            f"| {name} | {count // 1000:,} | {before // 1000:,} | {100 * (count / before - 1):+.1f} % |"
        )
    if "--write" in sys.argv:
        text = json.dumps({"compiler": built_by, "instructions": found}, indent=2)
        STORED.write_text(text + "\n", encoding="utf-8")
        return 0
    for name in slower:
        print(
            f"slower: {name}; if that pays, store the new figures with --write and say why in the commit"
        )
    return 1 if slower else 0


if __name__ == "__main__":
    sys.exit(main())
