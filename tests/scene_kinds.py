"""A small scene of every kind, as after training."""

from __future__ import annotations

import torch
from scenes import look_around
from tiny_fields import ALL_KINDS as FIELDS
from tiny_fields import cloud, stirred_field, tiny_options

from dyngs.core.camera import Cameras
from dyngs.core.state import State, select_prefix, strip_roles
from dyngs.deform.fields import OPEN_WINDOW, WindowedField
from dyngs.deform.keys import DynamicModel
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import Gaussians
from dyngs.gaussians.colour.network import ColourNetwork, robust_bounding_box
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.gaussians.visibility import VisibilityMasks
from dyngs.human.avatar.posing import PoseBlendShapes, Skeleton, texel_gaussians
from dyngs.human.avatar.scene import HumanScene, initial_human_scene
from dyngs.human.body.atlas import atlas_texels
from dyngs.human.body.body_reader import default_template
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import MotionClip
from dyngs.ops.perceptron import Layer
from dyngs.ops.shading import num_inputs

KINDS = ("static", *FIELDS, "windowed", "masked", "human")
MOVING = torch.tensor([1, 4, 5, 8])
SEEN_AT = (0.0, 0.5, 1.0)
PERSON = HumanModel(sh_degree=0)


def scene_of_kind(kind: str) -> GaussianScene:
    """Nine Gaussians with a 3D filter, of which four may move, or a person; ``masked`` is a
    hexplane with masks, ``windowed`` are nodes of which each Gaussian is there for a part of the
    clip. 4D Gaussians have spherical harmonics, others a colour network."""
    std = 0.01 + torch.arange(9.0) / 100
    if kind == "static":
        return StaticScene(gaussians=cloud(), filter_std=std, training_times=SEEN_AT)
    if kind == "human":
        return _person()
    masks = None
    if kind == "masked":
        seen = torch.rand(3, 9, generator=torch.Generator().manual_seed(1)) < 0.4
        masks = VisibilityMasks.pack(SEEN_AT, seen)
    field = stirred_field(_field(kind), len(MOVING))
    if kind == "windowed":
        field = WindowedField(field, len(MOVING))
        field.edges.data[:] = torch.tensor([[0.1, 0.4], [0.3, 1.2], [-0.1, 0.8], OPEN_WINDOW])
    return DynamicScene(
        gaussians=cloud(),
        training_times=SEEN_AT,
        field=field,
        moving=MOVING,
        filter_std=std,
        masks=masks,
        colour=None if kind == "gaussians_4d" else _network(),
    )


def restored(kind: str, state: State) -> GaussianScene:
    """The scene of what is stored, but for its colours."""
    tensors = {name: x.clone() for name, x in strip_roles(state).items()}
    gaussians = Gaussians.stored(select_prefix(tensors, "gaussians"))
    own = select_prefix(tensors, "model")
    if kind == "static":
        return StaticScene.from_state(gaussians, own)
    if kind == "human":
        return HumanScene.from_state(gaussians, own)
    return DynamicScene.from_state(DynamicModel(deform=tiny_options(_field(kind))), gaussians, own)


def onlooker() -> Cameras:
    """One camera that sees all of them."""
    intrinsics = torch.tensor([[30.0, 0, 18], [0, 30, 14], [0, 0, 1]])
    return Cameras(look_around(1, torch.float32), intrinsics[None], 36, 28)


def _field(kind: str) -> str:
    return {"masked": "hexplane", "windowed": "control_nodes"}.get(kind, kind)


def _network() -> ColourNetwork:
    generator = torch.Generator().manual_seed(5)
    inputs = num_inputs(uses_time=True, uses_normals=True)
    sizes = ((8, inputs), (3, 8))
    layers = [
        Layer(0.3 * torch.randn(size, generator=generator), torch.zeros(size[0])) for size in sizes
    ]
    return ColourNetwork(tuple(layers), robust_bounding_box(cloud().means), True, True)


def _person() -> HumanScene:
    generator = torch.Generator().manual_seed(1)
    body = default_template()
    gaussians, anchors = texel_gaussians(atlas_texels(body, 16), (0.0,), 0)
    gaussians = gaussians.replace(sh=torch.randn(gaussians.sh.shape, generator=generator))
    times = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    poses = torch.randn(3, 55, 3, generator=generator)
    clip = MotionClip(
        times, 0.3 * poses, 0.1 * torch.randn(3, 3, generator=generator), torch.ones(3)
    )
    directions = (
        (0.02 * torch.randn(9 * 54, 9, generator=torch.Generator().manual_seed(2))).half().float()
    )
    # of a body of three vertices
    shapes = PoseBlendShapes(directions, torch.arange(3).repeat(len(body.faces), 1))
    skeleton = Skeleton(body.joints, body.parents)
    scene = initial_human_scene(gaussians, anchors, skeleton, clip, shapes)
    for x in scene.learned.values().values():
        x += 0.05 * torch.randn(x.shape, generator=generator)
    return scene
