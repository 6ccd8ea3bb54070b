"""How well the preset `static` shows sky and far hills behind a scene.

    python benchmarks/sky.py FOLDER CAPTURE... [key=value ...]

Copies of each capture, whose images must have alpha, are put before a procedural sky. `infinite`:
clouds and hills that depend on the direction of the ray alone. `ridges`: that sky behind five
ridges, 30 to 100 times as far as the cameras are from their centre. Points are in silhouettes, and
as far as structure from motion finds them. Printed are Gaussians, those more than ten times as far
as the farthest camera, and held-out PSNR: whole, where there is sky, and the rest.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
import trimesh

import dyngs
from dyngs.api.train import train
from dyngs.capture.initial_points import sample_points_in_silhouettes
from dyngs.config import DataConfig
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.metrics import psnr
from dyngs.data.capture import PointCloud, Split, Splits, View
from dyngs.data.geometry import camera_center, invert_rigid
from dyngs.data.images.images import read_image
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.scene_space import cube_half_side
from dyngs.evaluate.report import split_views
from dyngs.gaussians.scene import require_gaussians
from dyngs.io.write import write_image
from dyngs.runs.checkpoint import load_run

FARS = {"infinite": (1e6,), "ridges": (30.0, 40.0, 55.0, 75.0, 100.0)}
HORIZON = -0.35  # Tangent of its elevation: cameras of NeRF-synthetic look down
SAMPLES = 2  # per pixel and side
FAR_POINTS = 60  # per view


def _noise(points: np.ndarray, frequency: float, seed: int) -> np.ndarray:
    """Return smooth noise (...,) in about [-1, 1] of ``points`` (..., 3)."""
    random = np.random.default_rng(seed)
    total = np.zeros(points.shape[:-1], np.float32)
    for octave in range(3):
        waves = random.normal(size=(3, 8)) * frequency * 2**octave
        total += (
            0.5**octave
            * np.cos(points @ waves.astype(np.float32) + random.uniform(0, 6.28, 8)).sum(-1)
            / 3
        )
    return total / 2


def far_colours(
    rays: np.ndarray, origin: np.ndarray, distances: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return colours (..., 3) and distances (...) of unit ``rays`` (..., 3) from ``origin`` (3,), z
    up, centre at 0."""
    up = rays[..., 2] / np.maximum(np.linalg.norm(rays[..., :2], axis=-1), 1e-6)
    height = np.clip((up - HORIZON) / 1.5, 0, 1)[..., None]
    sky = (1 - height) * np.array([0.78, 0.85, 0.95]) + height * np.array([0.2, 0.42, 0.8])
    cloud = np.clip(3 * _noise(rays * np.array([1, 1, 2.0], np.float32), 5, 0), 0, 1)[..., None]
    colours = (1 - 0.8 * cloud) * sky + 0.8 * cloud
    depth = np.full(rays.shape[:-1], 1e6)
    for k, far in reversed(list(enumerate(distances))):
        flat = rays[..., :2]
        a = (flat**2).sum(-1)
        b = flat @ origin[:2]
        c = (origin[:2] ** 2).sum() - far**2
        hit = origin + rays * ((np.sqrt(b**2 - a * c) - b) / np.maximum(a, 1e-9))[..., None]
        azimuth = np.arctan2(hit[..., 1], hit[..., 0])
        random = np.random.default_rng(k)
        ridge = sum(
            np.sin(n * azimuth + random.uniform(0, 6.28)) / n for n in (3, 5, 8, 13, 21, 34)
        )
        top = HORIZON + 0.1 * (ridge + k - len(distances) + 1)
        shade = 0.75 + 0.25 * _noise((hit / far).astype(np.float32), 12, 10 + k)
        haze = k / max(len(distances), 2)
        own = (
            (1 - haze) * np.array([0.25, 0.4, 0.15]) + haze * np.array([0.5, 0.6, 0.75])
        ) * shade[..., None]
        is_hit = hit[..., 2] / far < top
        colours = np.where(is_hit[..., None], own, colours)
        depth = np.where(is_hit, np.linalg.norm(hit - origin, axis=-1), depth)
    return colours, depth


def rays_of(view: View, pixels: np.ndarray) -> np.ndarray:
    """Return unit rays (..., 3) of ``pixels`` (..., 2) in the world."""
    rays = (
        np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)
        @ np.linalg.inv(view.intrinsics).T
    )
    rays = (rays @ view.cam_from_world[:3, :3]).astype(np.float32)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def behind(
    view: View, centre: np.ndarray, scale: float, distances: tuple[float, ...]
) -> np.ndarray:
    """Return what a view (H, W, 3) sees of what is far."""
    n = SAMPLES
    x = (np.arange(view.width * n) + 0.5) / n
    y = (np.arange(view.height * n) + 0.5) / n
    rays = rays_of(view, np.stack(np.meshgrid(x, y), -1))
    origin = ((camera_center(view.cam_from_world) - centre) / scale).astype(np.float32)
    colours, _ = far_colours(rays, origin, distances)
    return colours.reshape(view.height, n, view.width, n, 3).mean((1, 3))


