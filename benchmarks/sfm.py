"""Poses found by `dyngs data sfm` beside those that captures come with, and what is trained from
both.

    python benchmarks/sfm.py FOLDER CAPTURE... [--video NAME,...] [--train STEPS] [--side PX]
    [--threads N] [key=value]

The images of each capture are copied, shrunk to PX on their longest side, without their poses;
those of captures named by --video become a video. Poses are estimated, aligned with the given ones
by a similarity, and compared: the distance of camera centres as a fraction of the span (the largest
distance of two given centres). With --train both are trained at PX with the given overrides and
measured on the same images: every eighth one. FOLDER keeps all of it.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.distance import pdist

from dyngs.api.train import train
from dyngs.capture.sfm.colmap import SfmOptions
from dyngs.capture.sfm.estimate import estimate_poses
from dyngs.config import DataConfig
from dyngs.config.io import load_config
from dyngs.data.capture import View, all_views
from dyngs.data.images.images import area_downscale, read_image, target_size
from dyngs.data.read import read_capture
from dyngs.evaluate.report import evaluate_run
from dyngs.export.video import video_writer
from dyngs.io.write import to_uint8, write_image
from dyngs.runs.checkpoint import checkpoint_paths

CONFIGS = Path(__file__).parents[1] / "configs"
FPS = 24


def shrunk(view: View, side: int) -> np.ndarray:
    """Return the stored image of a view, (H, W, 3) uint8, shrunk to ``side``."""
    pixels = read_image(view.image_path)[..., :3].float() / 255
    size = target_size(pixels.shape[1], pixels.shape[0], longest_side=side)
    return to_uint8(area_downscale(pixels, *size).numpy())


def unposed(views: Sequence[View], folder: Path, side: int, video: bool) -> Path:
    """Write the images without their poses; return the folder or the video, whose frames are sorted
    by name."""
    if video:
        path = folder.with_suffix(".mp4")
        if not path.exists():
            with video_writer(path, fps=FPS, quality=9) as add:
                for view in views:
                    add(shrunk(view, side))
        return path
    for view in views:
        target = folder / f"{view.image_path.stem}.png"
        if not target.exists():
            write_image(target, shrunk(view, side))
    return folder


def centres(views: Sequence[View], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return camera centres by name."""
    found = (np.linalg.inv(view.cam_from_world)[:3, 3] for view in views)
    return dict(zip(names, found, strict=True))


def errors(found: dict[str, np.ndarray], given: dict[str, np.ndarray]) -> np.ndarray:
    """Return distances of centres after a similarity, as fractions of the span of the given
    ones."""
    names = sorted(found.keys() & given.keys())
    x, y = (np.array([centre[name] for name in names]) for centre in (found, given))
    a = x - x.mean(0)
    b = y - y.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * signs).sum() / (a**2).sum()
    return np.linalg.norm(scale * a @ ((u * signs) @ vt).T - b, axis=1) / pdist(y).max()


def trained(root: Path, run: Path, preset: str, overrides: Sequence[str]) -> float:
    """Return the PSNR on the test images of a run, trained where it is not there."""
    if not checkpoint_paths(run):
        keys = [f"data.root={root}", f"run.dir={run}", "data.test_every=8", *overrides]
        train(load_config(CONFIGS / f"{preset}.yaml", keys))
    return evaluate_run(run).psnr


def row(capture: Path, options: argparse.Namespace, overrides: Sequence[str]) -> str:
    """Return the row of the table for a capture."""
    video = capture.name in options.video.split(",")
    views = sorted(
        all_views(read_capture(DataConfig(root=capture)).splits),
        key=lambda view: view.image_path.stem,
    )
    name = f"{capture.name}_{options.side}"
    source = unposed(views, options.folder / name, options.side, video)
    out = options.folder / f"{name}_posed"
    figures = options.folder / f"{name}_sfm.json"
    if not figures.exists():
        before = resource.getrusage(resource.RUSAGE_SELF)
        begun = time.perf_counter()
        result = estimate_poses(source, out, SfmOptions(num_threads=options.threads))
        after = resource.getrusage(resource.RUSAGE_SELF)
        cpu = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        fields = [
            time.perf_counter() - begun,
            cpu,
            result.num_registered,
            result.num_images,
            result.mean_error_px,
        ]
        figures.write_text(json.dumps(fields))
    seconds, cpu, registered, count, error_px = json.loads(figures.read_text())
    posed = all_views(read_capture(DataConfig(root=out)).splits)
    frames = [views[int(view.image_path.stem[6:])] if video else view for view in posed]
    labels = [view.image_path.stem for view in frames]
    off = errors(centres(posed, labels), centres(views, [view.image_path.stem for view in views]))
    text = f"| {name} | {seconds:.0f} ({cpu:.0f}) | {registered} of {count} | {error_px:.2f} px "
    text += f"| {off.mean():.2%}, {off.max():.2%} "
    if options.train:
        preset = "dynamic" if video else "static"
        keys = [f"train.steps={options.train}", f"data.longest_side={options.side}", *overrides]
        roots = (("given", capture), ("found", out))
        given, found = (
            trained(root, options.folder / f"{name}_{kind}", preset, keys) for kind, root in roots
        )
        text += f"| {given:.2f} dB | {found:.2f} dB "
    return text + "|"


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("words", nargs="+", help="captures, and key=value")
    parser.add_argument("--video", default="", help="names of captures whose images become a video")
    parser.add_argument("--train", type=int, default=0, metavar="STEPS")
    parser.add_argument("--side", type=int, default=200)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_intermixed_args(words)
    options.folder.mkdir(parents=True, exist_ok=True)
    overrides = [word for word in options.words if "=" in word]
    columns = [
        "capture",
        "seconds (CPU)",
        "registered",
        "error",
        "centres, mean and max of the span",
    ]
    columns += ["PSNR, given poses", "PSNR, found poses"] if options.train else []
    print(f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for word in options.words:
        if "=" not in word:
            print(row(Path(word), options, overrides), flush=True)


if __name__ == "__main__":
    main()
