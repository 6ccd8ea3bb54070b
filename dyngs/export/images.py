"""Rendered images, contact sheets, and the images of a capture drawn anew."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import ReportProgress, report_nothing, srgb_encoded
from dyngs.core.errors import DyngsError, counted
from dyngs.core.metrics import psnr
from dyngs.data.loader import ImageLoader
from dyngs.export.camera_paths import CameraPath, pick_cameras
from dyngs.export.orbits import frame_orbit_for_points
from dyngs.export.video import VideoWriter
from dyngs.gaussians.rendering import drawing_options, render, splat_options
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.formats import Written, read_splats
from dyngs.io.formats.similarity import AXES
from dyngs.io.formats.splat_file import SplatFile
from dyngs.io.write import to_uint8, write_image
from dyngs.models.renderable import DrawOptions, Renderable, TimeStep
from dyngs.ops.device import CPU
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened, split_views

# Windows opens no file of these names
_DEVICE = re.compile(r"con|prn|aux|nul|(com|lpt)[0-9¹²³]", re.IGNORECASE)
_SHEET_ROWS = 12
_DEPTH_SAMPLES = 8  # frames of a path from which the range of its depth colours is taken
# Of contact sheets, px
_GAP = 6
_LABEL_HEIGHT = 22
_PANEL_WIDTH = 480
_BACKGROUND = 32  # grey level


@dataclass(frozen=True)
class DrawnImage:
    """One rendered image, float32."""

    rgb: np.ndarray  # (H, W, 3), composited on the background, clamped to [0, 1]
    alpha: np.ndarray  # (H, W) in [0, 1]
    # (H, W) expected depth, 0 where nothing is hit; None if it was not rendered
    depth: np.ndarray | None


@dataclass(frozen=True)
class OutputOptions:
    """Files to write in addition to the colour images."""

    # ``NAME_depth.png`` (colours) and ``NAME_depth.exr`` (float32, along the optical axis, in the
    # unit of the capture)
    depth: bool = False
    alpha: bool = False  # ``NAME_alpha.png``, white = opaque
    video: Path | None = None  # MP4 of the colour images in order
    fps: float = 30.0  # frames per second of the video


def render_frame(
    scene: Renderable,
    camera: Cameras,
    time: float | TimeStep | None = None,
    options: DrawOptions | None = None,
) -> DrawnImage:
    """Render one camera, without gradients.

    ``time``: in [0, 1], or the scene at that time, so that it is not computed again. ``options``:
    None: those of the scene; ``depth`` other than "none" fills ``DrawnImage.depth``.
    """
    with torch.no_grad():
        rendering = scene.render(camera, time, options=options)
    depth = None if rendering.depth is None else rendering.depth[0].cpu().numpy()
    return DrawnImage(
        rendering.rgb[0].clamp(0, 1).cpu().numpy(), rendering.alpha[0].cpu().numpy(), depth
    )


def path_frames(
    scene: Renderable, path: CameraPath, options: DrawOptions | None = None
) -> Iterator[DrawnImage]:
    """Yield the frames along a path one by one, so that memory does not grow with their number.

    The scene is deformed only where the time differs from that of the frame before. A path without
    times shows time 0.
    """
    moment, moment_time = None, None
    for i in range(len(path)):
        time = None if path.times is None or scene.is_static else path.times[i]
        if moment is None or time != moment_time:
            with torch.no_grad():
                moment = scene.time_step(time)
            moment_time = time
        yield render_frame(scene, path.cameras.select(i), moment, options)


def write_path_images(
    opened: Opened,
    path: CameraPath,
    out_dir: Path | None,
    output: OutputOptions = OutputOptions(),
    report: ReportProgress = report_nothing,
) -> list[Path]:
    """Render a scene along a path to ``frame_0000.png`` and so on, and to a video if requested;
    return the paths.

    ``out_dir``: None writes only the video. Images of the capture are not overwritten; depth
    colours share one range over the full path. Raises DyngsError: no cameras, nothing to write, or
    a file cannot be written.
    """
    if len(path) == 0:
        raise DyngsError("the camera path has no cameras")
    if out_dir is None and output.video is None:
        raise DyngsError("nothing to write: give a folder for the images or a video file")
    scene = opened.renderable
    options = _with_depth(scene, output)
    limits = None
    if output.depth and out_dir is not None:
        count = min(len(path), _DEPTH_SAMPLES)
        rows = np.linspace(0, len(path) - 1, count, dtype=np.float32).round().astype(int)
        sample = CameraPath(
            pick_cameras(path.cameras, rows),
            times=path.times and tuple(path.times[i] for i in rows),
        )
        depths = []
        alphas = []
        for frame in path_frames(scene, sample, options):
            if frame.depth is not None:
                depths.append(frame.depth)
                alphas.append(frame.alpha)
        limits = _depth_limits(np.stack(depths), np.stack(alphas))
    digits = max(4, len(str(len(path) - 1)))
    with _FrameWriter(opened, out_dir, output, limits) as writer:
        for i, frame in enumerate(path_frames(scene, path, options)):
            writer.write(f"frame_{i:0{digits}d}", frame)
            report("frames", i + 1, len(path))
    return writer.written


def write_split_images(
    opened: Opened,
    split: str,
    out_dir: Path,
    output: OutputOptions = OutputOptions(),
    report: ReportProgress = report_nothing,
    device: torch.device = CPU,
) -> list[Path]:
    """Render a split of a run to ``NAME.png`` per view and ``sheet.png`` (truth, render, error);
    return the paths.

    The sheet shows at most 12 views, evenly spread, with their PSNR; masked pixels are black. The
    background is that of ``opened``, behind truth and render. Raises DyngsError: no such split,
    unreadable images, or a video of several sizes.
    """
    views = split_views(opened.capture, split)
    loader = ImageLoader(views, opened.config.data)
    scene = opened.of_split(split).renderable.to(device)
    options = _with_depth(scene, output)
    shown = np.linspace(0, len(loader) - 1, min(len(loader), _SHEET_ROWS)).round().astype(int)
    rows: list[tuple[str, np.ndarray, np.ndarray]] = []
    with _FrameWriter(opened, out_dir, output) as writer:
        for i, stem in enumerate(file_stems([view.name for view in views])):
            image = loader[i]
            frame = render_frame(scene, image.cameras, image.time, options)
            writer.write(stem, frame)
            report("views", i + 1, len(views))
            if i in shown:
                truth = image.composite(opened.background)
                rendered = torch.from_numpy(frame.rgb)
                label = f"{psnr(rendered, truth, image.mask):.2f} dB  {image.name}"
                # masked pixels show no error
                counts = 1.0 if image.mask is None else image.mask[..., None]
                rows.append((label, (truth * counts).numpy(), (rendered * counts).numpy()))
    writer.write_image(out_dir / "sheet.png", contact_sheet(rows))
    return writer.written


def _with_depth(scene: Renderable, output: OutputOptions) -> DrawOptions:
    return replace(scene.options, depth="expected" if output.depth else "none")


def file_stems(names: Sequence[str]) -> list[str]:
    """Return safe and unique file names, without suffix, for the names of views.

    Folders that all names share are dropped, other folders become a prefix (``left/0001`` is
    ``left_0001``). Parts such as ``..`` and special characters are replaced, so that no name leaves
    the output folder.
    """
    parts = []
    for name in names:
        pieces = [part for part in re.split(r"[/\\]", name) if part.strip(". ")]
        parts.append([_safe(piece) for piece in pieces] or ["view"])
    while all(len(p) > 1 for p in parts) and len({p[0] for p in parts}) == 1:
        parts = [p[1:] for p in parts]
    taken = {"sheet"}
    stems = []
    for part in parts:
        stem = base = "_".join(part)
        number = 1
        # in lower case because some file systems ignore case
        while taken & {f"{stem}{suffix}".lower() for suffix in ("", "_depth", "_alpha")}:
            number += 1
            stem = f"{base}_{number}"
        taken |= {f"{stem}{suffix}".lower() for suffix in ("", "_depth", "_alpha")}
        stems.append(stem)
    return stems


def _safe(part: str) -> str:
    name = re.sub(r"[^\w.-]", "_", part).lstrip(".") or "_"
    return f"{name}_" if _DEVICE.fullmatch(name.split(".")[0]) else name


class _FrameWriter:
    """Context manager that writes frames to images and a video; ``written`` lists the files."""

    def __init__(
        self,
        opened: Opened,
        out_dir: Path | None,
        output: OutputOptions,
        limits: tuple[float, float] | None = None,
    ) -> None:
        self.written: list[Path] = []
        self._inputs = inputs_of(opened)
        self._out_dir, self._output, self._limits = out_dir, output, limits
        self._depth_unit = np.float32(opened.frame.scale)
        self._stack = ExitStack()
        self._video: VideoWriter | None = None

    def __enter__(self) -> _FrameWriter:
        path = self._output.video
        for out in (self._out_dir, path):
            if out is not None:
                self._inputs.require_output(out)
        if path is not None:
            self._video = self._stack.enter_context(VideoWriter(path, fps=self._output.fps))
        return self

    def __exit__(self, *problem: object) -> None:
        self._stack.__exit__(*problem)  # type: ignore[arg-type]
        if problem[0] is None and self._output.video is not None:
            self.written.append(self._output.video)

    def write(self, stem: str, frame: DrawnImage) -> None:
        rgb = to_uint8(frame.rgb)
        if self._video is not None:
            try:
                self._video.add(rgb)
            except ValueError as error:
                raise DyngsError(f"{self._output.video}: {stem} differs: {error}") from error
        if self._out_dir is None:
            return
        self.write_image(self._out_dir / f"{stem}.png", rgb)
        if self._output.alpha:
            self.write_image(self._out_dir / f"{stem}_alpha.png", frame.alpha)
        if self._output.depth and frame.depth is not None:
            colours = depth_to_rgb(frame.depth, frame.alpha, self._limits)
            self.write_image(self._out_dir / f"{stem}_depth.png", colours)
            self.write_image(self._out_dir / f"{stem}_depth.exr", frame.depth * self._depth_unit)

    def write_image(self, path: Path, pixels: np.ndarray) -> None:
        self._inputs.require_output(path)
        write_image(path, pixels)
        self.written.append(path)


def contact_sheet(rows: Sequence[tuple[str, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 with truth, render and error side by side, one view per row.

    ``rows``: a label, truth and render, (H, W, 3) of the same size, uint8 or float in [0, 1]. The
    error is the mean absolute difference of the channels times 5, in magma colours (black = equal).
    Images wider than 480 pixels are shrunk, after the difference was taken.
    """
    bands = []
    for label, *images in rows:
        truth, rendered = (to_uint8(image) for image in images)
        difference = np.abs(truth.astype(np.float32) - rendered.astype(np.float32)).mean(axis=2)
        panels = {
            f"truth  {label}": truth,
            "render": rendered,
            "error x5": color_map(5.0 * (difference / 255.0), "magma"),
        }
        cells = [_captioned(text, panel) for text, panel in panels.items()]
        bands.append(np.concatenate(cells, axis=1))
    width = max(band.shape[1] for band in bands)
    padded = [
        np.pad(b, ((0, 0), (0, width - b.shape[1]), (0, 0)), constant_values=_BACKGROUND)
        for b in bands
    ]
    margins = ((0, _GAP), (_GAP, 0), (0, 0))
    return np.pad(np.concatenate(padded), margins, constant_values=_BACKGROUND)


