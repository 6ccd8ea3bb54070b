"""Avatar scene: Gaussians on a body template in the rest pose, animated by a motion clip."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.state import Role, State, StateTensor, add_prefix, select_prefix, with_role
from dyngs.core.tensor_checks import (
    require_indices,
    require_positive,
    require_tensor,
    require_times,
)
from dyngs.data.capture import Capture, Split
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.colour.network import RestPose
from dyngs.gaussians.optimizer import Parameters
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep
from dyngs.human.avatar.posing import (
    PER_FRAME,
    Anchors,
    BodyPose,
    Light,
    PoseBlendShapes,
    SharedCorrection,
    Skeleton,
    corrected_clip,
    corrected_pose,
    frame_pose,
    learned_light,
    new_corrections,
    pose_gaussians,
    skinning_weights,
)
from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.human.body.skinning import check_tree
from dyngs.human.motion.motion import (
    MotionClip,
    captured_motion,
    has_same_parameters,
    interpolate_linearly,
)
from dyngs.models.renderable import Posable, Renderable, clamp_time


@dataclass(frozen=True, kw_only=True, repr=False)
class HumanScene(GaussianScene, Posable):
    """Avatar of one person: N Gaussians in the rest pose, m, and the motion clip that it plays."""

    anchors: Anchors  # of the Gaussians, with the skinning weights of the template
    skeleton: Skeleton  # of the template in the person's shape; clips refer to it
    clip: MotionClip  # of the training frames, without corrections
    learned: Parameters  # corrections of all of these, see ``new_corrections``
    shapes: PoseBlendShapes | None = None  # of the template
    # Clip to play instead of the training clip; only shared corrections are applied to it.
    replacement_clip: MotionClip | None = None

    @staticmethod
    def from_state(gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        """Restore the scene from the tensors of ``state``; it plays the training clip. Raises
        KeyError or ValueError."""
        # Exported files hold the corrected weights only.
        tensors = {"learned.weights": torch.zeros_like(tensors["anchors.weights"]), **tensors}
        require_avatar(gaussians, tensors)
        anchors = Anchors(**select_prefix(tensors, "anchors"))
        clip = MotionClip(**select_prefix(tensors, "clip"))
        skeleton = Skeleton(tensors["joints"], tuple(tensors["parents"].tolist()))
        learned = select_prefix(tensors, "learned")
        corrections = new_corrections(clip, skeleton, anchors, learned.get("normals"))
        shapes = None
        if "shapes.directions" in tensors:
            shapes = PoseBlendShapes(
                tensors["shapes.directions"].float(), tensors["shapes.faces"].long()
            )
        return HumanScene(
            gaussians=gaussians,
            anchors=anchors,
            skeleton=skeleton,
            clip=clip,
            learned=corrections.with_state(learned),
            shapes=shapes,
        )

    @property
    def times(self) -> tuple[float, ...]:
        return tuple(self.played_clip.times.tolist())

    @property
    def is_static(self) -> bool:
        """True if the played clip has a single pose."""
        return len(self.clip if self.replacement_clip is None else self.replacement_clip) == 1

    @property
    def rows(self) -> Tensor:
        """All rows: a person moves as a whole."""
        return torch.arange(len(self), device=self.gaussians.means.device)

    @property
    def num_motion_values(self) -> int:
        return self.learned.num_values

    @property
    def weights(self) -> Tensor:
        """Skinning weights (N, J) with learned corrections."""
        if "weights" not in self._derived:
            with torch.no_grad():
                self._derived["weights"] = skinning_weights(
                    self.anchors, len(self.skeleton.joints), self.learned["weights"]
                )
        return self._derived["weights"]

    @property
    def learned_skeleton(self) -> Skeleton:
        """Skeleton with learned joint positions."""
        with torch.no_grad():
            joints = self.skeleton.joints + self.learned["joints"]
        return replace(self.skeleton, joints=joints)

    @property
    def light(self) -> Light | None:
        """Learned light, or None."""
        return learned_light(self.learned.values())

    @property
    def fit(self) -> SharedCorrection:
        """Learned correction shared by all poses."""
        return SharedCorrection(
            self.learned["turns"].detach(), float(self.learned["log_scale"].detach())
        )

    @property
    def left_out(self) -> tuple[str, ...]:
        """Warnings about what exported files cannot hold."""
        if self.light is None:
            return ()
        return ("the learned light is not exported; colours are those under uniform light",)

    @property
    def played_clip(self) -> MotionClip:
        """The played clip with learned corrections applied."""
        if "clip" not in self._derived:
            clip = self.replacement_clip
            own = ()
            if clip is None:
                clip = self.clip
                own = (self.learned[name] for name in PER_FRAME)
            self._derived["clip"] = corrected_clip(self.fit, clip, *own)
        return self._derived["clip"]

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the person at ``time`` of the clip, clamped to its range; None: the first frame.

        A static person is posed once, unless gradients are needed.
        """
        now = clamp_time(time)
        cached = self._derived.get("posed")
        if cached is not None and not torch.is_grad_enabled():
            return replace(cached, time=now)
        posed = self.time_step_in_pose(frame_pose(self.played_clip.at(now), 0), now)
        if self.is_static and not torch.is_grad_enabled():
            self._derived["posed"] = posed
        return posed

    def time_step_in_pose(self, posing: BodyPose, time: float) -> GaussianTimeStep:
        """Return the person in a pose, at ``time`` in [0, 1] for time-dependent colours;
        differentiable in the pose."""
        gaussians = self._posed(posing, self.weights, self.learned_skeleton, self.light)
        frame = RestPose(self.gaussians.means, posing.rotations[0])
        return GaussianTimeStep(gaussians, time, frame)

    def _posed(
        self, posing: BodyPose, weights: Tensor, skeleton: Skeleton, light: Light | None
    ) -> Gaussians:
        offsets = None
        if self.shapes is not None:
            offsets = self.shapes.offsets(self.anchors, posing.rotations)
        return pose_gaussians(self.gaussians, weights, skeleton, posing, offsets, light)

    def gaussians_in_frame(
        self, row: int, template_weights: Tensor | None = None
    ) -> tuple[Gaussians, BodyPose]:
        """Pose the Gaussians as in row ``row`` of the training clip; differentiable in all
        corrections.

        With ``template_weights`` (N, J) no correction is applied.
        """
        if template_weights is not None:
            posing = frame_pose(self.clip, row)
            return self._posed(posing, template_weights, self.skeleton, None), posing
        posing = corrected_pose(self.learned, self.clip, row)
        joints = self.skeleton.joints + self.learned["joints"]
        skeleton = replace(self.skeleton, joints=joints)
        weights = skinning_weights(self.anchors, len(skeleton.joints), self.learned["weights"])
        return self._posed(posing, weights, skeleton, learned_light(self.learned)), posing

    def template_weights(self) -> Tensor:
        """Return the skinning weights (N, J) of the template, without corrections."""
        return skinning_weights(self.anchors, len(self.skeleton.joints))

    def apply_edit(self, edit: TopologyEdit) -> HumanScene:
        return replace(
            self,
            gaussians=self.gaussians.apply_edit(edit),
            anchors=self.anchors.select(edit.source),
            learned=self.learned.apply_edit(Role.PER_GAUSSIAN, edit),
        )

    def with_motion(self, clip: MotionClip) -> HumanScene:
        """Return the same person playing another clip.

        Shared corrections (size, joint rotations) are applied to its poses, as to those of
        training.
        """
        return replace(self, replacement_clip=clip)

    def with_corrected_motion(self, clip: MotionClip) -> HumanScene:
        """Return the same person playing a clip that includes the shared corrections."""
        inverse = SharedCorrection(-self.fit.turns, -self.fit.log_scale)
        return self.with_motion(corrected_clip(inverse, clip))

    def body_up_direction(self) -> Tensor:
        from dyngs.human.motion.placement import up_direction  # needs scipy

        return up_direction(self.clip)

    def at_rest(self) -> HumanScene:
        from dyngs.human.motion.placement import rest_clip  # needs scipy

        return self.with_motion(rest_clip(self.clip, self.skeleton.joints, self.skeleton.parents))

    def placed(self, rotation: Tensor, scale: float, shift: Tensor) -> HumanScene:
        from dyngs.human.motion.placement import transform_clip  # needs scipy

        pelvis = self.learned_skeleton.joints[0] * math.exp(self.fit.log_scale)
        rotation = rotation.to(self.clip.trans)
        shift = shift.to(self.clip.trans)

        def transform(clip: MotionClip) -> MotionClip:
            return transform_clip(clip, rotation, scale, shift, pelvis)

        moved = replace(self, clip=transform(self.clip))
        if self.replacement_clip is None:
            return moved
        return moved.with_motion(transform(self.replacement_clip))

    def for_split(self, capture: Capture, split: Split) -> HumanScene:
        """Return the person in the motion of a split's views.

        The split ``pose``, and splits with body parameters of their own, play those. Others play
        the training clip with refined poses; frames that were left out of it play their own body
        parameters, with the refinements of the neighbouring training frames.
        """
        if capture.body is None:
            return self
        body_frames = capture.body[split]
        views = capture.splits[split]
        clip = captured_motion(capture.root, body_frames, views, self.skeleton.joints).clip
        if split == "pose" or not has_same_parameters(body_frames, capture.body["train"]):
            return self.with_motion(clip)
        if len(self.clip) == 1 or bool(torch.isin(clip.times, self.clip.times).all()):
            return self
        corrections = (
            interpolate_linearly(self.clip.times, self.learned[name].detach(), clip.times)
            for name in PER_FRAME
        )
        return self.with_corrected_motion(corrected_clip(self.fit, clip, *corrections))

    def drawing_state(self) -> State:
        """Return the tensors needed for rendering, with skinning weight corrections applied."""
        state = super().drawing_state()
        corrections = state.pop("model.learned.weights").tensor
        if bool(corrections.any()):
            fractions = self.anchors.weights * corrections.exp()
            weights = StateTensor(fractions / fractions.sum(1, keepdim=True), Role.PER_GAUSSIAN)
            state["model.anchors.weights"] = weights
        return state

    def _model_state(self) -> State:
        """Return all tensors besides the Gaussians; the avatar is rendered without other files."""
        clip = self.clip
        skeleton = self.skeleton
        state = add_prefix("learned", self.learned.state())
        state |= add_prefix("anchors", with_role(self.anchors.tensors(), Role.PER_GAUSSIAN))
        tensors = {
            "clip.times": clip.times,
            "clip.poses": clip.poses,
            "clip.trans": clip.trans,
            "clip.scale": clip.scale,
            "joints": skeleton.joints,
            "parents": torch.tensor(skeleton.parents, device="cpu"),
        }
        if self.shapes is not None:
            tensors |= {
                "shapes.directions": self.shapes.directions.half(),
                "shapes.faces": self.shapes.faces.int(),
            }
        return state | {name: StateTensor(x, Role.SHARED) for name, x in tensors.items()}


