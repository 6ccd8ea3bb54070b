"""Training of an avatar in the pose of each image, with refinement of the body fit."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.capture.masks import SEEN_BARE
from dyngs.core.camera import Cameras
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
    fill_unseen,
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

OUTLINE_REACH_PX = 2  # width of the band around the mask in which the original image is used
MAX_OUTSIDE_ALPHA = 0.02  # alpha up to which a pixel is outside the mask
PLATE_FRAMES = 21  # frames per camera in the median that gives the background plate
# Median difference from the plate above which the camera or the light must have changed.
MAX_BACKGROUND_CHANGE = 12 / 255
# Least fraction of outline pixels with a known background for which plates are used.
MIN_OUTLINE_FRACTION = 0.01
_STRIP = 32  # image rows per median, to bound memory


@dataclass(frozen=True)
class Plate:
    """Background of a fixed camera, whose images may be crops of it."""

    colours: Tensor  # (H, W, 3) of all crops together
    known: Tensor  # (H, W) bool, where the background was visible
    corners: Mapping[int, tuple[int, int]]  # top and left of each image in it, by view index

    def window(self, index: int, height: int, width: int) -> tuple[Tensor, Tensor]:
        """Return colours (height, width, 3) and known pixels behind the image of a view."""
        top, left = self.corners[index]
        window = slice(top, top + height), slice(left, left + width)
        return self.colours[window], self.known[window]


class OutlineLoss(Loss):
    """L1 and D-SSIM; inside the mask and up to ``OUTLINE_REACH_PX`` around it, the render is
    composited over the background plate and compared with the original image.

    The opacity of the render, not the mask, then decides how much of the plate is visible.
    """

    def __init__(
        self,
        photos: ImageLoader,
        plates: Mapping[int, Plate],
        background: Tensor,
        ssim_weight: float,
        known_fraction: float,
    ) -> None:
        """Args:
        photos: training images without masks.
        plates: by camera number.
        background: (3,) background colour of the run.
        ssim_weight: weight of D-SSIM.
        known_fraction: fraction of outline pixels with a known background, for the message."""
        self._photos = photos
        self.plates = plates
        self._background = background
        self._ssim_weight = ssim_weight
        self.message = (
            f"estimated masks: {known_fraction:.0%} of their outline pixels are compared over the "
            "background of other frames"
        )

    def __call__(self, look: LossInput) -> Mapping[str, Tensor]:
        rendered = look.rendered
        truth = look.truth
        plate = self.plates.get(self._photos.views[look.index].camera_id)
        alpha = look.image.alpha
        if plate is not None and alpha is not None and truth.shape[:2] == alpha.shape:
            colours, known = plate.window(look.index, *alpha.shape)
            photo = self._photos[look.index].rgb_premultiplied
            colours, known, photo, background = (
                copy_async(x, rendered.device) for x in (colours, known, photo, self._background)
            )
            on_outline = (known & _silhouette_band(alpha))[..., None]
            transmittance = look.drawn.rendering.transmittance[0][..., None]
            rendered = rendered + on_outline * transmittance * (colours - background)
            truth = torch.where(on_outline, photo, truth)
        return {"image": l1_ssim_loss(rendered, truth, self._ssim_weight, look.image.mask)}


def make_outline_loss(run: StartContext) -> OutlineLoss | None:
    """Return the loss with background plates; None if masks come with the images or no camera is
    fixed."""
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
    plates: dict[int, Plate] = {}
    known = total = 0.0
    for camera, corners in _fixed_cameras(views, photos.sizes).items():
        rows = list(corners)
        indices = [rows[i] for i in evenly_spaced(len(rows), PLATE_FRAMES)]
        height = max(top + photos.sizes[i][1] for i, (top, _) in corners.items())
        width = max(left + photos.sizes[i][0] for i, (_, left) in corners.items())
        images = torch.zeros(len(indices), height, width, 3, dtype=torch.uint8, device="cpu")
        near = torch.ones(len(indices), height, width, dtype=torch.bool, device="cpu")
        outside = torch.zeros_like(near)
        for image, covered, is_outside, i in zip(images, near, outside, indices, strict=True):
            alpha = run.images[i].alpha
            if alpha is None:
                continue
            top, left = corners[i]
            window = slice(top, top + alpha.shape[0]), slice(left, left + alpha.shape[1])
            image[window] = (255 * photos[i].rgb_premultiplied).round().byte()
            covered[window] = _silhouette_band(alpha)
            is_outside[window] = alpha <= 1 - MAX_OUTSIDE_ALPHA
        plate = _plate(images, near)
        if plate is None:
            continue
        plates[camera] = Plate(*plate, corners)
        outline = near & outside
        known += float((outline & plate[1]).sum())
        total += float(outline.sum())
    if not plates or known < MIN_OUTLINE_FRACTION * total:
        return None
    return OutlineLoss(
        photos, plates, background_colour(run.background), config.train.ssim_weight, known / total
    )


def _fixed_cameras(
    views: Sequence[View], sizes: Sequence[tuple[int, int]]
) -> dict[int, dict[int, tuple[int, int]]]:
    """Return top and left, px, of the images of each camera that does not move, by view index, in a
    plate that contains them all.

    Images are whole, or crops at whole pixels. ``sizes`` are width and height in training.
    """
    rows: dict[int, list[int]] = defaultdict(list)
    for row, view in enumerate(views):
        rows[view.camera_id].append(row)
    cameras: dict[int, dict[int, tuple[int, int]]] = {}
    for camera, indices in rows.items():
        scales = np.array([sizes[i][0] / views[i].width for i in indices])
        poses = np.stack([views[i].cam_from_world for i in indices])
        intrinsics = np.stack([views[i].intrinsics for i in indices]) * scales[:, None, None]
        focal_lengths = intrinsics[:, [0, 1], [0, 1]]
        shifts = intrinsics[:, :2, 2].max(0) - intrinsics[:, :2, 2]  # left, top
        is_fixed = (
            len(indices) > SEEN_BARE
            and np.allclose(poses, poses[0], atol=1e-6)
            and np.allclose(focal_lengths, focal_lengths[0], rtol=1e-6)
            and np.allclose(shifts, shifts.round(), atol=0.02)
        )
        if is_fixed:
            corners = shifts.round().astype(int)[:, ::-1].tolist()
            cameras[camera] = {
                i: (top, left) for i, (top, left) in zip(indices, corners, strict=True)
            }
    return cameras


def _silhouette_band(alpha: Tensor) -> Tensor:
    """Return where (..., H, W) the mask is, including a band of ``OUTLINE_REACH_PX`` around it."""
    size = 2 * OUTLINE_REACH_PX + 1
    dilated = torch.nn.functional.max_pool2d(alpha[..., None, :, :], size, 1, OUTLINE_REACH_PX)
    return dilated[..., 0, :, :] > MAX_OUTSIDE_ALPHA


def _plate(photos: Tensor, person: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the background plate of one camera and where it is known; None if it changes or is
    never visible.

    The plate is the median of photos (F, H, W, 3) uint8 over frames without the person. ``person``
    (F, H, W) is True where the person may be.
    """
    known = (~person).sum(0) >= SEEN_BARE
    colours = torch.zeros(*photos.shape[1:], device=photos.device)
    differences = []
    for first in range(0, len(known), _STRIP):
        rows = slice(first, first + _STRIP)
        background = (photos[:, rows] / 255).masked_fill(person[:, rows, :, None], torch.nan)
        colours[rows] = background.nanmedian(0).values.nan_to_num()
        differences.append((background - colours[rows]).abs().amax(-1)[:, known[rows]].flatten())
    difference = torch.cat(differences)
    difference = difference[~difference.isnan()]
    if not len(difference) or float(difference.median()) > MAX_BACKGROUND_CHANGE:
        return None
    return colours, known


