"""Sizes and PSNR of moving scenes with each part of MEGA (Zhang et al. 2024), at equal steps.

    python benchmarks/mega.py FOLDER --data CAPTURES [--jobs 2] [--steps 1500] [key=value ...]
    python benchmarks/mega.py FOLDER --table [--store]

Each part is added to those before: the colour network, opacity entropy, and for 4D Gaussians the
predictor of deformation. The last run of a system is then stored in half precision and zipped,
as published, and as a .dyngs file. Both files are read again and evaluated on the test split.
Megabytes of runs are float32 parameters. The published ratio of sizes is 125 (N3V) to 188
(Technicolor). One row is stored as FOLDER/results/CAPTURE_SYSTEM_PART.json; stored rows are not
measured again, and interrupted trainings are resumed. Overrides apply to all trainings. `--store`
keeps the rows for docs/results.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from dynamic import write_result
from results import MEGA, current_commit, mega_table
from torch import Tensor

from dyngs.api.scene_file import write_scene_file
from dyngs.config.io import load_resolved
from dyngs.core.state import strip_roles
from dyngs.evaluate.report import evaluate_run
from dyngs.models.checkpoint import Checkpoint
from dyngs.runs.checkpoint import (
    checkpoint_paths,
    latest_checkpoint,
    load_run,
    save_checkpoint,
)
from dyngs.runs.folder import write_config

CAPTURES = ("stage", "rig")
SYSTEMS = ("gaussians_4d", "free", "control_nodes")
# Parts in the order in which they are added; "harmonics" of 4D Gaussians are 144 numbers.
PARTS: dict[str, tuple[str, ...]] = {
    "harmonics": ("model.sh_degree=3", "colour.kind=sh"),
    "network": ("colour.kind=network", "colour.width=64", "colour.normals=false"),
    "entropy": ("colour.opacity_entropy=5e-4",),
    "deformation": ("model.deform.predictor_width=256",),
}
ONLY_4D = ("deformation",)
WITH_WAVES = ("model.deform.frequencies=2",)  # 16 harmonics x 3 channels x 3 terms in time
FILES = ("half and zip", ".dyngs")


@dataclass(frozen=True)
class Row:
    """One line of the table: a run, or a file of one."""

    folder: Path
    capture: str
    system: str
    part: str

    @property
    def stem(self) -> str:
        return f"{self.capture}_{self.system}_{self.part.strip('.').replace(' ', '_')}"

    @property
    def result(self) -> Path:
        return self.folder / "results" / f"{self.stem}.json"

    @property
    def run(self) -> Path:
        return self.folder / "runs" / self.stem

    @property
    def overrides(self) -> list[str]:
        """Overrides of this part and of those before."""
        parts = list(PARTS)
        own = parts[: parts.index(self.part) + 1]
        words = [word for part in own for word in PARTS[part] if self.has(part)]
        return [*words, *(WITH_WAVES if self.system == "gaussians_4d" else ())]

    def has(self, part: str) -> bool:
        return part not in ONLY_4D or self.system == "gaussians_4d"


def train_run(row: Row, data: Path, steps: int, overrides: list[str]) -> float:
    """Train or resume a run. Returns the seconds of this call."""
    began = time.perf_counter()
    words = ["train", "dynamic", f"data.root={data / row.capture}", f"run.dir={row.run}"]
    words += ["model.pilot_runs=false", f"model.deform.kind={row.system}", *row.overrides]
    words += [f"train.steps={steps}", "run.threads=1", *overrides]
    if checkpoint_paths(row.run):
        words = ["train", "--resume", str(row.run)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "dyngs", *words], env=environment, capture_output=True, text=True
    )
    if done.returncode and "already finished" not in done.stderr:
        sys.exit(f"{row.stem}: {done.stderr.strip().splitlines()[-1]}")
    return time.perf_counter() - began


def half_and_zip(run: Path, out: Path) -> int:
    """Store a run in half precision in a zip file, and what it holds as a run in ``out``.

    Returns the bytes of the file.
    """
    checkpoint = latest_checkpoint(run)
    kept = strip_roles(load_run(run).scene.drawing_state())
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as file:
        for name, x in kept.items():
            values = x.half() if x.dtype == torch.float32 else x
            stream = BytesIO()
            np.save(stream, values.numpy())
            file.writestr(f"{name}.npy", stream.getvalue())
    tensors: dict[str, Tensor] = {}
    with zipfile.ZipFile(packed) as file:
        for name, x in kept.items():
            values = np.load(BytesIO(file.read(f"{name}.npy")), allow_pickle=False)
            tensors[name] = torch.from_numpy(values).to(x.dtype)
    out.mkdir(parents=True, exist_ok=True)
    write_config(load_resolved(run), out)
    save_checkpoint(out, Checkpoint(checkpoint.info, tensors), 0.0)
    return packed.tell()


def measure(row: Row, run: Path, num_bytes: int | None, facts: dict[str, Any]) -> None:
    """Evaluate ``run`` and store the result of ``row``."""
    report = evaluate_run(run, threads=1)
    facts |= {
        "capture": row.capture,
        "system": row.system,
        "part": row.part,
        "psnr": report.psnr,
        "psnr_moving": report.psnr_moving,
        "gaussians": report.num_gaussians,
        "fps": report.fps,
        "mb": report.model_mb if num_bytes is None else 1e-6 * num_bytes,
        "steps": report.step,
        "commit": current_commit(),
    }
    write_result(row.result, facts)
    print(f"{row.stem}: {report.psnr:.2f} dB, {facts['mb']:.3f} MB", flush=True)


def run_part(row: Row, options: argparse.Namespace) -> None:
    """Train and measure a run; the last part of a system also as files."""
    if not row.result.is_file():
        seconds = train_run(row, options.data, options.steps, options.overrides)
        measure(row, row.run, None, {"seconds": seconds, "overrides": options.overrides})
    if row.part != [part for part in PARTS if row.has(part)][-1]:
        return
    for name in FILES:
        stored = replace(row, part=name)
        if stored.result.is_file():
            continue
        if name == ".dyngs":
            num_bytes = write_scene_file(row.run, stored.run).num_bytes
        else:
            num_bytes = half_and_zip(row.run, stored.run)
        measure(stored, stored.run, num_bytes, {})


def load_rows(folder: Path) -> list[dict[str, Any]]:
    """Return the stored results in the order of the parts."""
    paths = sorted((folder / "results").glob("*.json"))
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    order = [*PARTS, *FILES]
    return sorted(
        found, key=lambda x: (x["capture"], SYSTEMS.index(x["system"]), order.index(x["part"]))
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--data", type=Path, default=Path("."), help="folder of the captures")
    parser.add_argument("--captures", nargs="+", default=CAPTURES, metavar="CAPTURE")
    parser.add_argument("--systems", nargs="+", default=SYSTEMS, choices=SYSTEMS)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time, one thread each")
    parser.add_argument("--table", action="store_true", help="print the table, do not train")
    parser.add_argument("--store", action="store_true", help="keep the rows for docs/results.md")
    options = parser.parse_intermixed_args()
    options.folder = options.folder.absolute()
    options.data = options.data.absolute()
    if not options.table:
        wanted = [
            row
            for capture in options.captures
            for system in options.systems
            for part in PARTS
            if (row := Row(options.folder, capture, system, part)).has(part)
        ]
        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(lambda row: run_part(row, options), wanted))
    rows = load_rows(options.folder)
    print(mega_table(rows))
    if options.store:
        write_result(MEGA, rows)


if __name__ == "__main__":
    main()
