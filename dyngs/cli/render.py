"""``dyngs render``: images and videos of a run, an avatar file, or any file of Gaussians."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.imports import heavy_imports
from dyngs.cli.output import ProgressBar, print_notes
from dyngs.core.errors import DyngsError, format_count

if TYPE_CHECKING:
    from dyngs.export.choose_path import PathOptions
    from dyngs.runs.opened import OpenedScene

_EPILOG = """\
examples:
  dyngs render runs/bench --out images                          the test views and a contact sheet
  dyngs render runs/bench --out frames --path orbit --video orbit.mp4
  dyngs render runs/bench --out orbit.gif                       an orbit as .mp4, .webm or .gif
  dyngs render runs/bench --out orbit.webm --background none    with a transparent background
  dyngs render runs/street --path along --video along.mp4                  along the smoothed training cameras
  dyngs render runs/dance --path orbit --time 0.5 --video frozen.mp4       moving camera, frozen scene
  dyngs render runs/dance --times 0:1:60 --view 3 --video fixed.mp4        fixed camera, moving scene
  dyngs render runs/ann --motion walk.npz --video walk.mp4                 animate a person (model.kind=human)
  dyngs render runs/ann --pose rest --path orbit --video rest.mp4          a person in rest pose
  dyngs render ann.safetensors --motion walk.npz --video walk.mp4          an avatar file
  dyngs render dance_export/scene.dyngs --path orbit --video orbit.mp4     what `export --format dyngs` wrote
  dyngs render splats.ply --path spiral --video spiral.mp4 --up=-y --size 1280x720
"""


def add_parser(commands: args.Commands) -> None:
    about = "Render the views of a split next to the ground truth, a camera path, or a fixed camera over time."
    short = "render images and videos of a run, an avatar or a file of Gaussians"
    parser = args.add_command(commands, "render", run, short, about, _EPILOG)
    source = "run folder, avatar file (.safetensors), or any 3DGS .ply"
    parser.add_argument("source", type=args.input_path, metavar="RUN_OR_FILE", help=source)
    out = "folder for the images; a video file is the same as --video with --path orbit"
    parser.add_argument("--out", type=args.output_path, metavar="DIR", help=out)
    cameras = parser.add_mutually_exclusive_group()
    args.add_split(cameras, "render the views of this split (default: test)", None)
    path = "camera path: orbit (default for files), spiral, along (the training cameras), or a .json file"
    cameras.add_argument("--path", type=args.input_word, metavar="PATH", help=path)
    when = parser.add_mutually_exclusive_group()
    when.add_argument(
        "--time",
        type=args.scene_time,
        metavar="T",
        help="render the scene at this time, from 0 to 1",
    )
    when.add_argument("--times", metavar="A:B:N", help="N times from A to B, one per frame")
    view = "without --path: render from the camera of this view (default: the first one)"
    parser.add_argument("--view", metavar="NAME|N", help=view)
    person = parser.add_mutually_exclusive_group()
    args.add_motion(person)
    person.add_argument(
        "--pose", choices=("rest",), help="render a person in the rest pose of the template"
    )
    parser.add_argument(
        "--video",
        type=args.output_path,
        metavar="FILE.mp4",
        help="also write a video: .mp4, .mov, .mkv, .webm or .gif",
    )
    frames = "number of frames of orbit, spiral and along (default 120)"
    kind = args.integer_type("a number of frames", 1, 10**9)
    parser.add_argument("--frames", type=kind, metavar="N", help=frames)
    fps = "frames per second of the video (default 30, or as in the .json)"
    parser.add_argument("--fps", type=float, metavar="F", help=fps)
    depth = "also write depth: coloured .png, and .exr in the unit of the capture"
    parser.add_argument("--depth", action="store_true", help=depth)
    parser.add_argument("--alpha", action="store_true", help="also write opacity")
    size = "image size for a path or fixed camera, in pixels"
    parser.add_argument("--size", type=args.image_size, metavar="WxH", help=size)
    background = "background of all images (default: that of training); none: transparent"
    parser.add_argument("--background", choices=("white", "black", "none"), help=background)
    args.add_up(parser, " of the path")
    args.add_max_gaussians_drawn(
        parser, "static scenes: levels of detail with at most N Gaussians per image"
    )
    args.add_threads(parser)
    args.add_device(parser)
    args.add_data_root(parser)


def run(arguments: argparse.Namespace) -> int:
    """Render and print the written files."""
    _check(arguments)
    written = _render(arguments)
    if len(written) == 1:
        print(f"written: {written[0]}")
        return 0
    folders = sorted({str(path.parent) for path in written})
    print(f"written: {format_count(len(written), 'file')} in {', '.join(folders)}")
    for path in written:
        if path == arguments.video or path.name == "sheet.png":
            print(f"         {path}")
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Raise DyngsError for a missing source or output, or options that do not apply."""
    from dyngs.export.video import WRITTEN_SUFFIXES, require_video_suffix
    from dyngs.io.outputs import VIDEO_SUFFIXES, suggest_command

    out = arguments.out
    videos = {*WRITTEN_SUFFIXES, *VIDEO_SUFFIXES}
    if out is not None and arguments.video is None and out.suffix.lower() in videos:
        arguments.out = None
        arguments.video = out
        if not arguments.split and not _has_fixed_camera(arguments):
            arguments.path = arguments.path or "orbit"
    if arguments.video is not None:
        transparent = arguments.background == "none"
        require_video_suffix(arguments.video, transparent=transparent)
    arguments.source = args.run_of_scene_file(arguments.source)
    known = suggest_command(arguments.source)
    if known is not None and not (arguments.source / "config.yaml").is_file():
        raise DyngsError(f"{arguments.source}: not a scene; {known}")
    is_file = arguments.source.is_file()
    if is_file and arguments.split:
        raise DyngsError(
            f"{arguments.source}: files have no splits; use --path orbit, spiral or FILE.json"
        )
    if arguments.view is not None and arguments.path:
        raise DyngsError("--view (fixed camera) and --path (moving camera) exclude each other")
    if arguments.times is not None and arguments.frames is not None:
        raise DyngsError("--times and --frames both set the number of frames; use one of them")
    if arguments.out is None and (arguments.video is None or not _is_path(arguments)):
        raise DyngsError(
            "no output given; add --out DIR, or --video FILE.mp4 with --path, --time, --times or "
            "--view"
        )
    if not arguments.source.exists():
        raise DyngsError(
            f"{arguments.source}: no such run or file; give a run folder written by `dyngs train`"
        )
    if arguments.up and not (is_file or arguments.path):
        raise DyngsError("--up requires --path orbit, spiral or along")
    if arguments.size and not _is_path(arguments):
        raise DyngsError("--size requires --path; the views of a split keep their size")


