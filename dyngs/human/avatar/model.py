"""The avatar as the trainer sees it: Gaussians on a template at rest, posed for every picture, with its fit refined."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.colour.network import Frame
from dyngs.config import HumanModel
from dyngs.conventions import SH_C0
from dyngs.data.loader import Picture
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors, skinning_weights
from dyngs.human.avatar.corrections import Corrections, corrected_pose, corrected_skeleton, corrected_weights
from dyngs.human.avatar.neighbours import nearest_neighbours
from dyngs.human.avatar.observations import SurfacePoints, observe_points
from dyngs.human.avatar.posing import BodyPose, PoseBlendShapes, Skeleton, frame_pose, pose_gaussians, rest_offsets
from dyngs.human.motion.captured import CapturedMotion
from dyngs.human.template.atlas import Texels
from dyngs.static.densify import EditResult
from dyngs.static.model import Drawn
from dyngs.static.rates import Rates

NEIGHBOURS = 5
CENTIMETRE = 0.01


@dataclass(frozen=True)
class Subject:
    """Who is filmed: the template's skeleton, what ties the first N Gaussians to it, and the poses of the pictures.

    ``shapes`` are the template's pose blend shapes, None where it has none.
    """

    skeleton: Skeleton
    anchors: Anchors
    footage: CapturedMotion
    shapes: PoseBlendShapes | None = None


def first_look(
    gaussians: Gaussians, texels: Texels, subject: Subject, pictures: Iterable[Picture], carve: float
) -> tuple[Gaussians, Subject]:
    """Those of the first Gaussians that pictures can hold, in the colours that they show.

    Gaussians above the lowest scaffold are kept if they lie inside the silhouette of a share ``carve`` of the pictures.

    Args:
        gaussians: P times the number of scaffolds, as ``texel_gaussians`` orders them.
        texels: P.
        subject: whose anchors are those of ``gaussians``.
        pictures: some of those to train on.
    """
    clip, anchors, skeleton = subject.footage.clip, subject.anchors, subject.skeleton
    rows = {frame: row for row, frame in enumerate(subject.footage.frames)}
    shown = ((picture, frame_pose(clip, rows[picture.frame or 0])) for picture in pictures)
    normals = texels.normals.repeat(len(anchors) // max(len(texels), 1), 1)
    weights = skinning_weights(anchors, len(skeleton.joints))

    def offsets(posing: BodyPose) -> Tensor | None:
        return rest_offsets(anchors, weights, posing, subject.shapes, None)

    found = observe_points(SurfacePoints(anchors.points, normals, weights, offsets), skeleton, shown)
    sh = gaussians.sh.clone()
    sh[:, 0] = (found.rgb - 0.5) / SH_C0
    kept = found.inside >= carve
    kept[: len(texels)] = True
    gaussians = gaussians.replace(sh=sh).select(kept)
    return gaussians, replace(subject, anchors=anchors.select(kept))


class HumanScene:
    """Gaussians that follow a skeleton.

    Attributes:
        anchors: of the Gaussians there are now.
        corrections: what is learned beside them.
    """

    def __init__(self, options: HumanModel, subject: Subject, rates: Rates) -> None:
        self.options, self.subject, self.rates = options, subject, rates
        self.anchors = subject.anchors
        self.refines_from = round(options.refine_from * rates.steps)
        self.corrections = Corrections(options, subject.footage.clip, subject.skeleton, subject.anchors)
        self._rows = {frame: row for row, frame in enumerate(subject.footage.frames)}
        self._given_weights: Tensor | None = None
        self._near: Tensor | None = None

    def trains_on(self, time: float | None, step: int) -> bool:
        """Every picture, always."""
        return True

    def gaussians_at(self, parameters: Gaussians, batch: Picture, step: int) -> Drawn:
        """The Gaussians in the pose of ``batch``, and the regularizers; differentiable.

        Raises:
            DyngsError: the picture's frame has no pose.
        """
        row = self._rows.get(-1 if batch.frame is None else batch.frame)
        if row is None:
            raise DyngsError(f"view {batch.name!r}: no body parameters for frame {batch.frame}")
        clip, skeleton = self.subject.footage.clip, self.subject.skeleton
        penalties = self._penalties(parameters)
        pose_dirs = None
        if self._refines(step):
            learned = self.corrections.learned
            pose_dirs = self.corrections.pose_dirs
            posing, skeleton = corrected_pose(learned, clip, row), corrected_skeleton(learned, skeleton)
            weights = corrected_weights(learned, self.anchors, len(skeleton.joints))
            penalties |= self.corrections.penalties()
        else:
            posing = frame_pose(clip, row)
            weights = self._constant_weights()
        offsets = rest_offsets(self.anchors, weights, posing, self.subject.shapes, pose_dirs)
        moved = pose_gaussians(parameters, weights, skeleton, posing, offsets)
        penalties |= self._between_neighbours(parameters, moved, float(clip.scale[row]), step)
        return Drawn(moved, penalties, Frame(parameters.means, posing.rotations[0]))

    def after_step(self, parameters: Gaussians, step: int, result: EditResult | None) -> int:
        """Rows left out for bad gradients; optimizes the corrections, follows ``result``."""
        left_out = 0
        if self._refines(step):
            progress = self.rates.progress(step, since=self.refines_from)
            left_out = self.corrections.learned.step(step - self.refines_from, progress)
        if result is not None and result.edit is not None:
            self.anchors = self.anchors.select(result.edit.source)
            self.corrections.follow(result.edit.source, result.edit.is_new)
            self._given_weights = self._near = None
        return left_out

    def edit(self, parameters: Gaussians, step: int) -> EditResult | None:
        """The set of Gaussians is left to the strategy."""
        return None

    def num_moving(self, num_gaussians: int) -> int:
        """All of them move."""
        return num_gaussians

    def state(self) -> dict[str, Tensor]:
        """Everything that the avatar needs besides its Gaussians: no file is read to draw it."""
        clip = self.subject.footage.clip
        state = {f"learned.{name}": x for name, x in self.corrections.learned.state().items()}
        state |= {f"anchors.{name}": x for name, x in self.anchors.tensors().items()}
        state |= {f"clip.{name}": getattr(clip, name) for name in ("times", "poses", "trans", "scale")}
        state |= {"joints": self.subject.skeleton.joints, "parents": torch.tensor(self.subject.skeleton.parents)}
        if self.subject.shapes is not None:
            shapes = self.subject.shapes
            state |= {"shapes.directions": shapes.directions.half(), "shapes.faces": shapes.faces.int()}
        return state if self._near is None else state | {"near": self._near}

    def load_state(self, state: dict[str, Tensor]) -> None:
        prefix = "anchors."
        self.anchors = Anchors(**{k.removeprefix(prefix): x for k, x in state.items() if k.startswith(prefix)})
        prefix = "learned."
        self.corrections.learned.load_state(
            {k.removeprefix(prefix): x for k, x in state.items() if k.startswith(prefix)},
            dict.fromkeys(("weights", "pose_dirs"), len(self.anchors)),
        )
        self._near, self._given_weights = state.get("near"), None

    def _refines(self, step: int) -> bool:
        return self.options.refine and step > self.refines_from

    def _constant_weights(self) -> Tensor:
        if self._given_weights is None:
            self._given_weights = skinning_weights(self.anchors, len(self.subject.skeleton.joints))
        return self._given_weights

    def _penalties(self, parameters: Gaussians) -> dict[str, Tensor]:
        """Gaussians should stay near their scaffolds, and near the size of their texels."""
        terms, options = {}, self.options
        if options.offset_weight > 0:
            away = (parameters.means - self.anchors.points) / CENTIMETRE
            terms["offset"] = options.offset_weight * away.square().sum(1).mean()
        if options.scale_weight > 0:
            longer = parameters.log_scales - self.anchors.size.log()[:, None]
            terms["scale"] = options.scale_weight * longer.clamp_min(0).square().sum(1).mean()
        return terms

    def _between_neighbours(
        self, parameters: Gaussians, moved: Gaussians, scale: float, step: int
    ) -> dict[str, Tensor]:
        """What neighbours at rest should have in common, in cm^2; in each step for one of the five neighbours.

        Rigidity: distances do not change. Smoothness: offsets from the scaffold are alike.
        """
        options = self.options
        if options.rigidity == 0 and options.smoothness == 0:
            return {}
        if self._near is None:
            self._near = nearest_neighbours(parameters.means, NEIGHBOURS)
        if not self._near.shape[1]:
            return {}
        near = self._near[:, step % self._near.shape[1]]
        terms = {}
        if options.rigidity > 0:
            before, after = (_lengths(x - x.index_select(0, near)) for x in (parameters.means, moved.means))
            strain = (after / scale - before) / CENTIMETRE
            terms["rigidity"] = options.rigidity * strain.square().mean()
        if options.smoothness > 0:
            away = (parameters.means - self.anchors.points) / CENTIMETRE
            terms["smoothness"] = options.smoothness * (away - away.index_select(0, near)).square().sum(1).mean()
        return terms


def _lengths(vectors: Tensor) -> Tensor:
    """(N,) lengths, with a gradient of 0 at 0."""
    return (vectors.square().sum(1) + 1e-12).sqrt()