@dataclass(frozen=True)
class AvatarParams:
    """When and how strongly an avatar is regularised; distances in cm."""

    refine_from: float = 0.1  # fraction of the run after which corrections are learned
    # the same for corrections of single frames, after the shared ones have converged
    refine_frames_from: float = 0.25
    offset_weight: float = 2e-4  # of squared distances of Gaussians from their anchors
    scale_weight: float = 1e-2  # of the squared excess of log-scales over the size of the texel
    rigidity: float = 1e-2  # of squared distance changes between neighbours by posing
    smoothness: float = 1e-3  # of squared differences between the offsets of neighbours
    neighbours: int = 5
    symmetry_weight: float = 0.1  # of squared colour differences between sides, with learned light
    visibility_views: int = 100  # limit on the training views in which visibility is measured
    min_reported_fraction: float = 0.01  # of filled Gaussians, for the log message


PARAMS = AvatarParams()
CENTIMETRE = 0.01


class HumanTraining(SceneTraining[HumanScene]):
    """Training of a ``HumanScene``, see ``SceneTraining``.

    Args:
        options: config section of the model.
        frames: frame numbers of the rows of the training clip.
        rates: learning rate schedule.
        views: camera and frame number of each training view; without them nothing is filled in.
        outlines: image loss with background plates.
        refit: schedule of pose refits.
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
        self._message = None if outlines is None else outlines.message
        self.refines_from = round(PARAMS.refine_from * rates.steps)
        self.refine_frames_from = round(PARAMS.refine_frames_from * rates.steps)
        self._rows = {frame: row for row, frame in enumerate(frames)}
        self._has_refined = False
        self._neighbours: Tensor | None = None
        self._mirror_images: tuple[Tensor, Tensor] | None = None
        self._refit = refit

    def time_step(self, scene: HumanScene, image: Image, step: int) -> GaussianTimeStep:
        """Return the Gaussians in the pose of ``image``, and the regularisation terms."""
        row = self._row(scene, image.frame or 0)
        gaussians = scene.gaussians
        anchors = scene.anchors
        offsets = (gaussians.means - anchors.points) / CENTIMETRE
        log_excess = (gaussians.log_scales - anchors.size.log()[:, None]).clamp_min(0)
        penalties = {
            "offset": PARAMS.offset_weight * offsets.square().sum() / len(offsets),
            "scale": PARAMS.scale_weight * log_excess.square().sum() / len(log_excess),
        }
        moved, posing = self._in_frame(scene, row, step)
        if self._refines(step):
            penalties |= correction_penalties(scene.learned)
            if scene.light is not None:
                if self._mirror_images is None:
                    self._mirror_images = find_mirror_gaussians(
                        anchors, float(scene.skeleton.joints[0, 0])
                    )
                asymmetry = colour_asymmetry(gaussians, *self._mirror_images)
                penalties["sides"] = PARAMS.symmetry_weight * asymmetry
        if self._neighbours is None:
            weights = scene.template_weights()
            self._neighbours = same_part_neighbours(anchors.points, weights, PARAMS.neighbours)
        # Each step uses one column of neighbours; squared distances are in cm^2.
        neighbours = self._neighbours[:, step % PARAMS.neighbours]
        strain, smoothness = rigidity_errors(
            gaussians.means, moved.means, anchors.points, neighbours, scene.clip.scale[row]
        )
        penalties["rigidity"] = PARAMS.rigidity * strain / CENTIMETRE**2
        penalties["smoothness"] = PARAMS.smoothness * smoothness / CENTIMETRE**2
        frame = RestPose(gaussians.means, posing.rotations[0])
        return GaussianTimeStep(moved, image.time, frame, penalties)

    def optimize(self, scene: HumanScene, step: int) -> Count:
        """Update the body corrections."""
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
        """Return the body corrections."""
        return scene.learned.leaves

    def edit_scene(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult] | None:
        """Fill unseen Gaussians after the last step; before, refit poses when due.

        After the first step it only reports the outline loss.
        """
        if step == 1 and self._message is not None:
            return scene, EditResult(None, message=self._message)
        if step == self.rates.steps:
            has_views = self.options.fill_unseen and self.views and len(scene)
            return self._fill_unseen(scene, step) if has_views else None
        edited = None if self._refit is None else self._refit.edit_scene(scene, step)
        return None if edited is None else (edited[0], EditResult(None, message=edited[1] or None))

    def _fill_unseen(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult]:
        views = [self.views[i] for i in evenly_spaced(len(self.views), PARAMS.visibility_views)]
        device = scene.skeleton.joints.device
        with torch.no_grad():
            posed = (
                (self._in_frame(scene, self._row(scene, frame), step)[0], camera.to(device=device))
                for camera, frame in views
            )
            size = scene.anchors.size
            view_counts = effective_view_counts(
                posed, size, float(scene.clip.scale.mean()), scene.options
            )
            confidence = visibility_confidence(view_counts * (len(self.views) / len(views)))
            middle = float(scene.skeleton.joints[0, 0])
            gaussians = scene.gaussians.detach()
            changes = fill_unseen(
                gaussians, scene.anchors, scene.template_weights(), middle, confidence
            )
        low_fraction = float((confidence < LOW_CONFIDENCE).float().mean())
        message = None
        if low_fraction >= PARAMS.min_reported_fraction:
            message = f"filled {low_fraction:.0%} of the surface that few views show"
        return scene, EditResult(None, changes, message=message)

    def apply_edit(self, edit: TopologyEdit | None = None) -> None:
        """Discard cached neighbours after the set of Gaussians changed."""
        self._neighbours = self._mirror_images = None

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        self.apply_edit()
        if "refines_from" in tensors:  # the run may have been extended
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
        """Return the clip row of a frame; a static person has one row."""
        return min(self._rows[frame], len(scene.clip) - 1)

    def _in_frame(self, scene: HumanScene, row: int, step: int) -> tuple[Gaussians, BodyPose]:
        """Return the Gaussians in clip row ``row`` as trained at ``step``, and the pose."""
        return scene.gaussians_in_frame(
            row, None if self._refines(step) else scene.template_weights()
        )

    def _refines(self, step: int) -> bool:
        return self.options.refine and step > self.refines_from
