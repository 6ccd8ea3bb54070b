"""Training of avatars: losses in the pose of each image, and refinement of the body fit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.capture.masks import SEEN_BARE
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, with_role
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import RestPose
from dyngs.gaussians.model import SceneTraining
from dyngs.gaussians.scene import GaussianTimeStep
from dyngs.gaussians.schedule import RateSchedule
from dyngs.human.avatar.observations import (
    LOW_CONFIDENCE,
    effective_view_counts,
    filled,
    find_mirror_gaussians,
    rigidity_errors,
    same_part_neighbours,
    visibility_confidence,
)
from dyngs.human.avatar.pose_fit import PoseRefit
from dyngs.human.avatar.posing import (
    PER_FRAME,
    BodyPose,
    colour_asymmetry,
    correction_penalties,
    symmetrize_joint_gradients,
)
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.keys import HumanModel
from dyngs.models.kind import StartContext
from dyngs.models.model import Loss, LossInput
from dyngs.models.views import background_colour
from dyngs.ops.adam import Count
from dyngs.ops.device import copy_async
from dyngs.ops.loss import l1_ssim_loss

# Width of the rim around the mask in which renders are compared with unmasked photos, px
OUTLINE_REACH_PX = 2
MAX_OUTSIDE_ALPHA = 0.02  # largest alpha of pixels outside the mask
PLATE_FRAMES = 21  # frames per camera whose median is the background plate
# Median difference from the plate, outside the masks, above which the background is not static
MAX_BACKGROUND_CHANGE = 12 / 255
# Outlines are compared only if the plates cover this fraction of the pixels near outlines.
MIN_OUTLINE_FRACTION = 0.01
_STRIP = 32  # image rows per median, which bounds memory


class OutlineLoss(Loss):
    """L1 and D-SSIM loss that does not depend on the exact outlines of detected masks.

    In the mask and up to ``OUTLINE_REACH_PX`` around it, the render is composited over the
    background plate of its camera and compared with the unmasked photo. Thus the rendered opacity
    replaces the mask. Pixels without a plate are compared with the masked image.
    """

    def __init__(
        self,
        photos: ImageLoader,
        plates: Mapping[int, tuple[Tensor, Tensor]],
        behind: Tensor,
        ssim_weight: float,
        known: float,
    ) -> None:
        """
        Args:
            photos: training images without masks.
            plates: by camera id, background colours (H, W, 3) and the pixels (H, W) bool where
                enough frames show the background.
            behind: (3,) background colour of the run.
            known: fraction of the pixels near outlines that have a plate, for the message.
        """
        self._photos = photos
        self._plates = plates
        self._behind = behind
        self._ssim_weight = ssim_weight
        self.finding = (
            f"masks are detected: {known:.0%} of the pixels at outlines are compared over the "
            "background that other frames show"
        )

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        rendered = look.rendered
        truth = look.truth
        plate = self._plates.get(self._photos.views[look.index].camera_id)
        alpha = look.image.alpha
        if plate is not None and alpha is not None and truth.shape == plate[0].shape:
            photo = self._photos[look.index].rgb_premultiplied
            colours, known, photo, behind = (
                copy_async(x, rendered.device) for x in (*plate, photo, self._behind)
            )
            use = (known & _near_silhouette(alpha))[..., None]
            seen = look.drawn.rendering.transmittance[0][..., None]
            rendered = rendered + use * seen * (colours - behind)
            truth = torch.where(use, photo, truth)
        return {"image": l1_ssim_loss(rendered, truth, self._ssim_weight, look.image.mask)}


def make_outline_loss(run: StartContext) -> OutlineLoss | None:
    """Return the loss for detected masks.

    None if masks come with the images, no camera is fixed, plates cover too little, or settings
    (random background, exposure, camera refinement) rule it out.
    """
    views = run.images.views
    config = run.config
    if (
        run.background == "random"
        or config.train.exposure != "never"
        or config.camera.refine == "always"
    ):
        return None
    if any(view.silhouette is None for view in views):
        return None
    photos = ImageLoader([replace(view, silhouette=None) for view in views], config.data)
    if photos[0].alpha is not None:
        return None
    plates: dict[int, tuple[Tensor, Tensor]] = {}
    known = total = 0.0
    for camera, rows in _fixed_cameras(views).items():
        shown = [rows[i] for i in evenly_spaced(len(rows), PLATE_FRAMES)]
        alphas = torch.stack([x for i in shown if (x := run.images[i].alpha) is not None])
        near = _near_silhouette(alphas)
        bare = [(255 * photos[i].rgb_premultiplied).round().byte() for i in shown]
        plate = _background_plate(torch.stack(bare), near)
        if plate is None:
            continue
        plates[camera] = plate
        rims = near & (alphas <= 1 - MAX_OUTSIDE_ALPHA)
        known += float((rims & plate[1]).sum())
        total += float(rims.sum())
    if not plates or known < MIN_OUTLINE_FRACTION * total:
        return None
    return OutlineLoss(
        photos, plates, background_colour(run.background), config.train.ssim_weight, known / total
    )


def _fixed_cameras(views: Sequence[View]) -> dict[int, list[int]]:
    """Return the rows of the views of each fixed camera, by camera id."""
    rows: dict[int, list[int]] = defaultdict(list)
    for row, view in enumerate(views):
        rows[view.camera_id].append(row)

    def stands(own: list[int]) -> bool:
        first = views[own[0]]
        places = np.stack([views[i].cam_from_world for i in own])
        lenses = {(views[i].intrinsics.tobytes(), views[i].width, views[i].height) for i in own}
        return len(lenses) == 1 and np.allclose(places, first.cam_from_world, atol=1e-6)

    return {camera: own for camera, own in rows.items() if len(own) > SEEN_BARE and stands(own)}


def _near_silhouette(alpha: Tensor) -> Tensor:
    """Return the mask, dilated by ``OUTLINE_REACH_PX``, as (..., H, W) bool."""
    size = 2 * OUTLINE_REACH_PX + 1
    grown = torch.nn.functional.max_pool2d(alpha[..., None, :, :], size, 1, OUTLINE_REACH_PX)
    return grown[..., 0, :, :] > MAX_OUTSIDE_ALPHA


def _background_plate(photos: Tensor, near: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the background plate: the median over the frames without the person at a pixel.

    Args:
        photos: (F, H, W, 3) uint8.
        near: (F, H, W) bool, pixels where the person may be.

    Returns:
        colours (H, W, 3), and the pixels (H, W) bool with enough frames. None if the background
        changes or is never visible.
    """
    known = (~near).sum(0) >= SEEN_BARE
    colours = torch.zeros(*photos.shape[1:], device=photos.device)
    away = []
    for first in range(0, len(known), _STRIP):
        rows = slice(first, first + _STRIP)
        bare = (photos[:, rows] / 255).masked_fill(near[:, rows, :, None], torch.nan)
        colours[rows] = bare.nanmedian(0).values.nan_to_num()
        away.append((bare - colours[rows]).abs().amax(-1)[:, known[rows]].flatten())
    differences = torch.cat(away)
    differences = differences[~differences.isnan()]
    if not len(differences) or float(differences.median()) > MAX_BACKGROUND_CHANGE:
        return None
    return colours, known


