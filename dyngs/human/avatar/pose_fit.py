"""Body poses in which an avatar, which stays as it is, looks most like images, or has their
silhouettes.

So do GART (Lei et al. 2024) and Anim-NeRF (Chen et al. 2021) before they score new poses. F time
steps, V images each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

import torch
from torch import Tensor

from dyngs.core.metrics import psnr
from dyngs.data.images.images import area_downscale
from dyngs.data.images.maps import silhouette_box
from dyngs.data.loader import Image, ImageLoader
from dyngs.human.avatar.posing import (
    POSE_CM,
    POSE_WEIGHT,
    BodyPose,
    SharedCorrection,
    corrected_clip,
    frame_pose,
    posed_joints,
)
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.motion.motion import MotionClip
from dyngs.models.renderable import Rendering
from dyngs.ops.adam import adam_step_
from dyngs.ops.loss import l1_ssim_loss

SSIM_WEIGHT, ALPHA_WEIGHT = 0.2, 0.1
"""Of SSIM and of the mean error of alpha in the loss of full images, as in training."""


@dataclass(frozen=True)
class Comparison:
    """How renders of a person are compared with images, and what keeps the pose near that given."""

    # the loss () between a rendering and an image on a background (3,), with sides divided by a
    # factor
    difference: Callable[[Rendering, Image, Tensor, int], Tensor]
    turn_weight: float  # of the mean squared rotation that is added to the joints, 1 / rad^2
    shift_weight: float = 0.0  # of the mean squared translation that is added, 1 / m^2
    # images of a time step from which on rotations are fitted; with fewer the shift is
    views_to_turn: int = 1
    most_windows: int | None = None  # after which a round ends; None: ``MOST_WINDOWS``


def difference_of_images(drawn: Rendering, image: Image, background: Tensor, shrink: int) -> Tensor:
    """Return 0.8 L1 + 0.2 (1 - SSIM) + 0.1 of the mean error of alpha ()."""
    rendered = drawn.rgb[0]
    truth = image.composite(background)
    mask = image.mask
    error = None if image.alpha is None else (drawn.alpha[0] - image.alpha)[..., None]
    if mask is not None:
        rendered = rendered * mask[..., None]
        truth = truth * mask[..., None]
        error = None if error is None else error * mask[..., None]
        mask = shrunk(mask[..., None], shrink)[..., 0]
    loss = l1_ssim_loss(shrunk(rendered, shrink), shrunk(truth, shrink), SSIM_WEIGHT, mask)
    return loss if error is None else loss + ALPHA_WEIGHT * shrunk(error, shrink).abs().mean()


def difference_of_silhouettes(
    drawn: Rendering, image: Image, background: Tensor, shrink: int
) -> Tensor:
    """Return the squared error of alpha, over the area of the silhouette (); nothing else of the
    image is looked at.

    Raises ValueError: an image without alpha.
    """
    if image.alpha is None:
        raise ValueError(f"{image.name}: has no silhouette")
    error = drawn.alpha[0] - image.alpha
    truth = image.alpha
    if image.mask is not None:
        error = error * image.mask
        truth = truth * image.mask
    return shrunk(error[..., None], shrink).square().sum() / shrunk(
        truth[..., None], shrink
    ).sum().clamp_min(1)


IMAGES = Comparison(difference_of_images, turn_weight=POSE_WEIGHT / POSE_CM**2)
SILHOUETTES = Comparison(
    difference_of_silhouettes, turn_weight=1.0, shift_weight=10.0, views_to_turn=2
)
"""One view hides how far limbs reach towards the camera: rotations fitted to it look wrong from
elsewhere."""


def shrunk(image: Tensor, factor: int) -> Tensor:
    """Return the (H, W, C) image with its sides divided by ``factor``, averaged over pixel
    areas."""
    if factor == 1:
        return image
    height, width = (max(1, round(side / factor)) for side in image.shape[:2])
    return area_downscale(image, width, height)


COARSE_PX = 40  # height of the person, px, in the coarsest of the three rounds
FIRST_RATES = (5e-3, 5e-3, 3e-3)
LAST_RATES = (2.5e-3, 1.2e-3, 5e-4)
"""Learning rates of rotations, rad, in the three rounds."""
SHIFT_RATE = 0.5  # learning rate of the translation, m, over that of rotations, rad
BETAS = (0.9, 0.99)
WINDOW, LEAST_GAIN, MOST_WINDOWS = 8, 0.02, 12
"""After so many updates (at least one for each image) the rate is halved unless the mean loss fell
by that share; a round ends below the last rate, or after so many windows."""


@dataclass(frozen=True)
class Correction:
    """Of one pose: rotations ``turns`` (J, 3) axis-angle applied before the given ones, rad;
    ``shift`` (3,) m."""

    turns: Tensor
    shift: Tensor

    def leaves(self) -> Correction:
        """Return the same values as leaf tensors that receive gradients."""
        return Correction(self.turns.clone().requires_grad_(), self.shift.clone().requires_grad_())


@dataclass(frozen=True)
class FittedPoses:
    """Poses fitted to images."""

    scene: HumanScene  # the same person, playing them
    updates: tuple[int, ...]  # number of updates at each of the F time steps


def fitted_to_images(
    scene: HumanScene,
    images: ImageLoader,
    background: Tensor,
    comparison: Comparison = IMAGES,
    which: Collection[int] | None = None,
) -> FittedPoses:
    """Return the person in the poses in which it looks most like ``images``: rotations of joints
    and translation.

    All images of a time step decide its pose. The fit begins with the pose that is played, or with
    that corrected as the one before was, whichever looks more alike. ``scene`` plays the clip to
    correct; ``background`` (3,) is behind both. ``which`` are the indices of the images that count,
    None: all.
    """
    groups = by_time(images, which)
    times = sorted(groups)
    parts = [scene.moves_as.at(time) for time in times]
    poses, trans, scale = (
        torch.cat([getattr(x, name) for x in parts]) for name in ("poses", "trans", "scale")
    )
    starts = MotionClip(torch.tensor(times, dtype=torch.float64, device="cpu"), poses, trans, scale)
    found: list[Correction] = []
    counts: list[int] = []
    for row, time in enumerate(times):
        start = starts.select(torch.tensor([row], device="cpu"))
        fit = _Fit(
            scene, start, time, background, tuple(images[i] for i in groups[time]), comparison
        )
        correction, count = fit.fitted(found[-1] if found else None)
        found.append(correction)
        counts.append(count)
    fit = scene.fit
    none = SharedCorrection(torch.zeros_like(scene.fit.turns), 0.0)
    turns = torch.stack([x.turns for x in found])
    shifts = torch.stack([x.shift for x in found])
    clip = corrected_clip(none, starts, turns, shifts * starts.scale[:, None])
    # ``playing`` applies both again
    exactly = corrected_clip(SharedCorrection(-fit.turns, -fit.log_scale), clip)
    return FittedPoses(scene.playing(exactly), tuple(counts))


def by_time(images: ImageLoader, which: Collection[int] | None = None) -> dict[float, list[int]]:
    """Return indices of images by their time; those without one are of time 0. ``which`` count,
    None: all."""
    groups: dict[float, list[int]] = {}
    for index, time in enumerate(images.times):
        if which is None or index in which:
            groups.setdefault(0.0 if time is None else time, []).append(index)
    return groups


@dataclass(frozen=True)
class _Fit:
    """The fit of one pose."""

    scene: HumanScene  # the person
    start: MotionClip  # the pose to begin with, a clip of one frame
    time: float  # of the images
    background: Tensor
    images: tuple[Image, ...]  # V
    comparison: Comparison  # what of these counts

    def fitted(self, guess: Correction | None) -> tuple[Correction, int]:
        """Return the correction of the pose, and the number of updates it took.

        ``guess`` is another correction to begin with than none.
        """
        joints = self.scene.skeleton.joints
        none = Correction(torch.zeros_like(joints), torch.zeros_like(joints[0]))
        heights = [
            int((x.alpha > 0).any(1).sum()) if x.alpha is not None else x.cameras.height
            for x in self.images
        ]
        coarse = max(1, round(max(heights) / COARSE_PX))
        shrinks = coarse, round(math.sqrt(coarse)), 1
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

    def _round(
        self, start: Correction, shrink: int, rate: float, last: float
    ) -> tuple[Correction, int]:
        """Return the correction after one round, and its number of updates; each is for one image,
        in turn."""
        now = Correction(start.turns.clone(), start.shift.clone())
        moments = [torch.zeros_like(x) for x in (now.turns, now.turns, now.shift, now.shift)]
        window = len(self.images) * math.ceil(WINDOW / len(self.images))
        before = math.inf
        update = 0
        for _ in range(self.comparison.most_windows or MOST_WINDOWS):
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
                adam_step_(
                    now.shift,
                    by_shift,
                    *moments[2:],
                    lr=SHIFT_RATE * rate,
                    step=update,
                    betas=BETAS,
                )
            if total > (1 - LEAST_GAIN) * before:
                rate /= 2
                if rate < last:
                    break
            before = total
        return now, update

    def _loss(self, correction: Correction, images: Sequence[Image], shrink: int) -> Tensor:
        """Return the loss () of a correction: the mean over ``images``, compared after shrinking,
        and its size."""
        start = self.start
        how = self.comparison
        posing = BodyPose(
            start.rotations[0] @ axis_angle_to_matrix(correction.turns),
            start.trans[0] + correction.shift * start.scale[0],
            start.scale[0],
        )
        moment = self.scene.in_pose(posing, self.time)
        losses = []
        for image in images:
            drawn = self.scene.render(
                image.cameras, moment, options=self.scene.options, background=self.background
            )
            losses.append(how.difference(drawn, image, self.background, shrink))
        size = (
            how.turn_weight * correction.turns.square().mean()
            + how.shift_weight * correction.shift.square().mean()
        )
        return torch.stack(losses).mean() + size


TRIED = 3  # time steps at which a view is left out
REFIT_GAIN = 0.5  # mean of its PSNR in the person's box, dB, from which all poses are fitted
LEAST_MOVE = 0.005
"""Mean of all joints, m of the body, from which they are fitted the first time: training learns
less without.

Poses that are given, or found in good silhouettes, are moved by 2 to 6 mm, those in a detector's
masks by 6 to 16.
"""
# fractions of the run after which poses are fitted, one after each step
STARTS = (0.25, 0.45, 0.65)
REFIT_WINDOWS = 6  # of each round of a fit: training goes on with what is found


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
        self._comparison = replace(IMAGES, most_windows=min(max(few, 1), REFIT_WINDOWS))

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
        self.goes_on = gain >= REFIT_GAIN and (move >= LEAST_MOVE or step > self._starts[0])
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
