"""How much memory drawing takes: measured in processes of their own, whose parent this module is when it is run.

A process never gives back all that it once had, so that in one process only the hungriest variant would show.
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

from dyngs.camera import Cameras
from dyngs.data.loader import Picture
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import load_run
from dyngs.tradeoff.measure import VariantRenderer, render_options_of
from dyngs.tradeoff.variants import Variant

_STATUS = Path("/proc/self/status")


class MemoryMeter:
    """A process that measures; a context that ends it. On systems that do not tell (not Linux) nothing is measured.

    It imports what drawing needs once, and forks for every measurement.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> MemoryMeter:
        return self

    def __exit__(self, *error: object) -> None:
        if self._process is not None:
            self._process.communicate()

    def peak_megabytes(
        self, folder: Path, variant: Variant, pictures: Sequence[Picture], background: Tensor
    ) -> float | None:
        """By how much a process grows at most, 1e6 bytes of resident memory, that loads a run and draws on one thread.

        Counted from where the program is loaded and nothing is read. None where it cannot be measured.

        Args:
            folder: of the run.
            variant: how it is drawn.
            pictures: whose cameras and times are drawn; a person plays the clip of training.
            background: (3,).
        """
        process = self._started()
        if process is None or process.stdin is None or process.stdout is None:
            return None
        shots = [
            {
                "pose": picture.cameras.cam_from_world.tolist(),
                "intrinsics": picture.cameras.intrinsics.tolist(),
                "size": [picture.cameras.width, picture.cameras.height],
                "time": picture.time,
            }
            for picture in pictures
        ]
        request = {"folder": str(folder.absolute()), "variant": variant.to_json(), "background": background.tolist()}
        try:
            process.stdin.write(json.dumps(request | {"shots": shots}) + "\n")
            process.stdin.flush()
            return float(process.stdout.readline())
        except (OSError, ValueError):
            return None

    def _started(self) -> subprocess.Popen[str] | None:
        """The process, which the first measurement starts; Ctrl-C is none of its business."""
        if self._process is None and _STATUS.is_file():
            command, pipe = [sys.executable, "-m", "dyngs.tradeoff.memory"], subprocess.PIPE
            self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, start_new_session=True)
        return self._process


def main() -> int:
    """Answer each line of stdin, which asks for a measurement, with megabytes."""
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            _measure(json.loads(line))
            os._exit(0)
        if os.waitpid(child, 0)[1] != 0:
            print("failed", flush=True)
    return 0


def _measure(request: dict[str, Any]) -> None:
    """Draw what is asked for and print the megabytes that it took."""
    before = _kilobytes("VmRSS")
    variant = Variant.from_json(request["variant"])
    with kernel_threads(1):
        run = load_run(Path(request["folder"]))
        options, background = render_options_of(variant, run.config.model), torch.tensor(request["background"])
        drawer = VariantRenderer(run.scene, options, background, variant.scale)
        for shot in request["shots"]:
            pose, intrinsics = (torch.tensor(shot[name]) for name in ("pose", "intrinsics"))
            drawer.picture(Cameras(pose, intrinsics, *shot["size"]), shot["time"])
    print(1024e-6 * (_kilobytes("VmHWM") - before), flush=True)


def _kilobytes(name: str) -> int:
    line = next(line for line in _STATUS.read_text(encoding="ascii").splitlines() if line.startswith(f"{name}:"))
    return int(line.split()[1])


if __name__ == "__main__":
    sys.exit(main())
