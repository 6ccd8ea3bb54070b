"""Inputs of runs, configurations and captures, which no function that writes a file may replace."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from moving_scene import write_moving_run

import dyngs
from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import train
from dyngs.capture.inspection import draw_cameras
from dyngs.config import RunConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.read import read_capture
from dyngs.export.cameras import write_cameras
from dyngs.export.choose_path import PathOptions, choose_path
from dyngs.export.html.page import write_page
from dyngs.export.images import OutputOptions, write_path_images, write_split_images
from dyngs.export.splat_files import write_4dgs, write_run_sequence, write_run_splats
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.folder import collect_inputs
from dyngs.runs.opened import open_run

PACKAGE = Path(dyngs.__file__).parent

WRITERS = {
    "atomic_file",
    "write_text",
    "write_image",
    "video_writer",
    "write_tensors",
    "save_config",
}
CHECKS = {
    "require_output",
    "require_empty",
    "require_new_folder",
    "new_folder",
    "open_export_folder",
}
ROOMS_BELOW = ("files/", "config/", "runs/", "data/images/", "splats/", "ops/")
"""Rooms of writers that are handed what they write, or that keep the run folder and the caches of
dyngs itself."""
VALUES = (
    "is handed values, and reads no file that it could replace; the command checks its arguments"
)
OWN = "in a run folder, or in a hidden folder, that its caller has made and checked"
UNCHECKED = {
    "api/choose.py:write_choice": OWN,
    "bench.py:write_report": VALUES,
    "budget/size.py:write_within": OWN,
    "camera_paths/path.py:write_path": VALUES,
    "capture/masks.py:with_background_masks": OWN,
    "capture/sfm/photos.py:copied": OWN,
    "capture/sfm/photos.py:lay_out": OWN,
    "capture/sfm/colmap.py:match_listed": OWN,
    "data/times.py:write_seconds": OWN,
    "demo.py:run_demo": "in a folder that is empty, and locked",
    "data/synthetic/captures.py:write_split": OWN,
    "evaluate/report.py:evaluate_run": "checks it in _require_possible",
    "export/splat_files.py:write_tracks": VALUES,
    "human/fit/fitted_capture.py:write_body_file": OWN,
    "human/fit/fitted_capture.py:write_split": OWN,
    "human/fit/fitted_capture.py:read_person_capture": OWN,
    "human/motion/amass.py:write_amass": VALUES,
    "storage/file.py:write_scene": VALUES,
    "study/runs.py:require_same_study": OWN,
    "study/runs.py:write_stored": OWN,
    "study/report.py:write_report": OWN,
}
"""Functions that write without a check of their own, each with its reason."""


def write_all(run: Path, out: Path) -> dict[str, Callable[[], object]]:
    """Functions of the Python API that write of a run, each to ``out``."""
    loaded = load_run(run)
    capture = read_capture(loaded.config.data)
    opened = open_run(run)
    path = choose_path(opened, PathOptions("orbit", 1, size=(8, 8)))
    as_mp4 = OutputOptions(video=out)
    return {
        "train": lambda: train(loaded.config.model_copy(update={"run": RunConfig(dir=out)})),
        "write_run_splats": lambda: write_run_splats(opened, out),
        "write_run_sequence": lambda: write_run_sequence(opened, out, (0.0, 1.0)),
        "write_moving": lambda: write_4dgs(opened, out, (0.0, 1.0)),
        "write_scene_file": lambda: write_scene_file(run, out),
        "write_cameras": lambda: write_cameras(out, capture, capture.splits),
        "write_page": lambda: write_page(opened, out),
        "write_path_images": lambda: write_path_images(opened, path, out),
        "write_path_images, video": lambda: write_path_images(opened, path, None, as_mp4),
        "write_split_images": lambda: write_split_images(opened, "test", out),
        "draw_cameras": lambda: draw_cameras(capture, out),
    }


def test_no_function_replaces_a_file_of_the_capture(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path)
    root = load_resolved(run).data.root
    image = next(root.rglob("*.png"))
    (tmp_path / "link.png").symlink_to(image)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    for out in (
        image,
        tmp_path / "link.png",
        root / "transforms_train.json",
        root,
    ):
        for name, write in write_all(run, out).items():
            with pytest.raises(DyngsError, match="is an input") as caught:
                write()
            assert "\n" not in str(caught.value), name
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_inputs_of_a_run(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path)
    own = [run / RESOLVED_NAME, *checkpoint_paths(run)]
    for path in own:
        for named in (run, run / "checkpoints" / ".." / ".." / "run"):
            with pytest.raises(DyngsError, match="which is an input"):
                collect_inputs(named).require_output(path)
    for name in ("splats.ply", "metrics.json", "scene.dyngs"):
        (run / name).write_text("an export")
        collect_inputs(run).require_output(run / name)
    checkpoint_paths(run)[0].rename(run / "kept")
    for named in (run, run / "scene.dyngs"):
        with pytest.raises(DyngsError, match="which is an input"):
            collect_inputs(named).require_output(run / "scene.dyngs")
