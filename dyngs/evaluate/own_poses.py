"""Scores of held-out views from poses that were refined on their own pictures, and the refined cameras of training.

Where poses of training are wrong, so are those of test views, and a sharp scene loses by it. The usual protocol (BARF,
Lin et al. 2021) moves each test camera to where the scene looks most like its picture before scoring. That figure has
seen the test pictures: it stands beside the usual one, never in its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import torch

from dyngs.data.capture import Capture, View
from dyngs.data.loader import PictureLoader
from dyngs.evaluate.temporal import Drawing
from dyngs.metrics import psnr
from dyngs.runs.cameras import found_corrections
from dyngs.runs.checkpoint import LoadedRun
from dyngs.training.camera_fit import fitted_to_picture


def psnr_from_own_poses(drawing: Drawing, pictures: PictureLoader, size: float) -> float:
    """Return the mean PSNR, dB, of pictures from poses that were fitted to them; the scene stays as it is.

    Args:
        drawing: of the scene.
        pictures: of a split.
        size: of the scene, world units.
    """
    scene, options, background = drawing.scene, drawing.options, drawing.background
    scores: list[float] = []
    for picture in (pictures[i] for i in range(len(pictures))):
        fitted = fitted_to_picture(scene, picture, background, size, options=options)
        with torch.no_grad():
            rendering = scene.render(fitted.cameras, picture.time, options=options, background=background)
        scores.append(psnr(rendering.rgb[0], picture.composite(background), picture.mask))
    return fmean(scores)


def pictures_of_split(capture: Capture, views: Sequence[View], run_dir: Path, run: LoadedRun) -> PictureLoader:
    """Return the pictures of ``views``, a split of ``capture``, with the cameras that training found, if any.

    Pictures that were not trained on have the lens that they share with others, and the pose of a camera that stands
    still; all other poses are those of the capture.

    Raises:
        DyngsError: unreadable pictures, or a checkpoint of other views.
    """
    pictures = PictureLoader(views, run.config.data)
    found = found_corrections(run_dir, run, capture.splits["train"])
    if found is not None:
        pictures.corrected = lambda index, cameras: found.applied_to(pictures.views[index], cameras)
    return pictures
