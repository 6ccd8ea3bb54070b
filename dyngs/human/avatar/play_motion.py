"""Playing motion files with an avatar."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dyngs.core.errors import DyngsError
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.body_reader import load_template
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import motion_clip
from dyngs.human.motion.placement import place_like
from dyngs.human.motion.retarget import read_motion
from dyngs.models.checkpoint import CheckpointInfo
from dyngs.models.kind import PlayedMotion
from dyngs.models.renderable import Renderable


def play_motion(
    section: HumanModel, renderable: Renderable, info: CheckpointInfo, path: Path
) -> PlayedMotion:
    """Return the avatar animated by a motion file, see ``HasBody.in_motion``."""
    if not isinstance(renderable, HumanScene):
        raise DyngsError(f"{path}: motions can only be played by avatars (model.kind=human)")
    scene = renderable.to("cpu")
    motion = read_motion(path, load_template(section))
    if motion.poses.shape[1] != len(scene.skeleton.joints):
        motion = motion.for_joints(len(scene.skeleton.joints))
    is_fit = bool((motion.scale != 1).any())
    if is_fit:
        trans = motion.trans - motion.trans.new_tensor(info.world_offset)
        unit = info.world_scale
        motion = replace(motion, trans=trans / unit, scale=motion.scale / unit)
    clip = motion_clip(motion)
    if not is_fit:
        clip = place_like(clip, scene.clip, scene.skeleton.joints, scene.skeleton.parents)
    animated = scene.with_motion(clip)
    device = renderable.gaussians.means.device
    return PlayedMotion(animated.to(device), motion.fps, motion.notes)
