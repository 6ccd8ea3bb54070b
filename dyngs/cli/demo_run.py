"""The demo: a built-in moving scene is trained, evaluated, rendered and exported."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.errors import DyngsError, counted, show
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.evaluate.report import EvalReport, evaluate_run
from dyngs.export.choose_path import PathOptions, choose_path
from dyngs.export.images import OutputOptions, write_path_images, write_split_images
from dyngs.export.splat_files import write_run_splats
from dyngs.io.outputs import LOCK_NAME, InUseError, writing
from dyngs.runs.opened import open_run
from dyngs.training.events import Listener


@dataclass(frozen=True)
class DemoOptions:
    """Size of the demo.

    Attributes:
        threads: 0 = all cores.
        size: width and height of the images, pixels.
        num_times: number of training images, one camera and one time each.
        num_points: number of random initial points.
        num_frames: number of frames of the video.
    """

    steps: int = 3000
    threads: int = 0
    size: int = 160
    num_times: int = 60
    num_points: int = 6000
    num_frames: int = 90


@dataclass(frozen=True)
class DemoResult:
    """The run, its rendered test views, an orbit video, the model for other programs, metrics and
    the total time."""

    run_dir: Path
    images: Path
    video: Path
    ply: Path
    report: EvalReport
    seconds: float


def run_demo(
    out: Path, options: DemoOptions = DemoOptions(), listeners: Sequence[Listener] = ()
) -> DemoResult:
    """Run the demo in ``out``, or in ``out-2`` and so on if ``out`` is not empty. Raises
    DyngsError."""
    start = time.perf_counter()
    with claimed_folder(out) as folder:
        capture, run_dir, images, video = (
            folder / name for name in ("capture", "run", "images", "orbit.mp4")
        )
        show(f"[1/4] ray tracing the images of the demo scene into {capture}")
        moving = DynamicOptions(size=options.size, num_times=options.num_times, samples=3)
        write_dynamic_capture("spin", capture, moving)
        print(f"[2/4] training {counted(options.steps, 'step')} into {run_dir}", flush=True)
        train(demo_config(capture, run_dir, options), listeners=listeners)
        print("[3/4] evaluating on held-out views", flush=True)
        report = evaluate_run(run_dir, threads=options.threads)
        show("[4/4] rendering the test views and an orbit around the moving scene")
        opened = open_run(run_dir)
        write_split_images(opened, "test", images)
        path = choose_path(opened, PathOptions("orbit", options.num_frames))
        write_path_images(opened, path, None, OutputOptions(video=video))
        ply = write_run_splats(opened, folder / "splats.ply").path
        return DemoResult(run_dir, images, video, ply, report, time.perf_counter() - start)


def demo_config(capture: Path, run_dir: Path, options: DemoOptions) -> Config:
    """Return the preset ``dynamic`` for the capture and size of the demo."""
    overrides = (
        "data.root=capture",
        f"init.num_random={options.num_points}",
        f"model.num_random_moving={options.num_points // 3}",
        f"train.steps={options.steps}",
        "model.choose=false",  # the scene is made to move
        "train.initial_downscale=2",  # the images are small, and soon as large as they get
        "train.resolution_grows_from=0.35",
        "train.resolution_full_at=0.45",
        "run.name=demo",
        f"run.threads={options.threads}",
    )
    config = load_config(packaged_preset("dynamic"), overrides)
    data = config.data.model_copy(update={"root": capture.absolute()})
    return config.model_copy(
        update={"data": data, "run": config.run.model_copy(update={"dir": run_dir})}
    )


@contextmanager
def claimed_folder(out: Path) -> Iterator[Path]:
    """Yield the first of ``out``, ``out-2``, ``out-3``... that holds nothing, locked against other
    demos."""
    with ExitStack() as stack:
        for number in range(1, 1001):
            folder = out if number == 1 else out.with_name(f"{out.name}-{number}")
            if not is_unused(folder):
                continue
            try:
                stack.enter_context(writing(folder))
            except InUseError:
                continue
            if is_unused(folder):
                yield folder
                return
    raise DyngsError(
        f"{out}: so many demos lie there already; delete some or give --out another folder"
    )


def is_unused(folder: Path) -> bool:
    """Whether ``folder`` can be made, or holds at most a lock file."""
    return not folder.exists() or (
        folder.is_dir() and all(path.name == LOCK_NAME for path in folder.iterdir())
    )


def result_table(result: DemoResult) -> tuple[str, list[str], list[list[str]]]:
    """Return title, head and cells of the table of results."""
    report = result.report
    size = f"{report.width}x{report.height}"
    title = f"{counted(report.num_views, 'test view')} of {size}, {counted(report.step, 'step')}"
    cells = {
        "PSNR dB": f"{report.psnr:.2f}",
        "SSIM": f"{report.ssim:.4f}",
        "Gaussians": f"{report.num_gaussians:,}",
        "moving": f"{report.moving_fraction:.0%}",
        "MB": f"{report.model_mb:.1f}",
        "frames/s": f"{report.fps:.0f}",
        "training s": f"{report.seconds_train:.1f}",
        "total s": f"{result.seconds:.1f}",
    }
    return title, list(cells), [list(cells.values())]
