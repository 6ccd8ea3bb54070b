"""Body poses fitted to images: the poses in which an avatar, which stays as it is, looks most like them.

Either the whole images count, or their silhouettes alone (``dyngs.human.avatar.pose_comparison``). GART (Lei et al.
2024), Anim-NeRF (Chen et al. 2021) and others fit the poses of test images like this before they score new poses.
Local letters: F moments, J joints, V images of a moment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.data.loader import Image, ImageLoader
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import GaussianTimeStep
from dyngs.human.avatar.corrections import SharedCorrection, corrected_clip
from dyngs.human.avatar.pose_comparison import IMAGES, Comparison
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.clip import MotionClip
from dyngs.human.pose.skinning import axis_angle_to_matrix
from dyngs.models.renderable import Rendering
from dyngs.ops.adam import adam_step_

COARSE_PX = 40
"""Height of the person, px, in the coarsest of the three rounds."""
FIRST_RATES, LAST_RATES = (5e-3, 5e-3, 3e-3), (2.5e-3, 1.2e-3, 5e-4)
"""Learning rates of rotations, rad, in the three rounds."""
SHIFT_RATE = 0.5
"""Learning rate of the translation, m, over that of rotations, rad."""
BETAS = (0.9, 0.99)
WINDOW, LEAST_GAIN, MOST_WINDOWS = 8, 0.02, 12
"""After so many updates (at least one for each image) the rate is halved unless the mean loss fell by that share; a
round ends below the last rate, or after so many windows."""


@dataclass(frozen=True)
class Correction:
    """Of one pose: rotations ``turns`` (J, 3) axis-angle applied before the given ones, rad; ``shift`` (3,) m."""

    turns: Tensor
    shift: Tensor

    def leaves(self) -> Correction:
        """Return the same values as leaf tensors that receive gradients."""
        return Correction(self.turns.clone().requires_grad_(), self.shift.clone().requires_grad_())


@dataclass(frozen=True)
class FittedPoses:
    """Poses fitted to images.

    Attributes:
        scene: the same person, playing them.
        updates: number of updates at each of the F moments.
    """

    scene: HumanScene
    updates: tuple[int, ...]


def fitted_to_images(
    scene: HumanScene,
    images: ImageLoader,
    background: Tensor,
    options: RenderOptions,
    comparison: Comparison = IMAGES,
) -> FittedPoses:
    """Return the person in the poses in which it looks most like ``images``: rotations of joints and translation.

    All images of a moment decide its pose, and no others do. The fit begins with the pose that is played, or with
    that corrected as the moment before was, whichever looks more alike. Skeleton, size and appearance stay as they are.
    No random numbers are drawn.

    Args:
        scene: playing the clip that is to be corrected.
        images: of a split.
        background: (3,) behind both.
        options: as in training.
        comparison: what of the images counts.
    """
    groups: dict[float, list[int]] = {}
    for index, time in enumerate(images.times):
        groups.setdefault(0.0 if time is None else time, []).append(index)
    times = sorted(groups)
    starts = _moments(scene.moves_as, times)
    found: list[Correction] = []
    counts: list[int] = []
    for row, time in enumerate(times):
        start = starts.select(torch.tensor([row], device="cpu"))
        fit = _Fit(scene, start, time, background, options, tuple(images[i] for i in groups[time]), comparison)
        correction, count = fit.fitted(found[-1] if found else None)
        found.append(correction)
        counts.append(count)
    none = SharedCorrection(torch.zeros_like(scene.fit.turns), 0.0)
    turns, shifts = torch.stack([x.turns for x in found]), torch.stack([x.shift for x in found])
    clip = corrected_clip(none, starts, turns, shifts * starts.scale[:, None])
    return FittedPoses(_playing_exactly(scene, clip), tuple(counts))


def _moments(clip: MotionClip, times: Sequence[float]) -> MotionClip:
    """Return the clip at ``times``, ascending."""
    parts = [clip.at(time) for time in times]
    poses, trans, scale = (torch.cat([getattr(x, name) for x in parts]) for name in ("poses", "trans", "scale"))
    return MotionClip(torch.tensor(times, dtype=torch.float64, device="cpu"), poses, trans, scale)


def _playing_exactly(scene: HumanScene, clip: MotionClip) -> HumanScene:
    """Return the person in ``clip`` as it is: what ``playing`` applies to all poses is taken off first."""
    fit = scene.fit
    return scene.playing(corrected_clip(SharedCorrection(-fit.turns, -fit.log_scale), clip))


@dataclass(frozen=True)
class _Fit:
    """The fit of one pose.

    Attributes:
        scene: the person.
        start: the pose to begin with, a clip of one frame.
        time: of the images.
        background, options: to draw with.
        images: V.
        comparison: what of these counts.
    """

    scene: HumanScene
    start: MotionClip
    time: float
    background: Tensor
    options: RenderOptions
    images: tuple[Image, ...]
    comparison: Comparison

    def fitted(self, guess: Correction | None) -> tuple[Correction, int]:
        """Return the correction of the pose, and the number of updates it took.

        Args:
            guess: another correction to begin with than none.
        """
        joints = self.scene.skeleton.joints
        none = Correction(torch.zeros_like(joints), torch.zeros_like(joints[0]))
        shrinks = _shrinks(self.images)
        found = none if guess is None else self._better(none, guess, shrinks[0])
        count = 0
        for shrink, first, last in zip(shrinks, FIRST_RATES, LAST_RATES, strict=True):
            found, updates = self._round(found, shrink, first, last)
            count += updates
        return self._better(none, found, 1), count

    def _better(self, a: Correction, b: Correction, shrink: int) -> Correction:
        """Return the one that looks more like the images, ``a`` if neither does."""
        with torch.no_grad():
            losses = [float(self._loss(x, self.images, shrink)) for x in (a, b)]
        return b if losses[1] < losses[0] else a

    def _round(self, start: Correction, shrink: int, rate: float, last: float) -> tuple[Correction, int]:
        """Return the correction after one round, and its number of updates; each is for one image, in turn."""
        now = Correction(start.turns.clone(), start.shift.clone())
        moments = [torch.zeros_like(x) for x in (now.turns, now.turns, now.shift, now.shift)]
        window = len(self.images) * math.ceil(WINDOW / len(self.images))
        before, update = math.inf, 0
        for _ in range(MOST_WINDOWS):
            total = 0.0
            for _ in range(window):
                update += 1
                leaves = now.leaves()
                with torch.enable_grad():
                    loss = self._loss(leaves, (self.images[update % len(self.images)],), shrink)
                    by_turns, by_shift = torch.autograd.grad(loss, [leaves.turns, leaves.shift])
                total += float(loss.detach())
                if len(self.images) >= self.comparison.views_to_turn:
                    adam_step_(now.turns, by_turns, *moments[:2], lr=rate, step=update, betas=BETAS)
                adam_step_(now.shift, by_shift, *moments[2:], lr=SHIFT_RATE * rate, step=update, betas=BETAS)
            if total > (1 - LEAST_GAIN) * before:
                rate /= 2
                if rate < last:
                    break
            before = total
        return now, update

    def _loss(self, correction: Correction, images: Sequence[Image], shrink: int) -> Tensor:
        """Return the loss () of a correction: the mean over ``images``, compared after shrinking, and its size."""
        start, how = self.start, self.comparison
        posing = BodyPose(
            axis_angle_to_matrix(start.poses[0]) @ axis_angle_to_matrix(correction.turns),
            start.trans[0] + correction.shift * start.scale[0],
            start.scale[0],
        )
        moment = self.scene.in_pose(posing, self.time)
        losses = [how.difference(self._drawn(x, moment), x, self.background, shrink) for x in images]
        size = how.turn_weight * correction.turns.square().mean() + how.shift_weight * correction.shift.square().mean()
        return torch.stack(losses).mean() + size

    def _drawn(self, image: Image, moment: GaussianTimeStep) -> Rendering:
        """Return the person at ``moment`` as the camera of an image sees it."""
        return self.scene.render(image.cameras, moment, options=self.options, background=self.background)


def _shrinks(images: Sequence[Image]) -> tuple[int, int, int]:
    """Return the factors by which images are shrunk in the three rounds."""
    heights = [int((x.alpha > 0).any(1).sum()) if x.alpha is not None else x.cameras.height for x in images]
    coarse = max(1, round(max(heights) / COARSE_PX))
    return coarse, round(math.sqrt(coarse)), 1
