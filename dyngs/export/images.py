"""Rendered images and videos, contact sheets, and comparison of exported files with their
source."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import ProgressCallback, encode_srgb, ignore_progress
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import psnr
from dyngs.data.loader import ImageLoader
from dyngs.export.camera_paths import CameraPath, pick_cameras, spread_rows
from dyngs.export.orbits import frame_orbit_for_points
from dyngs.export.video import video_writer
from dyngs.gaussians.rendering import file_render_options, render, splat_options
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.formats import WrittenFile, read_splats
from dyngs.io.formats.similarity import AXES
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.labelled_sheet import labelled_sheet
from dyngs.io.write import to_uint8, write_image
from dyngs.models.renderable import DrawOptions, Renderable, TimeStep
from dyngs.ops.device import CPU
from dyngs.runs.folder import collect_inputs
from dyngs.runs.opened import OpenedScene, split_views


@dataclass(frozen=True)
class DrawnImage:
    """A rendered image, float32."""

    rgb: np.ndarray  # (H, W, 3) on the background, clamped to [0, 1]
    alpha: np.ndarray  # (H, W) in [0, 1]
    # (H, W) expected depth, 0 for empty pixels; None if not rendered
    depth: np.ndarray | None


@dataclass(frozen=True)
class OutputOptions:
    """Files to write in addition to the colour images."""

    # ``NAME_depth.png`` (colours) and ``NAME_depth.exr`` (float32, along the optical axis, in the
    # unit of the capture)
    depth: bool = False
    alpha: bool = False  # ``NAME_alpha.png``, white = opaque
    video: Path | None = None  # video of the colour images in order
    fps: float = 30.0  # frames per second of the video
    # colour images have straight alpha, for scenes on a black background
    transparent: bool = False


def render_frame(
    scene: Renderable,
    camera: Cameras,
    time: float | TimeStep | None = None,
    options: DrawOptions | None = None,
) -> DrawnImage:
    """Render one camera without gradients.

    Args:
        time: scene time in [0, 1], or a precomputed time step.
        options: render options. None uses those of the scene. ``depth`` other than "none" adds
            depth.
    """
    with torch.no_grad():
        rendering = scene.render(camera, time, options=options)
    depth = None if rendering.depth is None else rendering.depth[0].cpu().numpy()
    return DrawnImage(
        rendering.rgb[0].clamp(0, 1).cpu().numpy(), rendering.alpha[0].cpu().numpy(), depth
    )


def render_path(
    scene: Renderable, path: CameraPath, options: DrawOptions | None = None
) -> Iterator[DrawnImage]:
    """Yield the frames along a path, one at a time.

    The scene is deformed again only if the time changes. A path without times uses time 0.
    """
    times = [None] * len(path) if path.times is None or scene.is_static else path.times
    time_step, step_time = None, None
    for camera, time in zip(path.cameras, times, strict=True):
        if time_step is None or time != step_time:
            with torch.no_grad():
                time_step = scene.drawing_step(time)
            step_time = time
        yield render_frame(scene, camera, time_step, options)


def write_path_images(
    opened: OpenedScene,
    path: CameraPath,
    out_dir: Path | None,
    output: OutputOptions = OutputOptions(),
    on_progress: ProgressCallback = ignore_progress,
) -> list[Path]:
    """Render a scene along a path to ``frame_0000.png`` etc. and to a video. Return the paths.

    Depth colours of all frames use the range of the first frame.

    Args:
        out_dir: folder of the images. None writes only the video.
        on_progress: receives the number of frames.

    Raises:
        DyngsError: no cameras, no output, or a file cannot be written.
    """
    if len(path) == 0:
        raise DyngsError("the camera path has no cameras")
    if out_dir is None and output.video is None:
        raise DyngsError("no output: give a folder for images or a video file")
    scene = opened.renderable
    options = _with_depth(scene, output)
    digits = max(4, len(str(len(path) - 1)))

    def frames() -> Iterator[tuple[str, DrawnImage]]:
        for i, frame in enumerate(render_path(scene, path, options)):
            yield f"frame_{i:0{digits}d}", frame
            on_progress("frames", i + 1, len(path))

    return _write_images(opened, frames(), out_dir, output, one_range=True)


def write_split_images(
    opened: OpenedScene,
    split: str,
    out_dir: Path,
    output: OutputOptions = OutputOptions(),
    on_progress: ProgressCallback = ignore_progress,
    device: torch.device = CPU,
) -> list[Path]:
    """Render a split of a run to ``NAME.png`` per view and ``sheet.png`` (truth, render, error).

    The sheet shows at most 12 evenly spread views with their PSNR. Masked pixels are black. The
    background is that of ``opened``, behind truth and render.

    Returns:
        the paths of the written files.

    Raises:
        DyngsError: unknown split, unreadable images, or a video of images with several sizes.
    """
    views = split_views(opened.capture, split)
    loader = ImageLoader(views, opened.config.data)
    scene = opened.for_split(split).renderable.to(device)
    options = _with_depth(scene, output)
    shown = spread_rows(len(loader), 12)
    rows: list[tuple[str, np.ndarray, np.ndarray]] = []

    def frames() -> Iterator[tuple[str, DrawnImage]]:
        for i, stem in enumerate(file_stems([view.name for view in views])):
            image = loader[i]
            frame = render_frame(scene, image.cameras, image.time, options)
            yield stem, frame
            on_progress("views", i + 1, len(views))
            if i in shown:
                truth = image.composite(opened.background)
                rendered = torch.from_numpy(frame.rgb)
                label = f"{psnr(rendered, truth, image.mask):.2f} dB  {image.name}"
                # Masked pixels have no error.
                counts = 1.0 if image.mask is None else image.mask[..., None]
                rows.append((label, (truth * counts).numpy(), (rendered * counts).numpy()))

    sheet = out_dir / "sheet.png"
    collect_inputs(opened).require_output(sheet)
    written = _write_images(opened, frames(), out_dir, output)
    write_image(sheet, contact_sheet(rows))
    return [*written, sheet]


def _with_depth(scene: Renderable, output: OutputOptions) -> DrawOptions:
    return replace(scene.options, depth="expected" if output.depth else "none")


def file_stems(names: Sequence[str]) -> list[str]:
    """Return safe, unique file names without suffix for the names of views.

    Common folders are dropped and other folders become prefixes (``left/0001`` is ``left_0001``).
    Special characters and parts such as ``..`` are replaced, so files stay in the output folder.
    """
    parts = []
    for name in names:
        pieces = [part for part in re.split(r"[/\\]", name) if part.strip(". ")]
        parts.append([re.sub(r"[^\w.-]", "_", x).lstrip(".") or "_" for x in pieces] or ["view"])
    while all(len(p) > 1 for p in parts) and len({p[0] for p in parts}) == 1:
        parts = [p[1:] for p in parts]
    taken = {"sheet"}
    stems = []
    for part in parts:
        stem = base = "_".join(part)
        number = 1
        # Compare in lower case, since some file systems ignore case.
        while stem.lower() in taken:
            number += 1
            stem = f"{base}_{number}"
        taken |= {f"{stem}{suffix}".lower() for suffix in ("", "_depth", "_alpha")}
        stems.append(stem)
    return stems


def _write_images(
    opened: OpenedScene,
    frames: Iterable[tuple[str, DrawnImage]],
    out_dir: Path | None,
    output: OutputOptions,
    *,
    one_range: bool = False,
) -> list[Path]:
    """Write named frames as images and a video. Return the paths.

    Args:
        one_range: depth colours of all frames use the range of the first frame.
    """
    limits = None
    inputs = collect_inputs(opened)
    for out in (out_dir, output.video):
        if out is not None:
            inputs.require_output(out)
    written: list[Path] = []
    with ExitStack() as stack:
        add = None
        if output.video is not None:
            add = stack.enter_context(video_writer(output.video, output.fps))
        for stem, frame in frames:
            shown = _straight_alpha(frame) if output.transparent else frame.rgb
            pixels = {f"{stem}.png": to_uint8(shown)}
            if add is not None:
                add(pixels[f"{stem}.png"])
            if output.alpha:
                pixels[f"{stem}_alpha.png"] = frame.alpha
            if frame.depth is not None:
                limits = limits if one_range else None
                limits = limits or _depth_limits(frame.depth, frame.alpha)
                colours = depth_to_rgb(frame.depth, frame.alpha, limits)
                pixels[f"{stem}_depth.png"] = colours
                pixels[f"{stem}_depth.exr"] = frame.depth * np.float32(opened.frame.scale)
            if out_dir is None:
                continue
            for name, image in pixels.items():
                path = out_dir / name
                inputs.require_output(path)
                write_image(path, image)
                written.append(path)
    return written if output.video is None else [*written, output.video]


def _straight_alpha(frame: DrawnImage) -> np.ndarray:
    """Return an image on black as (H, W, 4) with straight alpha."""
    alpha = frame.alpha[..., None]
    colour = frame.rgb / np.maximum(alpha, 1 / 255)
    return np.concatenate([colour, alpha], axis=-1)


def contact_sheet(rows: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 with truth, render and error side by side, one view per row.

    The error is the mean absolute channel difference times 5 in magma colours. Images wider than
    480 px are downscaled after computing the difference. Captions are cut to the width of the
    image.

    Args:
        rows: label, truth and render, (H, W, 3) of equal size, uint8 or float in [0, 1].
    """
    bands = []
    for label, *images in rows:
        truth, rendered = (to_uint8(image) for image in images)
        difference = np.abs(truth.astype(np.float32) - rendered.astype(np.float32)).mean(axis=2)
        error = color_map(5.0 * (difference / 255.0), "magma")
        bands.append([(f"truth  {label}", truth), ("render", rendered), ("error x5", error)])
    return labelled_sheet(bands)


