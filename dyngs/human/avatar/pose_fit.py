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
class PoseComparison:
    """How renders of a person are compared with images, and what keeps the pose near that given."""

    # the loss () between a rendering and an image on a background (3,), with sides divided by a
    # factor
    difference: Callable[[Rendering, Image, Tensor, int], Tensor]
    rotation_weight: float  # of the mean squared rotation that is added to the joints, 1 / rad^2
    translation_weight: float = 0.0  # of the mean squared translation that is added, 1 / m^2
    # images of a time step from which on rotations are fitted; with fewer the shift is
    min_views_for_rotations: int = 1
    max_windows: int | None = None  # after which a round ends; None: ``MOST_WINDOWS``


def image_difference(drawn: Rendering, image: Image, background: Tensor, shrink: int) -> Tensor:
    """Return 0.8 L1 + 0.2 (1 - SSIM) + 0.1 of the mean error of alpha ()."""
    rendered = drawn.rgb[0]
    truth = image.composite(background)
    alpha = drawn.alpha[0]
    error = alpha - (alpha if image.alpha is None else image.alpha)
    mask = image.mask
    if mask is not None:
        rendered = rendered * mask[..., None]
        truth = truth * mask[..., None]
        error = error * mask
        mask = downscale_image(mask[..., None], shrink)[..., 0]
    loss = l1_ssim_loss(
        downscale_image(rendered, shrink), downscale_image(truth, shrink), SSIM_WEIGHT, mask
    )
    return loss + ALPHA_WEIGHT * downscale_image(error[..., None], shrink).abs().mean()


def silhouette_difference(
    drawn: Rendering, image: Image, background: Tensor, shrink: int
) -> Tensor:
    """Return the squared error of alpha, over the area of the silhouette (); nothing else of the
    image is looked at."""
    assert image.alpha is not None
    mask = 1.0 if image.mask is None else image.mask
    error = (drawn.alpha[0] - image.alpha) * mask
    area = downscale_image((image.alpha * mask)[..., None], shrink).sum().clamp_min(1)
    return downscale_image(error[..., None], shrink).square().sum() / area


IMAGE_COMPARISON = PoseComparison(image_difference, rotation_weight=POSE_WEIGHT / POSE_CM**2)
SILHOUETTE_COMPARISON = PoseComparison(
    silhouette_difference, rotation_weight=1.0, translation_weight=10.0, min_views_for_rotations=2
)
"""One view hides how far limbs reach towards the camera: rotations fitted to it look wrong from
elsewhere."""


def downscale_image(image: Tensor, factor: int) -> Tensor:
    """Return the (H, W, C) image with its sides divided by ``factor``, averaged over pixel
    areas."""
    if factor == 1:
        return image
    height, width = (max(1, round(side / factor)) for side in image.shape[:2])
    return area_downscale(image, width, height)


COARSE_HEIGHT_PX = 40  # height of the person, px, in the coarsest of the three rounds
FIRST_RATES = (5e-3, 5e-3, 3e-3)
LAST_RATES = (2.5e-3, 1.2e-3, 5e-4)
"""Learning rates of rotations, rad, in the three rounds."""
TRANSLATION_RATE = 0.5  # learning rate of the translation, m, over that of rotations, rad
BETAS = (0.9, 0.99)
UPDATES_PER_WINDOW, MIN_LOSS_DECREASE, MAX_WINDOWS = 8, 0.02, 12
"""After so many updates (at least one for each image) the rate is halved unless the mean loss fell
by that share; a round ends below the last rate, or after so many windows."""


def fit_poses_to_images(
    scene: HumanScene,
    images: ImageLoader,
    background: Tensor,
    comparison: PoseComparison = IMAGE_COMPARISON,
    which: Collection[int] | None = None,
) -> tuple[HumanScene, list[int]]:
    """Return the person in the poses in which it looks most like ``images``, rotations of joints
    and translation, and the number of updates at each of the F time steps.

    All images of a time step decide its pose. The fit begins with the pose that is played, or with
    that corrected as the one before was, whichever looks more alike. ``scene`` plays the clip to
    correct; ``background`` (3,) is behind both. ``which`` are the indices of the images that count,
    None: all.
    """
    groups = group_by_time(images, which)
    times = sorted(groups)
    parts = [scene.played_clip.at(time) for time in times]
    poses, trans, scale = (
        torch.cat([getattr(x, name) for x in parts]) for name in ("poses", "trans", "scale")
    )
    starts = MotionClip(torch.tensor(times, dtype=torch.float64, device="cpu"), poses, trans, scale)
    found: list[Tensor] = []
    counts: list[int] = []
    for row, time in enumerate(times):
        start = frame_pose(starts.select(torch.tensor([row], device="cpu")), 0)
        shown = [images[i] for i in groups[time]]
        guess = found[-1] if found else None
        correction, count = _fit_pose(scene, start, time, background, shown, comparison, guess)
        found.append(correction)
        counts.append(count)
    fit = scene.fit
    none = SharedCorrection(torch.zeros_like(fit.turns), 0.0)
    corrections = torch.stack(found)
    shifts = corrections[:, -1] * starts.scale[:, None]
    clip = corrected_clip(none, starts, corrections[:, :-1], shifts)
    # ``playing`` applies both again
    exactly = corrected_clip(SharedCorrection(-fit.turns, -fit.log_scale), clip)
    return scene.with_motion(exactly), counts


