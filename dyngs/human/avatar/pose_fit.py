"""Fitting body poses to images with a frozen avatar.

GART (Lei et al. 2024) and Anim-NeRF (Chen et al. 2021) fit test poses in the same way before they
evaluate them. Symbols: F time steps, V images of each, J joints.
"""

from __future__ import annotations

import math
from collections import defaultdict
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
    frame_pose,
    posed_joints,
)
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.motion.motion import MotionClip, compose_rotations
from dyngs.models.renderable import Rendering
from dyngs.ops.adam import adam_step_
from dyngs.ops.loss import l1_ssim_loss

SSIM_WEIGHT, ALPHA_WEIGHT = 0.2, 0.1
"""Weights of D-SSIM and of the mean alpha error in the image loss, as in training."""


@dataclass(frozen=True)
class PoseComparison:
    """Loss between renders and images, and how strongly poses are kept near the given ones."""

    # loss () between a render and an image over a background (3,), downscaled by an integer factor
    difference: Callable[[Rendering, Image, Tensor, int], Tensor]
    rotation_weight: float  # of the mean squared joint rotation correction, 1 / rad^2
    translation_weight: float = 0.0  # of the mean squared translation correction, 1 / m^2
    # images per time step from which rotations are fitted; with fewer only the translation is
    min_views_for_rotations: int = 1
    max_windows: int | None = None  # after which a round ends; None: ``MOST_WINDOWS``


def image_difference(render: Rendering, image: Image, background: Tensor, shrink: int) -> Tensor:
    """Return 0.8 L1 + 0.2 D-SSIM + 0.1 mean alpha error ()."""
    alpha = render.alpha[0]
    error = alpha - (alpha if image.alpha is None else image.alpha)
    images = (render.rgb[0], image.composite(background), error[..., None])
    mask = image.mask
    if mask is not None:
        images = tuple(x * mask[..., None] for x in images)
        mask = downscale_image(mask[..., None], shrink)[..., 0]
    rendered, truth, error = (downscale_image(x, shrink) for x in images)
    return l1_ssim_loss(rendered, truth, SSIM_WEIGHT, mask) + ALPHA_WEIGHT * error.abs().mean()


def silhouette_difference(
    render: Rendering, image: Image, background: Tensor, shrink: int
) -> Tensor:
    """Return the squared alpha error summed over the image, divided by the silhouette's area ()."""
    assert image.alpha is not None
    mask = 1.0 if image.mask is None else image.mask
    error = (render.alpha[0] - image.alpha) * mask
    area = downscale_image((image.alpha * mask)[..., None], shrink).sum().clamp_min(1)
    return downscale_image(error[..., None], shrink).square().sum() / area


IMAGE_COMPARISON = PoseComparison(image_difference, rotation_weight=POSE_WEIGHT / POSE_CM**2)
SILHOUETTE_COMPARISON = PoseComparison(
    silhouette_difference, rotation_weight=1.0, translation_weight=10.0, min_views_for_rotations=2
)
"""Rotations need two views, because a single silhouette does not show the depth of limbs."""


def downscale_image(image: Tensor, factor: int) -> Tensor:
    """Average an (H, W, C) image over pixel areas to sides divided by ``factor``."""
    if factor == 1:
        return image
    height, width = (max(1, round(side / factor)) for side in image.shape[:2])
    return area_downscale(image, width, height)


COARSE_HEIGHT_PX = 40  # height of the person at the coarsest of the three resolution levels, px
FIRST_RATES = (5e-3, 5e-3, 3e-3)
LAST_RATES = (2.5e-3, 1.2e-3, 5e-4)
"""First and last learning rates of rotations, rad, at the three levels from coarse to fine."""
TRANSLATION_RATE = 0.5  # learning rate of the translation, m, relative to that of rotations, rad
BETAS = (0.9, 0.99)
UPDATES_PER_WINDOW, MIN_LOSS_DECREASE, MAX_WINDOWS = 8, 0.02, 12
"""After each window of updates (at least one per image), the learning rate is halved unless the
mean loss decreased by this fraction. A level ends below its last rate or after this many
windows."""


def fit_poses_to_images(
    scene: HumanScene,
    images: ImageLoader,
    background: Tensor,
    comparison: PoseComparison = IMAGE_COMPARISON,
    indices: Collection[int] | None = None,
) -> tuple[HumanScene, list[int]]:
    """Fit joint rotations and translation of each time step to its images, with a frozen avatar.

    All images of a time step share one pose. The fit starts from the pose of ``scene``, or from
    that pose with the previous time step's correction, whichever has the lower loss.

    Args:
        scene: plays the clip to correct.
        images: with their cameras and times.
        background: (3,) colour behind both render and image.
        comparison: loss and regularisation.
        indices: of the images to use; None: all.

    Returns:
        The scene with the fitted poses, and the number of updates at each of the F time steps.
    """
    groups = group_by_time(images, range(len(images.times)) if indices is None else indices)
    times = list(groups)
    starts = replace(
        MotionClip.joined([scene.played_clip.at(time) for time in times]),
        times=torch.tensor(times, dtype=torch.float64, device="cpu"),
    )
    corrections: list[Tensor] = []
    counts: list[int] = []
    for row, time in enumerate(times):
        start = frame_pose(starts, row)
        time_images = [images[i] for i in groups[time]]
        guess = corrections[-1] if corrections else None
        correction, count = _fit_pose(
            scene, start, time, background, time_images, comparison, guess
        )
        corrections.append(correction)
        counts.append(count)
    stacked = torch.stack(corrections)
    clip = replace(
        starts,
        poses=compose_rotations(starts.poses, stacked[:, :-1]),
        trans=starts.trans + stacked[:, -1] * starts.scale[:, None],
    )
    return scene.with_corrected_motion(clip), counts


