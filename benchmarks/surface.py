"""Meshes of runs against the true surface of the synthetic scene of polyhedra.

    python benchmarks/polyhedra.py FOLDER --size 200
    dyngs train static data.root=FOLDER run.dir=RUN
    python benchmarks/surface.py RUN [RUN ...]

The true surface is what rays through the pixels of the training views meet. Prints the mean
distance from points of the mesh to it and back (their mean is the Chamfer distance), as parts of
the scene's size, and the F-score at 1 % of that.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from polyhedra import polyhedra
from scipy.spatial import cKDTree

from dyngs.data.geometry import invert_rigid
from dyngs.data.synthetic.captures import nearest_primitives, sampled_rays
from dyngs.export.surface_file import write_surface
from dyngs.runs.opened import OpenedScene, open_run

SIDE = 200  # Rays along an image
POINTS = 300_000  # Of a mesh
NEAR = 0.01  # Of the scene's size


def true_points(opened: OpenedScene) -> np.ndarray:
    """Return (P, 3) points of the true surface that training views see."""
    scene = polyhedra()
    found = []
    for view in opened.capture.splits["train"]:
        pose = invert_rigid(view.cam_from_world).astype(np.float32)
        pose[:3, 1:3] *= -1  # axes of cameras as the ray tracer has them: y up, looking along -z
        origin = pose[:3, 3]
        for directions in sampled_rays(pose, SIDE, 1):
            _, distance = nearest_primitives(scene, origin, directions)
            hit = np.isfinite(distance)
            found.append(origin + distance[hit, None] * directions[hit])
    return np.concatenate(found)


def scored(found: np.ndarray, true: np.ndarray) -> tuple[float, float, float]:
    """Return mean distances of ``found`` from ``true`` and back, and the F-score, all as parts of
    the size."""
    size = float(np.ptp(true, axis=0).max())
    to_true = cKDTree(true).query(found)[0] / size
    to_found = cKDTree(found).query(true)[0] / size
    precision = float((to_true < NEAR).mean())
    recall = float((to_found < NEAR).mean())
    return (
        float(to_true.mean()),
        float(to_found.mean()),
        2 * precision * recall / max(precision + recall, 1e-9),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    runs: list[Path] = parser.parse_args().runs
    print(
        "| run | triangles | mesh to truth | truth to mesh | F-score at 1 % |\n|---|---|---|---|---|"
    )
    for path in runs:
        opened = open_run(path)
        with tempfile.TemporaryDirectory() as folder:
            surface = write_surface(opened, Path(folder) / "mesh.ply")
        mesh = trimesh.Trimesh(opened.world.points(surface.vertices), surface.faces, process=False)
        points, _ = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
        near, far, score = scored(np.asarray(points), true_points(opened))
        print(
            f"| {path} | {len(surface.faces):,} | {near:.2%} | {far:.2%} | {score:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