def group_by_time(
    images: ImageLoader, which: Collection[int] | None = None
) -> dict[float, list[int]]:
    """Return indices of images by their time; those without one are of time 0. ``which`` count,
    None: all."""
    groups: dict[float, list[int]] = {}
    for index, time in enumerate(images.times):
        if which is None or index in which:
            groups.setdefault(0.0 if time is None else time, []).append(index)
    return groups


def _fit_pose(
    scene: HumanScene,
    start: BodyPose,
    time: float,
    background: Tensor,
    images: Sequence[Image],
    comparison: PoseComparison,
    guess: Tensor | None,
) -> tuple[Tensor, int]:
    """Return the correction (J + 1, 3) of one pose, and the number of updates it took.

    Rotations of the J joints, axis-angle, applied before those of ``start``, rad; last the
    translation, m. The fit begins with no correction or with ``guess``, whichever looks more alike.
    Each update is for one image, in turn.
    """

    def loss_of(correction: Tensor, shown: Sequence[Image], shrink: int) -> Tensor:
        turns = correction[:-1]
        shift = correction[-1]
        posing = BodyPose(
            start.rotations @ axis_angle_to_matrix(turns),
            start.trans + shift * start.scale,
            start.scale,
        )
        moment = scene.time_step_in_pose(posing, time)
        losses = []
        for image in shown:
            drawn = scene.render(
                image.cameras, moment, options=scene.options, background=background
            )
            losses.append(comparison.difference(drawn, image, background, shrink))
        size = comparison.rotation_weight * turns.square().mean()
        size = size + comparison.translation_weight * shift.square().mean()
        return torch.stack(losses).mean() + size

    @torch.no_grad()
    def better(a: Tensor, b: Tensor, shrink: int) -> Tensor:
        return b if loss_of(b, images, shrink) < loss_of(a, images, shrink) else a

    none = start.trans.new_zeros(len(start.rotations) + 1, 3)
    heights = [
        x.cameras.height if x.alpha is None else int((x.alpha > 0).any(1).sum()) for x in images
    ]
    coarse = max(1, round(max(heights) / COARSE_HEIGHT_PX))
    found = none if guess is None else better(none, guess, coarse)
    factors = [(slice(-1, None), TRANSLATION_RATE)]
    if len(images) >= comparison.min_views_for_rotations:
        factors.append((slice(-1), 1.0))
    window = len(images) * math.ceil(UPDATES_PER_WINDOW / len(images))
    count = 0
    shrinks = coarse, round(math.sqrt(coarse)), 1
    for shrink, rate, last in zip(shrinks, FIRST_RATES, LAST_RATES, strict=True):
        found = found.clone()
        moments = torch.zeros_like(found), torch.zeros_like(found)
        before = math.inf
        update = 0
        for _ in range(comparison.max_windows or MAX_WINDOWS):
            total = 0.0
            for _ in range(window):
                update += 1
                leaf = found.clone().requires_grad_()
                with torch.enable_grad():
                    loss = loss_of(leaf, (images[update % len(images)],), shrink)
                    gradient = torch.autograd.grad(loss, leaf)[0]
                total += float(loss.detach())
                for rows, factor in factors:
                    adam_step_(
                        found[rows],
                        gradient[rows],
                        *(x[rows] for x in moments),
                        lr=factor * rate,
                        step=update,
                        betas=BETAS,
                    )
            if total > (1 - MIN_LOSS_DECREASE) * before:
                rate /= 2
                if rate < last:
                    break
            before = total
        count += update
    return better(none, found, 1), count


NUM_TRIAL_TIMES = 3  # time steps at which a view is left out
MIN_REFIT_GAIN_DB = 0.5  # mean of its PSNR in the person's box, dB, from which all poses are fitted
MIN_JOINT_SHIFT = 0.005
"""Mean of all joints, m of the body, from which they are fitted the first time: training learns
less without.

Poses that are given, or found in good silhouettes, are moved by 2 to 6 mm, those in a detector's
masks by 6 to 16.
"""
# fractions of the run after which poses are fitted, one after each step
REFIT_STARTS = (0.25, 0.45, 0.65)
MAX_REFIT_WINDOWS = 6  # of each round of a fit: training goes on with what is found