def group_by_time(images: ImageLoader, indices: Collection[int]) -> dict[float, list[int]]:
    """Return ``indices`` of images by ascending time; images without a time belong to time 0."""
    groups: dict[float, list[int]] = defaultdict(list)
    for index in indices:
        groups[images.times[index] or 0.0].append(index)
    return dict(sorted(groups.items()))


def _fit_pose(
    scene: HumanScene,
    start: BodyPose,
    time: float,
    background: Tensor,
    images: Sequence[Image],
    comparison: PoseComparison,
    guess: Tensor | None,
) -> tuple[Tensor, int]:
    """Return the correction (J + 1, 3) of one pose, and the number of updates.

    Rows are axis-angle rotations of the J joints, rad, applied before those of ``start``, and the
    translation, m. The fit starts from zero or from ``guess``, whichever has the lower loss. Each
    update uses one image, in turn.
    """

    def loss_of(correction: Tensor, batch: Sequence[Image], shrink: int) -> Tensor:
        rotations = correction[:-1]
        translation = correction[-1]
        posing = BodyPose(
            start.rotations @ axis_angle_to_matrix(rotations),
            start.trans + translation * start.scale,
            start.scale,
        )
        time_step = scene.time_step_in_pose(posing, time)
        losses = []
        for image in batch:
            render = scene.render(
                image.cameras, time_step, options=scene.options, background=background
            )
            losses.append(comparison.difference(render, image, background, shrink))
        penalty = comparison.rotation_weight * rotations.square().mean()
        penalty = penalty + comparison.translation_weight * translation.square().mean()
        return torch.stack(losses).mean() + penalty

    @torch.no_grad()
    def better(a: Tensor, b: Tensor, shrink: int) -> Tensor:
        return b if loss_of(b, images, shrink) < loss_of(a, images, shrink) else a

    zero = start.trans.new_zeros(len(start.rotations) + 1, 3)
    heights = [
        x.cameras.height if x.alpha is None else int((x.alpha > 0).any(1).sum()) for x in images
    ]
    coarse = max(1, round(max(heights) / COARSE_HEIGHT_PX))
    best = zero if guess is None else better(zero, guess, coarse)
    factors = [(slice(-1, None), TRANSLATION_RATE)]
    if len(images) >= comparison.min_views_for_rotations:
        factors.append((slice(-1), 1.0))
    window = len(images) * math.ceil(UPDATES_PER_WINDOW / len(images))
    num_updates = 0
    shrinks = coarse, round(math.sqrt(coarse)), 1
    for shrink, learning_rate, last in zip(shrinks, FIRST_RATES, LAST_RATES, strict=True):
        best = best.clone()
        moments = torch.zeros_like(best), torch.zeros_like(best)
        previous_loss = math.inf
        update = 0
        for _ in range(comparison.max_windows or MAX_WINDOWS):
            window_loss = 0.0
            for _ in range(window):
                update += 1
                leaf = best.clone().requires_grad_()
                with torch.enable_grad():
                    loss = loss_of(leaf, (images[update % len(images)],), shrink)
                    gradient = torch.autograd.grad(loss, leaf)[0]
                window_loss += float(loss.detach())
                for rows, factor in factors:
                    adam_step_(
                        best[rows],
                        gradient[rows],
                        *(x[rows] for x in moments),
                        lr=factor * learning_rate,
                        step=update,
                        betas=BETAS,
                    )
            if window_loss > (1 - MIN_LOSS_DECREASE) * previous_loss:
                learning_rate /= 2
                if learning_rate < last:
                    break
            previous_loss = window_loss
        num_updates += update
    return better(zero, best, 1), num_updates


NUM_TRIAL_TIMES = 3  # time steps of the trial that decides about a refit
MIN_REFIT_GAIN_DB = 0.5  # gain of held-out views, in the person's box, needed for a refit
MIN_JOINT_SHIFT = 0.005
"""Mean joint motion, m, needed for the first refit; training corrects smaller errors itself.

Accurate poses move by 2 to 6 mm, poses from a detector's masks by 6 to 16 mm.
"""
# Fractions of the run at which a refit starts; it fits one time step after each training step.
REFIT_STARTS = (0.25, 0.45, 0.65)
MAX_REFIT_WINDOWS = 6  # per level; lower than ``MAX_WINDOWS`` because training continues afterwards


