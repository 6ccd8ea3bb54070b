"""``dyngs convert``: convert a file of Gaussians to another format."""

from __future__ import annotations

import argparse

from dyngs.cli.arguments import Commands, add_command, input_path, output_path
from dyngs.cli.output import print_notes, print_written
from dyngs.cli.splats import add_axes, print_image_difference
from dyngs.core.errors import format_count

_EPILOG = """\
examples:
  dyngs convert garden.ply garden.spz                 rotated to the up axis of the format
  dyngs convert garden.spz garden.ply --sh-degree 3   for programs that require degree 3
  dyngs convert garden.ply room.glb --from-up=z       the input has z up
"""


def add_parser(commands: Commands) -> None:
    about = (
        "Convert a file of Gaussians, from dyngs or another program, to another format. The file "
        "suffixes select the formats."
    )
    parser = add_command(
        commands, "convert", run, "convert a file of Gaussians to another format", about, _EPILOG
    )
    parser.add_argument(
        "source", type=input_path, metavar="IN", help="file to read, such as a .ply or .spz"
    )
    parser.add_argument(
        "target", type=output_path, metavar="OUT", help="file to write, such as a .glb or .sog"
    )
    add_axes(parser)


def run(arguments: argparse.Namespace) -> int:
    """Convert the file, and print the PSNR between renderings of both files."""
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
    axis = f"up axis {rotated.up}"
    if rotated.up != splat.up:
        axis = f"up axis rotated from {splat.up} to {rotated.up}"
    print_notes((*splat.notes, f"{format_count(len(splat.gaussians), 'Gaussian')}, {axis}"))
    written = write_splats(arguments.target, rotated, sh_degree=arguments.sh_degree)
    print_image_difference(written.notes, [compare_file_with_source(splat, written)])
    print_written(written.path)
    return 0