def initial_human_scene(
    gaussians: Gaussians,
    anchors: Anchors,
    skeleton: Skeleton,
    clip: MotionClip,
    shapes: PoseBlendShapes | None = None,
) -> HumanScene:
    """Return the scene of initial Gaussians on their ``anchors``, with zero corrections."""
    return HumanScene(
        gaussians=gaussians,
        anchors=anchors,
        skeleton=skeleton,
        clip=clip,
        learned=new_corrections(clip, skeleton, anchors),
        shapes=shapes,
    )


def as_human_scene(scene: Renderable) -> HumanScene | None:
    """Return ``scene`` if it is an avatar, else None."""
    return scene if isinstance(scene, HumanScene) else None


def require_avatar(gaussians: Gaussians, state: Mapping[str, Tensor]) -> None:
    """Validate the state of an avatar against its Gaussians. Raises KeyError or ValueError."""
    n = len(gaussians)
    j = len(state["joints"])
    f = len(state["clip.times"])
    terms = gaussians.sh.shape[1]
    parents = state["parents"]
    k = state["anchors.weights"].shape[-1]
    if not n or not f or j not in SMPLX_ROWS or terms not in (1, 4):
        raise ValueError(
            f"unsupported sizes: {n} Gaussians, {terms} harmonics, {j} joints, {f} frames"
        )
    check_tree(tuple(require_tensor("parents", parents, (j,), torch.int64).tolist()))
    require_times("clip.times", state["clip.times"])
    shapes = {
        "joints": (j, 3),
        "clip.poses": (f, j, 3),
        "clip.trans": (f, 3),
        "clip.scale": (f,),
        "anchors.weights": (n, k),
        "anchors.points": (n, 3),
        "anchors.barycentric": (n, 3),
        "anchors.size": (n,),
        "anchors.height": (n,),
        "anchors.uv": (n, 2),
    }
    if "learned.normals" in state:
        shapes["learned.normals"] = (n, 3)
    for name, shape in shapes.items():
        require_tensor(name, state[name], shape)
    require_positive("clip.scale", state["clip.scale"])
    weights = state["anchors.weights"]
    if bool((weights < 0).any()) or not bool((weights.sum(1) > 0).all()):
        raise ValueError("the skinning weights of a Gaussian are negative or sum to 0")
    faces = 2**31  # without blend shapes the number of triangles is not stored
    if "shapes.directions" in state:
        directions = state["shapes.directions"]
        require_tensor("shapes.directions", directions, (9 * (j - 1), None), torch.float16)
        vertices, remainder = divmod(directions.shape[1], 3)
        if remainder:
            raise ValueError("'shapes.directions' must have three columns per vertex")
        faces = len(state["shapes.faces"])
        require_indices("shapes.faces", state["shapes.faces"], (None, 3), vertices, torch.int32)
    require_indices("anchors.joints", state["anchors.joints"], (n, k), j)
    require_indices("anchors.face", state["anchors.face"], (n,), faces)
