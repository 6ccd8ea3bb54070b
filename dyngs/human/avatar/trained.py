"""A trained avatar: Gaussians that play the clip they were trained on, or any other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from torch import Tensor

from dyngs.colour.network import ColourNetwork, Frame
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.avatar.corrections import SharedCorrection, corrected_clip, corrected_skeleton, corrected_weights
from dyngs.human.avatar.posing import PoseBlendShapes, Skeleton, frame_pose, pose_gaussians, rest_offsets
from dyngs.human.avatar.validation import require_avatar, require_shapes
from dyngs.human.motion.clip import MotionClip
from dyngs.rendering import Shader


@dataclass(frozen=True)
class AvatarScene:
    """A person who moves as a clip says.

    Attributes:
        gaussians: N Gaussians at rest, m.
        anchors: of the Gaussians, with the template's weights.
        weights: (N, J) learned skinning weights.
        skeleton: learned.
        given_joints: (J, 3) of the template, which clips are given for.
        fit: what was learned about poses.
        shapes: the template's pose blend shapes, or None.
        pose_dirs: (N, 27) learned offsets that depend on the pose, or None.
        clip: what is played, corrections included.
        given_clip: that of training, without corrections.
        num_field_values: how many numbers there are beside the Gaussians.
        colour: what colours them, by place and direction at rest; None: their harmonics.
    """

    gaussians: Gaussians
    anchors: Anchors
    weights: Tensor
    skeleton: Skeleton
    given_joints: Tensor
    fit: SharedCorrection
    shapes: PoseBlendShapes | None
    pose_dirs: Tensor | None
    clip: MotionClip
    given_clip: MotionClip
    num_field_values: int
    colour: ColourNetwork | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    @property
    def is_still(self) -> bool:
        """The clip has one pose: ``at`` returns the same at every time."""
        return len(self.clip) == 1

    @property
    def rows(self) -> Tensor:
        """(N,) indices of the Gaussians that move: of all of them."""
        return torch.arange(len(self))

    @property
    def moving_share(self) -> float:
        """All or none."""
        return 0.0 if self.is_still else 1.0

    @property
    def times(self) -> tuple[float, ...]:
        """Moments of the clip in [0, 1], ascending."""
        return tuple(self.clip.times.tolist())

    @torch.no_grad()
    def at(self, time: float | None) -> Gaussians:
        """The N Gaussians in the world at ``time`` of the clip, clamped to it; None is the first moment.

        Raises:
            DyngsError: the time is NaN.
        """
        posing = frame_pose(self.clip.at(time), 0)
        offsets = rest_offsets(self.anchors, self.weights, posing, self.shapes, self.pose_dirs)
        return pose_gaussians(self.gaussians, self.weights, self.skeleton, posing, offsets)

    def shader_at(self, time: float | None) -> Shader | None:
        """What colours the Gaussians of ``at(time)``; None: their harmonics."""
        if self.colour is None:
            return None
        return self.colour.shader(time, Frame(self.gaussians.means, frame_pose(self.clip.at(time), 0).rotations[0]))

    def part(self, which: Literal["moving", "still"]) -> AvatarScene:
        """All of it, or nothing: a person moves as a whole."""
        count = len(self) if (which == "still") == self.is_still else 0
        index = torch.arange(count)
        return replace(
            self,
            gaussians=self.gaussians.select(index),
            anchors=self.anchors.select(index),
            weights=self.weights[index],
            pose_dirs=None if self.pose_dirs is None else self.pose_dirs[index],
        )

    def playing(self, clip: MotionClip) -> AvatarScene:
        """The same person in another clip, whose poses are given as those of training were.

        What was learned about all poses is applied: the person's size, and how the joints are turned.
        """
        return replace(self, clip=corrected_clip(self.fit, clip))


def trained_avatar(gaussians: Gaussians, state: Mapping[str, Tensor]) -> AvatarScene:
    """The avatar of a checkpoint: its Gaussians, and the state of its model; it plays the clip of training.

    Raises:
        KeyError: the state lacks a tensor.
        ValueError: a tensor is not as the others have it.
    """
    require_avatar(gaussians, state)
    learned = {name: state[f"learned.{name}"] for name in ("poses", "trans", "turns", "joints", "log_scale", "weights")}
    anchors = Anchors(**{field.name: state[f"anchors.{field.name}"] for field in fields(Anchors)})
    clip = MotionClip(*(state[f"clip.{name}"] for name in ("times", "poses", "trans", "scale")))
    skeleton = Skeleton(state["joints"], tuple(state["parents"].tolist()))
    fit = SharedCorrection(learned["turns"], float(learned["log_scale"]))
    with torch.no_grad():
        return AvatarScene(
            gaussians=gaussians,
            anchors=anchors,
            weights=corrected_weights(learned, anchors, len(skeleton.joints)),
            skeleton=corrected_skeleton(learned, skeleton),
            given_joints=skeleton.joints,
            fit=fit,
            shapes=stored_shapes(state),
            pose_dirs=state.get("learned.pose_dirs"),
            clip=corrected_clip(fit, clip, learned["poses"], learned["trans"]),
            given_clip=clip,
            num_field_values=sum(x.numel() for x in (*learned.values(), *_optional(state, "learned.pose_dirs"))),
        )


def stored_shapes(state: Mapping[str, Tensor]) -> PoseBlendShapes | None:
    """The pose blend shapes of a state, if there are any."""
    if "shapes.directions" not in state:
        return None
    require_shapes(state["shapes.directions"], state["shapes.faces"], len(state["joints"]))
    return PoseBlendShapes(state["shapes.directions"].float(), state["shapes.faces"].long())


def _optional(state: Mapping[str, Tensor], name: str) -> tuple[Tensor, ...]:
    """The tensor of that name, if there is one."""
    return (state[name],) if name in state else ()
