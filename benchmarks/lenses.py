"""What undistorting a fisheye lens costs.

    python benchmarks/lenses.py FOLDER [--degrees 120] [--side 160] [--views 24] [key=value ...]

Ray-traced images of a furnished corner (`dyngs/data/synthetic`): training through an equidistant
fisheye of so many degrees across, and as many through a pinhole of the same focal length, to
compare with. Test images are the truth from poses in between, through pinholes 60 and 100 degrees
across, which no lens touched. FOLDER keeps captures and runs, which are reused.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from dyngs.api.train import train
from dyngs.config.io import load_config, packaged_preset
from dyngs.data.capture import Lens
from dyngs.data.geometry import pinhole_matrix
from dyngs.data.images.lens import undistort_points
from dyngs.data.synthetic.captures import f32, scene_at, trace
from dyngs.evaluate.report import evaluate_run
from dyngs.io.write import write_image, write_text
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths

SAMPLES, DISTANCE = 2, 2.6
FISHEYE = Lens("fisheye", (0.0,) * 4)


def directions(
    lens: Lens, focal: float, size: tuple[int, int], shift: tuple[float, float]
) -> np.ndarray:
    """Return (H * W, 3) unit rays in OpenGL axes through one place in every pixel."""
    width, height = size
    y, x = np.mgrid[:height, :width] + np.asarray(shift)[::-1, None, None]
    intrinsics = pinhole_matrix(focal, focal, 0.5 * width, 0.5 * height)
    places = torch.from_numpy(np.stack([x, y], -1).reshape(-1, 2))
    flat = undistort_points(lens, intrinsics, places).numpy() - (0.5 * width, 0.5 * height)
    rays = np.column_stack([flat[:, 0], -flat[:, 1], np.full(len(flat), -focal)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def image(pose: np.ndarray, lens: Lens, focal: float, size: tuple[int, int]) -> np.ndarray:
    """Return the (H, W, 3) uint8 image of the room from an OpenGL pose."""
    scene = scene_at("room", 0.3)
    total = np.zeros((size[0] * size[1], 3), np.float32)
    for a, b in np.ndindex(SAMPLES, SAMPLES):
        rays = (
            directions(lens, focal, size, ((a + 0.5) / SAMPLES, (b + 0.5) / SAMPLES))
            @ pose[:3, :3].T
        )
        lamps = np.broadcast_to(f32(scene.lamp), rays.shape)
        hit, colours = trace(scene, f32(pose[:3, 3]), f32(rays), lamps)
        total[hit] += colours
    return (255 * total / SAMPLES**2 + 0.5).astype(np.uint8).reshape(size[1], size[0], 3)


def poses(count: int, seed: int) -> np.ndarray:
    """Return (count, 4, 4) OpenGL poses on an arc before the corner, looking about its middle."""
    random = np.random.default_rng(seed)
    azimuth = np.radians(
        -45 + 70 * ((np.arange(count) + 0.5) / count - 0.5) + random.uniform(-2, 2, count)
    )
    elevation = np.radians(random.uniform(8, 32, count))
    distance = DISTANCE * random.uniform(0.6, 1.0, count)
    centres = distance[:, None] * np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        -1,
    )
    backward = centres - random.uniform(-0.4, 0.4, (count, 3))
    backward /= np.linalg.norm(backward, axis=1, keepdims=True)
    right = np.cross([0.0, 0, 1], backward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    found = np.tile(np.eye(4), (count, 1, 1))
    found[:, :3, :4] = np.stack([right, np.cross(backward, right), backward, centres], -1)
    return found


def write_capture(out: Path, lens: Lens, focal: float, options: argparse.Namespace) -> None:
    """Write training images through ``lens``, and test images through wide pinholes."""
    size = (options.side, options.side * 3 // 4)
    tested = [(0.5 * size[0] / np.tan(np.radians(degrees / 2)), Lens()) for degrees in (60, 100)]
    for split, count, lenses in (("train", options.views, [(focal, lens)]), ("test", 8, tested)):
        frames = []
        for i, pose in enumerate(poses(count, 0 if split == "train" else 1)):
            own_focal, own = lenses[i % len(lenses)]
            write_image(out / split / f"{i:03d}.png", image(pose, own, own_focal, size))
            frames.append(
                {
                    "file_path": f"{split}/{i:03d}.png",
                    "transform_matrix": pose.tolist(),
                    "fl_x": own_focal,
                    "is_fisheye": own.model == "fisheye",
                }
            )
        write_text(out / f"transforms_{split}.json", json.dumps({"frames": frames}))


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("keys", nargs="*", help="key=value")
    parser.add_argument("--degrees", type=float, default=120.0)
    parser.add_argument("--side", type=int, default=160)
    parser.add_argument("--views", type=int, default=24)
    options = parser.parse_intermixed_args(words)
    keys = [word for word in options.keys if re.match(r"[\w.]+=", word)]
    focal = 0.5 * options.side / np.radians(options.degrees / 2)
    print("| lens of training | PSNR | Gaussians | CPU s |\n|" + "---|" * 4)
    with kernel_threads(torch.get_num_threads()):
        for name, lens in (("pinhole", Lens()), ("fisheye", FISHEYE)):
            root = options.folder / name
            run = options.folder / f"{name}_run"
            if not root.exists():
                write_capture(root, lens, focal, options)
            begun = resource.getrusage(resource.RUSAGE_SELF).ru_utime
            if not checkpoint_paths(run):
                own = [f"data.root={root}", f"run.dir={run}", *keys]
                train(load_config(packaged_preset("static"), own))
            seconds = resource.getrusage(resource.RUSAGE_SELF).ru_utime - begun
            report = evaluate_run(run)
            print(
                f"| {name} | {report.psnr:.2f} | {report.num_gaussians:,} | {seconds:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
