"""Tensors on a device: dataclasses moved as a whole, and results where their inputs are.

The device "meta", which holds no data, stands for an accelerator: every machine has it.
"""

from __future__ import annotations

from pathlib import Path

import torch
from motion_files import random_motion
from synthetic_bodies import model, write_npz

from dyngs.core.state import move_to_device
from dyngs.human.avatar.observations import same_part_neighbours
from dyngs.human.avatar.posing import (
    Skeleton,
    frame_pose,
    pose_blend_shapes,
    pose_gaussians,
    skinning_weights,
    texel_gaussians,
)
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body_reader import read_body
from dyngs.human.keys import HumanPredictorModel
from dyngs.human.motion.motion import motion_clip
from dyngs.human.motion.placement import place_like, place_on_floor, rest_clip
from dyngs.human.predict.ghg.network import AtlasNetwork


def test_no_tensor_is_made_on_the_default_device(tmp_path: Path) -> None:
    """With a default device without data, everything is computed where the inputs are."""
    body = read_body(write_npz(tmp_path / "x.npz", model("smplx")))
    motion = random_motion(3)
    generator = torch.Generator().manual_seed(0)
    with torch.device("meta"):
        gaussians, anchors = texel_gaussians(atlas_texels(body, 16), (0.0, 0.02), 1)
        clip = motion_clip(place_on_floor(motion, body))
        clip = place_like(
            clip, rest_clip(clip, body.joints, body.parents), body.joints, body.parents
        )
        pose = frame_pose(clip.at(0.3), 0)
        weights = skinning_weights(anchors, len(body.joints))
        found = pose_gaussians(gaussians, weights, Skeleton(body.joints, body.parents), pose)
        near = same_part_neighbours(found.means, weights)
        network = AtlasNetwork(HumanPredictorModel(), generator)
    for tensor in (
        *found.tensors().values(),
        *anchors.tensors().values(),
        near,
        *network.parameters(),
    ):
        assert tensor.device.type == "cpu"


def test_the_parts_of_an_avatar_move_to_a_device(tmp_path: Path) -> None:
    body = read_body(write_npz(tmp_path / "x.npz", model("smplx")))
    _, anchors = texel_gaussians(atlas_texels(body, 16), (0.0,), 0)
    shapes = pose_blend_shapes(body)
    assert shapes is not None
    skeleton = Skeleton(body.joints, body.parents)
    moved = move_to_device((body, anchors, shapes, skeleton), "meta")
    for x in (moved[0].weights, moved[1].points, moved[2].faces, moved[3].joints):
        assert x.device.type == "meta"
    clip = motion_clip(random_motion(2)).to(device="meta")
    assert (clip.poses.device.type, clip.times.device.type) == ("meta", "cpu")
