"""What wrong camera poses cost, and what their refinement (`camera.refine`) wins back.

    python benchmarks/cameras.py FOLDER CAPTURE... [--preset static] [--seed 0] [--refine
    never,always,auto] [key=value]

In a copy of each capture (those with transforms*.json) the cameras of all training images are
turned by 0.5 degrees around a random axis and shifted in a random direction by 1 % of their mean
distance from their middle; test cameras stay. The preset is trained on the capture as it is and on
the copy, and scored on the test images: from their given poses, and from poses refined on the
images themselves. FOLDER keeps copies and runs, which are reused.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from disturbed import Study, print_table

from dyngs.config import DataConfig
from dyngs.data.read import read_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.io.write import write_text
from dyngs.runs.checkpoint import load_run

DEGREES, FRACTION = 0.5, 0.01


def disturb(capture: Path, out: Path, seed: int) -> None:
    """Write a copy of ``capture`` whose training cameras are wrong."""
    shutil.copytree(capture, out)
    views = read_capture(DataConfig(root=out)).splits["train"]
    centers = np.stack([np.linalg.inv(view.cam_from_world)[:3, 3] for view in views])
    shift = FRACTION * float(np.linalg.norm(centers - centers.mean(0), axis=1).mean())
    trained_on = {view.image_path.resolve() for view in views}
    random = np.random.default_rng(seed)
    for path in sorted(out.glob("transforms*.json")):
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            named = (out / frame["file_path"]).resolve()
            if named in trained_on or named.with_suffix(".png") in trained_on:
                pose = np.asarray(frame["transform_matrix"], dtype=np.float64)
                frame["transform_matrix"] = (pose @ _motion(random, shift)).tolist()
        write_text(path, json.dumps(content))


def _motion(random: np.random.Generator, shift: float) -> np.ndarray:
    """Return a rigid transform (4, 4) by ``DEGREES`` and ``shift`` in random directions."""
    axis, direction = (x / np.linalg.norm(x) for x in random.normal(size=(2, 3)))
    cross = np.cross(np.eye(3), -axis)
    motion = np.eye(4)
    angle = np.radians(DEGREES)
    motion[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    motion[:3, 3] = shift * direction
    return motion


def scores(run: Path) -> list[str]:
    """Return the cells of a run: what was used, PSNR from given and from own poses, and its
    size."""
    report = evaluate_run(run, refine_poses=True)
    used = load_run(run).config.camera.refine
    return [used, f"{report.psnr:.2f}", f"{report.psnr_own_poses:.2f}", f"{report.num_gaussians:,}"]


STUDY = Study(
    text=__doc__ or "",
    worse="cameras",
    given="given",
    key="camera.refine",
    disturb=disturb,
    columns=("used", "PSNR", "own poses", "Gaussians"),
    scores=scores,
)

if __name__ == "__main__":
    print_table(STUDY)
