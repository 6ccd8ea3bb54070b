"""Scores of held-out views from poses that were refined on their own images, and the refined cameras of training.

Where poses of training are wrong, so are those of test views, and a sharp scene loses by it. The usual protocol (BARF,
Lin et al. 2021) moves each test camera to where the scene looks most like its image before scoring. Of a person it is
the body's pose that is fitted, once to the silhouettes alone, as a tool would that poses a known person in a new clip,
and once to the whole images. These figures have seen the test images: they stand beside the usual one, never in
its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch

from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.evaluate.drawing import Drawing
from dyngs.evaluate.view_scores import PoseScores, means_of, score_views
from dyngs.gaussians.scene import require_gaussians
from dyngs.human.avatar.pose_fit import IMAGES, SILHOUETTES, Comparison, fitted_to_images
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.metrics import Lpips, psnr
from dyngs.runs.checkpoint import LoadedRun, found_corrections
from dyngs.training.corrections.camera_fit import fitted_to_image


@dataclass(frozen=True)
class PoseRefinement:
    """Scores from poses that were fitted to the tested images; None where that was not done.

    Attributes:
        psnr: from cameras, or of a person from body poses, fitted to the whole images.
        to_images: of a person, all scores of these.
        to_silhouettes: of a person, from poses fitted to the silhouettes alone; None without silhouettes.
    """

    psnr: float | None = None
    to_images: PoseScores | None = None
    to_silhouettes: PoseScores | None = None


def scores_from_own_poses(drawing: Drawing, images: ImageLoader, size: float, lpips: Lpips) -> PoseRefinement:
    """Return the scores of images from poses that were fitted to them; the scene stays as it is."""
    avatar = avatar_of(drawing.scene)
    if avatar is None:
        return PoseRefinement(psnr_from_own_poses(drawing, images, size))
    outlined = all(images[i].alpha is not None for i in range(len(images)))
    whole = _person_scores(avatar, drawing, images, lpips, IMAGES)
    outlines = _person_scores(avatar, drawing, images, lpips, SILHOUETTES) if outlined else None
    return PoseRefinement(whole.psnr, whole, outlines)


def _person_scores(
    avatar: HumanScene, drawing: Drawing, images: ImageLoader, lpips: Lpips, comparison: Comparison
) -> PoseScores:
    """Return the scores of a person in the poses that are most like the images."""
    fitted = fitted_to_images(avatar, images, drawing.background, avatar.options, comparison)
    each = (images[i] for i in range(len(images)))
    views, _ = score_views(fitted.scene, each, drawing.options, drawing.background, lpips)
    return PoseScores(**means_of(views), updates=fmean(fitted.updates), per_view=tuple(views))


def psnr_from_own_poses(drawing: Drawing, images: ImageLoader, size: float) -> float:
    """Return the mean PSNR, dB, of images from poses fitted to them; ``size`` of the scene is in world units."""
    scene, background = require_gaussians(drawing.scene, "what cameras are fitted to"), drawing.background
    options = scene.options
    scores: list[float] = []
    for image in (images[i] for i in range(len(images))):
        fitted = fitted_to_image(scene, image, background, size, options=options)
        with torch.no_grad():
            rendering = scene.render(fitted.cameras, image.time, options=options, background=background)
        scores.append(psnr(rendering.rgb[0], image.composite(background), image.mask))
    return fmean(scores)


def images_of_split(capture: Capture, views: Sequence[View], run_dir: Path, run: LoadedRun) -> ImageLoader:
    """Return the images of ``views``, a split of ``capture``, with the cameras that training found, if any.

    Images that were not trained on have the lens that they share with others, and the pose of a camera that stands
    still; all other poses are those of the capture.
    """
    images = ImageLoader(views, run.config.data)
    found = found_corrections(run_dir, run, capture.splits["train"])
    if found is not None:
        images.corrected = lambda index, cameras: found.applied_to(images.views[index], cameras)
    return images
