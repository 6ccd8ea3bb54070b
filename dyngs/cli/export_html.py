"""``dyngs export --format html``: a run as one page that plays in a browser by itself."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.cli.arguments import data_root, is_avatar_file, print_notes
from dyngs.errors import DyngsError


def export_page(arguments: argparse.Namespace) -> int:
    """Write the page of a run or an avatar file, and print where it is and how large.

    Raises:
        DyngsError: an option that does not go with a page, no run there, or a file that cannot be written.
    """
    from dataclasses import replace

    from dyngs.export.html.page import write_page
    from dyngs.runs.opened import open_scene

    source: Path = arguments.run_dir
    if arguments.out is None and is_avatar_file(source):
        raise DyngsError(f"{source}: where to? Give --out FILE.html")
    out: Path = arguments.out or source / "scene.html"
    if out.suffix.lower() not in (".html", ".htm") or out.is_dir():
        raise DyngsError(f"{out}: --format html writes one file; give --out {out.with_suffix('.html')}")
    opened = open_scene(source, data_root=data_root(arguments))
    if arguments.motion is not None:
        opened = opened.in_motion(arguments.motion)
    if arguments.from_up is not None:
        opened = replace(opened, stated_up=arguments.from_up)
    written = write_page(opened, out, time=0.0 if arguments.time is None else arguments.time)
    print_notes(written.notes)
    print(f"written: {written.path} ({written.num_bytes / 1e6:.1f} MB); it plays in any browser with WebGL 2, offline")
    return 0
