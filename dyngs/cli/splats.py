"""What commands that write files of Gaussians share: names of formats, options about axes, lines
about the result."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from dyngs.cli.arguments import AXES
from dyngs.cli.output import print_notes

SPLAT_FORMATS = ("ply", "compressed-ply", "spz", "splat", "sog", "glb", "usd")
"""Names of ``dyngs.io.formats.formats.FORMATS``; those and ``MOVING`` are so that ``--help`` need not
import them."""
MOVING = "4dgs"
"""Name and suffix of the format of moving Gaussians."""


def add_axes(parser: argparse.ArgumentParser) -> None:
    """Add the options about which way is up, and the degree of the harmonics."""
    about = (
        "axis that points up in the file; the scene is rotated (default: what viewers of the format take for up: -y, "
        "but y for .spz, .glb and USD); keep: nothing is rotated"
    )
    parser.add_argument("--up", choices=(*AXES, "keep"), help=about)
    about = "axis that points up in what is read (default: found out)"
    parser.add_argument("--from-up", choices=AXES, metavar="AXIS", help=about)
    about = "degree of the harmonics in the file, 0 to 4: higher ones are left out, missing ones are zero"
    parser.add_argument("--sh-degree", type=int, choices=range(5), metavar="N", help=about)


def print_image_difference(notes: tuple[str, ...], found: Sequence[float]) -> None:
    """Print what the format could not hold, and the worst PSNR, dB, of files drawn again and the
    scene."""
    worst = min(found)
    figure = "the same images" if worst >= 99.9 else f"{worst:.1f} dB (PSNR)"
    print_notes((*notes, f"drawn again: {figure} compared with the scene"))
    if worst < 30:
        print_notes((), (f"the file shows the scene with visible differences ({worst:.1f} dB)",))
