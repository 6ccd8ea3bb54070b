"""Poses of training fitted again, in the middle of it, to its images: silhouettes place limbs less
well than colours.

The better the poses, the sharper the avatar, and the better it places limbs: so it is done a few
times. Poses that were given well gain little: each time it is tried first, at a few time steps, on
views that are left out.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean

import torch
from torch import Tensor

from dyngs.core.metrics import psnr
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image, ImageLoader
from dyngs.human.avatar.pose_fit import FIRST_RATES, IMAGES, WINDOW, by_time, fitted_to_images
from dyngs.human.avatar.posing import frame_pose, posed_joints
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.joints import JOINT_NAMES

TRIED = 3  # time steps at which a view is left out
LEAST_GAIN = 0.5  # mean of its PSNR in the person's box, dB, from which all poses are fitted
LEAST_MOVE = 0.005
"""Mean of all joints, m of the body, from which they are fitted the first time: training learns
less without.

Poses that are given, or found in good silhouettes, are moved by 2 to 6 mm, those in a detector's
masks by 6 to 16.
"""
# fractions of the run after which poses are fitted, one after each step
STARTS = (0.25, 0.45, 0.65)
MOST_WINDOWS = 6  # of each round of a fit: training goes on with what is found


class PoseRefit:
    """When and to what poses are fitted in a run of ``steps``.

    To the training ``images``, with the colour ``background`` (3,) behind person and render. Only
    time steps with two images or more are fitted: one hides how far limbs reach towards the camera.

    Attributes:
        goes_on: whether views gained when poses were fitted last.
    """

    goes_on = True

    def __init__(self, images: ImageLoader, background: Tensor, steps: int) -> None:
        self._images, self._background = images, background
        self._groups = [sorted(group) for _, group in sorted(by_time(images).items())]
        self._starts = [round(start * steps) for start in STARTS]
        # as many updates as the run has, at most
        few = steps // (len(FIRST_RATES) * WINDOW * len(self._groups))
        self._comparison = replace(IMAGES, most_windows=min(max(few, 1), MOST_WINDOWS))

    def suits(self, scene: HumanScene) -> bool:
        """Return whether each row of the clip of training has images of its own, and some have two
        or more."""
        return len(self._groups) == len(scene.clip) and any(
            map(self._is_fitted, range(len(scene.clip)))
        )

    def revised(self, scene: HumanScene, step: int) -> tuple[HumanScene, str] | None:
        """Return the scene as it is after ``step``, and a line if that was decided; None: nothing
        is to do."""
        since = [step - start for start in self._starts if start <= step]
        if not self.goes_on or not since or since[-1] > len(self._groups) or not self.suits(scene):
            return None
        scene.changed()
        if since[-1] > 0:
            return self.refitted(scene, since[-1] - 1), ""
        gain, move = self.tried(scene)
        self.goes_on = gain >= LEAST_GAIN and (move >= LEAST_MOVE or step > self._starts[0])
        decided = (
            "are fitted to the images again" if self.goes_on else "stay, but for what is learned"
        )
        why = f"such a fit moves joints by {1000 * move:.0f} mm, and views left out of it gain {gain:.1f} dB"
        return scene, f"poses {decided}: {why}"

    def tried(self, scene: HumanScene) -> tuple[float, float]:
        """Return what poses fitted to all views but one of their time do, as means over some times.

        By how many dB the view that was left out gains, in the person's box; how far joints move, m
        of the body.
        """
        rows = [row for row in range(len(self._groups)) if self._is_fitted(row)]
        rows = [rows[(2 * i + 1) * len(rows) // (2 * TRIED)] for i in range(TRIED)]
        gains = []
        moves = []
        for number, row in enumerate(dict.fromkeys(rows)):
            group = self._groups[row]
            left_out = group[number % len(group)]
            found = self._fitted(scene, [i for i in group if i != left_out])
            gains.append(self._psnr(found, left_out) - self._psnr(scene, left_out))
            time = self._images.times[left_out] or 0.0
            before, after = (_joints(x, time) for x in (scene, found))
            moves.append(float((after - before).norm(dim=1).mean()))
        return fmean(gains), fmean(moves)

    def refitted(self, scene: HumanScene, row: int) -> HumanScene:
        """Return the scene with row ``row`` of the clip of training as it was fitted, and its
        corrections zero."""
        found = self._fitted(scene, self._groups[row]).played if self._is_fitted(row) else None
        if found is None:
            return scene
        clip = scene.clip
        poses = clip.poses.clone()
        trans = clip.trans.clone()
        poses[row] = found.poses[0]
        trans[row] = found.trans[0]
        with torch.no_grad():
            for name in ("poses", "trans"):
                scene.learned[name][row] = 0
        return replace(scene, clip=replace(clip, poses=poses, trans=trans))

    def _is_fitted(self, row: int) -> bool:
        return len(self._groups[row]) > 1

    def _fitted(self, scene: HumanScene, which: list[int]) -> HumanScene:
        still = replace(scene, gaussians=scene.gaussians.detach())
        return fitted_to_images(
            still, self._images, self._background, self._comparison, which
        ).scene

    @torch.no_grad()
    def _psnr(self, scene: HumanScene, index: int) -> float:
        image: Image = self._images[index]
        drawn = scene.render(
            image.cameras, image.time, options=scene.options, background=self._background
        ).rgb[0]
        box = (None if image.alpha is None else silhouette_box(image.alpha)) or (
            slice(None),
            slice(None),
        )
        mask = None if image.mask is None else image.mask[box]
        return psnr(drawn[box], image.composite(self._background)[box], mask)


@torch.no_grad()
def _joints(scene: HumanScene, time: float) -> Tensor:
    """Return the joints of the body (22, 3) at ``time``, in the world over the person's scale: m of
    the body."""
    pose = frame_pose(scene.moves_as.at(time), 0)
    return posed_joints(scene.learned_skeleton, pose)[: JOINT_NAMES.index("jaw")] / pose.scale
