"""``dyngs data``: look at a capture, estimate poses, make a synthetic one."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.errors import DyngsError


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``data`` and its own commands to the commands."""
    parser = commands.add_parser("data", help="inspect a capture, estimate poses, make a synthetic capture")
    verbs = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_inspect(verbs)
    _add_sfm(verbs)
    _add_synth(verbs)


def _add_inspect(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = verbs.add_parser(
        "inspect",
        help="what a capture holds and what is suspicious about it",
        description="Report views, sizes, intrinsics, times, points, masks, and everything suspicious.",
    )
    parser.add_argument("path", type=Path, metavar="PATH", help="capture folder")
    parser.add_argument("--format", choices=("auto", "blender", "nerfstudio", "colmap"), default="auto")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw cameras and points into this picture")
    parser.add_argument("--deep", action="store_true", help="decode every picture in full (slow)")
    parser.set_defaults(run=run_inspect)


def _add_sfm(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = verbs.add_parser(
        "sfm",
        help="estimate poses of photos or of a video",
        description="Estimate camera poses with COLMAP's structure from motion; OUT can then be trained on.",
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", help="folder of photos, or a video file")
    parser.add_argument("out", type=Path, metavar="OUT", help="a new folder")
    parser.add_argument("--matching", choices=("auto", "exhaustive", "sequential"), default="auto")
    parser.add_argument("--frames", type=int, default=100, metavar="N", help="taken from a video (default 100)")
    parser.add_argument("--threads", type=int, default=0, metavar="N", help="0 = all cores")
    parser.set_defaults(run=run_sfm)


def _add_synth(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = verbs.add_parser(
        "synth",
        help="write the embedded synthetic scene as a capture",
        description="Ray trace the embedded scene into a capture in the layout of NeRF-synthetic.",
    )
    parser.add_argument("scene", choices=("still",), help="which scene")
    parser.add_argument("out", type=Path, metavar="OUT", help="a new folder")
    parser.add_argument("--size", type=int, default=128, metavar="PX", help="width and height (default 128)")
    parser.add_argument("--views", type=int, default=48, metavar="N", help="training views (default 48)")
    parser.add_argument("--seed", type=int, default=0)
    parser.set_defaults(run=run_synth)


def run_inspect(arguments: argparse.Namespace) -> int:
    """Print the report on a capture, and draw it if asked to."""
    from dyngs.config import DataConfig
    from dyngs.data.inspect import format_report, inspect_capture

    report = inspect_capture(DataConfig(root=arguments.path, format=arguments.format), arguments.deep)
    if report.capture is None:
        for problem in report.problems[1:]:
            print(f"also: {problem}")
        raise DyngsError(report.problems[0])
    print(format_report(report))
    if arguments.picture is not None:
        from dyngs.data.camera_picture import draw_cameras

        draw_cameras(report.capture, arguments.picture)
        print(f"written: {arguments.picture}")
    return 0


def run_sfm(arguments: argparse.Namespace) -> int:
    """Estimate poses and say how to train on them."""
    from dyngs.data.sfm import SfmOptions, estimate_poses

    options = SfmOptions(matching=arguments.matching, num_frames=arguments.frames, num_threads=arguments.threads)
    result = estimate_poses(arguments.images, arguments.out, options)
    print(result.summary())
    print(f"next: dyngs data inspect {result.root} --picture cameras.png")
    print(f"      dyngs train configs/static.yaml data.root={result.root}")
    return 0


def run_synth(arguments: argparse.Namespace) -> int:
    """Write the capture and say how to train on it."""
    from dyngs.data.synthetic import StillOptions, write_still_capture

    out: Path = arguments.out
    if arguments.size < 1 or arguments.views < 1:
        raise DyngsError("--size and --views must be at least 1")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DyngsError(f"{out} exists already; name a new folder for the capture")
    write_still_capture(out, StillOptions(size=arguments.size, num_train=arguments.views, seed=arguments.seed))
    print(f"written: {out}\nnext:    dyngs train configs/static.yaml data.root={out}")
    return 0
