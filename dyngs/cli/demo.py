"""``dyngs demo``: train, evaluate, render and export a built-in moving scene."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import Commands, add_command, add_threads, integer_type, output_path
from dyngs.cli.output import numbers_table, print_tables
from dyngs.core.errors import format_count, log_info, quote_path

if TYPE_CHECKING:
    from dyngs.config import Config
    from dyngs.training.events import Listener

SIZE, NUM_TIMES, NUM_POINTS = 160, 60, 6000
"""Image width and height, px; number of training images, each from its own camera and time; number
of random initial points."""


def add_parser(commands: Commands) -> None:
    about = "Ray trace a small moving scene, train it, evaluate it, render images and a video, write a .ply."
    parser = add_command(
        commands, "demo", run, "train, evaluate and render a built-in moving scene", about
    )
    out = "output folder (default dyngs-demo)"
    default = Path("dyngs-demo")
    parser.add_argument("--out", type=output_path, default=default, metavar="DIR", help=out)
    kind = integer_type("a number of steps", 1, 10**9)
    parser.add_argument(
        "--steps", type=kind, default=3000, metavar="N", help="training steps (default 3000)"
    )
    add_threads(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo in ``--out``, or in ``OUT-2``, ``OUT-3`` ... if it is not empty."""
    from dyngs.cli.training_progress import TrainingProgress
    from dyngs.io.outputs import lock_folder

    folder: Path = arguments.out
    numbers = count(2)
    while not is_unused(folder):
        folder = arguments.out.with_name(f"{arguments.out.name}-{next(numbers)}")
    with lock_folder(folder), TrainingProgress() as progress:
        run_demo(folder, arguments.steps, arguments.threads, [progress])
    return 0


def is_unused(folder: Path) -> bool:
    """Return whether ``folder`` does not exist or contains only a lock file."""
    from dyngs.io.outputs import LOCK_NAME

    return not folder.exists() or (
        folder.is_dir() and all(path.name == LOCK_NAME for path in folder.iterdir())
    )


def run_demo(
    folder: Path, steps: int, threads: int = 0, listeners: Sequence[Listener] = ()
) -> None:
    """Run the demo in an empty folder; print the metrics and the paths of the files."""
    from dyngs.api.train import train
    from dyngs.cli.evaluate import report_rows
    from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
    from dyngs.evaluate.report import evaluate_run
    from dyngs.export.choose_path import PathOptions, choose_path
    from dyngs.export.images import OutputOptions, write_path_images, write_split_images
    from dyngs.export.splat_files import write_run_splats
    from dyngs.runs.opened import open_run

    run_dir = folder / "run"
    images = folder / "images"
    video = folder / "orbit.mp4"
    capture = folder / "capture"
    log_info(f"[1/4] ray tracing the demo scene to {capture}")
    write_dynamic_capture(
        "spin", capture, DynamicOptions(size=SIZE, num_times=NUM_TIMES, samples=3)
    )
    log_info(f"[2/4] training {format_count(steps, 'step')} to {run_dir}")
    train(demo_config(capture, run_dir, steps, threads), listeners=listeners)
    log_info("[3/4] evaluating on held-out views")
    report = evaluate_run(run_dir, threads=threads)
    log_info("[4/4] rendering the test views and an orbit video")
    opened = open_run(run_dir)
    write_split_images(opened, "test", images)
    path = choose_path(opened, PathOptions("orbit", 90))
    write_path_images(opened, path, None, OutputOptions(video=video))
    ply = write_run_splats(opened, folder / "splats.ply").path
    title = format_count(report.num_views, "test view")
    print_tables(numbers_table(title, ("metric", "value"), report_rows(report)))
    print(f"contact sheet         {images / 'sheet.png'}")
    print(f"orbit video           {video}")
    print(f"Gaussians             {ply}")
    print(f"run folder            {run_dir}")
    print(f"to look around        dyngs view {quote_path(run_dir)}    (pip install 'dyngs[view]')")
    print(f"one page to share     dyngs export {quote_path(run_dir)} --out scene.html")


def demo_config(capture: Path, run_dir: Path, steps: int = 3000, threads: int = 0) -> Config:
    """Return the config of the demo, based on the preset ``dynamic``."""
    from dyngs.config.io import load_config, packaged_preset

    overrides = (
        "data.root=capture",
        f"init.num_random={NUM_POINTS}",
        f"model.num_random_moving={NUM_POINTS // 3}",
        f"train.steps={steps}",
        "model.pilot_runs=false",  # the scene is known to move
        "train.initial_downscale=2",  # the images are small already
        "train.resolution_grows_from=0.35",
        "train.resolution_full_at=0.45",
        "run.name=demo",
        f"run.threads={threads}",
    )
    config = load_config(packaged_preset("dynamic"), overrides)
    data = config.data.model_copy(update={"root": capture.absolute()})
    own = config.run.model_copy(update={"dir": run_dir})
    return config.model_copy(update={"data": data, "run": own})
