"""``dyngs export``: a run as a file for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``export`` to the commands."""
    parser = commands.add_parser(
        "export",
        help="write a run as a file for other programs",
        description="Write the Gaussians of a run as the standard 3DGS .ply, which viewers and editors read.",
    )
    parser.add_argument("run_dir", type=Path, metavar="RUN", help="folder that `dyngs train` wrote")
    parser.add_argument("--format", choices=("ply",), default="ply")
    parser.add_argument("--out", type=Path, metavar="FILE", help="default RUN/splats.ply")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the file and say how large it is."""
    from dyngs.export.run import export_ply

    path = export_ply(arguments.run_dir, arguments.out or arguments.run_dir / "splats.ply")
    print(f"written: {path} ({path.stat().st_size / 1e6:.1f} MB)")
    return 0
