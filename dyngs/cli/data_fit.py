"""``dyngs data fit``: the body template fitted to images of a person."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from dyngs.cli.arguments import data_section, input_path, output_path
from dyngs.cli.progress_bar import ProgressBar
from dyngs.errors import as_word

if TYPE_CHECKING:
    from dyngs.human.fit.known_person import KnownAvatar

_GIVEN = ("keypoints", "masks", "background", "joints", "body", "person")


def add_parser(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``fit`` to the commands of ``dyngs data``."""
    parser = verbs.add_parser(
        "fit",
        help="fit the free body template to images of a person",
        description="Fit the free body template to the silhouettes of a person: one shape and skeleton, and the pose "
        "of every frame. OUT is a capture for `dyngs train human`.",
    )
    parser.add_argument(
        "capture",
        type=input_path,
        metavar="CAPTURE",
        help="folder of a capture; or a video, or a folder of images, of one camera that stands",
    )
    parser.add_argument("out", type=output_path, metavar="OUT", help="a new folder")
    parser.add_argument(
        "--keypoints", type=input_path, metavar="PATH", help="key points: a folder of OpenPose files, or a COCO file"
    )
    parser.add_argument(
        "--masks", type=input_path, metavar="DIR", help="masks of the person (white), named as the images"
    )
    parser.add_argument(
        "--background",
        type=input_path,
        metavar="PATH",
        help="an image of the place without the person, or a folder of one for each camera: masks are made by it",
    )
    parser.add_argument(
        "--joints",
        type=input_path,
        metavar="PATH",
        help="a fit of another program: 3D joints (.npz, .json), a folder of SAM 3D Body, or posed vertices",
    )
    parser.add_argument(
        "--body", type=input_path, metavar="FILE", help="body file (SMPL, ...) that posed vertices belong to"
    )
    parser.add_argument(
        "--person",
        type=input_path,
        metavar="PATH",
        help="a fitted capture of the same person, or the run of their avatar: the shape is kept, poses are found, by "
        "the avatar's silhouette if there is one",
    )
    parser.add_argument("overrides", nargs="*", default=[], metavar="data.key=value", help="keys of data")
    parser.set_defaults(run=run_fit)


def run_fit(arguments: argparse.Namespace) -> int:
    """Fit a body and print how good the fit is, and the next command."""
    from dyngs.human.fit.fitted_capture import FitInputs, write_fitted_capture

    options = data_section(arguments.overrides).model_copy(update={"root": arguments.capture})
    given = FitInputs(**{name: getattr(arguments, name) for name in _GIVEN}, avatar=_avatar_in(arguments.person))
    with ProgressBar() as report:
        result = write_fitted_capture(options, arguments.out, report, given)
    print(result.summary())
    print(f"next: dyngs train human data.root={as_word(result.root)}")
    return 0


def _avatar_in(person: Path | None) -> KnownAvatar | None:
    """Return the avatar of a run, None of anything else."""
    from dyngs.config.io import RESOLVED_NAME

    if person is None or not (person / RESOLVED_NAME).is_file():
        return None
    from dyngs.human.avatar.scene import avatar_of
    from dyngs.human.fit.known_person import KnownAvatar
    from dyngs.runs.checkpoint import load_run

    run = load_run(person)
    scene = avatar_of(run.scene)
    return None if scene is None else KnownAvatar(scene, run.config.data.longest_side)
