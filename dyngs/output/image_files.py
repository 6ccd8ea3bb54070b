"""Render to image and video files: the frames of a job, or the views of a split beside their ground truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.conventions import ReportProgress, report_nothing
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluation_background, scene_of_split, split_views
from dyngs.files.write import to_uint8, write_image
from dyngs.metrics import psnr
from dyngs.models.renderable import DrawOptions
from dyngs.ops.device import CPU
from dyngs.output.camera_paths import CameraPath
from dyngs.output.contact_sheet import SheetRow, contact_sheet, depth_limits, depth_to_rgb
from dyngs.output.render_job import Frame, RenderJob, job_frames, render_frame
from dyngs.output.video import VideoWriter
from dyngs.runs.checkpoint import load_run

_SHEET_ROWS = 12
_DEPTH_SAMPLES = 8


@dataclass(frozen=True)
class OutputOptions:
    """Files to write besides the colour images.

    Attributes:
        depth: ``NAME_depth.png`` (colours) and ``NAME_depth.exr`` (float32, world units along the optical axis).
        alpha: ``NAME_alpha.png``, white = opaque.
        video: MP4 of the colour images in order.
        fps: frames per second of the video.
    """

    depth: bool = False
    alpha: bool = False
    video: Path | None = None
    fps: float = 30.0


def write_job_images(
    job: RenderJob,
    out_dir: Path | None,
    output: OutputOptions = OutputOptions(),
    report: ReportProgress = report_nothing,
) -> list[Path]:
    """Render a job to ``frame_0000.png`` and so on, and to a video if asked for; return the paths.

    Args:
        job: F >= 1 cameras and times, in the order of the video.
        out_dir: folder for the images; None writes only the video.
        output: depth, alpha, video. Depth colours share one range over the whole path.
        report: is told of each frame.

    Raises:
        DyngsError: no cameras, nothing to write, or a file cannot be written.
    """
    if len(job.path) == 0:
        raise DyngsError("the camera path has no cameras")
    if out_dir is None and output.video is None:
        raise DyngsError("nothing to write: give a folder for the images or a video file")
    job = replace(job, options=_with_depth(job.options, output))
    limits = None
    if output.depth and out_dir is not None:
        limits = _shared_depth_limits(job_frames(replace(job, path=_sample(job.path))))
    digits = max(4, len(str(len(job.path) - 1)))
    with _FrameWriter(out_dir, output, job.protected, limits) as writer:
        for i, frame in enumerate(job_frames(job)):
            writer.write(f"frame_{i:0{digits}d}", frame)
            report("frames", i + 1, len(job.path))
    return writer.written


def write_split_images(
    run_dir: Path,
    split: str,
    out_dir: Path,
    output: OutputOptions = OutputOptions(),
    report: ReportProgress = report_nothing,
    device: torch.device = CPU,
) -> list[Path]:
    """Render a split of a run to ``NAME.png`` per view and ``sheet.png`` (truth, render, error); return the paths.

    The sheet shows at most 12 views, evenly spread, with their PSNR; masked pixels are black. The background is that
    of training, black if that was random.

    Args:
        run_dir: run folder with at least one checkpoint.
        split: "test", "val" or "train".
        out_dir: folder for the images, which are named after the views (``file_stems``).
        output: depth, alpha, video (views of one size only).
        report: is told of each view.
        device: draws.

    Raises:
        DyngsError: no such run or split, unreadable images, a file cannot be written.
    """
    run = load_run(run_dir)
    capture = read_capture(run.config.data)
    views = split_views(capture, split)
    loader = ImageLoader(views, run.config.data)
    _, background = evaluation_background(run.config.data.background, capture.has_alpha)
    options = _with_depth(run.renderable.options, output)
    scene = scene_of_split(run, capture, split).to(device)
    shown = set(np.linspace(0, len(loader) - 1, min(len(loader), _SHEET_ROWS)).round().astype(int).tolist())
    rows: list[SheetRow] = []
    with _FrameWriter(out_dir, output, files_of(capture)) as writer:
        for i, stem in enumerate(file_stems([view.name for view in views])):
            image = loader[i]
            frame = render_frame(scene, scene.time_step(image.time), image.cameras, options, background)
            writer.write(stem, frame)
            report("views", i + 1, len(views))
            if i in shown:
                truth = image.composite(background)
                label = f"{psnr(torch.from_numpy(frame.rgb), truth, image.mask):.2f} dB  {image.name}"
                rows.append(_sheet_row(label, truth, torch.from_numpy(frame.rgb), image.mask))
    writer.write_image(out_dir / "sheet.png", contact_sheet(rows))
    return writer.written


def files_of(capture: Capture) -> frozenset[Path]:
    """Return the paths of the images, masks and maps of a capture, with symbolic links resolved."""
    views = [view for split in capture.splits.values() for view in split]
    own = ("image_path", "mask_path", "depth_path", "motion_mask_path", "flow_path")
    files = (path for view in views for name in own if (path := getattr(view, name)) is not None)
    return frozenset(path.resolve() for path in files)


def _sheet_row(label: str, truth: Tensor, rendered: Tensor, mask: Tensor | None) -> SheetRow:
    """Return a row of the sheet; masked pixels are black on both sides, so that they show no error."""
    counts = 1.0 if mask is None else mask[..., None]
    return SheetRow(label, to_uint8((truth * counts).cpu().numpy()), to_uint8((rendered * counts).cpu().numpy()))


def file_stems(names: Sequence[str]) -> list[str]:
    """Return safe and unique file names, without suffix, for the names of views.

    Folders that all names share are dropped, other folders become a prefix (``left/0001`` is ``left_0001``). Parts
    such as ``..`` and special characters are replaced, so that no name leaves the output folder.
    """
    parts = [[_safe(part) for part in name.replace("\\", "/").split("/") if part.strip(". ")] for name in names]
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
        protected: frozenset[Path],
        limits: tuple[float, float] | None = None,
    ) -> None:
        self.written: list[Path] = []
        self._protected = protected
        self._out_dir, self._output, self._limits = out_dir, output, limits
        self._stack = ExitStack()
        self._video: VideoWriter | None = None
        self._size: tuple[int, ...] | None = None

    def __enter__(self) -> _FrameWriter:
        if self._output.video is not None:
            self._video = self._stack.enter_context(VideoWriter(self._output.video, fps=self._output.fps))
        return self

    def __exit__(self, *problem: object) -> None:
        self._stack.__exit__(*problem)  # type: ignore[arg-type]
        if problem[0] is None and self._output.video is not None:
            self.written.append(self._output.video)

    def write(self, stem: str, frame: Frame) -> None:
        rgb = to_uint8(frame.rgb)
        if self._video is not None:
            self._size = self._size or rgb.shape
            if rgb.shape != self._size:
                raise DyngsError(f"{self._output.video}: a video needs views of one size, {stem} differs")
            self._video.add(rgb)
        if self._out_dir is None:
            return
        self.write_image(self._out_dir / f"{stem}.png", rgb)
        if self._output.alpha:
            self.write_image(self._out_dir / f"{stem}_alpha.png", frame.alpha)
        if self._output.depth and frame.depth is not None:
            self.write_image(self._out_dir / f"{stem}_depth.png", depth_to_rgb(frame.depth, frame.alpha, self._limits))
            self.write_image(self._out_dir / f"{stem}_depth.exr", frame.depth)

    def write_image(self, path: Path, pixels: np.ndarray) -> None:
        if self._protected and path.resolve() in self._protected:
            raise DyngsError(f"{path}: is an image of the capture and would be overwritten; give another --out")
        write_image(path, pixels)
        self.written.append(path)


def _with_depth(options: DrawOptions, output: OutputOptions) -> DrawOptions:
    return replace(options, depth="expected" if output.depth else "none")


def _sample(path: CameraPath) -> CameraPath:
    """Return at most 8 of the frames, evenly spread."""
    count, device = min(len(path), _DEPTH_SAMPLES), path.cameras.cam_from_world.device
    index = torch.linspace(0, len(path) - 1, count, device=device).round().long()
    poses, intrinsics = path.cameras.cam_from_world[index], path.cameras.intrinsics[index]
    cameras = replace(path.cameras, cam_from_world=poses, intrinsics=intrinsics)
    return replace(path, cameras=cameras, times=path.times and tuple(path.times[i] for i in index.tolist()))


def _shared_depth_limits(frames: Iterator[Frame]) -> tuple[float, float]:
    """Return near and far over all of the frames."""
    seen = [(frame.depth.ravel(), frame.alpha.ravel()) for frame in frames if frame.depth is not None]
    return depth_limits(np.concatenate([d for d, _ in seen]), np.concatenate([a for _, a in seen]))


def _files(stem: str) -> set[str]:
    """Return the file names of a view, in lower case because some file systems ignore case."""
    return {f"{stem}{suffix}".lower() for suffix in ("", "_depth", "_alpha")}


def _safe(part: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in part).lstrip(".") or "_"
