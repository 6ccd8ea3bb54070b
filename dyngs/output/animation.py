"""A trained person in another motion or in the rest pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.config import HumanModel
from dyngs.errors import DyngsError
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.human.motion.clip import motion_clip
from dyngs.human.motion.placement import place_like, rest_clip
from dyngs.human.template.load import load_template
from dyngs.runs.checkpoint import LoadedRun


@dataclass(frozen=True)
class AnimatedRun:
    """A run whose person performs another motion, and the frame rate of the motion."""

    run: LoadedRun
    fps: float


def with_motion(run: LoadedRun, path: Path) -> AnimatedRun:
    """Return the run with its person in the motion of a file (AMASS, SMPL-X, BVH, glTF or VRM animation).

    A file with ``scale`` is a fit to this person in the world of the capture; any other motion is adapted to the size,
    place and up direction of the person.

    Raises:
        DyngsError: the run is not of a person, or the file cannot be read.
    """
    from dyngs.human.motion.read import read_motion  # late: scipy's rotations, which no other drawing needs

    scene, model = _avatar(run, f"--motion {path}")
    motion = read_motion(path, load_template(model))
    if motion.poses.shape[1] != len(scene.skeleton.joints):
        motion = motion.for_joints(len(scene.skeleton.joints))
    clip = motion_clip(motion)
    if bool((motion.scale != 1).any()):
        clip = replace(clip, trans=clip.trans - clip.trans.new_tensor(run.info.world_offset))
    else:
        clip = place_like(clip, scene.clip, scene.skeleton.joints, scene.skeleton.parents)
    return AnimatedRun(replace(run, renderable=scene.playing(clip)), motion.fps)


def in_rest_pose(run: LoadedRun) -> LoadedRun:
    """Return the run with its person in the rest pose of the template, upright on the floor.

    Raises:
        DyngsError: the run is not of a person.
    """
    scene, _ = _avatar(run, "--pose rest")
    rest = rest_clip(scene.clip, scene.skeleton.joints, scene.skeleton.parents)
    return replace(run, renderable=scene.playing(rest))


def _avatar(run: LoadedRun, wanted: str) -> tuple[HumanScene, HumanModel]:
    scene, model = avatar_of(run.scene), run.config.model
    if scene is None or not isinstance(model, HumanModel):
        raise DyngsError(f"{wanted} needs the run of a person (model.kind=human), this one is {run.config.model.kind}")
    return scene, model