def _captioned(text: str, panel: np.ndarray) -> np.ndarray:
    """Return an image (H, W, 3) uint8, shrunk to the width of panels, below a caption, with a gap on
    its right.

    The text is made smaller to fit, down to a limit at which it is cut off; there is none if no
    font is installed.
    """
    import OpenImageIO as oiio
    from skimage.transform import resize_local_mean

    if panel.shape[1] > _PANEL_WIDTH:
        height = max(round(panel.shape[0] * _PANEL_WIDTH / panel.shape[1]), 1)
        panel = to_uint8(
            resize_local_mean(panel.astype(np.float32) / 255.0, (height, _PANEL_WIDTH))
        )
    width = panel.shape[1]
    strip = np.full((_LABEL_HEIGHT, width, 3), _BACKGROUND, np.uint8)
    image = oiio.ImageBuf(strip)
    size = 14
    while size > 9 and oiio.ImageBufAlgo.text_size(text, size).width > width - 4:
        size -= 1
    ink = (0.85, 0.85, 0.85)
    if oiio.ImageBufAlgo.render_text(image, 2, _LABEL_HEIGHT - 7, text, size, textcolor=ink):
        strip = np.asarray(image.get_pixels(oiio.UINT8))
    cell = np.concatenate([strip, panel])
    return np.pad(cell, ((0, 0), (0, _GAP), (0, 0)), constant_values=_BACKGROUND)


