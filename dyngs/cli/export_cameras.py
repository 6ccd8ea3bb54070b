"""``dyngs export --format cameras``: the cameras of a run as a transforms.json, refined where training refined them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import data_root, is_avatar_file, print_notes
from dyngs.errors import DyngsError, as_word, counted

if TYPE_CHECKING:
    from dyngs.data.capture import Split, View


def export_cameras(arguments: argparse.Namespace) -> int:
    """Write the cameras of a run, and print where they are and what of them was refined.

    Raises:
        DyngsError: an option that does not go with cameras, no run there, a capture that cannot be read, refined
            cameras that are lost with the checkpoints, or a file that cannot be written.
    """
    from dyngs.data.capture import all_views
    from dyngs.data.read import read_capture
    from dyngs.export.cameras import NAME, write_cameras
    from dyngs.runs.cameras import found_corrections
    from dyngs.runs.checkpoint import load_run

    source: Path = arguments.run_dir
    if is_avatar_file(source):
        raise DyngsError(f"{source}: an avatar file has no cameras; give a run")
    out: Path = arguments.out or source / "cameras"
    path = out if out.suffix.lower() == ".json" else out / NAME
    run = load_run(source, data_root(arguments))
    capture = read_capture(run.config.data)
    if path.resolve().parent == capture.root.resolve():
        raise DyngsError(f"{path}: would stand in for the cameras of the capture; give another folder")
    found = found_corrections(source, run, capture.splits["train"])
    if found is None and run.config.camera.refine == "always":
        raise DyngsError(f"{source}: refined cameras lie in checkpoints, and there is none; restore one or train again")
    splits: dict[Split, Sequence[View]] = {name: views for name, views in capture.splits.items() if name != "pose"}
    if found is None:
        print_notes(("camera.refine was not used in this run: these are the cameras of the capture",))
    else:
        splits = {name: [found.corrected_view(view) for view in views] for name, views in splits.items()}
        print_notes(("training cameras as training found them; others have the capture's poses, and known lenses",))
    written = write_cameras(path, capture, splits)
    count, root = len(all_views(capture.splits)), as_word(path.parent)
    print(
        f"written: {written} ({counted(count, 'camera')}); `data.root={root} data.follow_links=true` trains with them"
    )
    return 0
