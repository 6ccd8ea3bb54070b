"""Options and messages shared by commands that write files of Gaussians."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from dyngs.cli.arguments import AXES
from dyngs.cli.output import print_notes

SPLAT_FORMATS = ("ply", "compressed-ply", "spz", "splat", "sog", "glb", "usd")
"""Names of ``dyngs.io.formats.formats.FORMATS``, repeated so that ``--help`` need not import it."""
MOVING = "4dgs"
"""Name and suffix of the format of moving Gaussians."""


def add_axes(parser: argparse.ArgumentParser) -> None:
    """Add the options of the up axis and the SH degree."""
    about = (
        "up axis of the file, to which the scene is rotated (default: y for .spz, .glb and USD, -y "
        "for other formats); keep: no rotation"
    )
    parser.add_argument("--up", choices=(*AXES, "keep"), help=about)
    about = "up axis of the input (default: detected)"
    parser.add_argument("--from-up", choices=AXES, metavar="AXIS", help=about)
    about = "SH degree of the file, 0 to 4: higher coefficients are dropped, missing ones are zero"
    parser.add_argument("--sh-degree", type=int, choices=range(5), metavar="N", help=about)


def print_image_difference(notes: tuple[str, ...], found: Sequence[float]) -> None:
    """Print notes about the format and the lowest PSNR, dB, of renderings of file and scene."""
    worst = min(found)
    figure = "the same images" if worst >= 99.9 else f"{worst:.1f} dB (PSNR)"
    print_notes((*notes, f"drawn again: {figure} compared with the scene"))
    if worst < 30:
        print_notes((), (f"the file shows the scene with visible differences ({worst:.1f} dB)",))
