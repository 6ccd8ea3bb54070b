"""The demo: the whole of dyngs on an embedded moving scene, from pictures to a trained, measured, rendered model."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import EvalReport, evaluate_run
from dyngs.export.run_to_ply import export_ply
from dyngs.runs.lock import LOCK_NAME, InUseError, writing
from dyngs.view.image_files import OutputOptions, write_job_images, write_split_images
from dyngs.view.job_of_run import job_of_run
from dyngs.view.render_job import RenderJobOptions

if TYPE_CHECKING:
    from rich.table import Table

DEFAULT_OUT = Path("dyngs-demo")


@dataclass(frozen=True)
class DemoOptions:
    """How much the demo does.

    Attributes:
        steps: of training.
        threads: 0 = all cores.
        size: width and height of the pictures, pixels.
        num_times: training pictures, one camera and one time each.
        num_points: random points to start from.
        num_frames: of the video.
    """

    steps: int = 3000
    threads: int = 0
    size: int = 160
    num_times: int = 60
    num_points: int = 6000
    num_frames: int = 90


@dataclass(frozen=True)
class DemoResult:
    """What the demo made.

    Attributes:
        folder: of everything below.
        capture, run_dir, pictures: folders of the input, the model, the rendered test views.
        sheet, video, ply: truth beside render, the flight around the scene, the model for other programs.
        report: the metrics.
        seconds: of everything.
    """

    folder: Path
    capture: Path
    run_dir: Path
    pictures: Path
    sheet: Path
    video: Path
    ply: Path
    report: EvalReport
    seconds: float


def run_demo(out: Path = DEFAULT_OUT, options: DemoOptions = DemoOptions()) -> DemoResult:
    """What was made in ``out``, or in ``out-2`` and so on where ``out`` holds something already.

    Raises:
        DyngsError: the folder cannot be written.
    """
    start = time.perf_counter()
    with claimed_folder(out) as folder:
        return _run_demo(folder, options, start)


def _run_demo(folder: Path, options: DemoOptions, start: float) -> DemoResult:
    capture, run_dir, pictures = folder / "capture", folder / "run", folder / "pictures"
    print(f"[1/4] ray tracing the pictures of the demo scene into {capture}", flush=True)
    write_dynamic_capture("spin", capture, DynamicOptions(size=options.size, num_times=options.num_times, samples=3))
    print(f"[2/4] training {options.steps} steps into {run_dir}", flush=True)
    train(demo_config(capture, run_dir, options))
    print("[3/4] measuring on pictures that were not trained on", flush=True)
    report = evaluate_run(run_dir, threads=options.threads)
    print("[4/4] rendering the test views and a flight around the moving scene", flush=True)
    write_split_images(run_dir, "test", pictures)
    shot = job_of_run(run_dir, RenderJobOptions("orbit", options.num_frames))
    video = folder / "orbit.mp4"
    output = OutputOptions(video=video)
    write_job_images(shot, None, output)
    ply = export_ply(run_dir, folder / "splats.ply")
    seconds = time.perf_counter() - start
    return DemoResult(folder, capture, run_dir, pictures, pictures / "sheet.png", video, ply, report, seconds)


def demo_config(capture: Path, run_dir: Path, options: DemoOptions) -> Config:
    """The packaged preset ``dynamic`` for the demo's capture and size."""
    overrides = (
        "data.root=capture",
        f"init.num_random={options.num_points}",
        f"model.num_random_moving={options.num_points // 3}",
        f"train.steps={options.steps}",
        "train.initial_downscale=2",  # the pictures are small
        "run.name=demo",
        f"run.threads={options.threads}",
    )
    config = load_config(packaged_preset("dynamic"), overrides)
    data = config.data.model_copy(update={"root": capture.absolute()})
    return config.model_copy(update={"data": data, "run": config.run.model_copy(update={"dir": run_dir})})


def unused_folder(wanted: Path) -> Path:
    """``wanted``, or ``wanted-2``, ``wanted-3``... : the first that does not exist or is empty; earlier results stay.

    Raises:
        DyngsError: a thousand are in use.
    """
    for number in range(1, 1001):
        folder = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
        if _is_unused(folder):
            return folder
    raise DyngsError(f"{wanted}: so many demos lie there already; delete some or give --out another folder")


@contextmanager
def claimed_folder(wanted: Path) -> Iterator[Path]:
    """An unused folder that no other demo takes while the block lasts."""
    with ExitStack() as stack:
        for number in range(1, 1001):
            folder = unused_folder(wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}"))
            try:
                stack.enter_context(writing(folder))
            except InUseError:
                continue
            if _is_unused(folder):
                yield folder
                return
    raise DyngsError(f"{wanted}: so many demos run there already; give --out another folder")


def _is_unused(folder: Path) -> bool:
    """Whether ``folder`` can be made, or holds at most a lock file."""
    return not folder.exists() or (folder.is_dir() and all(path.name == LOCK_NAME for path in folder.iterdir()))


def result_table(result: DemoResult) -> Table:
    """What came out, in one row."""
    from rich.table import Table

    report = result.report
    table = Table(title=f"{report.num_views} test views of {report.width}x{report.height}, {report.step} steps")
    cells = {
        "PSNR dB": f"{report.psnr:.2f}",
        "SSIM": f"{report.ssim:.4f}",
        "Gaussians": f"{report.num_gaussians:,}",
        "moving": f"{report.moving_share:.0%}",
        "MB": f"{report.model_mb:.1f}",
        "frames/s": f"{report.fps:.0f}",
        "training s": f"{report.seconds_train:.1f}",
        "in all s": f"{result.seconds:.1f}",
    }
    for name in cells:
        table.add_column(name, justify="right")
    table.add_row(*cells.values())
    return table
