"""A person drawn in its own poses, as images to fit to, and the same person with joints turned away
from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from dyngs.config import Config, DataConfig, OptimConfig, RunConfig, TrainConfig
from dyngs.core.camera import Cameras
from dyngs.core.metrics import psnr
from dyngs.data.loader import Image
from dyngs.human.avatar.posing import frame_pose
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import apply_transforms, joint_transforms
from dyngs.human.keys import HumanModel
from dyngs.human.motion.motion import MotionClip
from dyngs.training.new_trainer import build_trainer

WHITE = torch.ones(3)
SIZE = 64
MOVED = (
    "pelvis",
    "left_hip",
    "right_knee",
    "spine2",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "head",
)


class Shown:
    """Images in memory, as a loader has them."""

    def __init__(self, images: list[Image]) -> None:
        self._images = images
        self.times = tuple(image.time for image in images)

    def __getitem__(self, index: int) -> Image:
        return self._images[index]


def person_and_cameras(person: Path) -> tuple[HumanScene, list[Cameras]]:
    """A person of a few hundred Gaussians, which was not trained, and three cameras."""
    config = Config(
        data=DataConfig(root=person),
        model=HumanModel(resolution=24, sh_degree=0),
        optim=OptimConfig(),
        train=TrainConfig(steps=10),
        run=RunConfig(threads=1),
    )
    trainer = build_trainer(config)
    assert isinstance(trainer.model.scene, HumanScene)
    cameras = {
        tuple(x.cam_from_world.flatten().tolist()): x for x in (p.cameras for p in trainer.images)
    }
    grow = torch.tensor([SIZE / 32, SIZE / 32, 1.0])[:, None]
    larger = [Cameras(x.cam_from_world, grow * x.intrinsics, SIZE, SIZE) for x in cameras.values()]
    return trainer.model.scene, larger


def images_of(
    scene: HumanScene, cameras: list[Cameras], times: list[float], mask: Tensor | None = None
) -> list[Image]:
    found = []
    for time in times:
        for i, camera in enumerate(cameras):
            with torch.no_grad():
                drawn = scene.render(camera, time, background=torch.zeros(3))
            rgb = drawn.rgb[0].clamp(0, 1)
            found.append(Image(f"{time}_{i}", camera, rgb, drawn.alpha[0], mask, time))
    return found


def disturbed(scene: HumanScene) -> HumanScene:
    """The same person with some joints turned by 9 degrees about some axis, 3 cm from where it
    was."""
    random = torch.Generator().manual_seed(2)
    clip = scene.clip
    rows = [JOINT_NAMES.index(name) for name in MOVED]
    poses = clip.poses.clone()
    away = torch.randn(len(clip), len(rows), 3, generator=random)
    poses[:, rows] += 0.15 * away / away.norm(dim=2, keepdim=True)
    return scene.with_motion(
        replace(clip, poses=poses, trans=clip.trans + torch.tensor([0.03, 0.0, 0.0]))
    )


def joints_of(scene: HumanScene, clip: MotionClip, row: int) -> Tensor:
    posing = frame_pose(clip, row)
    skeleton = scene.learned_skeleton
    moved = joint_transforms(skeleton.joints, skeleton.parents, posing.rotations)
    return posing.scale * apply_transforms(moved, skeleton.joints)[:22] + posing.trans


def mean_psnr(scene: HumanScene, images: list[Image]) -> float:
    with torch.no_grad():
        drawn = [scene.render(x.cameras, x.time, background=WHITE).rgb[0] for x in images]
    return sum(psnr(a, x.composite(WHITE)) for a, x in zip(drawn, images, strict=True)) / len(
        images
    )