class PoseRefit:
    """When and to what poses are fitted in a run of ``steps``.

    To the training ``images``, with the colour ``background`` (3,) behind person and render. Only
    time steps with two images or more are fitted: one hides how far limbs reach towards the camera.

    Attributes:
        goes_on: whether views gained when poses were fitted last.
    """

    is_active = True

    def __init__(self, images: ImageLoader, background: Tensor, steps: int) -> None:
        self._images, self._background = images, background
        self._groups = [sorted(group) for _, group in sorted(group_by_time(images).items())]
        self._starts = [round(start * steps) for start in REFIT_STARTS]
        # as many updates as the run has, at most
        few = steps // (len(FIRST_RATES) * UPDATES_PER_WINDOW * len(self._groups))
        self._comparison = replace(
            IMAGE_COMPARISON, max_windows=min(max(few, 1), MAX_REFIT_WINDOWS)
        )

    def applies_to(self, scene: HumanScene) -> bool:
        """Return whether each row of the clip of training has images of its own, and some have two
        or more."""
        return len(self._groups) == len(scene.clip) and any(
            map(self._is_fitted, range(len(scene.clip)))
        )

    def edit_scene(self, scene: HumanScene, step: int) -> tuple[HumanScene, str] | None:
        """Return the scene as it is after ``step``, and a line if that was decided; None: nothing
        is to do."""
        since = [step - start for start in self._starts if start <= step]
        if (
            not self.is_active
            or not since
            or since[-1] > len(self._groups)
            or not self.applies_to(scene)
        ):
            return None
        scene.clear_caches()
        if since[-1] > 0:
            return self.refit_frame(scene, since[-1] - 1), ""
        gain, move = self.measure_gain(scene)
        self.is_active = gain >= MIN_REFIT_GAIN_DB and (
            move >= MIN_JOINT_SHIFT or step > self._starts[0]
        )
        decided = (
            "are fitted to the images again" if self.is_active else "stay, but for what is learned"
        )
        why = f"such a fit moves joints by {1000 * move:.0f} mm, and views left out of it gain {gain:.1f} dB"
        return scene, f"poses {decided}: {why}"

    def measure_gain(self, scene: HumanScene) -> tuple[float, float]:
        """Return what poses fitted to all views but one of their time do, as means over some times.

        By how many dB the view that was left out gains, in the person's box; how far joints move, m
        of the body.
        """
        rows = [row for row in range(len(self._groups)) if self._is_fitted(row)]
        rows = [
            rows[(2 * i + 1) * len(rows) // (2 * NUM_TRIAL_TIMES)] for i in range(NUM_TRIAL_TIMES)
        ]
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

    def refit_frame(self, scene: HumanScene, row: int) -> HumanScene:
        """Return the scene with row ``row`` of the clip of training as it was fitted, and its
        corrections zero."""
        found = (
            self._fitted(scene, self._groups[row]).replacement_clip
            if self._is_fitted(row)
            else None
        )
        if found is None:
            return scene
        clip = {"poses": scene.clip.poses.clone(), "trans": scene.clip.trans.clone()}
        with torch.no_grad():
            for name, x in clip.items():
                x[row] = getattr(found, name)[0]
                scene.learned[name][row] = 0
        return replace(scene, clip=replace(scene.clip, **clip))

    def _is_fitted(self, row: int) -> bool:
        return len(self._groups[row]) > 1

    def _fitted(self, scene: HumanScene, which: list[int]) -> HumanScene:
        still = replace(scene, gaussians=scene.gaussians.detach())
        return fit_poses_to_images(still, self._images, self._background, self._comparison, which)[
            0
        ]

    @torch.no_grad()
    def _psnr(self, scene: HumanScene, index: int) -> float:
        image: Image = self._images[index]
        drawn = scene.render(
            image.cameras, image.time, options=scene.options, background=self._background
        ).rgb[0]
        box = None if image.alpha is None else silhouette_box(image.alpha)
        if box is None:
            box = slice(None), slice(None)
        mask = None if image.mask is None else image.mask[box]
        return psnr(drawn[box], image.composite(self._background)[box], mask)


@torch.no_grad()
def _joints(scene: HumanScene, time: float) -> Tensor:
    """Return the joints of the body (22, 3) at ``time``, in the world over the person's scale: m of
    the body."""
    pose = frame_pose(scene.played_clip.at(time), 0)
    return posed_joints(scene.learned_skeleton, pose)[: JOINT_NAMES.index("jaw")] / pose.scale
