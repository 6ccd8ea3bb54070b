"""``dyngs edit``: another frame for a scene, a part of it, what spoils it taken away, several
scenes in one."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli import arguments as args
from dyngs.cli.imports import heavy_imports
from dyngs.cli.output import print_written
from dyngs.core.errors import DyngsError, log_info, quote_path

if TYPE_CHECKING:
    from dyngs.api.edit import Edits

_NEGATIVE = re.compile(r"-([xyz]$|\.?\d)")  # values of options that begin with a minus
_EXIF = Path("exif")
_EPILOG = """\
examples:
  dyngs edit runs/room --up auto --scale "0,0,0 1,0,0 1.25m" --out room.ply   upright, in metres
  dyngs edit room.ply --crop -1,-1,-1 1,1,1 --out table.spz                   a box, by two corners
  dyngs edit room.ply --crop 0,0,0 1.5 --outside --out rest.ply               all but a sphere
  dyngs edit runs/room --clean --out clean.ply                                without what spoils it, for 0.1 dB at most
  dyngs edit runs/site --geo points.csv --out site.ply                        in the coordinates of control points
  dyngs edit runs/site --geo exif --out runs/site_m                           north, up and metres by GPS of the photos
  dyngs edit room.ply --merge chair.ply lamp.spz --out all.ply
  dyngs edit table.ply --undo --out before.ply                                the frame of before
  dyngs edit runs/room --up auto --scale 2 --out runs/upright                 a run: its cameras, motion, exports, too

What is asked for is done in this order: --clean, --crop, --merge, the frame. Guide: `dyngs docs edit`.
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "edit",
        run,
        "another frame, a part, cleaned, several in one: a scene as an edited file",
        "Edit a run or a file of Gaussians, and write the result as another file or run. Points are given in the "
        "coordinates of a file, or of the capture of a run. How the frame was changed is stored: it can be undone.",
        _EPILOG,
    )
    parser._negative_number_matcher = _NEGATIVE  # else "-1,0,2" would be taken for an option
    parser.add_argument(
        "source", type=args.input_path, metavar="RUN|FILE", help="run folder, or file of Gaussians"
    )
    about = "file to write, such as a .ply, .spz, .glb, or .4dgs of what moves; without a suffix the folder of a run"
    parser.add_argument(
        "--out", type=args.output_path, required=True, metavar="FILE|RUN2", help=about
    )
    frame = parser.add_argument_group("frame")
    about = "direction that is up: an axis such as -y, x,y,z, or auto, by the cameras of the run"
    frame.add_argument("--up", metavar="DIRECTION", help=about)
    frame.add_argument("--origin", metavar="X,Y,Z", help="point that becomes the origin")
    about = 'factor, or "x,y,z x,y,z LENGTH": two points, and what their distance is to be'
    frame.add_argument("--scale", metavar="FACTOR", help=about)
    about = "control points: rows of x,y,z in the scene and X,Y,Z in the world, three or more; exif: GPS of the photos"
    frame.add_argument("--geo", type=args.input_path, metavar="FILE|exif", help=about)
    frame.add_argument("--undo", action="store_true", help="the frame from before the first edit")
    part = parser.add_argument_group("Gaussians")
    about = "what stays: two corners x,y,z x,y,z of a box, or centre and radius of a sphere"
    part.add_argument("--crop", nargs="+", metavar="REGION", help=about)
    part.add_argument("--outside", action="store_true", help="--crop leaves out what lies inside")
    about = "take away floaters, needles, faint veils, and what no camera ever saw"
    part.add_argument("--clean", action="store_true", help=about)
    about = "largest loss of PSNR of views held out by --clean, dB (default 0.1)"
    part.add_argument("--max-loss", metavar="DB", help=about)
    about = "files of Gaussians, or runs, to be added; all still"
    part.add_argument(
        "--merge", nargs="+", default=[], type=args.input_path, metavar="FILE", help=about
    )
    part.add_argument(
        "--time",
        type=args.scene_time,
        metavar="T",
        help="time of a moving scene, 0 to 1 (default 0)",
    )
    args.add_threads(parser)
    args.add_data_root(parser)


def run(arguments: argparse.Namespace) -> int:
    """Edit, and print what was done and how the file differs from the scene."""
    with heavy_imports():
        from dyngs.api.edit import edit_scene
        from dyngs.cli.splats import print_image_difference

    source = args.run_of_scene_file(arguments.source)
    reads = [] if arguments.geo in (None, _EXIF) else [arguments.geo]
    edits = _edits(arguments)
    written = edit_scene(source, arguments.out, edits, reads, args.data_root(arguments), _note)
    if written.redrawn is None:
        print(f"written: {written.path}")
    else:
        print_image_difference(written.notes, [written.redrawn])
        print_written(written.path)
    if written.redrawn is None or written.path.suffix.lower() == ".ply":
        print(f"next:    dyngs view {quote_path(written.path)}")
    return 0


def _note(text: str) -> None:
    log_info(f"note: {text}")


def _edits(arguments: argparse.Namespace) -> Edits:
    """Return what the options ask for. Raises DyngsError: they do not go together, or are no points
    or numbers."""
    from dyngs.api.edit import Edits
    from dyngs.export.edit.crop import parse_region
    from dyngs.export.edit.frame import (
        Frame,
        control_point_frame,
        parse_direction,
        parse_number,
        parse_point,
        parse_scale,
    )

    alone = [
        f"--{name}" for name in ("up", "origin", "scale") if getattr(arguments, name) is not None
    ]
    whole = [f"--{name}" for name in ("geo", "undo") if getattr(arguments, name)]
    if len(whole) + bool(alone) > 1 and whole:
        raise DyngsError(
            f"{whole[0]} gives the whole frame, so leave out {' and '.join([*whole[1:], *alone])}"
        )
    if arguments.outside and arguments.crop is None:
        raise DyngsError("--outside goes with --crop, which names what is left out")
    if arguments.max_loss is not None and not arguments.clean:
        raise DyngsError("--max-loss goes with --clean")
    max_loss = 0.1 if arguments.max_loss is None else parse_number(arguments.max_loss, "--max-loss")
    if max_loss < 0:
        raise DyngsError(f"--max-loss {max_loss:g}: give the dB that may be lost, 0 or more")
    return Edits(
        max_loss=max_loss if arguments.clean else None,
        region=None if arguments.crop is None else parse_region(arguments.crop),
        outside=arguments.outside,
        merge=tuple(arguments.merge),
        frame=Frame(
            None if arguments.up is None else parse_direction(arguments.up),
            None if arguments.origin is None else parse_point(arguments.origin, "--origin"),
            1.0 if arguments.scale is None else parse_scale(arguments.scale),
        ),
        geo=None if arguments.geo in (None, _EXIF) else control_point_frame(arguments.geo),
        gps=arguments.geo == _EXIF,
        undo=arguments.undo,
        time=arguments.time,
        threads=arguments.threads,
    )
