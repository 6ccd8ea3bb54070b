"""Memory needed for rendering, measured in a child process that runs this module."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.evaluate.view_scores import Drawing
from dyngs.io.child import python_command
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import load_run
from dyngs.study.variants import Variant

_STATUS = Path("/proc/self/status")


def peak_megabytes(
    folder: Path, variant: Variant, images: Sequence[Image], background: Tensor
) -> float | None:
    """Return the largest growth of resident memory, 1e6 bytes, while a process loads a run and
    renders ``images`` on one thread with the settings of ``variant``.

    Counted from the loaded program, before any file is read. None where it cannot be measured:
    where /proc is missing (systems other than Linux).
    """
    if not _STATUS.is_file():
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
        "views": views,
    }
    command = python_command("dyngs.study.memory")
    done = subprocess.run(
        command, input=json.dumps(request), stdout=subprocess.PIPE, text=True, check=False
    )
    return float(done.stdout) if done.returncode == 0 else None


def _measure(request: dict[str, Any]) -> float:
    """Render the requested views; return the growth of memory in megabytes."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # forgets the peak so far
    before = _kilobytes("VmRSS")
    variant = Variant(**request["variant"])
    with kernel_threads(1):
        scene = load_run(Path(request["folder"])).renderable
        background = torch.tensor(request["background"], device="cpu")
        options = replace(scene.options, **variant.drawn)
        drawing = Drawing(scene, options, background, variant.scale)
        for view in request["views"]:
            pose, intrinsics = (
                torch.tensor(view[name], device="cpu") for name in ("pose", "intrinsics")
            )
            drawing.image(Cameras(pose, intrinsics, *view["size"]), view["time"])
    return 1024e-6 * (_kilobytes("VmHWM") - before)


def _kilobytes(name: str) -> int:
    lines = _STATUS.read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith(f"{name}:")).split()[1])


if __name__ == "__main__":
    print(_measure(json.load(sys.stdin)))
