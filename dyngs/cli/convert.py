"""``dyngs convert``: read a file of Gaussians and write it in another format."""

from __future__ import annotations

import argparse

from dyngs.cli.arguments import Commands, add_command, input_path, output_path
from dyngs.cli.output import print_notes, print_written
from dyngs.cli.splats import add_axes, print_image_difference
from dyngs.core.errors import format_count

_EPILOG = """\
examples:
  dyngs convert garden.ply garden.spz                 upright in viewers of either
  dyngs convert garden.spz garden.ply --sh-degree 3   for programs that insist on degree 3
  dyngs convert garden.ply room.glb --from-up=z       a .ply whose z points up
"""


def add_parser(commands: Commands) -> None:
    about = (
        "Read a file of Gaussians, of dyngs or of any other program, and write it in another format; the suffixes name "
        "the formats."
    )
    parser = add_command(
        commands, "convert", run, "write a file of Gaussians in another format", about, _EPILOG
    )
    parser.add_argument(
        "source", type=input_path, metavar="IN", help="file to read, such as a .ply or .spz"
    )
    parser.add_argument(
        "target", type=output_path, metavar="OUT", help="file to write, such as a .glb or .sog"
    )
    add_axes(parser)


def run(arguments: argparse.Namespace) -> int:
    """Convert the file, and print how much that changes what it shows."""
    from dataclasses import replace

    from dyngs.export.images import compare_file_with_source
    from dyngs.io.formats.formats import (
        format_for_path,
        orient_to_axis,
        read_splats,
        write_splats,
    )

    format_for_path(arguments.target)  # before a large file is read
    splat = read_splats(arguments.source, nonfinite="skip")
    if arguments.from_up is not None:
        splat = replace(splat, up=arguments.from_up)
    rotated = orient_to_axis(splat, arguments.up, arguments.target)
    said = f"up is {rotated.up} in the file" + (
        f", it was {splat.up}" if rotated.up != splat.up else ", as it was"
    )
    print_notes((*splat.notes, f"{format_count(len(splat.gaussians), 'Gaussian')}; {said}"))
    written = write_splats(arguments.target, rotated, sh_degree=arguments.sh_degree)
    print_image_difference(written.notes, [compare_file_with_source(splat, written)])
    print_written(written.path)
    return 0