def _depth_limits(depth: np.ndarray, alpha: np.ndarray) -> tuple[float, float]:
    """Return near and far for ``depth_to_rgb``: the 1st and 99th percentile of depth where alpha is
    at least 0.5.

    Any equal shapes, so that the frames of a video can share limits. (0, 1) if nothing is opaque.
    """
    seen = depth[(alpha >= 0.5) & np.isfinite(depth)]
    if not seen.size:
        return 0.0, 1.0
    near, far = np.percentile(seen, [1.0, 99.0])
    return float(near), float(far)


def depth_to_rgb(
    depth: np.ndarray, alpha: np.ndarray, limits: tuple[float, float] | None = None
) -> np.ndarray:
    """Return depth as colours (H, W, 3) uint8: near is red, far is blue (turbo), darkened to black
    where alpha is 0.

    ``depth``: (H, W) expected depth in world units; non-finite values count as far. ``alpha``: (H,
    W) in [0, 1]. ``limits``: near and far; None: those of this image.
    """
    near, far = limits or _depth_limits(depth, alpha)
    finite = np.nan_to_num(depth, nan=far, posinf=far, neginf=near)
    fraction = (far - finite) / max(far - near, 1e-12)
    colors = color_map(fraction, "turbo").astype(np.float32)
    return (colors * np.clip(alpha, 0.0, 1.0)[..., None] + 0.5).astype(np.uint8)


