"""The human scene: Gaussians on a body template at rest, which its skeleton poses as a clip says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from dyngs.config import HumanModel
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import Frame
from dyngs.gaussians.parameters import Parameters
from dyngs.gaussians.scene import GaussianTimeStep, Scene
from dyngs.human.avatar.anchors import Anchors, skinning_weights
from dyngs.human.avatar.corrections import (
    SharedCorrection,
    corrected_clip,
    corrected_pose,
    corrected_skeleton,
    corrected_weights,
    learned_light,
    new_corrections,
)
from dyngs.human.avatar.light import Light
from dyngs.human.avatar.posing import (
    BodyPose,
    PoseBlendShapes,
    Skeleton,
    frame_pose,
    pose_gaussians,
    rest_offsets,
)
from dyngs.human.avatar.validation import require_avatar, require_shapes
from dyngs.human.motion.clip import MotionClip
from dyngs.models.renderable import Renderable, clamped_time
from dyngs.state import Role, State, StateTensor, part_of, prefixed, with_role


@dataclass(frozen=True, kw_only=True)
class HumanScene(Scene):
    """N Gaussians at rest, m, and a person who moves as a clip says.

    Attributes:
        anchors: of the Gaussians, with the template's weights.
        skeleton: of the template in the person's shape; clips are given for it.
        clip: that of training, as it was given.
        learned: corrections to all of these, see ``new_corrections``.
        shapes: the template's pose blend shapes, or None.
        played: another clip to play, given as that of training was; None: that of training, corrected frame by frame.
    """

    anchors: Anchors
    skeleton: Skeleton
    clip: MotionClip
    learned: Parameters
    shapes: PoseBlendShapes | None = None
    played: MotionClip | None = None

    @staticmethod
    def restored(options: HumanModel, gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        """Return the scene of what ``state`` returned; it plays the clip of training.

        Raises:
            KeyError: a tensor is missing.
            ValueError: one is not as the others and the options have it.
        """
        tensors = dict(tensors)
        tensors.setdefault(
            "learned.weights", torch.zeros_like(tensors["anchors.weights"])
        )  # files hold the sum of both
        require_avatar(gaussians, tensors)
        anchors = Anchors(**{field.name: tensors[f"anchors.{field.name}"] for field in fields(Anchors)})
        clip = MotionClip(*(tensors[f"clip.{name}"] for name in ("times", "poses", "trans", "scale")))
        skeleton = Skeleton(tensors["joints"], tuple(tensors["parents"].tolist()))
        own = part_of(tensors, "learned")
        learned = new_corrections(options, clip, skeleton, anchors, own.get("normals")).restored(own)
        return HumanScene(
            gaussians=gaussians,
            anchors=anchors,
            skeleton=skeleton,
            clip=clip,
            learned=learned,
            shapes=stored_shapes(tensors),
        )

    @property
    def times(self) -> tuple[float, ...]:
        return tuple(self.moves_as.times.tolist())

    @property
    def is_static(self) -> bool:
        """Whether the clip that is played has one pose."""
        return len(self.clip if self.played is None else self.played) == 1

    @property
    def rows(self) -> Tensor:
        """All of them: a person moves as a whole."""
        return torch.arange(len(self), device=self.gaussians.means.device)

    @property
    def num_moving(self) -> int:
        return len(self)

    @property
    def num_motion_values(self) -> int:
        return self.learned.num_values

    @property
    def weights(self) -> Tensor:
        """(N, J) skinning weights as they were learned."""
        if "weights" not in self._derived:
            with torch.no_grad():
                self._derived["weights"] = corrected_weights(self.learned, self.anchors, len(self.skeleton.joints))
        return self._derived["weights"]

    @property
    def learned_skeleton(self) -> Skeleton:
        """With joints where they were learned to be."""
        with torch.no_grad():
            return corrected_skeleton(self.learned, self.skeleton)

    @property
    def pose_dirs(self) -> Tensor | None:
        """(N, 27) learned offsets that depend on the pose, or None."""
        return self.learned["pose_dirs"].detach() if "pose_dirs" in self.learned else None

    @property
    def light(self) -> Light | None:
        """The learned light, or None."""
        found = learned_light(self.learned)
        return None if found is None else Light(found.normals.detach(), found.factors.detach())

    @property
    def fit(self) -> SharedCorrection:
        """The correction of all poses."""
        return SharedCorrection(self.learned["turns"].detach(), float(self.learned["log_scale"].detach()))

    @property
    def moves_as(self) -> MotionClip:
        """The clip that is played, with what was learned about the person applied."""
        if "clip" not in self._derived:
            poses, trans = self.learned["poses"].detach(), self.learned["trans"].detach()
            self._derived["clip"] = (
                corrected_clip(self.fit, self.clip, poses, trans)
                if self.played is None
                else corrected_clip(self.fit, self.played)
            )
        return self._derived["clip"]

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the person at ``time`` of the clip, clamped to it; None is the first moment.

        Who keeps one pose is posed once, but for gradients.
        """
        if not self.is_static or torch.is_grad_enabled():
            return self._posed(time)
        if "posed" not in self._derived:
            self._derived["posed"] = self._posed(None)
        return replace(self._derived["posed"], time=clamped_time(time))

    def _posed(self, time: float | None) -> GaussianTimeStep:
        now = clamped_time(time)
        return self.in_pose(frame_pose(self.moves_as.at(now), 0), now)

    def in_pose(self, posing: BodyPose, time: float) -> GaussianTimeStep:
        """Return the person in a pose, at ``time`` in [0, 1] for what depends on it; differentiable in the pose."""
        offsets = rest_offsets(self.anchors, self.weights, posing, self.shapes, self.pose_dirs)
        gaussians = pose_gaussians(self.gaussians, self.weights, self.learned_skeleton, posing, offsets, self.light)
        return GaussianTimeStep(gaussians, time, Frame(self.gaussians.means, posing.rotations[0]))

    def in_frame(self, row: int, given_weights: Tensor | None = None) -> tuple[Gaussians, BodyPose]:
        """Return the Gaussians in frame ``row`` of the clip of training; differentiable in all that is learned.

        Args:
            row: of the clip.
            given_weights: (N, J) of ``skinning_weights``; then nothing that was learned about the body is applied.
        """
        skeleton, pose_dirs, light = self.skeleton, None, None
        if given_weights is None:
            posing, skeleton = corrected_pose(self.learned, self.clip, row), corrected_skeleton(self.learned, skeleton)
            weights = corrected_weights(self.learned, self.anchors, len(skeleton.joints))
            pose_dirs, light = self.learned.get("pose_dirs"), learned_light(self.learned)
        else:
            posing, weights = frame_pose(self.clip, row), given_weights
        offsets = rest_offsets(self.anchors, weights, posing, self.shapes, pose_dirs)
        return pose_gaussians(self.gaussians, weights, skeleton, posing, offsets, light), posing

    def given_weights(self) -> Tensor:
        """Return (N, J) skinning weights of the template."""
        return skinning_weights(self.anchors, len(self.skeleton.joints))

    def edited(self, edit: TopologyEdit) -> HumanScene:
        return replace(
            self,
            gaussians=self.gaussians.edited(edit),
            anchors=self.anchors.select(edit.source),
            learned=self.learned.edited(Role.PER_GAUSSIAN, edit),
        )

    def part(self, which: str) -> HumanScene:
        """Return all of it, or nothing: a person moves as a whole."""
        count = len(self) if (which == "still") == self.is_static else 0
        return self.select(torch.arange(count, device=self.gaussians.means.device))

    def playing(self, clip: MotionClip) -> HumanScene:
        """Return the same person in another clip, whose poses are given as those of training were.

        What was learned about all poses is applied: the person's size, and how the joints are turned.
        """
        return replace(self, played=clip)

    def drawing_state(self) -> State:
        """Return what drawing needs; learned corrections of skinning weights are applied to them."""
        state = super().drawing_state()
        corrections = state.pop("model.learned.weights").tensor
        if bool(corrections.any()):
            fractions = self.anchors.weights * corrections.exp()
            weights = StateTensor(fractions / fractions.sum(1, keepdim=True), Role.PER_GAUSSIAN)
            state["model.anchors.weights"] = weights
        return state

    def _model_state(self) -> State:
        """Return everything that the avatar needs besides its Gaussians: no file is read to draw it."""
        clip, skeleton = self.clip, self.skeleton
        state = prefixed("learned", self.learned.state())
        state |= prefixed("anchors", with_role(self.anchors.tensors(), Role.PER_GAUSSIAN))
        given = {f"clip.{name}": getattr(clip, name) for name in ("times", "poses", "trans", "scale")}
        given |= {"joints": skeleton.joints, "parents": torch.tensor(skeleton.parents, device="cpu")}
        if self.shapes is not None:
            given |= {"shapes.directions": self.shapes.directions.half(), "shapes.faces": self.shapes.faces.int()}
        return state | {name: StateTensor(x, Role.SHARED) for name, x in given.items()}


def avatar_of(scene: Renderable) -> HumanScene | None:
    """Return ``scene`` if it is a person, who can be posed; None for any other scene."""
    return scene if isinstance(scene, HumanScene) else None


def stored_shapes(tensors: Mapping[str, Tensor]) -> PoseBlendShapes | None:
    """Return the pose blend shapes of a state, if there are any."""
    if "shapes.directions" not in tensors:
        return None
    require_shapes(tensors["shapes.directions"], tensors["shapes.faces"], len(tensors["joints"]))
    return PoseBlendShapes(tensors["shapes.directions"].float(), tensors["shapes.faces"].long())
