"""Memory needed for rendering, measured in child processes; run as a program, this module is their
parent.

The peak of a process never falls, so several variants measured in one process would all show that
of the largest.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.io.child import python_command
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import load_run
from dyngs.study.tradeoff.measure import variant_drawing
from dyngs.study.tradeoff.variants import Variant

_STATUS = Path("/proc/self/status")


class MemoryMeter:
    """Context manager of a process that imports the renderer once and forks for every measurement.

    Nothing is measured where /proc is missing (systems other than Linux).
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> MemoryMeter:
        return self

    def __exit__(self, *error: object) -> None:
        if self._process is not None:
            self._process.communicate()

    def peak_megabytes(
        self, folder: Path, variant: Variant, images: Sequence[Image], background: Tensor
    ) -> float | None:
        """Return the largest growth of resident memory, 1e6 bytes, while loading a run and
        rendering on one thread.

        Counted from the loaded program, before any file is read. None where it cannot be measured.

        Args:
            variant: its render settings are used.
            images: their cameras and times are rendered; a person shows the training motion.
            background: (3,) colour.
        """
        process = self._started()
        if process is None or process.stdin is None or process.stdout is None:
            return None
        views = [
            {
                "pose": image.cameras.cam_from_world.tolist(),
                "intrinsics": image.cameras.intrinsics.tolist(),
                "size": [image.cameras.width, image.cameras.height],
                "time": image.time,
            }
            for image in images
        ]
        request = {
            "folder": str(folder.absolute()),
            "variant": variant.changes,
            "background": background.tolist(),
        }
        try:
            process.stdin.write(json.dumps(request | {"views": views}) + "\n")
            process.stdin.flush()
            return float(process.stdout.readline())
        except (OSError, ValueError):
            return None

    def _started(self) -> subprocess.Popen[str] | None:
        """Return the process, started by the first measurement; in a session of its own, so that
        Ctrl-C spares it."""
        if self._process is None and _STATUS.is_file():
            command = python_command("dyngs.study.tradeoff.memory")
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(
                command, stdin=pipe, stdout=pipe, text=True, start_new_session=True
            )
        return self._process


def main() -> int:
    """Answer each request, a line of JSON on stdin, with a line of megabytes on stdout."""
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            _measure(json.loads(line))
            os._exit(0)
        if os.waitpid(child, 0)[1] != 0:
            print("failed", flush=True)
    return 0


def _measure(request: dict[str, Any]) -> None:
    """Render the requested views and print the growth of memory in megabytes."""
    before = _kilobytes("VmRSS")
    variant = Variant(**request["variant"])
    with kernel_threads(1):
        run = load_run(Path(request["folder"]))
        background = torch.tensor(request["background"], device="cpu")
        drawing = variant_drawing(variant, run.renderable, background)
        for view in request["views"]:
            pose, intrinsics = (
                torch.tensor(view[name], device="cpu") for name in ("pose", "intrinsics")
            )
            drawing.image(Cameras(pose, intrinsics, *view["size"]), view["time"])
    print(1024e-6 * (_kilobytes("VmHWM") - before), flush=True)


def _kilobytes(name: str) -> int:
    line = next(
        line
        for line in _STATUS.read_text(encoding="ascii").splitlines()
        if line.startswith(f"{name}:")
    )
    return int(line.split()[1])


if __name__ == "__main__":
    sys.exit(main())
