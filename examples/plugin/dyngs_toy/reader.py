"""Reader of captures whose cameras are a table, ``cameras.csv``, beside the images.

Columns: image, fx, fy, cx, cy in pixels, and r00 ... r23, the rows of ``cam_from_world`` (3, 4) with
OpenCV axes.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from dyngs.data.capture import Capture, CaptureFormat, View
from dyngs.data.geometry import validate_pose
from dyngs.data.images.images import read_header
from dyngs.io.fields import read_limited

TABLE = "cameras.csv"
POSE = [f"r{row}{column}" for row in range(3) for column in range(4)]


def read_table(root: Path) -> Capture:
    """Return all images as training views; dyngs holds out some of them for testing.

    A missing column or a value that is no number is reported by dyngs in one line.
    """
    views = []
    lines = read_limited(root / TABLE).decode().splitlines()
    for row in csv.DictReader(lines):
        path = root / row["image"]
        image = read_header(path)
        pose = np.array([float(row[name]) for name in POSE]).reshape(3, 4)
        cam_from_world, _ = validate_pose(pose, f"{root / TABLE}, {path.name}")
        fx, fy, cx, cy = (float(row[name]) for name in ("fx", "fy", "cx", "cy"))
        intrinsics = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        name = Path(row["image"]).stem
        views.append(View(name, path, cam_from_world, intrinsics, image.width, image.height))
    return Capture(root, FORMAT.name, {"train": tuple(views)})


FORMAT = CaptureFormat("camera_table", TABLE, lambda root: (root / TABLE).is_file(), read_table)
