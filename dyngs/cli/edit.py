"""``dyngs edit``: change the coordinate frame of a scene, crop, clean and merge scenes."""

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
  dyngs edit runs/room --clean --out clean.ply                                remove floaters, at most 0.1 dB loss
  dyngs edit runs/site --geo points.csv --out site.ply                        in the coordinates of control points
  dyngs edit runs/site --geo exif --out runs/site_m                           metres, north and up from photo GPS
  dyngs edit room.ply --merge chair.ply lamp.spz --out all.ply
  dyngs edit table.ply --undo --out before.ply                                the original coordinate frame
  dyngs edit runs/room --up auto --scale 2 --out runs/upright                 a new run with cameras and motion

Edits are applied in this order: --clean, --crop, --merge, coordinate frame. Details: dyngs docs edit.
"""


def add_parser(commands: args.Commands) -> None:
    parser = args.add_command(
        commands,
        "edit",
        run,
        "transform, crop, clean and merge scenes",
        "Edit a run or a file of Gaussians, and write the result as another file or run. Points "
        "are in the coordinates of the file, or of the capture of a run. Changes of the "
        "coordinate frame are stored and can be undone.",
        _EPILOG,
    )
    parser._negative_number_matcher = _NEGATIVE  # otherwise "-1,0,2" is parsed as an option
    parser.add_argument(
        "source", type=args.input_path, metavar="RUN|FILE", help="run folder, or file of Gaussians"
    )
    about = "file to write (.ply, .spz, .glb, .4dgs for moving scenes ...); without a suffix: new run folder"
    parser.add_argument(
        "--out", type=args.output_path, required=True, metavar="FILE|RUN2", help=about
    )
    frame = parser.add_argument_group("frame")
    about = (
        "up direction: an axis such as -y, a vector x,y,z, or auto (from the cameras of the run)"
    )
    frame.add_argument("--up", metavar="DIRECTION", help=about)
    frame.add_argument("--origin", metavar="X,Y,Z", help="point that becomes the origin")
    about = 'scale factor, or "x,y,z x,y,z LENGTH": two points and their distance after scaling'
    frame.add_argument("--scale", metavar="FACTOR", help=about)
    about = (
        "control points: three or more rows of scene x,y,z and world X,Y,Z; exif: GPS of the photos"
    )
    frame.add_argument("--geo", type=args.input_path, metavar="FILE|exif", help=about)
    frame.add_argument("--undo", action="store_true", help="restore the original coordinate frame")
    part = parser.add_argument_group("Gaussians")
    about = "region to keep: two corners x,y,z x,y,z of a box, or centre and radius of a sphere"
    part.add_argument("--crop", nargs="+", metavar="REGION", help=about)
    part.add_argument("--outside", action="store_true", help="keep what is outside of --crop")
    about = "remove floaters, needles, faint and isolated Gaussians, and those that no camera sees"
    part.add_argument("--clean", action="store_true", help=about)
    about = "largest loss of PSNR by --clean on held-out views, dB (default 0.1)"
    part.add_argument("--max-loss", metavar="DB", help=about)
    about = "static files of Gaussians or runs to add"
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
    """Edit, and print the changes and the PSNR between renderings of the file and the scene."""
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
    """Parse the options. Raises DyngsError: incompatible options, or invalid points or numbers."""
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
            f"{whole[0]} defines the whole coordinate frame; "
            f"remove {' and '.join([*whole[1:], *alone])}"
        )
    if arguments.outside and arguments.crop is None:
        raise DyngsError("--outside requires --crop")
    if arguments.max_loss is not None and not arguments.clean:
        raise DyngsError("--max-loss requires --clean")
    max_loss = 0.1 if arguments.max_loss is None else parse_number(arguments.max_loss, "--max-loss")
    if max_loss < 0:
        raise DyngsError(f"--max-loss {max_loss:g}: must be 0 dB or more")
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
