"""Images and videos of scenes: frames along a camera path, or the views of a split next to their
ground truth."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.conventions import ReportProgress, report_nothing
from dyngs.core.errors import DyngsError
from dyngs.core.metrics import psnr
from dyngs.data.loader import ImageLoader
from dyngs.export.camera_paths.path import CameraPath
from dyngs.export.contact_sheet import SheetRow, contact_sheet, depth_limits, depth_to_rgb
from dyngs.export.video import VideoWriter
from dyngs.io.outputs import Inputs
from dyngs.io.write import to_uint8, write_image
from dyngs.models.renderable import DrawOptions, Renderable, TimeStep
from dyngs.ops.device import CPU
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened, split_views

# Windows opens no file of these names
_DEVICE = re.compile(r"con|prn|aux|nul|(com|lpt)[0-9¹²³]", re.IGNORECASE)
_SHEET_ROWS = 12
_DEPTH_SAMPLES = 8


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
    options = _with_depth(opened.renderable, output)
    limits = None
    if output.depth and out_dir is not None:
        seen = [
            (x.depth, x.alpha)
            for x in path_frames(opened.renderable, _sample(path), options)
            if x.depth is not None
        ]
        limits = depth_limits(
            *(np.concatenate([x.ravel() for x in part]) for part in zip(*seen, strict=True))
        )
    digits = max(4, len(str(len(path) - 1)))
    with _FrameWriter(out_dir, output, inputs_of(opened), opened.frame.scale, limits) as writer:
        for i, frame in enumerate(path_frames(opened.renderable, path, options)):
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
    inputs = inputs_of(opened)
    inputs.require_output(out_dir)
    views = split_views(opened.capture, split)
    loader = ImageLoader(views, opened.config.data)
    background = opened.background
    scene = opened.of_split(split).renderable.to(device)
    options = _with_depth(scene, output)
    shown = set(
        np.linspace(0, len(loader) - 1, min(len(loader), _SHEET_ROWS)).round().astype(int).tolist()
    )
    rows: list[SheetRow] = []
    with _FrameWriter(out_dir, output, inputs, opened.frame.scale) as writer:
        for i, stem in enumerate(file_stems([view.name for view in views])):
            image = loader[i]
            frame = render_frame(scene, image.cameras, image.time, options)
            writer.write(stem, frame)
            report("views", i + 1, len(views))
            if i in shown:
                both = image.composite(background), torch.from_numpy(frame.rgb)
                label = f"{psnr(both[1], both[0], image.mask):.2f} dB  {image.name}"
                # masked pixels show no error
                counts = 1.0 if image.mask is None else image.mask[..., None]
                rows.append(SheetRow(label, *(to_uint8((x * counts).cpu().numpy()) for x in both)))
    writer.write_image(out_dir / "sheet.png", contact_sheet(rows))
    return writer.written


def file_stems(names: Sequence[str]) -> list[str]:
    """Return safe and unique file names, without suffix, for the names of views.

    Folders that all names share are dropped, other folders become a prefix (``left/0001`` is
    ``left_0001``). Parts such as ``..`` and special characters are replaced, so that no name leaves
    the output folder.
    """
    parts = [
        [_safe(part) for part in name.replace("\\", "/").split("/") if part.strip(". ")]
        for name in names
    ]
    parts = [p or ["view"] for p in parts]
    while all(len(p) > 1 for p in parts) and len({p[0] for p in parts}) == 1:
        parts = [p[1:] for p in parts]
    taken: set[str] = {"sheet"}
    stems = []
    for p in parts:
        stem = base = "_".join(p)
        number = 1
        while taken & _files(stem):
            number += 1
            stem = f"{base}_{number}"
        taken |= _files(stem)
        stems.append(stem)
    return stems


class _FrameWriter:
    """Context manager that writes frames to images and a video; ``written`` lists the files."""

    def __init__(
        self,
        out_dir: Path | None,
        output: OutputOptions,
        inputs: Inputs,
        depth_unit: float,
        limits: tuple[float, float] | None = None,
    ) -> None:
        self.written: list[Path] = []
        self._inputs = inputs
        self._out_dir, self._output, self._limits = out_dir, output, limits
        self._depth_unit = np.float32(depth_unit)
        self._stack = ExitStack()
        self._video: VideoWriter | None = None
        self._size: tuple[int, ...] | None = None

    def __enter__(self) -> _FrameWriter:
        for out in (self._out_dir, self._output.video):
            if out is not None:
                self._inputs.require_output(out)
        if self._output.video is not None:
            self._video = self._stack.enter_context(
                VideoWriter(self._output.video, fps=self._output.fps)
            )
        return self

    def __exit__(self, *problem: object) -> None:
        self._stack.__exit__(*problem)  # type: ignore[arg-type]
        if problem[0] is None and self._output.video is not None:
            self.written.append(self._output.video)

    def write(self, stem: str, frame: DrawnImage) -> None:
        rgb = to_uint8(frame.rgb)
        if self._video is not None:
            self._size = self._size or rgb.shape
            if rgb.shape != self._size:
                raise DyngsError(
                    f"{self._output.video}: a video needs views of one size, {stem} differs"
                )
            self._video.add(rgb)
        if self._out_dir is None:
            return
        self.write_image(self._out_dir / f"{stem}.png", rgb)
        if self._output.alpha:
            self.write_image(self._out_dir / f"{stem}_alpha.png", frame.alpha)
        if self._output.depth and frame.depth is not None:
            self.write_image(
                self._out_dir / f"{stem}_depth.png",
                depth_to_rgb(frame.depth, frame.alpha, self._limits),
            )
            self.write_image(self._out_dir / f"{stem}_depth.exr", frame.depth * self._depth_unit)

    def write_image(self, path: Path, pixels: np.ndarray) -> None:
        self._inputs.require_output(path)
        write_image(path, pixels)
        self.written.append(path)


def _with_depth(scene: Renderable, output: OutputOptions) -> DrawOptions:
    return replace(scene.options, depth="expected" if output.depth else "none")


def _sample(path: CameraPath) -> CameraPath:
    """Return at most 8 of the frames, evenly spread."""
    count = min(len(path), _DEPTH_SAMPLES)
    device = path.cameras.cam_from_world.device
    index = torch.linspace(0, len(path) - 1, count, device=device).round().long()
    poses = path.cameras.cam_from_world[index]
    intrinsics = path.cameras.intrinsics[index]
    cameras = replace(path.cameras, cam_from_world=poses, intrinsics=intrinsics)
    return replace(
        path, cameras=cameras, times=path.times and tuple(path.times[i] for i in index.tolist())
    )


def _files(stem: str) -> set[str]:
    """Return the file names of a view, in lower case because some file systems ignore case."""
    return {f"{stem}{suffix}".lower() for suffix in ("", "_depth", "_alpha")}


def _safe(part: str) -> str:
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in part).lstrip(".") or "_"
    return f"{name}_" if _DEVICE.fullmatch(name.split(".")[0]) else name