@dataclass(frozen=True)
class AvatarParams:
    """When and how strongly an avatar is regularised; distances in cm."""

    refine_from: float = 0.1  # fraction of the run after which the body fit is corrected
    # Fraction after which corrections of single frames are learned, too; shared ones come first.
    refine_frames_from: float = 0.25
    offset_weight: float = 2e-4  # weight of squared distances of Gaussians from their anchors
    scale_weight: float = 1e-2  # weight of the squared excess of log-scales over the texel size
    rigidity: float = 1e-2  # weight of squared changes of distances between neighbours by posing
    smoothness: float = 1e-3  # weight of squared differences between the offsets of neighbours
    neighbours: int = 5  # neighbours per Gaussian
    # Weight of squared colour differences between mirror images, if a light is learned
    sides_weight: float = 0.1
    views: int = 100  # largest number of training views that measure visibility
    # Fraction of hardly visible Gaussians from which the message is logged
    min_reported_fraction: float = 0.01


PARAMS = AvatarParams()
CENTIMETRE = 0.01


class HumanTraining(SceneTraining[HumanScene]):
    """Training of an avatar, see ``SceneTraining``.

    Args:
        frames: frame numbers of the rows of the training clip.
        rates: schedule of the learning rates.
        views: camera and frame number of each training view. Without views, unseen Gaussians are
            not filled in.
        outlines: image loss for detected masks.
        refit: repeated fit of the poses during training.
    """

    deformation_name = ("pose", "model")

    def __init__(
        self,
        options: HumanModel,
        frames: Sequence[int],
        rates: RateSchedule,
        views: Sequence[tuple[Cameras, int]] = (),
        outlines: OutlineLoss | None = None,
        refit: PoseRefit | None = None,
    ) -> None:
        self.options = options
        self.rates = rates
        self.views = views
        self.colour_loss = outlines
        self._finding = None if outlines is None else outlines.finding
        self.refines_from = round(PARAMS.refine_from * rates.steps)
        self.refine_frames_from = round(PARAMS.refine_frames_from * rates.steps)
        self._rows = {frame: row for row, frame in enumerate(frames)}
        self._has_refined = False
        self._neighbours: Tensor | None = None
        self._mirror_images: tuple[Tensor, Tensor] | None = None
        self._refit = refit

    def time_step(self, scene: HumanScene, image: Image, step: int) -> GaussianTimeStep:
        """Return the Gaussians in the pose of ``image``, and the regularisers.

        Raises DyngsError: the image's frame has no pose.
        """
        if image.frame not in self._rows:
            raise DyngsError(f"view {image.name!r}: no body parameters for frame {image.frame}")
        row = self._row(scene, image.frame)
        rest = scene.gaussians
        anchors = scene.anchors
        away = (rest.means - anchors.points) / CENTIMETRE
        longer = (rest.log_scales - anchors.size.log()[:, None]).clamp_min(0)
        penalties = {
            "offset": PARAMS.offset_weight * away.square().sum() / len(away),
            "scale": PARAMS.scale_weight * longer.square().sum() / len(longer),
        }
        moved, posing = self._in_frame(scene, row, step)
        if self._refines(step):
            penalties |= correction_penalties(scene.learned)
            if scene.light is not None:
                if self._mirror_images is None:
                    self._mirror_images = find_mirror_gaussians(
                        anchors, float(scene.skeleton.joints[0, 0])
                    )
                unlike = colour_asymmetry(rest, *self._mirror_images)
                penalties["sides"] = PARAMS.sides_weight * unlike
        if self._neighbours is None:
            weights = scene.template_weights()
            self._neighbours = same_part_neighbours(anchors.points, weights, PARAMS.neighbours)
        if self._neighbours.shape[1]:
            # Posing should preserve distances to neighbours, and neighbours should have similar
            # offsets from their anchors. Each step uses one neighbour per Gaussian. Units are cm^2.
            near = self._neighbours[:, step % self._neighbours.shape[1]]
            scale = scene.clip.scale[row]
            strain, uneven = rigidity_errors(rest.means, moved.means, anchors.points, near, scale)
            penalties["rigidity"] = PARAMS.rigidity * strain / CENTIMETRE**2
            penalties["smoothness"] = PARAMS.smoothness * uneven / CENTIMETRE**2
        frame = RestPose(rest.means, posing.rotations[0])
        return GaussianTimeStep(moved, image.time, frame, penalties)

    def optimize(self, scene: HumanScene, step: int) -> Count:
        """Update the corrections of the body fit."""
        if not self._refines(step):
            return 0
        self._has_refined = True
        progress = self.rates.progress(step, since=self.refines_from)
        symmetrize_joint_gradients(scene.learned)
        if step <= self.refine_frames_from:
            for name in PER_FRAME:
                scene.learned[name].grad = None
        return scene.learned.step(step - self.refines_from, progress)

    def leaves(self, scene: HumanScene) -> list[Tensor]:
        """Return the corrections of the body fit."""
        return scene.learned.leaves

    def edit_scene(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult] | None:
        """Fill in hardly visible Gaussians after the last step; before it, fit poses again if due.

        After the first step, only the message of the outline loss is returned.
        """
        if step == 1 and self._finding is not None:
            return scene, EditResult(None, message=self._finding)
        if step == self.rates.steps:
            has_views = self.options.fill_unseen and self.views and len(scene)
            return self._fill_unseen(scene, step) if has_views else None
        found = None if self._refit is None else self._refit.edit_scene(scene, step)
        return None if found is None else (found[0], EditResult(None, message=found[1] or None))

    def _fill_unseen(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult]:
        shown = [self.views[i] for i in evenly_spaced(len(self.views), PARAMS.views)]
        device = scene.skeleton.joints.device
        with torch.no_grad():
            drawn = (
                (self._in_frame(scene, self._row(scene, frame), step)[0], camera.to(device=device))
                for camera, frame in shown
            )
            size = scene.anchors.size
            seen = effective_view_counts(drawn, size, float(scene.clip.scale.mean()), scene.options)
            trust = visibility_confidence(seen * (len(self.views) / len(shown)))
            middle = float(scene.skeleton.joints[0, 0])
            gaussians = scene.gaussians.detach()
            changes = filled(gaussians, scene.anchors, scene.template_weights(), middle, trust)
        hardly = float((trust < LOW_CONFIDENCE).float().mean())
        line = (
            f"{hardly:.0%} of the surface is hardly seen: filled in from the mirrored side and "
            "neighbours"
        )
        message = line if hardly >= PARAMS.min_reported_fraction else None
        return replace(scene, seen=trust), EditResult(None, changes, message=message)

    def apply_edit(self, edit: TopologyEdit | None = None) -> None:
        """Discard cached neighbours and mirror images, since rows have changed."""
        self._neighbours = self._mirror_images = None

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        self.apply_edit()
        if "refines_from" in tensors:  # The run may have been extended.
            self._has_refined = True
            self.refines_from = min(self.refines_from, int(tensors["refines_from"]))
        if self._refit is not None:
            self._refit.is_active = "poses_stay" not in tensors
        return HumanScene.from_state(gaussians, tensors)

    def state(self) -> State:
        kept = {}
        if self._refit is not None and not self._refit.is_active:
            kept["poses_stay"] = torch.ones(1, device="cpu")
        if self._has_refined:
            kept["refines_from"] = torch.tensor(self.refines_from, device="cpu")
        return with_role(kept, Role.TRAINING)

    def _row(self, scene: HumanScene, frame: int) -> int:
        """Return the row of ``frame`` in the clip; clips of a static person have one row."""
        return min(self._rows[frame], len(scene.clip) - 1)

    def _in_frame(self, scene: HumanScene, row: int, step: int) -> tuple[Gaussians, BodyPose]:
        """Return the posed Gaussians of a row of the clip as rendered in ``step``, and the pose."""
        return scene.gaussians_in_frame(
            row, None if self._refines(step) else scene.template_weights()
        )

    def _refines(self, step: int) -> bool:
        return self.options.refine and step > self.refines_from