def _depth_limits(depth: np.ndarray, alpha: np.ndarray) -> tuple[float, float]:
    """Return near and far of depth colours: the 1st and 99th percentile of depth where alpha >=
    0.5.

    (0, 1) if no pixel is opaque.
    """
    seen = depth[(alpha >= 0.5) & np.isfinite(depth)]
    if not seen.size:
        return 0.0, 1.0
    near, far = np.percentile(seen, [1.0, 99.0])
    return float(near), float(far)


def depth_to_rgb(
    depth: np.ndarray, alpha: np.ndarray, limits: tuple[float, float] | None = None
) -> np.ndarray:
    """Return depth as colours (H, W, 3) uint8, from red (near) to blue (far), multiplied by alpha.

    Args:
        depth: (H, W) expected depth in world units. Non-finite values count as far.
        alpha: (H, W) in [0, 1].
        limits: near and far. None uses the range of this image.
    """
    near, far = limits or _depth_limits(depth, alpha)
    finite = np.nan_to_num(depth, nan=far, posinf=far, neginf=near)
    fraction = (far - finite) / max(far - near, 1e-12)
    colors = color_map(fraction, "turbo").astype(np.float32)
    return (colors * np.clip(alpha, 0.0, 1.0)[..., None] + 0.5).astype(np.uint8)


