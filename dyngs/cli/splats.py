"""What commands that write files of Gaussians share: names of formats, options about axes, lines about the result."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import print_notes

if TYPE_CHECKING:
    from dyngs.export.redrawn import Redrawn

SPLAT_FORMATS = ("ply", "compressed-ply", "spz", "splat", "sog", "glb", "usd")
"""Names of ``dyngs.splats.formats.FORMATS``; those and ``MOVING`` are so that ``--help`` need not import them."""
MOVING = "4dgs"
"""Name and suffix of the format of moving Gaussians."""
_AXES = ("x", "y", "z", "-x", "-y", "-z")


def add_axes(parser: argparse.ArgumentParser) -> None:
    """Add the options about which way is up, and the degree of the harmonics."""
    parser.add_argument(
        "--up",
        choices=(*_AXES, "keep"),
        help="axis that points up in the file; the scene is turned (default: what viewers of the format take for up: "
        "-y, but y for .spz, .glb and USD); keep: nothing is turned",
    )
    parser.add_argument(
        "--from-up", choices=_AXES, metavar="AXIS", help="axis that points up in what is read (default: found out)"
    )
    parser.add_argument(
        "--sh-degree",
        type=int,
        choices=range(5),
        metavar="N",
        help="degree of the harmonics in the file, 0 to 4: higher ones are left out, missing ones are zero",
    )


def known_suffix(path: Path) -> bool:
    """Return whether the name of a file ends as those of a format of Gaussians."""
    from dyngs.splats.formats import known_format

    return known_format(path) is not None


def print_redrawn(notes: tuple[str, ...], found: Sequence[Redrawn]) -> None:
    """Print what the format could not hold, and how the files differ from the scene: the worst of them."""
    worst = min(found, key=lambda one: one.psnr)
    print_notes((*notes, worst.line))
    if worst.is_faint:
        print_notes((), (f"the file shows the scene with visible differences ({worst.psnr:.1f} dB)",))
