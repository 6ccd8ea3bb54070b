"""Poses of training fitted again, in the middle of it, to its images: silhouettes place limbs less well than colours.

Poses that were given well gain little, so it is tried first, at a few time steps, on views that are left out.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image, ImageLoader
from dyngs.human.avatar.pose_fit import IMAGES, by_time, fitted_to_images
from dyngs.human.avatar.scene import HumanScene
from dyngs.metrics import psnr

TRIED = 3  # time steps at which a view is left out
LEAST_GAIN = 0.5  # mean of its PSNR in the person's box, dB, from which all poses are fitted
QUICKLY = replace(IMAGES, most_windows=3)  # training goes on with what is found


class PoseRefit:
    """What poses are fitted to: the training ``images``, and the colour ``background`` (3,) behind person and render.

    Only time steps with two images or more are fitted: one hides how far limbs reach towards the camera.
    """

    def __init__(self, images: ImageLoader, background: Tensor) -> None:
        self._images, self._background = images, background
        self._groups = [sorted(group) for _, group in sorted(by_time(images).items())]

    def suits(self, scene: HumanScene) -> bool:
        """Return whether each row of the clip of training has images of its own, and some have two or more."""
        return len(self._groups) == len(scene.clip) and any(map(self._is_fitted, range(len(scene.clip))))

    def gain(self, scene: HumanScene) -> float:
        """Return by how many dB views gain, in the person's box, from poses fitted to the others of their time."""
        rows = [row for row in range(len(self._groups)) if self._is_fitted(row)]
        rows = [rows[(2 * i + 1) * len(rows) // (2 * TRIED)] for i in range(TRIED)]
        gains = []
        for number, row in enumerate(dict.fromkeys(rows)):
            group = self._groups[row]
            left_out = group[number % len(group)]
            found = self._fitted(scene, [i for i in group if i != left_out])
            gains.append(self._psnr(found, left_out) - self._psnr(scene, left_out))
        return fmean(gains)

    def refitted(self, scene: HumanScene, row: int) -> HumanScene:
        """Return the scene with row ``row`` of the clip of training as it was fitted, and its corrections zero."""
        found = self._fitted(scene, self._groups[row]).played if self._is_fitted(row) else None
        if found is None:
            return scene
        clip = scene.clip
        poses, trans = clip.poses.clone(), clip.trans.clone()
        poses[row], trans[row] = found.poses[0], found.trans[0]
        with torch.no_grad():
            for name in ("poses", "trans"):
                scene.learned[name][row] = 0
        return replace(scene, clip=replace(clip, poses=poses, trans=trans))

    def _is_fitted(self, row: int) -> bool:
        return len(self._groups[row]) > 1

    def _fitted(self, scene: HumanScene, which: list[int]) -> HumanScene:
        still = replace(scene, gaussians=scene.gaussians.detach())
        return fitted_to_images(still, self._images, self._background, QUICKLY, which).scene

    @torch.no_grad()
    def _psnr(self, scene: HumanScene, index: int) -> float:
        image: Image = self._images[index]
        drawn = scene.render(image.cameras, image.time, options=scene.options, background=self._background).rgb[0]
        box = (None if image.alpha is None else silhouette_box(image.alpha)) or (slice(None), slice(None))
        mask = None if image.mask is None else image.mask[box]
        return psnr(drawn[box], image.composite(self._background)[box], mask)
