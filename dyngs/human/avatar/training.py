"""How an avatar is trained: in the pose of every image, with the fit of its body refined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role, State, with_role
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced
from dyngs.gaussians import EditResult, Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import RestFrame
from dyngs.gaussians.model import SceneTraining
from dyngs.gaussians.scene import GaussianTimeStep
from dyngs.gaussians.schedule import Rates
from dyngs.human.avatar.corrections import (
    OF_FRAMES,
    correction_penalties,
    new_corrections,
    share_sides,
)
from dyngs.human.avatar.neighbours import (
    HARDLY,
    filled,
    linked_neighbours,
    mirror_images,
    sightings,
    strains,
    trust_in,
)
from dyngs.human.avatar.observations import Subject
from dyngs.human.avatar.outlines import OutlineLoss
from dyngs.human.avatar.pose_refit import PoseRefit
from dyngs.human.avatar.posing import BodyPose, difference_of_sides
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.keys import HumanModel
from dyngs.ops.adam import Count

NEIGHBOURS = 5
FRAMES_FROM = 0.25
"""Fraction of the run after which poses of single frames are learned: what all frames share comes
first."""
CENTIMETRE = 0.01
# of the squared difference between colours of both sides, where light is learned, in the loss
SIDES_WEIGHT = 0.1
# number of training views, at most, in which it is counted how much they show of each Gaussian
LOOKS = 100
WORTH_TELLING = 0.01  # least fraction of Gaussians that are hardly seen at which a line says so


class HumanTraining(SceneTraining[HumanScene]):
    """See ``SceneTraining``; ``frames`` are numbers of the rows of the clip of training, ``rates``
    say how rates fall.

    ``views`` are camera and frame of the training views; without any, what they do not show is not
    filled. ``outlines`` is how colours are compared near the outlines of found masks, ``refit`` how
    poses are fitted again.
    """

    moves_by = ("pose", "model")

    def __init__(
        self,
        options: HumanModel,
        frames: Sequence[int],
        rates: Rates,
        views: Sequence[tuple[Cameras, int]] = (),
        outlines: OutlineLoss | None = None,
        refit: PoseRefit | None = None,
    ) -> None:
        self.options, self.rates, self.views, self.colour_loss = options, rates, views, outlines
        self._finding = None if outlines is None else outlines.finding
        self.refines_from = round(options.refine_from * rates.steps)
        self.frames_from = round(FRAMES_FROM * rates.steps)
        self._rows = {frame: row for row, frame in enumerate(frames)}
        self._given_weights: Tensor | None = None
        self._near: Tensor | None = None
        self._images: tuple[Tensor, Tensor] | None = None
        self._refit = refit

    def first_scene(
        self, gaussians: Gaussians, subject: Subject, normals: Tensor | None = None
    ) -> HumanScene:
        """Return the scene of the first Gaussians: nothing is learned yet; light only with their
        ``normals`` (N, 3)."""
        clip = subject.motion.clip
        learned = new_corrections(clip, subject.skeleton, subject.anchors, normals)
        return HumanScene(
            gaussians=gaussians,
            anchors=subject.anchors,
            skeleton=subject.skeleton,
            clip=clip,
            learned=learned,
            shapes=subject.shapes,
        )

    def time_step(self, scene: HumanScene, image: Image, step: int) -> GaussianTimeStep:
        """Return the Gaussians in the pose of ``image``, and the regularizers.

        Raises DyngsError: the image's frame has no pose.
        """
        row = self._rows.get(-1 if image.frame is None else image.frame)
        if row is None:
            raise DyngsError(f"view {image.name!r}: no body parameters for frame {image.frame}")
        penalties = self._penalties(scene)
        row = min(row, len(scene.clip) - 1)  # who never moves has one row
        gaussians, posing = self._in_frame(scene, row, step)
        if self._refines(step):
            penalties |= correction_penalties(scene.learned)
            if scene.light is not None:
                penalties["sides"] = SIDES_WEIGHT * difference_of_sides(
                    scene.gaussians, *self._images_in(scene)
                )
        penalties |= self._between_neighbours(scene, gaussians, scene.clip.scale[row], step)
        frame = RestFrame(scene.gaussians.means, posing.rotations[0])
        return GaussianTimeStep(gaussians, image.time, frame, penalties)

    def optimize(self, scene: HumanScene, step: int) -> Count:
        """Update the corrections."""
        if not self._refines(step):
            return 0
        progress = self.rates.progress(step, since=self.refines_from)
        share_sides(scene.learned)
        if step <= self.frames_from:
            for name in OF_FRAMES:
                scene.learned[name].grad = None
        return scene.learned.step(step - self.refines_from, progress)

    def leaves(self, scene: HumanScene) -> list[Tensor]:
        """Return the corrections."""
        return scene.learned.leaves

    def revised(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult] | None:
        """Return the scene, and after the last step new values for what the images hardly show.

        After the first step with a line about outlines, if there is one. In between poses may be
        fitted again.
        """
        if step == 1 and self._finding is not None:
            return scene, EditResult(None, finding=self._finding)
        if step == self.rates.steps:
            return (
                self._filled(scene, step)
                if self.options.fill_unseen and self.views and len(scene)
                else None
            )
        found = None if self._refit is None else self._refit.revised(scene, step)
        return None if found is None else (found[0], EditResult(None, finding=found[1] or None))

    def _filled(self, scene: HumanScene, step: int) -> tuple[HumanScene, EditResult]:
        shown = [self.views[i] for i in evenly_spaced(len(self.views), LOOKS)]
        last = len(scene.clip) - 1
        with torch.no_grad():
            drawn = (
                (
                    self._in_frame(scene, min(self._rows[frame], last), step)[0],
                    camera.to(device=scene.skeleton.joints.device),
                )
                for camera, frame in shown
            )
            seen = sightings(
                drawn, scene.anchors.size, float(scene.clip.scale.mean()), scene.options
            )
            trust = trust_in(seen * (len(self.views) / len(shown)))
            middle = float(scene.skeleton.joints[0, 0])
            changes = filled(
                scene.gaussians.detach(), scene.anchors, scene.given_weights(), middle, trust
            )
        hardly = float((trust < HARDLY).float().mean())
        line = f"{hardly:.0%} of the surface is hardly seen: filled from the other side of the body and from around it"
        finding = line if hardly >= WORTH_TELLING else None
        return replace(scene, seen=trust), EditResult(None, changes, finding=finding)

    def follow(self, edit: TopologyEdit) -> None:
        """Find out anew who the neighbours are, and what they weigh."""
        self._given_weights = self._near = self._images = None

    def restored(self, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        self._near = tensors.get("near")
        self._given_weights = None
        self._images = None
        if self._refit is not None:
            self._refit.goes_on = "poses_stay" not in tensors
        return HumanScene.restored(gaussians, tensors)

    def state(self) -> State:
        kept = {} if self._near is None else {"near": self._near}
        if self._refit is not None and not self._refit.goes_on:
            kept["poses_stay"] = torch.ones(1, device="cpu")
        return with_role(kept, Role.TRAINING)

    def _in_frame(self, scene: HumanScene, row: int, step: int) -> tuple[Gaussians, BodyPose]:
        """Return the Gaussians in row ``row`` of the clip as ``step`` draws them, and the pose."""
        if self._refines(step):
            return scene.in_frame(row)
        if self._given_weights is None:
            self._given_weights = scene.given_weights()
        return scene.in_frame(row, self._given_weights)

    def _images_in(self, scene: HumanScene) -> tuple[Tensor, Tensor]:
        if self._images is None:
            self._images = mirror_images(scene.anchors, float(scene.skeleton.joints[0, 0]))
        return self._images

    def _refines(self, step: int) -> bool:
        return self.options.refine and step > self.refines_from

    def _penalties(self, scene: HumanScene) -> dict[str, Tensor]:
        """Return penalties for Gaussians far from their scaffolds, or larger than their texels."""
        terms = {}
        options = self.options
        now = scene.gaussians
        if options.offset_weight > 0:
            away = (now.means - scene.anchors.points) / CENTIMETRE
            terms["offset"] = options.offset_weight * away.square().sum() / len(away)
        if options.scale_weight > 0:
            longer = now.log_scales - scene.anchors.size.log()[:, None]
            terms["scale"] = options.scale_weight * longer.clamp_min(0).square().sum() / len(longer)
        return terms

    def _between_neighbours(
        self, scene: HumanScene, moved: Gaussians, scale: Tensor, step: int
    ) -> dict[str, Tensor]:
        """Return penalties between neighbours at rest, in cm^2; in each step for one of the five
        neighbours.

        Rigidity: distances do not change. Smoothness: offsets from the scaffold are alike.
        """
        options = self.options
        means = scene.gaussians.means
        if options.rigidity == 0 and options.smoothness == 0:
            return {}
        if self._near is None:
            self._near = linked_neighbours(scene.anchors.points, scene.given_weights(), NEIGHBOURS)
        if not self._near.shape[1]:
            return {}
        near = self._near[:, step % self._near.shape[1]]
        strain, uneven = strains(means, moved.means, scene.anchors.points, near, scale)
        terms = {"rigidity": options.rigidity * strain, "smoothness": options.smoothness * uneven}
        return {name: x / CENTIMETRE**2 for name, x in terms.items() if getattr(options, name) > 0}
