"""What commands that write files of Gaussians share: names of formats, options about axes, lines
about the result."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dyngs.cli.arguments import AXES
from dyngs.cli.output import print_notes

if TYPE_CHECKING:
    from dyngs.export.images import Redrawn

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


def print_redrawn(notes: tuple[str, ...], found: Sequence[Redrawn]) -> None:
    """Print what the format could not hold, and how the files differ from the scene: the worst of
    them."""
    worst = min(found, key=lambda one: one.psnr)
    print_notes((*notes, worst.line))
    if worst.is_faint:
        print_notes(
            (), (f"the file shows the scene with visible differences ({worst.psnr:.1f} dB)",)
        )
