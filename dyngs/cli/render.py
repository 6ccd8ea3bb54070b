"""``dyngs render``: pictures and videos of a run, of an avatar file, or of any 3DGS .ply."""

from __future__ import annotations

import argparse
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.errors import DyngsError

if TYPE_CHECKING:
    from dyngs.view.render_job import RenderJob

MAX_THREADS = 1024

_EPILOG = """\
examples:
  dyngs render runs/bench --out pictures                          the test views and a contact sheet
  dyngs render runs/bench --out frames --path orbit --video orbit.mp4
  dyngs render runs/dance --path orbit --time 0.5 --video frozen.mp4       the camera moves, the scene does not
  dyngs render runs/dance --times 0:1:60 --view 3 --video standing.mp4     the scene moves, the camera does not
  dyngs render runs/ann --motion walk.npz --video walk.mp4                 a person (model.kind=human) walks
  dyngs render runs/ann --pose rest --path orbit --video rest.mp4          the same person in the template's pose
  dyngs render ann.safetensors --motion walk.npz --video walk.mp4          a person in one file
  dyngs render splats.ply --path spiral --video spiral.mp4 --up=-y --size 1280x720
"""


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``render`` to the commands."""
    parser = commands.add_parser(
        "render",
        help="pictures and videos of a run or a .ply",
        description="Render the views of a split beside their truth, the frames of a camera path, or moments in time.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "source", type=Path, metavar="RUN_OR_FILE", help="a run folder, an avatar (.safetensors), or any 3DGS .ply"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the pictures")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--split", choices=("test", "val", "train", "pose"), help="render these views (default for a run: test)"
    )
    what.add_argument("--path", metavar="PATH", help="orbit (default for a .ply), spiral, or a .json file of cameras")
    when = parser.add_mutually_exclusive_group()
    when.add_argument("--time", type=moment, metavar="T", help="everything at this time, from 0 to 1")
    when.add_argument("--times", metavar="A:B:N", help="N times from A to B, one per picture")
    parser.add_argument(
        "--view", metavar="NAME|N", help="whose camera stands still where there is no --path (default: the first view)"
    )
    whom = parser.add_mutually_exclusive_group()
    whom.add_argument(
        "--motion", type=Path, metavar="FILE", help="what the person of a run does: AMASS .npz, .bvh, .glb or .gltf"
    )
    whom.add_argument("--pose", choices=("rest",), help="the person of a run in the pose of the template")
    parser.add_argument("--video", type=Path, metavar="FILE.mp4", help="write a video too")
    parser.add_argument("--frames", type=_count, metavar="N", help="of orbit and spiral (default 120)")
    parser.add_argument("--fps", type=float, metavar="F", help="of the video (default 30, or what the .json says)")
    parser.add_argument("--depth", action="store_true", help="write depth too: colours (.png) and world units (.exr)")
    parser.add_argument("--alpha", action="store_true", help="write opacity too")
    parser.add_argument("--size", type=_size, metavar="WxH", help="of the pictures of a path, in pixels")
    parser.add_argument("--background", choices=("white", "black"), help="of a path (default: that of training)")
    parser.add_argument(
        "--up", choices=("x", "y", "z", "-x", "-y", "-z"), default="z", help="of a .ply; --up=-y suits many COLMAP ones"
    )
    parser.add_argument("--threads", type=threads, default=0, metavar="N", help="0 = all cores")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Render and say what was written."""
    written = _render(_checked(arguments))
    folders = sorted({str(path.parent) for path in written})
    print(f"written: {len(written)} files in {', '.join(folders)}")
    for path in written:
        if path.suffix == ".mp4" or path.name == "sheet.png":
            print(f"         {path}")
    return 0


def _checked(arguments: argparse.Namespace) -> argparse.Namespace:
    """The arguments, if they go together.

    Raises:
        DyngsError: nothing to render, nowhere to write, or options that mean nothing here.
    """
    is_file = arguments.source.is_file()
    if is_file and arguments.split:
        raise DyngsError(f"{arguments.source}: a file has no splits; use --path orbit, spiral or FILE.json")
    if arguments.view is not None and arguments.path:
        raise DyngsError("--view is for a camera that stands still and --path for one that moves; give one of them")
    if arguments.times is not None and arguments.frames is not None:
        raise DyngsError("--times and --frames both say how many pictures there are; give one of them")
    is_shot = is_file or arguments.path or _stands_still(arguments)
    if arguments.out is None and (arguments.video is None or not is_shot):
        raise DyngsError("say where to write: --out DIR (or --video FILE.mp4 with --path, --time, --times or --view)")
    if not arguments.source.exists():
        raise DyngsError(f"{arguments.source}: no such run or file; give a folder that `dyngs train` wrote, or a .ply")
    unfit = [f"--{name}" for name in ("size", "background") if getattr(arguments, name)]
    if unfit and not is_shot:
        raise DyngsError(f"{unfit[0]} goes with --path; the views of a split keep their size and background")
    return arguments


