"""How an avatar is trained: in the pose of every image, with the fit of its body refined."""

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

OUTLINE_REACH_PX = (
    2  # distance from the mask up to which images are compared as they were taken, px
)
MAX_OUTSIDE_ALPHA = 0.02  # alpha up to which a pixel is outside of the mask
PLATE_FRAMES = 21  # of a camera, whose median is what is behind
# median difference, over pixels outside of the masks, from which the camera or the light has moved
MAX_BACKGROUND_CHANGE = 12 / 255
# least fraction of the pixels near outlines, behind which something is known, to use any
MIN_OUTLINE_FRACTION = 0.01
_STRIP = 32  # rows whose median is taken at once


class OutlineLoss(Loss):
    """L1 and D-SSIM of the image; in masks and up to ``REACH`` px around them, before the plate
    where that is known.

    There the render's own opacity, not the mask, says how much of the plate is seen.
    """

    def __init__(
        self,
        photos: ImageLoader,
        plates: Mapping[int, tuple[Tensor, Tensor]],
        behind: Tensor,
        ssim_weight: float,
        known: float,
    ) -> None:
        """Keep all of it.

        Args:
            photos: the training images as they were taken.
            plates: colours (H, W, 3) behind the person by the number of the camera, and where (H,
                W) they are known: seen without the person often enough.
            behind: (3,) colour of the run's background.
            known: fraction of the pixels near outlines where a plate is known, for people.
        """
        self._photos = photos
        self._plates = plates
        self._behind = behind
        self._ssim_weight = ssim_weight
        self.finding = (
            f"masks are found ones: {known:.0%} of the pixels at their outlines are compared before what other frames "
            "show behind the person"
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
    """Return how colours are compared near outlines; None where masks come with the images, or no
    camera stands."""
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
    for camera, rows in _standing(views).items():
        shown = [rows[i] for i in evenly_spaced(len(rows), PLATE_FRAMES)]
        alphas = torch.stack([x for i in shown if (x := run.images[i].alpha) is not None])
        near = _near_silhouette(alphas)
        bare = [(255 * photos[i].rgb_premultiplied).round().byte() for i in shown]
        plate = _plate(torch.stack(bare), near)
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


def _standing(views: Sequence[View]) -> dict[int, list[int]]:
    """Return the rows of the views of each camera that stands, by its number."""
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
    """Return where (..., H, W) the mask is, and up to ``REACH`` px around it."""
    size = 2 * OUTLINE_REACH_PX + 1
    grown = torch.nn.functional.max_pool2d(alpha[..., None, :, :], size, 1, OUTLINE_REACH_PX)
    return grown[..., 0, :, :] > MAX_OUTSIDE_ALPHA


def _plate(photos: Tensor, near: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the median of photos (F, H, W, 3) uint8 over those that show no person at a pixel, and
    where it is known.

    ``near`` (F, H, W) says where the person may be. None: it is not one thing, or never seen.
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

    refine_from: float = 0.1  # fraction of the run after which corrections are learned
    # fraction after which those of single frames are: what all frames share comes first
    refine_frames_from: float = 0.25
    offset_weight: float = 2e-4  # of squared distances from the scaffold
    scale_weight: float = 1e-2  # of the squared excess of log-scales over the size of the texel
    rigidity: float = 1e-2  # of squared changes, by posing, of distances between neighbours
    smoothness: float = 1e-3  # of squared differences between the offsets of neighbours
    neighbours: int = 5
    # of the squared difference between colours of both sides, where light is learned
    sides_weight: float = 0.1
    views: int = 100  # training views, at most, in which it is counted how much they show
    # fraction of Gaussians that are hardly seen from which on a message says so
    min_reported_fraction: float = 0.01


PARAMS = AvatarParams()
CENTIMETRE = 0.01


class HumanTraining(SceneTraining[HumanScene]):
    """See ``SceneTraining``; ``frames`` are numbers of the rows of the clip of training, ``rates``
    say how rates fall.

    ``views`` are camera and frame of the training views; without any, what they do not show is not
    filled. ``outlines`` is how colours are compared near the outlines of found masks, ``refit`` how
    poses are fitted again.
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
        """Return the Gaussians in the pose of ``image``, and the regularizers.

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
            # in each step between neighbours of one of the five columns, in cm^2: distances do not
            # change, and offsets from the scaffold are alike
            near = self._neighbours[:, step % self._neighbours.shape[1]]
            scale = scene.clip.scale[row]
            strain, uneven = rigidity_errors(rest.means, moved.means, anchors.points, near, scale)
            penalties["rigidity"] = PARAMS.rigidity * strain / CENTIMETRE**2
            penalties["smoothness"] = PARAMS.smoothness * uneven / CENTIMETRE**2
        frame = RestPose(rest.means, posing.rotations[0])
        return GaussianTimeStep(moved, image.time, frame, penalties)

    def optimize(self, scene: HumanScene, step: int) -> Count:
        """Update the corrections."""
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
        """Return the corrections."""
        return scene.learned.leaves

    def edit_scene(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult] | None:
        """Return the scene, and after the last step new values for what the images hardly show.

        After the first step with a line about outlines, if there is one. In between poses may be
        fitted again.
        """
        if step == 1 and self._finding is not None:
            return scene, EditResult(None, message=self._finding)
        if step == self.rates.steps:
            has_views = self.options.fill_unseen and self.views and len(scene)
            return self._filled(scene, step) if has_views else None
        found = None if self._refit is None else self._refit.edit_scene(scene, step)
        return None if found is None else (found[0], EditResult(None, message=found[1] or None))

    def _filled(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult]:
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
        line = f"{hardly:.0%} of the surface is hardly seen: filled from the other side of the body and from around it"
        message = line if hardly >= PARAMS.min_reported_fraction else None
        return replace(scene, seen=trust), EditResult(None, changes, message=message)

    def apply_edit(self, edit: TopologyEdit | None = None) -> None:
        """Find out anew who the neighbours are."""
        self._neighbours = self._mirror_images = None

    def restore(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        self.apply_edit()
        if "refines_from" in tensors:  # the run may have become longer since
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
        """Return the row of ``frame`` in the clip; who never moves has one row."""
        return min(self._rows[frame], len(scene.clip) - 1)

    def _in_frame(self, scene: HumanScene, row: int, step: int) -> tuple[Gaussians, BodyPose]:
        """Return the Gaussians in row ``row`` of the clip as ``step`` draws them, and the pose."""
        return scene.gaussians_in_frame(
            row, None if self._refines(step) else scene.template_weights()
        )

    def _refines(self, step: int) -> bool:
        return self.options.refine and step > self.refines_from