def color_map(values: np.ndarray, name: str) -> np.ndarray:
    """Return colours (H, W, 3) uint8 of values (H, W) in [0, 1], by a colour map of OpenImageIO."""
    import OpenImageIO as oiio

    clipped = np.clip(values, 0.0, 1.0)[..., None]
    source = oiio.ImageBuf(np.ascontiguousarray(clipped, dtype=np.float32))
    colored = oiio.ImageBufAlgo.color_map(source, 0, name)
    linear = np.asarray(colored.get_pixels(oiio.FLOAT))[..., :3]  # colour tables are linear
    return to_uint8(encode_srgb(np.clip(linear, 0.0, 1.0)))


def compare_file_with_run(
    opened: OpenedScene, scene: GaussianScene, time: float, meant: SplatFile, read: SplatFile
) -> float:
    """Return the PSNR in dB between renderings of a file and of its scene; 100 if equal.

    Uses four cameras of the capture, or an orbit.

    Args:
        time: scene time in [0, 1].
        meant: intended content of the file, in its axes.
        read: content read from the file.
    """
    frame = meant.frame.after(opened.file_unit)
    cameras = opened.cameras
    if cameras is None:
        cameras = frame.inverse().cameras(_orbit_of_file(meant))
    else:
        cameras = pick_cameras(cameras, spread_rows(len(cameras), 4))
    black = torch.zeros(3, device=scene.device)
    with torch.no_grad():
        wanted = scene.render(cameras, time, background=black).rgb
    return compare_with_images(
        wanted, frame.cameras(cameras), read, scene.options.near * frame.scale
    )


def compare_file_with_source(splat: SplatFile, written: WrittenFile) -> float:
    """Return the PSNR in dB between renderings of a converted file and its source on an orbit.

    Raises:
        DyngsError: the file cannot be read.
    """
    cameras = _orbit_of_file(splat)
    moved = written.splat.frame.after(splat.frame.inverse())
    options = file_render_options(splat)
    black = torch.zeros_like(splat.gaussians.means[0])
    with torch.no_grad():
        wanted = render(splat.gaussians, cameras, options, background=black).rgb
    near = options.near * moved.scale
    return compare_with_images(wanted, moved.cameras(cameras), read_splats(written.path), near)


def compare_with_images(wanted: Tensor, cameras: Cameras, splat: SplatFile, near: float) -> float:
    """Return the PSNR between a file rendered from ``cameras`` and images ``wanted`` (V, H, W,
    3)."""
    options = replace(splat_options(splat), near=near)
    with torch.no_grad():
        drawn = render(splat.gaussians, cameras, options, background=wanted.new_zeros(3)).rgb
    return float(np.mean([psnr(a, b) for a, b in zip(drawn, wanted, strict=True)]))


def _orbit_of_file(splat: SplatFile) -> Cameras:
    """Return an orbit around the Gaussians of a file, in its axes."""
    means = splat.gaussians.means.numpy()
    return frame_orbit_for_points(means, 4, (240, 180), AXES[splat.up or "z"])