def _stands_still(arguments: argparse.Namespace) -> bool:
    """One camera is asked for, at one or many times."""
    given = (arguments.time, arguments.times, arguments.view, arguments.motion, arguments.pose)
    return not arguments.path and any(x is not None for x in given)


def _render(arguments: argparse.Namespace) -> list[Path]:
    """The files written."""
    import torch

    if arguments.threads > 0:
        torch.set_num_threads(arguments.threads)
    if arguments.source.is_file() or arguments.path or _stands_still(arguments):
        return _render_shot(arguments)
    return _render_split(arguments)


def _render_split(arguments: argparse.Namespace) -> list[Path]:
    from dyngs.view.image_files import OutputOptions, write_split_images

    output = OutputOptions(arguments.depth, arguments.alpha, arguments.video, arguments.fps or 30.0)
    return write_split_images(arguments.source, arguments.split or "test", arguments.out, output)


def _render_shot(arguments: argparse.Namespace) -> list[Path]:
    from dyngs.view.image_files import OutputOptions, write_job_images

    shot = _shot(arguments)
    say(shot.notes, shot.path.warnings)
    output = OutputOptions(arguments.depth, arguments.alpha, arguments.video, arguments.fps or shot.path.fps)
    return write_job_images(shot, arguments.out, output)


def _shot(arguments: argparse.Namespace) -> RenderJob:
    """What the arguments ask for."""
    from dyngs.view.camera_paths import parse_times
    from dyngs.view.job_of_avatar import job_of_avatar
    from dyngs.view.job_of_ply import job_of_ply
    from dyngs.view.job_of_run import job_of_run
    from dyngs.view.render_job import RenderJobOptions

    times = None if arguments.time is None else (arguments.time,)
    num_frames = arguments.frames
    if arguments.times is not None:
        times = parse_times(arguments.times)
        num_frames = len(times)
    options = RenderJobOptions(
        path=None if _stands_still(arguments) else arguments.path or "orbit",
        num_frames=num_frames,
        size=arguments.size,
        background=arguments.background,
        up=arguments.up,
        times=times,
        view=arguments.view,
        split=arguments.split,
        motion=arguments.motion,
        at_rest=arguments.pose == "rest",
    )
    if not arguments.source.is_file():
        return job_of_run(arguments.source, options)
    return (job_of_avatar if is_avatar(arguments.source) else job_of_ply)(arguments.source, options)


def is_avatar(path: Path) -> bool:
    """Whether a path names an avatar file, and neither a run nor a .ply."""
    return path.is_file() and path.suffix.lower() == ".safetensors"


def say(notes: tuple[str, ...], warnings: tuple[str, ...] = ()) -> None:
    """Print notes, and warnings on stderr."""
    for note in notes:
        print(f"note: {note}")
    for warning in warnings:
        print(f"dyngs: warning: {warning}", file=sys.stderr)


def moment(text: str) -> float:
    """The time that ``text`` names; one outside [0, 1] is clamped later, with a warning."""
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise argparse.ArgumentTypeError(f"{text!r} is not a time; write a number from 0 to 1, for instance 0.5")
    return time


def threads(text: str) -> int:
    """The number of threads that ``text`` names, 0 for all cores."""
    if not (text.isascii() and text.isdigit() and len(text) < 5 and int(text) <= MAX_THREADS):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a number of threads; write a whole number up to {MAX_THREADS}, 0 for all cores"
        )
    return int(text)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
    if not match or "0" in match.groups():
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write WIDTHxHEIGHT, for instance 1280x720")
    return int(match[1]), int(match[2])


def _count(text: str) -> int:
    if not (text.isdecimal() and len(text) < 10 and int(text)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of frames; write a whole number above 0")
    return int(text)
