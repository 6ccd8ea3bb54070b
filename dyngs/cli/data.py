"""``dyngs data``: look at a capture, estimate poses, make a synthetic one."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.errors import DyngsError

SYNTHETIC_SCENES = ("still", "spin", "wave", "merge", "room")
"""The scenes of ``dyngs data synth``: named here because the parser must not import numpy."""


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
    formats = ("auto", "blender", "nerfstudio", "colmap", "nerfies", "llff", "camera_folders")
    parser.add_argument("--format", choices=formats, default="auto")
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
        help="write an embedded synthetic scene as a capture",
        description="Ray trace an embedded scene into a capture in the layout of NeRF-synthetic, or of D-NeRF if it "
        "moves. still: a still life. spin: a turning die and a rolling ball. wave: a rippling cloth. merge: balls that "
        "appear, merge and vanish. room: video of fixed cameras of a still room in which one ball hops.",
    )
    parser.add_argument("scene", choices=SYNTHETIC_SCENES, metavar="NAME", help=", ".join(SYNTHETIC_SCENES))
    parser.add_argument("out", type=Path, metavar="OUT", help="a new folder")
    parser.add_argument("--size", type=int, default=128, metavar="PX", help="width and height (default 128)")
    parser.add_argument("--views", type=int, default=48, metavar="N", help="training views, of room times (default 48)")
    parser.add_argument("--cameras", type=int, metavar="N", help="training cameras of room (default 8)")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="another one places the cameras differently (default 0)"
    )
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
    from dyngs.data import synthetic

    out: Path = arguments.out
    if arguments.size < 1 or arguments.views < 1 or arguments.seed < 0:
        raise DyngsError("--size and --views must be at least 1, --seed at least 0")
    if arguments.cameras is not None and (arguments.scene != "room" or arguments.cameras < 1):
        raise DyngsError("--cameras must be at least 1, and is for the scene room only")
    synthetic.require_new_folder(out)
    size, seed = arguments.size, arguments.seed
    if arguments.scene == "still":
        synthetic.write_still_capture(out, synthetic.StillOptions(size=size, num_train=arguments.views, seed=seed))
    else:
        cameras = 8 if arguments.cameras is None else arguments.cameras
        options = synthetic.DynamicOptions(size=size, num_times=arguments.views, num_cameras=cameras, seed=seed)
        synthetic.write_dynamic_capture(arguments.scene, out, options)
    preset = "static" if arguments.scene == "still" else "dynamic"
    print(f"written: {out}\nnext:    dyngs train configs/{preset}.yaml data.root={out}")
    return 0
