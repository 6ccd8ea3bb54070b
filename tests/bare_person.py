"""A person on the free template without training: Gaussians on its texels, in colours of their
places."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.core.conventions import SH_C0
from dyngs.human.avatar.posing import Skeleton, new_corrections, texel_gaussians
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import MotionClip
from dyngs.runs.checkpoint import CheckpointInfo, LoadedRun

RESOLUTION = 64


@cache
def template() -> BodyTemplate:
    return default_template()


@cache
def atlas(resolution: int = RESOLUTION) -> Texels:
    return atlas_texels(template(), resolution)


def bands(points: Tensor) -> Tensor:
    """Colours (P, 3) that change smoothly: red from foot to head, green from right to left, blue
    from back to front."""
    x, y, z = points.unbind(-1)
    return torch.stack([0.5 + 0.4 * y, 0.5 + 0.4 * x, 0.5 + 1.5 * z], dim=-1).clamp(0.05, 0.95)


def random_clip(frames: int = 3, scale: float = 1.0, seed: int = 0) -> MotionClip:
    """Poses of all 55 joints by up to about half a radian."""
    make = torch.Generator().manual_seed(seed)
    return MotionClip(
        times=torch.linspace(0, 1, frames, dtype=torch.float64)
        if frames > 1
        else torch.zeros(1, dtype=torch.float64),
        poses=torch.rand(frames, 55, 3, generator=make) - 0.5,
        trans=torch.rand(frames, 3, generator=make),
        scale=torch.full((frames,), scale),
    )


def bare_scene(
    clip: MotionClip | None = None,
    colours: Callable[[Tensor], Tensor] = bands,
    resolution: int = RESOLUTION,
    light: bool = False,
) -> HumanScene:
    """Opaque discs on the skin; the joints are moved, the pose turned and the size changed by what
    was learned."""
    body = template()
    texels = atlas(resolution)
    gaussians, anchors = texel_gaussians(texels, [0.0], 0)
    gaussians = gaussians.replace(
        sh=((colours(anchors.points) - 0.5) / SH_C0)[:, None],
        logit_opacities=torch.full_like(gaussians.logit_opacities, 4.0),
    )
    clip = random_clip() if clip is None else clip
    skeleton = Skeleton(body.joints, body.parents)
    learned = new_corrections(clip, skeleton, anchors, texels.normals if light else None)
    make = torch.Generator().manual_seed(7)
    values = {name: x.detach().clone() for name, x in learned.values().items()}
    values["joints"] = 0.01 * torch.randn(55, 3, generator=make)
    values["turns"] = 0.05 * torch.randn(55, 3, generator=make)
    values["log_scale"] = torch.full((1,), 0.1)
    values["weights"] = 0.3 * torch.randn(values["weights"].shape, generator=make)
    return HumanScene(
        gaussians=gaussians,
        anchors=anchors,
        skeleton=skeleton,
        clip=clip,
        learned=learned.with_state(values),
    )


def bare_run(scene: HumanScene | None = None) -> LoadedRun:
    """A run with that scene, as if it were loaded."""
    info = CheckpointInfo(0, 1.0, (0.0, 0.0, 0.0), "white", "classic")
    config = Config(data=DataConfig(root=Path("nowhere")), model=HumanModel(resolution=RESOLUTION))
    return LoadedRun(config, bare_scene() if scene is None else scene, 0, 0.0, info)


def with_motion(run: LoadedRun, clip: MotionClip) -> LoadedRun:
    """The run with its person in another clip."""
    scene = run.scene
    assert isinstance(scene, HumanScene)
    return replace(run, renderable=scene.with_motion(clip))