def _is_path(arguments: argparse.Namespace) -> bool:
    """Return whether to render a camera path or a fixed camera instead of a split."""
    return arguments.source.is_file() or bool(arguments.path) or _has_fixed_camera(arguments)


def _has_fixed_camera(arguments: argparse.Namespace) -> bool:
    """Return whether to render from one fixed camera, at one or many times."""
    passed = (arguments.time, arguments.times, arguments.view, arguments.motion, arguments.pose)
    return not arguments.path and any(x is not None for x in passed)


def _render(arguments: argparse.Namespace) -> list[Path]:
    with heavy_imports():
        import torch

        from dyngs.export.choose_path import choose_path
        from dyngs.export.images import OutputOptions, write_path_images, write_split_images
        from dyngs.runs.opened import open_run

    device = args.computing_device(arguments.device)
    if arguments.threads > 0:
        torch.set_num_threads(arguments.threads)
    output = OutputOptions(
        arguments.depth,
        arguments.alpha,
        arguments.video,
        arguments.fps or 30.0,
        transparent=arguments.background == "none",
    )
    if not _is_path(arguments):
        with ProgressBar() as report:
            opened = _before(
                arguments, open_run(arguments.source, data_root=args.data_root(arguments))
            )
            opened = _coarser(arguments, opened)
            return write_split_images(
                opened, arguments.split or "test", arguments.out, output, report, device
            )
    opened = _opened(arguments)
    path = choose_path(opened, _path_options(arguments))
    print_notes((*opened.notes, *path.notes))
    if not arguments.fps:
        output = replace(output, fps=path.fps)
    with ProgressBar() as report:
        return write_path_images(
            _coarser(arguments, opened).to(device), path, arguments.out, output, report
        )


def _opened(arguments: argparse.Namespace) -> OpenedScene:
    """Open the scene with the requested motion or pose, background and up axis."""
    from dyngs.runs.opened import open_scene

    opened = open_scene(arguments.source, nonfinite="skip", data_root=args.data_root(arguments))
    if arguments.motion is not None:
        opened = args.play_motion(arguments, opened)
    elif arguments.pose == "rest":
        opened = opened.at_rest()
    elif arguments.split is not None:
        opened = opened.for_split(arguments.split)
    opened = _before(arguments, opened)
    return opened if arguments.up is None else replace(opened, stated_up=arguments.up)


def _before(arguments: argparse.Namespace, opened: OpenedScene) -> OpenedScene:
    """Return the scene with the requested background, if any."""
    name: str | None = arguments.background
    if name is None:
        return opened
    return opened.on_background("black" if name == "none" else name)


def _coarser(arguments: argparse.Namespace, opened: OpenedScene) -> OpenedScene:
    """Return the scene with levels of detail, if requested."""
    from dyngs.gaussians.levels import LevelScene

    most: int | None = arguments.max_gaussians_drawn
    return (
        opened
        if most is None
        else opened.with_scene(LevelScene.from_scene(opened.renderable, most))
    )


def _path_options(arguments: argparse.Namespace) -> PathOptions:
    from dyngs.export.camera_paths import parse_times
    from dyngs.export.choose_path import PathOptions

    times = None if arguments.time is None else (arguments.time,)
    num_frames = arguments.frames
    if arguments.times is not None:
        times = parse_times(arguments.times)
        num_frames = len(times)
    path = None if _has_fixed_camera(arguments) else arguments.path or "orbit"
    return PathOptions(path, num_frames, arguments.size, times, arguments.view, arguments.split)