class PoseRefit:
    """Schedule of refits of body poses to the training images during a run of ``steps``.

    Only time steps with two or more images are refitted, because one does not show the depth of
    limbs.

    Attributes:
        is_active: whether the last trial improved held-out views.
    """

    is_active = True

    def __init__(self, images: ImageLoader, background: Tensor, steps: int) -> None:
        self._images, self._background = images, background
        self._groups = list(group_by_time(images, range(len(images.times))).values())
        self._starts = [round(start * steps) for start in REFIT_STARTS]
        # as many updates as the run has, at most
        windows = steps // (len(FIRST_RATES) * UPDATES_PER_WINDOW * len(self._groups))
        self._comparison = replace(
            IMAGE_COMPARISON, max_windows=min(max(windows, 1), MAX_REFIT_WINDOWS)
        )

    def applies_to(self, scene: HumanScene) -> bool:
        """True if each row of the training clip has its own images, and one has two or more."""
        return len(self._groups) == len(scene.clip) and max(map(len, self._groups)) > 1

    def edit_scene(self, scene: HumanScene, step: int) -> tuple[HumanScene, str] | None:
        """Refit one time step after ``step``; return the scene and a message, or None if nothing
        is due.

        The first step of a refit runs the trial, whose decision the message reports.
        """
        elapsed = [step - start for start in self._starts if start <= step]
        is_due = self.is_active and elapsed and elapsed[-1] <= len(self._groups)
        if not is_due or not self.applies_to(scene):
            return None
        scene.clear_caches()
        if elapsed[-1] > 0:
            return self.refit_frame(scene, elapsed[-1] - 1), ""
        gain_db, shift = self.measure_gain(scene)
        self.is_active = gain_db >= MIN_REFIT_GAIN_DB and (
            shift >= MIN_JOINT_SHIFT or step > self._starts[0]
        )
        decision = "refitting body poses" if self.is_active else "body poses not refitted"
        reason = f"joints move {1000 * shift:.0f} mm, held-out views gain {gain_db:.1f} dB"
        return scene, f"{decision}: {reason}"

    def measure_gain(self, scene: HumanScene) -> tuple[float, float]:
        """Return the mean PSNR gain, dB, of held-out views by a refit, and the mean joint motion,
        m.

        At up to ``NUM_TRIAL_TIMES`` time steps, poses are fitted to all views but one. PSNR is
        measured in the person's box of that view.
        """
        groups = [group for group in self._groups if len(group) > 1]
        rows = [(2 * i + 1) * len(groups) // (2 * NUM_TRIAL_TIMES) for i in range(NUM_TRIAL_TIMES)]
        gains = []
        moves = []
        for number, row in enumerate(dict.fromkeys(rows)):
            group = groups[row]
            held_out = group[number % len(group)]
            fitted = self._fitted(scene, [i for i in group if i != held_out])
            gains.append(self._psnr(fitted, held_out) - self._psnr(scene, held_out))
            time = self._images.times[held_out] or 0.0
            before, after = (_joints(x, time) for x in (scene, fitted))
            moves.append(float((after - before).norm(dim=1).mean()))
        return fmean(gains), fmean(moves)

    def refit_frame(self, scene: HumanScene, row: int) -> HumanScene:
        """Return the scene with row ``row`` of the training clip refitted and its corrections
        reset to 0."""
        if len(self._groups[row]) == 1:
            return scene
        fitted_clip = self._fitted(scene, self._groups[row]).replacement_clip
        clip = {"poses": scene.clip.poses.clone(), "trans": scene.clip.trans.clone()}
        with torch.no_grad():
            for name, x in clip.items():
                x[row] = getattr(fitted_clip, name)[0]
                scene.learned[name][row] = 0
        return replace(scene, clip=replace(scene.clip, **clip))

    def _fitted(self, scene: HumanScene, indices: list[int]) -> HumanScene:
        frozen = replace(scene, gaussians=scene.gaussians.detach())
        return fit_poses_to_images(
            frozen, self._images, self._background, self._comparison, indices
        )[0]

    @torch.no_grad()
    def _psnr(self, scene: HumanScene, index: int) -> float:
        image: Image = self._images[index]
        render = scene.render(
            image.cameras, image.time, options=scene.options, background=self._background
        ).rgb[0]
        box = None if image.alpha is None else silhouette_box(image.alpha)
        box = box or (slice(None), slice(None))
        mask = None if image.mask is None else image.mask[box]
        return psnr(render[box], image.composite(self._background)[box], mask)


@torch.no_grad()
def _joints(scene: HumanScene, time: float) -> Tensor:
    """Return the body joints (22, 3) at ``time`` in metres of the body."""
    pose = frame_pose(scene.played_clip.at(time), 0)
    return posed_joints(scene.learned_skeleton, pose)[: JOINT_NAMES.index("jaw")] / pose.scale
