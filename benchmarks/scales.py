"""Protocol of Mip-Splatting (Yu et al. 2024): trained at one scale or at all, tested at several.

    python benchmarks/scales.py CAPTURE FOLDER [--side 100] [--steps 7000] [key=value ...]
    python benchmarks/scales.py CAPTURE FOLDER --table

CAPTURE has no point cloud (NeRF-synthetic) and images larger than --side, the longest side in px of
scale 1. Each variant is trained with images of scale 1, or of scales 1, 1/2, 1/4 and 1/8 together,
where scale 1 makes 40 % of the images. Test images of all scales are area averages of the images
of CAPTURE. Overrides apply to all trainings. One row is stored as
FOLDER/results/VARIANT_PROTOCOL_SEED.json; stored rows are not trained again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import torch
from dynamic import write_result
from results import current_commit, table
from torch import Tensor

from dyngs.config import DataConfig
from dyngs.core.metrics import psnr
from dyngs.data.geometry import to_opengl_pose
from dyngs.data.images.images import to_straight_uint8
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.scene_space import change_coordinates
from dyngs.evaluate.view_scores import SceneRenderer
from dyngs.io.write import write_image
from dyngs.models.views import evaluation_background
from dyngs.runs.checkpoint import load_run

# Scales of the test images; those larger than the stored images are left out.
TESTED = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
# Scales and number of copies of the training images of protocol `all`
TRAINED = ((1.0, 2), (0.5, 1), (0.25, 1), (0.125, 1))
PROTOCOLS = ("one", "all")
CLASSIC = ("model.rasterize_mode=classic", "model.eps2d=0.3")
VARIANTS: dict[str, tuple[str, ...]] = {
    "both": (),
    "2D": ("model.filter_3d=false",),
    "3D": CLASSIC,
    "neither": (*CLASSIC, "model.filter_3d=false"),
}


@dataclass(frozen=True)
class Row:
    """One training."""

    folder: Path
    variant: str
    protocol: str
    seed: int

    @property
    def stem(self) -> str:
        return f"{self.variant}_{self.protocol}_{self.seed}"

    @property
    def run(self) -> Path:
        return self.folder / "runs" / self.stem

    @property
    def result(self) -> Path:
        return self.folder / "results" / f"{self.stem}.json"


def with_alpha(image: Image) -> Tensor:
    """Return (H, W, 3 or 4) uint8 with straight alpha."""
    pixels = image.rgb_premultiplied
    if image.alpha is not None:
        pixels = torch.cat([pixels, image.alpha[..., None]], dim=-1)
    return to_straight_uint8(pixels)


def write_all_scales(root: Path, out: Path, side: int) -> None:
    """Write a capture in the format of nerfstudio with the training images of all scales."""
    if (out / "transforms.json").exists():
        return
    capture = read_capture(root)
    frames: list[dict[str, Any]] = []
    for scale, copies in TRAINED:
        options = DataConfig(root=root, longest_side=round(scale * side))
        loader = ImageLoader(capture.splits["train"], options)
        for i, view in enumerate(loader.views):
            image = loader[i]
            pose = to_opengl_pose(view.cam_from_world)
            pose[:3, 3] = capture.world_scale * pose[:3, 3] + capture.world_offset
            intrinsics = image.cameras.intrinsics[0]
            frame = {
                "w": image.cameras.width,
                "h": image.cameras.height,
                "fl_x": float(intrinsics[0, 0]),
                "fl_y": float(intrinsics[1, 1]),
                "cx": float(intrinsics[0, 2]),
                "cy": float(intrinsics[1, 2]),
                "transform_matrix": pose.tolist(),
            }
            for copy in range(copies):
                name = f"images/{round(scale * side):04d}_{copy}_{i:04d}.png"
                path = out / name
                path.parent.mkdir(parents=True, exist_ok=True)
                write_image(path, with_alpha(image).numpy())
                frames.append(frame | {"file_path": name})
    names = [frame["file_path"] for frame in frames]
    text = json.dumps({"train_filenames": names, "frames": frames})
    (out / "transforms.json").write_text(text, encoding="utf-8")


def train_run(row: Row, root: Path, words: list[str]) -> None:
    """Train a run; one that was interrupted continues."""
    command = ["train", "mip", f"data.root={root}", f"run.dir={row.run}", *VARIANTS[row.variant]]
    command += [f"run.seed={row.seed}", "run.threads=1", *words]
    if (row.run / "checkpoints").exists():
        command = ["train", "--resume", str(row.run)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "dyngs", *command], env=environment, capture_output=True, text=True
    )
    if done.returncode and "already finished" not in done.stderr:
        sys.exit(f"{row.stem}: {done.stderr.strip().splitlines()[-1]}")


def measure(row: Row, root: Path, side: int, largest: int) -> dict[str, float]:
    """Return the mean PSNR of the test images by scale."""
    run = load_run(row.run)
    capture = change_coordinates(read_capture(root), run.info.world_scale, run.info.world_offset)
    _, background = evaluation_background(run.config.data.background, capture.has_alpha)
    renderer = SceneRenderer(run.scene, run.scene.options, background)
    found = {}
    for scale in TESTED:
        if scale * side > largest:
            continue
        options = DataConfig(root=root, longest_side=round(scale * side))
        loader = ImageLoader(capture.splits["test"], options)
        scores = []
        for i in range(len(loader.views)):
            image = loader[i]
            rendered = renderer.image(image.cameras, image.time).clamp(0, 1)
            scores.append(psnr(rendered, image.composite(background)))
        found[f"{scale:g}"] = sum(scores) / len(scores)
    return found


def run_row(row: Row, options: argparse.Namespace, largest: int) -> None:
    """Train, measure and store a row."""
    root = options.capture
    side = f"data.longest_side={options.side}"
    if row.protocol == "all":
        root = options.folder / "all_scales"
        side = "data.longest_side=0"
    words = [f"train.steps={options.steps}", side, *options.overrides]
    train_run(row, root, words)
    facts = {"variant": row.variant, "protocol": row.protocol, "seed": row.seed, "words": words}
    facts["psnr"] = measure(row, options.capture, options.side, largest)
    facts["commit"] = current_commit()
    write_result(row.result, facts)
    print(f"{row.stem}: {facts['psnr']}", flush=True)


def results_table(folder: Path) -> str:
    """Return the stored results in Markdown."""
    paths = sorted((folder / "results").glob("*.json"))
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    order = list(VARIANTS)
    found.sort(key=lambda x: (PROTOCOLS.index(x["protocol"]), order.index(x["variant"]), x["seed"]))
    scales = [f"{scale:g}" for scale in TESTED]
    rows = [["trained at", "filters", "seed", *(f"{scale}x" for scale in scales)]]
    for x in found:
        own = [f"{x['psnr'][scale]:.2f}" if scale in x["psnr"] else "" for scale in scales]
        rows.append([f"{x['protocol']} scale", x["variant"], str(x["seed"]), *own])
    return table(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, metavar="CAPTURE")
    parser.add_argument("folder", type=Path, metavar="FOLDER")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    parser.add_argument("--side", type=int, default=100, help="longest side of scale 1, px")
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--protocols", nargs="+", default=PROTOCOLS, choices=PROTOCOLS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time, one thread each")
    parser.add_argument("--table", action="store_true", help="print the table, do not train")
    options = parser.parse_args()
    if not options.table:
        options.folder.mkdir(parents=True, exist_ok=True)
        views = read_capture(options.capture).splits["test"]
        largest = max(max(view.width, view.height) for view in views)
        if "all" in options.protocols:
            write_all_scales(options.capture, options.folder / "all_scales", options.side)
        rows = [
            Row(options.folder.absolute(), variant, protocol, seed)
            for seed, protocol, variant in product(
                options.seeds, options.protocols, options.variants
            )
        ]
        missing = [row for row in rows if not row.result.is_file()]
        with ThreadPoolExecutor(options.jobs) as pool:
            list(pool.map(lambda row: run_row(row, options, largest), missing))
    print(results_table(options.folder))


if __name__ == "__main__":
    main()
