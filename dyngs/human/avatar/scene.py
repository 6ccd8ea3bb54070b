"""The human scene: Gaussians on a body template at rest, which its skeleton poses as a clip
says."""

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
    LIGHT_NOT_EXPORTED,
    Anchors,
    BodyPose,
    Light,
    PoseBlendShapes,
    SharedCorrection,
    Skeleton,
    corrected_clip,
    corrected_pose,
    corrected_skeleton,
    frame_pose,
    learned_light,
    new_corrections,
    pose_blend_offsets,
    pose_gaussians,
    skinning_weights,
)
from dyngs.human.body.joints import SMPLX_ROWS
from dyngs.human.body.skinning import check_tree
from dyngs.human.motion.motion import MotionClip, captured_motion, has_same_parameters
from dyngs.models.renderable import Posable, Renderable, clamp_time


@dataclass(frozen=True, kw_only=True)
class HumanScene(GaussianScene, Posable):
    """N Gaussians at rest, m, and a person who moves as a clip says."""

    anchors: Anchors  # of the Gaussians, with the template's weights
    skeleton: Skeleton  # of the template in the person's shape; clips are given for it
    clip: MotionClip  # that of training, as it was given
    learned: Parameters  # corrections to all of these, see ``new_corrections``
    shapes: PoseBlendShapes | None = None  # the template's pose blend shapes, or None
    # another clip to play, given as that of training was; None: that of training, corrected frame
    # by frame
    replacement_clip: MotionClip | None = None
    # (N,) in [0, 1] how far colours are what the training views showed, not filled; None: that was
    # not found out
    seen: Tensor | None = None

    @staticmethod
    def from_state(gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> HumanScene:
        """Return the scene of what ``state`` returned, playing the clip of training. Raises
        KeyError or ValueError."""
        tensors = dict(tensors)
        tensors.setdefault(
            "learned.weights", torch.zeros_like(tensors["anchors.weights"])
        )  # files hold the sum of both
        require_avatar(gaussians, tensors)
        anchors = Anchors(**select_prefix(tensors, "anchors"))
        clip = MotionClip(**select_prefix(tensors, "clip"))
        skeleton = Skeleton(tensors["joints"], tuple(tensors["parents"].tolist()))
        learned = select_prefix(tensors, "learned")
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
            learned=new_corrections(clip, skeleton, anchors, learned.get("normals")).with_state(
                learned
            ),
            shapes=shapes,
            seen=tensors.get("seen"),
        )

    @property
    def times(self) -> tuple[float, ...]:
        return tuple(self.played_clip.times.tolist())

    @property
    def is_static(self) -> bool:
        """Whether the clip that is played has one pose."""
        return len(self.clip if self.replacement_clip is None else self.replacement_clip) == 1

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
                self._derived["weights"] = skinning_weights(
                    self.anchors, len(self.skeleton.joints), self.learned["weights"]
                )
        return self._derived["weights"]

    @property
    def learned_skeleton(self) -> Skeleton:
        """With joints where they were learned to be."""
        with torch.no_grad():
            return corrected_skeleton(self.learned, self.skeleton)

    @property
    def light(self) -> Light | None:
        """The learned light, or None."""
        found = learned_light(self.learned)
        return None if found is None else Light(found.normals.detach(), found.factors.detach())

    @property
    def fit(self) -> SharedCorrection:
        """The correction of all poses."""
        return SharedCorrection(
            self.learned["turns"].detach(), float(self.learned["log_scale"].detach())
        )

    @property
    def left_out(self) -> tuple[str, ...]:
        """Notes about what files without learned light leave out."""
        return () if self.light is None else (LIGHT_NOT_EXPORTED,)

    @property
    def played_clip(self) -> MotionClip:
        """The clip that is played, with what was learned about the person applied."""
        if "clip" not in self._derived:
            poses = self.learned["poses"].detach()
            trans = self.learned["trans"].detach()
            self._derived["clip"] = (
                corrected_clip(self.fit, self.clip, poses, trans)
                if self.replacement_clip is None
                else corrected_clip(self.fit, self.replacement_clip)
            )
        return self._derived["clip"]

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the person at ``time`` of the clip, clamped to it; None is the first time step.

        Who keeps one pose is posed once, but for gradients.
        """
        now = clamp_time(time)
        kept = self._derived.get("posed")
        if kept is not None and not torch.is_grad_enabled():
            return replace(kept, time=now)
        posed = self.time_step_in_pose(frame_pose(self.played_clip.at(now), 0), now)
        if self.is_static and not torch.is_grad_enabled():
            self._derived["posed"] = posed
        return posed

    def time_step_in_pose(self, posing: BodyPose, time: float) -> GaussianTimeStep:
        """Return the person in a pose, at ``time`` in [0, 1] for what depends on it; differentiable
        in the pose."""
        gaussians = self._posed(posing, self.weights, self.learned_skeleton, self.light)
        frame = RestPose(self.gaussians.means, posing.rotations[0])
        return GaussianTimeStep(gaussians, time, frame)

    def _posed(
        self, posing: BodyPose, weights: Tensor, skeleton: Skeleton, light: Light | None
    ) -> Gaussians:
        offsets = pose_blend_offsets(self.anchors, posing, self.shapes)
        return pose_gaussians(self.gaussians, weights, skeleton, posing, offsets, light)

    def gaussians_in_frame(
        self, row: int, template_weights: Tensor | None = None
    ) -> tuple[Gaussians, BodyPose]:
        """Return the Gaussians in frame ``row`` of the clip of training; differentiable in all that
        is learned.

        With ``given_weights`` (N, J) nothing that was learned about the body is applied.
        """
        if template_weights is not None:
            posing = frame_pose(self.clip, row)
            return self._posed(posing, template_weights, self.skeleton, None), posing
        posing = corrected_pose(self.learned, self.clip, row)
        skeleton = corrected_skeleton(self.learned, self.skeleton)
        weights = skinning_weights(self.anchors, len(skeleton.joints), self.learned["weights"])
        return self._posed(posing, weights, skeleton, learned_light(self.learned)), posing

    def template_weights(self) -> Tensor:
        """Return (N, J) skinning weights of the template."""
        return skinning_weights(self.anchors, len(self.skeleton.joints))

    def apply_edit(self, edit: TopologyEdit) -> HumanScene:
        return replace(
            self,
            gaussians=self.gaussians.apply_edit(edit),
            anchors=self.anchors.select(edit.source),
            learned=self.learned.apply_edit(Role.PER_GAUSSIAN, edit),
            seen=None if self.seen is None else self.seen[edit.source],
        )

    def part(self, which: str) -> HumanScene:
        """Return all of it, or nothing: a person moves as a whole."""
        count = len(self) if (which == "static") == self.is_static else 0
        return self.select(torch.arange(count, device=self.gaussians.means.device))

    def with_motion(self, clip: MotionClip) -> HumanScene:
        """Return the same person in another clip, whose poses are given as those of training were.

        What was learned about all poses is applied: the person's size, and how the joints are
        turned.
        """
        return replace(self, replacement_clip=clip)

    def body_up_direction(self) -> Tensor:
        from dyngs.human.motion.placement import up_direction  # late: scipy

        return up_direction(self.clip)

    def at_rest(self) -> HumanScene:
        from dyngs.human.motion.placement import rest_clip  # late: scipy

        return self.with_motion(rest_clip(self.clip, self.skeleton.joints, self.skeleton.parents))

    def placed(self, rotation: Tensor, scale: float, shift: Tensor) -> HumanScene:
        from dyngs.human.motion.placement import moved  # late: scipy

        pelvis = self.learned_skeleton.joints[0] * math.exp(self.fit.log_scale)
        rotation = rotation.to(self.clip.trans)
        shift = shift.to(self.clip.trans)

        def there(clip: MotionClip) -> MotionClip:
            return moved(clip, rotation, scale, shift, pelvis)

        replacement_clip = None if self.replacement_clip is None else there(self.replacement_clip)
        return replace(self, clip=there(self.clip), replacement_clip=replacement_clip)

    def for_split(self, capture: Capture, split: Split) -> HumanScene:
        """Return the person as the views of a split show them.

        The split pose, and splits with body parameters of their own, have the poses of their files.
        Others show the clip of training with its refined poses, interpolated at times between.
        """
        if capture.body is None:
            return self
        own = capture.body[split]
        if split != "pose" and has_same_parameters(own, capture.body["train"]):
            return self
        views = capture.splits[split]
        return self.with_motion(
            captured_motion(capture.root, own, views, self.skeleton.joints).clip
        )

    def drawing_state(self) -> State:
        """Return what drawing needs; learned corrections of skinning weights are applied to
        them."""
        state = super().drawing_state()
        state.pop("model.seen", None)
        corrections = state.pop("model.learned.weights").tensor
        if bool(corrections.any()):
            fractions = self.anchors.weights * corrections.exp()
            weights = StateTensor(fractions / fractions.sum(1, keepdim=True), Role.PER_GAUSSIAN)
            state["model.anchors.weights"] = weights
        return state

    def _model_state(self) -> State:
        """Return everything that the avatar needs besides its Gaussians: no file is read to draw
        it."""
        clip = self.clip
        skeleton = self.skeleton
        state = add_prefix("learned", self.learned.state())
        state |= add_prefix("anchors", with_role(self.anchors.tensors(), Role.PER_GAUSSIAN))
        if self.seen is not None:
            state["seen"] = StateTensor(self.seen, Role.PER_GAUSSIAN)
        given = {
            "clip.times": clip.times,
            "clip.poses": clip.poses,
            "clip.trans": clip.trans,
            "clip.scale": clip.scale,
            "joints": skeleton.joints,
            "parents": torch.tensor(skeleton.parents, device="cpu"),
        }
        if self.shapes is not None:
            given |= {
                "shapes.directions": self.shapes.directions.half(),
                "shapes.faces": self.shapes.faces.int(),
            }
        return state | {name: StateTensor(x, Role.SHARED) for name, x in given.items()}


def first_scene(
    gaussians: Gaussians,
    anchors: Anchors,
    skeleton: Skeleton,
    clip: MotionClip,
    shapes: PoseBlendShapes | None = None,
) -> HumanScene:
    """Return the scene of the first Gaussians, on their ``anchors``: nothing is learned yet."""
    return HumanScene(
        gaussians=gaussians,
        anchors=anchors,
        skeleton=skeleton,
        clip=clip,
        learned=new_corrections(clip, skeleton, anchors),
        shapes=shapes,
    )


def as_human_scene(scene: Renderable) -> HumanScene | None:
    """Return ``scene`` if it is a person, who can be posed; None for any other scene."""
    return scene if isinstance(scene, HumanScene) else None


def require_avatar(gaussians: Gaussians, state: Mapping[str, Tensor]) -> None:
    """Check the state of an avatar against its Gaussians. Raises KeyError or ValueError."""
    n = len(gaussians)
    j = len(state["joints"])
    f = len(state["clip.times"])
    terms = gaussians.sh.shape[1]
    parents = state["parents"]
    k = state["anchors.weights"].shape[-1]
    if not n or not f or j not in SMPLX_ROWS or terms not in (1, 4):
        raise ValueError(f"{n} Gaussians of {terms} harmonics on {j} joints in {f} frames")
    if parents.is_floating_point() or tuple(parents.shape) != (j,):
        raise ValueError(
            f"'parents' is {parents.dtype} {tuple(parents.shape)}, not whole numbers ({j},)"
        )
    check_tree(tuple(parents.tolist()))
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
    if "seen" in state:
        shapes["seen"] = (n,)
    for name, shape in shapes.items():
        require_tensor(name, state[name], shape)
    require_positive("clip.scale", state["clip.scale"])
    weights = state["anchors.weights"]
    if bool((weights < 0).any()) or not bool((weights.sum(1) > 0).all()):
        raise ValueError("the skinning weights of a Gaussian are negative or sum to 0")
    faces = 2**31  # those of a template without shapes are not there
    if "shapes.directions" in state:
        directions = state["shapes.directions"]
        require_tensor("shapes.directions", directions, (9 * (j - 1), None), torch.float16)
        vertices, rest = divmod(directions.shape[1], 3)
        if rest:
            raise ValueError("'shapes.directions' has not three columns for each vertex")
        faces = len(state["shapes.faces"])
        require_indices("shapes.faces", state["shapes.faces"], (None, 3), vertices, torch.int32)
    require_indices("anchors.joints", state["anchors.joints"], (n, k), j)
    require_indices("anchors.face", state["anchors.face"], (n,), faces)