def far_points(view: View, centre: np.ndarray, scale: float, kind: str, seed: int) -> PointCloud:
    """Return points as structure from motion finds them: up to 76 times as far as the cameras are
    from their centre."""
    random = np.random.default_rng(seed)
    rays = rays_of(view, random.random((FAR_POINTS, 2)) * (view.width, view.height))
    origin = (camera_center(view.cam_from_world) - centre) / scale
    colours, depth = far_colours(rays, origin.astype(np.float32), FARS[kind])
    depth = np.minimum(depth, 1 / random.uniform(1 / 76, 1 / 30, FAR_POINTS))
    rgb = np.round(255 * colours.clip(0, 1)).astype(np.uint8)
    return PointCloud(camera_center(view.cam_from_world) + scale * rays * depth[:, None], rgb)


def with_sky(capture: Path, out: Path, kind: str) -> None:
    """Write a copy of ``capture`` before a sky."""
    shutil.copytree(capture, out)
    splits = dyngs.read_capture(DataConfig(root=out)).splits
    half_side = cube_half_side("auto", splits["train"], 1.0)
    near = sample_points_in_silhouettes(splits["train"], DataConfig(root=out), 5000, half_side)
    centres = np.stack([camera_center(view.cam_from_world) for view in splits["train"]])
    centre = centres.mean(0)
    scale = float(np.linalg.norm(centres - centre, axis=1).mean())
    for view in (view for views in splits.values() for view in views):
        pixels = read_image(view.image_path).numpy().astype(np.float32) / 255
        alpha = pixels[..., 3:]
        mixed = alpha * pixels[..., :3] + (1 - alpha) * behind(view, centre, scale, FARS[kind])
        write_image(view.image_path, np.round(255 * mixed.clip(0, 1)).astype(np.uint8))
    clouds = [far_points(view, centre, scale, kind, i) for i, view in enumerate(splits["train"])]
    clouds += [near] if near is not None else []
    xyz = np.concatenate([x.xyz for x in clouds])
    rgb = np.concatenate([x.rgb for x in clouds])
    trimesh.PointCloud(xyz, colors=rgb).export(out / "points3D.ply")
    _as_nerfstudio(out, splits)


def _as_nerfstudio(out: Path, splits: Splits) -> None:
    """Write the poses anew as ``transforms.json``: NeRF-synthetic says that all lies in a cube
    around the origin."""
    frames = []
    for view in (view for views in splits.values() for view in views):
        pose = invert_rigid(view.cam_from_world) * np.array([1, -1, -1, 1])
        (fx, _, cx), (_, fy, cy), _ = view.intrinsics.tolist()
        size = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": view.width, "h": view.height}
        path = view.image_path.relative_to(out).as_posix()
        frames.append({"file_path": path, "transform_matrix": pose.tolist(), **size})
    lists = {
        f"{name}_filenames": [v.image_path.relative_to(out).as_posix() for v in views]
        for name, views in splits.items()
    }
    for path in out.glob("transforms_*.json"):
        path.unlink()
    (out / "transforms.json").write_text(json.dumps({**lists, "frames": frames}))


@torch.no_grad()
def scores(run: Path, capture: Path) -> str:
    """Return a row about a run; ``capture`` has the alpha."""
    loaded = load_run(run)
    gaussians = require_gaussians(loaded.scene, str(run)).at(None)
    config = loaded.config
    centres = torch.stack([image.cameras.centers[0] for image in _images(config.data, "train")])
    middle = centres.mean(0)
    reach = 10 * (centres - middle).norm(dim=1).max()
    far = int(((gaussians.means - middle).norm(dim=1) > reach).sum())
    found: list[list[float]] = []
    for image, cut in zip(
        _images(config.data, "test"),
        _images(config.data.model_copy(update={"root": capture}), "test"),
        strict=True,
    ):
        black = torch.zeros(3, device="cpu")
        shown = loaded.scene.render(image.cameras, None, background=black).rgb[0]
        assert cut.alpha is not None
        is_sky = (cut.alpha < 0.01).float()
        found.append(
            [psnr(shown, image.composite(black), mask) for mask in (None, is_sky, 1 - is_sky)]
        )
    means = (f"{fmean(x):.2f}" for x in zip(*found, strict=True))
    return f"{run.name}: {len(gaussians):,} Gaussians, {far:,} far; whole, sky, rest: {', '.join(means)} dB"


def _images(options: DataConfig, split: Split) -> list[Image]:
    loader = ImageLoader(split_views(read_capture(options), split), options)
    return [loader[i] for i in range(len(loader))]


def main(folder: Path, captures: Sequence[Path], overrides: Sequence[str]) -> None:
    for capture in captures:
        for kind in FARS:
            copy, run = (folder / f"{name}_{capture.name}_{kind}" for name in ("capture", "run"))
            if not copy.exists():
                with_sky(capture, copy, kind)
            train(
                load_config(
                    packaged_preset("static"), [f"data.root={copy}", f"run.dir={run}", *overrides]
                )
            )
            print(scores(run, capture), flush=True)


if __name__ == "__main__":
    given = sys.argv[2:]
    main(
        Path(sys.argv[1]), [Path(x) for x in given if "=" not in x], [x for x in given if "=" in x]
    )