def color_map(values: np.ndarray, name: str) -> np.ndarray:
    """Return colours (H, W, 3) uint8 of values (H, W) in [0, 1], by a colour map of OpenImageIO
    (magma, turbo...)."""
    import OpenImageIO as oiio

    clipped = np.clip(values, 0.0, 1.0)[..., None]
    source = oiio.ImageBuf(np.ascontiguousarray(clipped, dtype=np.float32))
    colored = oiio.ImageBufAlgo.color_map(source, 0, name)
    if colored.has_error:
        raise ValueError(f"no colour map '{name}': {colored.geterror()}")
    linear = np.asarray(colored.get_pixels(oiio.FLOAT))[..., :3]  # tables are in linear light
    return to_uint8(srgb_encoded(np.clip(linear, 0.0, 1.0)))


VIEWS = 4
_LONGEST_SIDE = 240
# cameras that see the scene in fewer pixels than this are replaced by an orbit
_LEAST_FRACTION = 0.002


@dataclass(frozen=True)
class Redrawn:
    """A file drawn again."""

    psnr: float  # dB, mean over the images; 100 where they are equal
    views: int  # number of images

    @property
    def line(self) -> str:
        """Return the figure for people."""
        figure = "the same images" if self.psnr >= 99.9 else f"{self.psnr:.1f} dB (PSNR)"
        return f"drawn again from {counted(self.views, 'camera')}: {figure} compared with the scene"

    @property
    def is_faint(self) -> bool:
        """Return whether the file shows something visibly different."""
        return self.psnr < 30.0


def compare_run(
    opened: Opened, scene: GaussianScene, time: float, meant: SplatFile, read: SplatFile
) -> Redrawn:
    """Return how a file differs from a scene at one time, seen by cameras of its capture, else from
    an orbit.

    ``time``: in [0, 1]. ``meant``: what the file is meant to hold, turned from the axes of the
    scene. Raises DyngsError: no camera sees anything.
    """
    frame = meant.frame.after(opened.file_unit)
    with torch.no_grad():
        moment = scene.time_step(time)
        black = torch.zeros_like(moment.gaussians.means[0])
        for cameras in (_capture_cameras(opened), frame.inverse().cameras(_around(meant))):
            if cameras is None:
                continue
            drawn = scene.render(cameras, moment, background=black)
            if float((drawn.alpha > 0.1).float().mean()) >= _LEAST_FRACTION:
                near = scene.options.near * frame.scale
                return _compare(drawn.rgb, frame.cameras(cameras), read, near)
    raise DyngsError(
        "nothing of the scene is seen by the cameras of the capture, or from an orbit around it"
    )


def compare_splats(splat: SplatFile, written: Written) -> Redrawn:
    """Return how a file differs from what it was converted from, seen from an orbit.

    Raises DyngsError: the file cannot be read.
    """
    cameras = _around(splat)
    moved = written.splat.frame.after(splat.frame.inverse())
    options = drawing_options(splat)
    black = torch.zeros_like(splat.gaussians.means[0])
    with torch.no_grad():
        wanted = render(splat.gaussians, cameras, options, background=black).rgb
    near = options.near * moved.scale
    return _compare(wanted, moved.cameras(cameras), read_splats(written.path), near)


def _compare(wanted: Tensor, cameras: Cameras, splat: SplatFile, near: float) -> Redrawn:
    """Return how what a file holds, seen by cameras in its axes, differs from images (V, H, W,
    3)."""
    options = replace(splat_options(splat), near=near)
    with torch.no_grad():
        drawn = render(splat.gaussians, cameras, options, background=wanted.new_zeros(3)).rgb
    values = [psnr(a, b) for a, b in zip(drawn, wanted, strict=True)]
    return Redrawn(float(np.mean(values)), len(values))


def _capture_cameras(opened: Opened) -> Cameras | None:
    """Return a few training cameras, in images of modest size; None where no capture can be
    read."""
    cameras = opened.cameras
    if cameras is None:
        return None
    rows = np.unique(np.linspace(0, len(cameras) - 1, VIEWS).round().astype(int))
    fraction = min(1.0, _LONGEST_SIDE / max(cameras.width, cameras.height))
    return pick_cameras(cameras, rows).scaled(fraction)


def _around(splat: SplatFile) -> Cameras:
    """Return an orbit around Gaussians, in their own axes."""
    size = (_LONGEST_SIDE, _LONGEST_SIDE * 3 // 4)
    return frame_orbit_for_points(splat.gaussians.means.numpy(), VIEWS, size, AXES[splat.up or "z"])
