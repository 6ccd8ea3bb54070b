"""``dyngs data fit``: the body template fitted to pictures of a person."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyngs.cli.arguments import data_section
from dyngs.cli.progress_bar import ProgressBar


def add_parser(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``fit`` to the commands of ``dyngs data``."""
    parser = verbs.add_parser(
        "fit",
        help="fit the free body template to pictures of a person",
        description="Fit the free body template to the silhouettes of a person: one shape and skeleton, and the pose "
        "of every frame. OUT is a capture for `dyngs train human`.",
    )
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="folder of a capture with silhouettes")
    parser.add_argument("out", type=Path, metavar="OUT", help="a new folder")
    parser.add_argument(
        "--keypoints", type=Path, metavar="PATH", help="key points: a folder of OpenPose files, or a COCO file"
    )
    parser.add_argument("overrides", nargs="*", default=[], metavar="data.key=value", help="keys of data")
    parser.set_defaults(run=run_fit)


def run_fit(arguments: argparse.Namespace) -> int:
    """Fit a body and print how good the fit is, and the next command."""
    from dyngs.human.fit.fitted_capture import write_fitted_capture

    options = data_section(arguments.overrides).model_copy(update={"root": arguments.capture})
    with ProgressBar() as report:
        result = write_fitted_capture(options, arguments.out, report, arguments.keypoints)
    print(result.summary())
    print(f"next: dyngs train human data.root={result.root}")
    return 0
