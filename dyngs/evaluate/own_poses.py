"""Scores of held-out views from poses that were refined on their own pictures, and the refined cameras of training.

Where poses of training are wrong, so are those of test views, and a sharp scene loses by it. The usual protocol (BARF,
Lin et al. 2021) moves each test camera to where the scene looks most like its picture before scoring. Of a person it is
the body's pose that is fitted, once to the silhouettes alone, as a tool would that poses a known person in a new clip,
and once to the whole pictures. These figures have seen the test pictures: they stand beside the usual one, never in
its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch

from dyngs.data.capture import Capture, View
from dyngs.data.loader import PictureLoader
from dyngs.evaluate.temporal import Drawing
from dyngs.evaluate.view_scores import PoseScores, means_of, score_views
from dyngs.human.avatar.pose_comparison import PICTURES, SILHOUETTES, Comparison
from dyngs.human.avatar.pose_fit import fitted_to_pictures
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.metrics import Lpips, psnr
from dyngs.runs.cameras import found_corrections
from dyngs.runs.checkpoint import LoadedRun
from dyngs.training.camera_fit import fitted_to_picture


@dataclass(frozen=True)
class PoseRefinement:
    """Scores from poses that were fitted to the tested pictures; None where that was not done.

    Attributes:
        psnr: from cameras, or of a person from body poses, fitted to the whole pictures.
        to_pictures: of a person, all scores of these.
        to_silhouettes: of a person, from poses fitted to the silhouettes alone; None without silhouettes.
    """

    psnr: float | None = None
    to_pictures: PoseScores | None = None
    to_silhouettes: PoseScores | None = None


def scores_from_own_poses(drawing: Drawing, pictures: PictureLoader, size: float, lpips: Lpips) -> PoseRefinement:
    """Return the scores of pictures from poses that were fitted to them; the scene stays as it is.

    Args:
        drawing: of the scene.
        pictures: of a split.
        size: of the scene, world units.
        lpips: from ``load_lpips``.
    """
    avatar = avatar_of(drawing.scene)
    if avatar is None:
        return PoseRefinement(psnr_from_own_poses(drawing, pictures, size))
    outlined = all(pictures[i].alpha is not None for i in range(len(pictures)))
    whole = _person_scores(avatar, drawing, pictures, lpips, PICTURES)
    outlines = _person_scores(avatar, drawing, pictures, lpips, SILHOUETTES) if outlined else None
    return PoseRefinement(whole.psnr, whole, outlines)


def _person_scores(
    avatar: HumanScene, drawing: Drawing, pictures: PictureLoader, lpips: Lpips, comparison: Comparison
) -> PoseScores:
    """Return the scores of a person in the poses that are most like the pictures."""
    fitted = fitted_to_pictures(avatar, pictures, drawing.background, drawing.options, comparison)
    each = (pictures[i] for i in range(len(pictures)))
    views, _ = score_views(fitted.scene, each, drawing.options, drawing.background, lpips)
    return PoseScores(**means_of(views), updates=fmean(fitted.updates), per_view=tuple(views))


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
